"""What new readers stumbled over: failures in a backend of one's own, runs that lose models, filters over all."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_scene
from command_line import bench, error_of

import semstab
from semstab.report.tables import tables

BACKENDS = """
from semstab.backends.numpy_reference import NumpyReference


class Raises(NumpyReference):
    def integrate(self, frame):
        return {}["opp"]


class Nothing(NumpyReference):
    def integrate(self, frame):
        super().integrate(frame)


class Sized:
    def __init__(self, size):
        pass
"""


@pytest.fixture
def wall(tmp_path):
    tiny_scene.write(tmp_path / "wall")
    (tmp_path / "mine.py").write_text(BACKENDS)
    return tmp_path


@pytest.mark.parametrize(("name", "line"), [
    ("Raises", "KeyError: 'opp' (mine.py, line 7)"),
    ("Nothing", "backend 'Nothing': integrate returned a NoneType; it returns a semstab.data.results.FrameReport"),
    ("Sized", "backend 'Sized' cannot be made with voxel_size and num_classes (missing a required argument: 'size')"),
])  # fmt: skip
def test_a_backend_that_fails_says_where(wall, name, line) -> None:
    done = bench("--data", "wall", "-b", f"mine.py:{name}", "-m", "a", "--out", "out", cwd=wall, code=2)
    assert line in done.stderr


def test_a_run_without_a_finished_unit_is_shown_as_such(wall) -> None:
    bench("--data", "wall", "-b", "mine.py:Raises", "-m", "a", "--out", "out", cwd=wall, code=2)
    lines = bench("show", "out", cwd=wall, code=2).stderr.strip().splitlines()
    assert lines[0] == "failed: wall, a: KeyError: 'opp' (mine.py, line 7)"
    assert lines[-1].startswith("error: out: no unit finished")


def test_units_that_failed_are_counted_in_the_captions(wall) -> None:
    (wall / "wall/labels/b/0001.png").write_bytes(b"damaged")
    bench("--data", "wall", "--out", "out", cwd=wall, code=2)
    result = semstab.load_result(wall / "out")
    assert all(table.caption.endswith("Without 1 unit that failed.") for table in tables(result))


def test_a_run_of_fewer_models_says_which_it_no_longer_has(wall) -> None:
    bench("--data", "wall", "--out", "out", cwd=wall)
    done = bench("--data", "wall", "--out", "out", "-m", "a", cwd=wall)
    assert "out: b is no longer in the summary; name them, too" in done.stderr
    assert semstab.load_result(wall / "out").models == ("a",)
    done = bench("--data", "wall", "--out", "out", cwd=wall)
    assert "finished earlier: 2 of 2 units" in done.stderr
    assert "no longer" not in done.stderr


def test_filters_are_put_over_labels_and_scores_of_one_name(wall) -> None:
    for k in range(tiny_scene.FRAMES):
        scores = np.full((3, tiny_scene.HEIGHT, tiny_scene.WIDTH), 0.25, np.float32)
        scores[0] = 0.5
        path = wall / f"wall/scores/a/{k:04d}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, scores)
    bench("--data", "wall", "--filter", "ema:0.6", "--out", "out", cwd=wall)
    names = set(semstab.load_result(wall / "out").models)
    assert names == {"a-ema-0.6", "b-ema-0.6", "a-scores-ema-0.6-scores"}


def test_a_single_value_of_a_sweep_is_told_to_be_a_list(wall) -> None:
    (wall / "mine.yaml").write_text("dataset: city\nsweeps: {voxel_size: 0.5}\n")
    line = error_of("study", "mine.yaml", cwd=wall)
    assert "sweeps.voxel_size: write a list of values, for example [0.1, 0.2] (got 0.5)" in line


def test_ids_that_count_from_one_are_named_so(wall) -> None:
    import cv2

    for path in (wall / "wall/labels/a").glob("*.png"):
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) + 1)
    done = bench("check", "--data", "wall", "-m", "a", cwd=wall, code=2)
    text = " ".join((done.stdout + done.stderr).split())
    assert "the ids may count from 1: write them from 0" in text


READER = """
from semstab.datasets.posed_folder import PosedFolder


class Mine(PosedFolder):
    pass


class Half:
    pass


def function(options):
    pass
"""


def test_a_reader_is_named_by_its_file_and_its_content_counts(wall) -> None:
    (wall / "reader.py").write_text(READER)
    words = ("--dataset", "reader.py:Mine", "--data", "wall", "-m", "a", "--out", "out")
    bench(*words, cwd=wall)
    (first,) = (wall / "out/units").iterdir()
    bench(*words, cwd=wall)
    assert [*(wall / "out/units").iterdir()] == [first]
    (wall / "reader.py").write_text(READER + "CHANGED = True\n")
    bench(*words, cwd=wall, process=True)
    assert [*(wall / "out/units").iterdir()] != [first]
    refused = error_of("relabel", "out", "--out", "fused", cwd=wall)
    assert "reader.py:Mine" in refused
    assert "--code" in refused
    bench("relabel", "out", "--out", "fused", "--code", "reader.py:Mine", cwd=wall)


@pytest.mark.parametrize(("name", "line"), [
    ("Half", "reader.py:Half': is no subclass of semstab.datasets.Dataset (docs/tutorials/extend.md)"),
    ("function", "reader.py:function': is no subclass of semstab.datasets.Dataset"),
    ("Min", "has no 'Min'; did you mean 'Mine'?"),
])  # fmt: skip
def test_a_reader_that_is_none_is_one_line(wall, name, line) -> None:
    (wall / "reader.py").write_text(READER)
    assert line in error_of("--dataset", f"reader.py:{name}", "--data", "wall", "--out", "out", cwd=wall)
    assert not (wall / "out").exists()
