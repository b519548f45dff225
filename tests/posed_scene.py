"""A posed_folder with every kind of file, to open whole or to break, and the check that something fails in one line."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from posed_writer import write_posed

from semstab import Frame, Intrinsics
from semstab.datasets import open_dataset

H, W, K = 6, 8, 3
SETTINGS = {"classes": ["a", "b", "c"], "up_axis": "z"}


def rotation(seed):
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    Q = Q * np.sign(np.diag(R))
    return Q * np.linalg.det(Q)


def pose(k):
    T = np.eye(4)
    T[:3, :3] = rotation(k)
    T[:3, 3] = (4e5 + k, 5e6, 30)
    return T


def save_image(path: Path, array) -> None:
    Image.fromarray(array).save(path)


def write_scene(folder: Path, names=("frame1", "frame2", "frame10")) -> Path:
    """A whole scene: depth, pose, colour, labels of 'net', scores of 'net', ground truth."""
    sources = {name: [frame(k, name) for k in range(len(names))] for name in ("net", "gt", "net-scores")}
    return write_posed(folder, names, sources, **SETTINGS)


def frame(k: int, source: str) -> Frame:
    rng = np.random.default_rng(k)
    return Frame(
        index=k, depth=(rng.integers(500, 9000, (H, W)) / 1000).astype(np.float32),
        intrinsics=Intrinsics(10, 11, 3.5, 2.5), T_wc=pose(k), color=rng.integers(0, 255, (H, W, 3)).astype(np.uint8),
        labels=None if source == "net-scores" else np.full((H, W), (k + (source == "gt")) % K, np.uint8),
        scores=rng.dirichlet(np.ones(K), (H, W)).astype(np.float16) if source == "net-scores" else None,
    )  # fmt: skip


def say(folder: Path, **settings) -> None:
    (folder / "scene.yaml").write_text(yaml.safe_dump(SETTINGS | settings))


def opened(folder: Path, **options):
    dataset = open_dataset("posed_folder", {"root": folder, **options})
    return dataset.scene(dataset.scenes[0])


def first_frame(folder: Path, model="net", **options):
    return opened(folder, **options).frame(0, model)


def fails(kind, match, action, *args, **options) -> None:
    """`action(*args, **options)` raises `kind`, in one line that matches."""
    with pytest.raises(kind, match=match) as caught:
        action(*args, **options)
    assert "\n" not in str(caught.value)
