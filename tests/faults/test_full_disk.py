"""A disk that fills while a map is exported: one line that names the file, exit code 2, and nothing half-written.

The limit on the size of a file (RLIMIT_FSIZE) stands for the disk: a write beyond it fails in any library, without a
file system of one's own.
"""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import predicted_scene
import pytest
import tiny_scene
from command_line import bench, error_of
from posed_config import configure

import semstab


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    root = tiny_scene.write(folder / "wall", models=("a",), frames=8)
    semstab.run(configure(root, models=["a"], backends=["numpy"], check=None), out=folder / "run", report=False)
    return folder / "run"


@contextlib.contextmanager
def room(size: int) -> Iterator[None]:
    """No file may be larger than so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def require_one_line(folder: Path, words: list[object], name: str) -> None:
    """It fails at each of several sizes, in one line about that file, and leaves what was there."""
    (folder / name).write_bytes(b"before")
    there = sorted(folder.rglob("*"))
    for size in (100, 1000, 1600):
        with room(size):
            said = error_of(*words, "--to", name, cwd=folder)
        assert said.startswith(f"error: {Path(name).stem}."), said
        assert (folder / name).read_bytes() == b"before"
        assert sorted(folder.rglob("*")) == there


@pytest.mark.parametrize("suffix", ["tif", "laz", "las", "ply", "csv", "parquet", "glb"])
def test_an_export_of_every_format(finished, tmp_path, suffix) -> None:
    require_one_line(tmp_path, ["export", finished], f"m.{suffix}")


def test_each_size_of_a_raster_and_of_laz_is_whole_or_refused(finished, tmp_path) -> None:
    """Also the last bytes: a library may write its data and lose what it writes about them."""
    for suffix in ("tif", "laz"):
        bench("export", finished, "--to", f"whole.{suffix}", cwd=tmp_path)
        whole = (tmp_path / f"whole.{suffix}").read_bytes()
        for size in np.linspace(1, len(whole), 24).astype(int):
            with room(int(size)):
                done = size == len(whole)
                bench("export", finished, "--to", f"m.{suffix}", cwd=tmp_path, code=0 if done else 2)
            assert (tmp_path / f"m.{suffix}").exists() == done
        assert len((tmp_path / f"m.{suffix}").read_bytes()) == len(whole)


@pytest.mark.parametrize("suffix", ["las", "laz", "ply"])
def test_a_cloud_that_is_classified_is_not_blamed(finished, tmp_path, suffix) -> None:
    bench("export", finished, "--to", f"cloud.{suffix}", cwd=tmp_path)
    require_one_line(tmp_path, ["export", finished, "--classify", f"cloud.{suffix}"], f"m.{suffix}")


def test_a_damaged_cloud_is_still_blamed(finished, tmp_path) -> None:
    bench("export", finished, "--to", "cloud.laz", cwd=tmp_path)
    content = bytearray((tmp_path / "cloud.laz").read_bytes())
    start = laspy.read(tmp_path / "cloud.laz").header.offset_to_point_data
    content[start + 60 : start + 400] = bytes(340)
    (tmp_path / "cloud.laz").write_bytes(content)
    said = error_of("export", finished, "--classify", "cloud.laz", "--to", "m.laz", cwd=tmp_path)
    assert said.startswith("error: cloud.laz: ")
    assert not (tmp_path / "m.laz").exists()


def test_images_of_annotation_tasks(tmp_path) -> None:
    root = predicted_scene.write(tmp_path / "flight")
    words = ["predict", "-m", "colour-clusters", "--data", root, "--quiet"]
    bench(*words, cwd=tmp_path)
    bench("--data", root, "--model", "colour-clusters", "--out", "run", "--voxel-size", "0.5", cwd=tmp_path)
    with room(600):
        said = error_of("export", "run", "--to", "tasks.json", "--format", "coco", cwd=tmp_path)
    assert "tasks_images/" in said
    assert not list((tmp_path / "tasks_images").iterdir())
    assert not (tmp_path / "tasks.json").exists()
