"""Which dataset a folder is of: every format as itself, near misses; and PATH alone on the command line."""

from __future__ import annotations

import shutil

import pytest
from command_line import bench, error_of
from dataset_writers import FORMATS, source

from semstab.datasets import recognise
from semstab.errors import DataError

CAMERA = ("--set", "dataset.options.intrinsics=[40,40,24,18]")


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_is_recognised_as_itself(name, tmp_path):
    form = FORMATS[name]
    form.write(tmp_path / "data" / "scene", source(form.scale))
    assert recognise(tmp_path / "data" / "scene")[0] == form.dataset
    found, why = recognise(tmp_path / "data")
    assert found == form.dataset
    assert why.endswith("1 scene")


def test_what_is_nearly_a_format_says_what_it_lacks(tmp_path):
    FORMATS["hololens"].write(tmp_path, source(1000))
    (tmp_path / "K.txt").unlink()
    shutil.rmtree(tmp_path / "depth")
    with pytest.raises(DataError, match=r"the nearest are hololens \(without depth/, K.txt\).*--dataset NAME"):
        recognise(tmp_path)
    (tmp_path / "empty").mkdir()
    assert recognise(tmp_path / "empty")[0] == "posed_folder"


@pytest.mark.parametrize(
    ("file", "said"),
    [("sequences/00/velodyne/000000.bin", "LiDAR scans in KITTI's layout"), ("a.pcd", "point clouds")],
)
def test_scans_are_named_as_what_they_are(tmp_path, file, said):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).touch()
    with pytest.raises(DataError, match=rf"holds {said} \(.*\), in no layout of scans that is read.*#scans"):
        recognise(tmp_path)


def test_a_word_that_is_neither_command_nor_path_gets_the_nearest_of_both(tmp_path):
    (tmp_path / "shelf").mkdir()
    neither = "is no command, and there is no such file or folder; "
    assert error_of("shelff", cwd=tmp_path).endswith(f"'shelff' {neither}did you mean 'shelf'?")
    assert error_of("shwo", cwd=tmp_path).endswith(f"'shwo' {neither}did you mean 'show'?")
    assert f"'elsewhere' {neither}commands: run, study," in error_of("elsewhere", cwd=tmp_path)


def test_a_finished_run_is_named_as_what_it_is(tmp_path):
    (tmp_path / "run/units").mkdir(parents=True)
    (tmp_path / "run/summary.json").touch()
    with pytest.raises(DataError, match=r"run: a finished run, no scene; semstab-bench show"):
        recognise(tmp_path / "run")


def test_a_path_alone_is_checked_and_run(tmp_path):
    FORMATS["tum"].write(tmp_path / "rgbd", source(5000))
    result = bench("check", tmp_path / "rgbd", *CAMERA, cwd=tmp_path)
    assert "read as tum (depth.txt, groundtruth.txt and rgb.txt; 1 scene)" in result.stderr
    assert "rgbd    " in result.stdout
    assert error_of(tmp_path / "nothing", cwd=tmp_path).endswith("nothing: there is no such folder")
    result = bench(tmp_path / "rgbd", *CAMERA, "--out", tmp_path / "run", cwd=tmp_path, code=2)
    assert "labels" in result.stderr  # there are none
