"""Annotation tasks: where frames disagree, in the view that shows it best, in files that annotation tools read."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import bench
from posed_writer import write_posed
from pycocotools.coco import COCO

import semstab
from semstab import Frame, Intrinsics
from semstab.datasets import open_dataset
from semstab.errors import ConfigError, DataError
from semstab.exports.annotation import outlined

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

W, H, SIZE = 192, 144, 0.1
K = Intrinsics(160, 160, 95.5, 71.5)
PATCHES = {1: (-0.8, -0.4, -0.4, 0.2), 2: (0.5, 0.7, -0.1, 0.1)}
"""x and y of two patches of a floor, metres, by the class that is contested there: 4 x 6 and 2 x 2 voxels."""

CAMERAS = [(0, 0, 3.0), (0.1, 0, 2.0), (0, 0.1, 3.0), (-0.1, 0, 3.0), (0, -0.1, 2.5), (0.1, 0.1, 3.5)]
"""x, y, height of each frame; of the second and the fourth one the labels are wrong on the patches."""

CLOSEST, SECOND = "frame1", "frame4"


def frame(k: int, *, blurred: bool = False, color: bool = True) -> Frame:
    """A view straight down; voxels lie between whole numbers, and the floor in their middle."""
    x, y, z = CAMERAS[k]
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = x, y, z + SIZE / 2
    v, u = np.mgrid[:H, :W]
    X, Y = x + (u - K.cx) / K.fx * z, y - (v - K.cy) / K.fy * z
    labels = np.zeros((H, W), np.uint8)
    for label, (left, right, low, high) in PATCHES.items():
        if k in (1, 3, 5)[: 3 if label == 1 else 2]:
            labels[(left < X) & (right > X) & (low < Y) & (high > Y)] = label
    grey = np.where((np.floor(X / 0.05) + np.floor(Y / 0.05)) % 2 > 0, 200, 60).astype(np.uint8)
    if blurred:
        grey = cv2.GaussianBlur(grey, (0, 0), 6)
    image = np.repeat(grey[..., None], 3, axis=2) if color else None
    return Frame(k, np.full((H, W), z, np.float32), K, T, labels=labels, color=image)


def run_of(folder: Path, *, blurred: int | None = None, color: bool = True) -> Path:
    frames = [frame(k, blurred=k == blurred, color=color) for k in range(len(CAMERAS))]
    names = [f"frame{k}" for k in range(len(CAMERAS))]
    scene = write_posed(folder / "floor", names, {"net": frames}, classes=["floor", "mat", "hole"], up_axis="z")
    semstab.run({
        "dataset": {"name": "posed_folder", "options": {"root": str(scene)}}, "voxel_size": SIZE, "taxonomy": None,
        "check": None, "check_geometry": False,
    }, out=folder / "run", report=False)  # fmt: skip
    return folder / "run"


@pytest.fixture(scope="module")
def floor(tmp_path_factory):
    return run_of(tmp_path_factory.mktemp("floor"))


def written(run: Path, folder: Path, **options) -> Path:
    path = folder / "tasks.json"
    semstab.export(run, path, task_format="coco", **options)
    return path


def opened(path: Path) -> COCO:
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(str(path))


def test_the_contested_place_is_found_and_outlined(floor, tmp_path):
    coco = opened(written(floor, tmp_path))
    first, second = coco.dataset["annotations"]
    assert (first["fused"], first["second"], second["second"]) == ("floor", "mat", "hole")
    assert (first["voxels"], second["voxels"], first["op"]) == (24, 4, 6)
    half, third = 1.0, -(2 * np.log2(1 / 3) + 4 * np.log2(2 / 3)) / 6
    assert first["score"] == pytest.approx(24 * half)
    assert second["score"] == pytest.approx(4 * third, abs=1e-3)
    np.testing.assert_allclose(first["center"], [-0.6, -0.1, 0.05], atol=1e-3)
    assert coco.imgs[first["image_id"]]["file_name"] == f"tasks_images/{CLOSEST}.jpg"
    contested = frame(1).labels
    for annotation, label in ((first, 1), (second, 2)):
        mask, true = coco.annToMask(annotation) > 0, contested == label
        assert (mask & true).sum() / (mask | true).sum() > 0.92  # to half a pixel
        assert annotation["area"] == pytest.approx(true.sum(), rel=0.1)
        low, size = np.array(annotation["bbox"][:2]), np.array(annotation["bbox"][2:])
        rows, columns = np.nonzero(true)
        np.testing.assert_allclose(
            [*low, *(low + size)], [columns.min(), rows.min(), columns.max(), rows.max()], atol=2
        )
    image = cv2.imread(str(tmp_path / "tasks_images" / f"{CLOSEST}.jpg"))
    assert np.abs(image.astype(int) - frame(1).color).mean() < 4


def test_the_best_view_is_large_frontal_and_sharp(floor, tmp_path):
    (first, *_) = json.loads(written(floor, tmp_path).read_text())["annotations"]
    assert len(first["views"]) == 5
    assert first["views"][0] == SECOND
    blurred = run_of(tmp_path / "blurred", blurred=1)
    coco = opened(written(blurred, tmp_path))
    assert coco.imgs[coco.anns[1]["image_id"]]["file_name"] == f"tasks_images/{SECOND}.jpg"


def test_at_most_so_many_of_these_classes(floor, tmp_path):
    assert len(json.loads(written(floor, tmp_path, most=1).read_text())["annotations"]) == 1
    with pytest.raises(ConfigError, match="no voxel with OP >= 1 and class hole"):
        written(floor, tmp_path, classes=["hole"])


def test_where_frames_agree_there_is_nothing_to_annotate(tmp_path):
    frames = [dataclasses.replace(frame(k), labels=np.zeros((H, W), np.uint8)) for k in range(3)]
    scene = write_posed(tmp_path / "same", ["a", "b", "c"], {"net": frames}, classes=["floor", "mat"])
    config = {"dataset": {"name": "posed_folder", "options": {"root": str(scene)}}, "voxel_size": SIZE, "check": None}
    semstab.run(config, out=tmp_path / "run", report=False)
    with pytest.raises(ConfigError, match="the frames disagree nowhere; there is nothing to annotate"):
        written(tmp_path / "run", tmp_path)
    assert not (tmp_path / "tasks.json").exists()


def test_frames_without_images_are_one_line(tmp_path):
    with pytest.raises(DataError, match="floor, frame0: the frame has no colour image to annotate"):
        written(run_of(tmp_path, color=False), tmp_path)


def test_the_command_says_what_it_wrote(floor, tmp_path):
    def said(to: str, kind: str, code: int = 0) -> str:
        done = bench("export", floor, "--to", to, "--format", kind, cwd=tmp_path, code=code)
        return done.stderr if code else done.stdout

    assert said("tasks.json", "coco").startswith("tasks.json: 2 tasks in 1 images, 28 bits of entropy")
    assert said("tasks.xml", "coco", code=2) == "error: tasks.xml: coco is a .json file\n"
    assert said("tasks.xml", "cvat", code=2).startswith("error: no format 'cvat'; write coco, which CVAT, ")


def test_an_outline_fills_gaps_and_leaves_specks_out():
    pixels = np.zeros((60, 80), bool)
    pixels[10:40:2, 10:50] = True  # depth in every second row
    pixels[50:52, 70:72] = True
    (outline,), mask = outlined(pixels, voxel=8, smallest=20)  # pixels
    assert mask[12:38, 12:48].all()
    assert not mask[45:].any()
    assert outline.min() >= 9


def test_tasks_hold_more_errors_than_their_images(tmp_path):
    """On the city: pixels whose class is not the truth, in the outlines and in all of the image."""
    config = {
        "dataset": {"name": "city", "options": {"width": 96, "height": 54, "frames": 16}}, "scenes": ["scene0"],
        "models": ["sim-flicker"], "voxel_size": 0.5, "taxonomy": None, "check": None, "check_geometry": False,
    }  # fmt: skip
    semstab.run(config, out=tmp_path / "run", report=False)
    coco = opened(written(tmp_path / "run", tmp_path, most=100))
    scene = open_dataset("city", config["dataset"]["options"]).scene("scene0")
    names = {f"tasks_images/{scene.image_name(i)}.jpg": i for i in range(16)}
    held, whole = [], []
    for annotation in coco.dataset["annotations"]:
        index = names[coco.imgs[annotation["image_id"]]["file_name"]]
        true, said = (scene.frame(index, source).labels for source in ("gt", "sim-flicker"))
        mask = coco.annToMask(annotation) > 0
        held.append((true != said)[mask])
        whole.append((true != said).ravel())
    assert np.concatenate(held).mean() > 1.25 * np.concatenate(whole).mean()
