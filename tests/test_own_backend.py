"""A backend that a user names by its file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import tiny_scene
from command_line import bench

from semstab import backends
from semstab.configure import load_config
from semstab.engine import load_result
from semstab.errors import ConfigError

ALIKE = """
from dataclasses import replace

import numpy as np
from semstab.backends.numpy_reference import NumpyReference

class Mine(NumpyReference):
    pass
"""

TWICE = """
    def table(self):
        table = super().table()
        weight = [1.0] * 7 + [2.0] * (len(table) - 7)
        return replace(table, evidence=table.evidence[:] * np.array(weight)[:, None])
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    tiny_scene.write(tmp_path / "wall", models=("a",))
    (tmp_path / "fusion.py").write_text(ALIKE, encoding="utf-8")
    return tmp_path


def run(folder: Path, *words: str, code: int = 0):
    common = ["--data", "wall", "--voxel-size", "0.25", "--rerun", "off", "--report", "off", "--out", "out"]
    return bench(*common, *words, cwd=folder, code=code)


def test_it_is_called_by_the_name_of_its_class_and_checked(folder) -> None:
    said = run(folder, "--backend", "fusion.py:Mine", "--check", "numpy").stdout
    assert "fusion by Mine equals numpy in all 60 voxels" in said
    assert load_result(folder / "out").backend == "Mine"


GROWS = """
    def room(self):
        return len(self.table())

    def reserve(self, room):
        with open("rooms.txt", "a") as file:
            print(room, file=file)
"""


def test_a_backend_is_told_the_room_that_the_last_map_of_the_scene_had(tmp_path) -> None:
    tiny_scene.write(tmp_path / "wall", models=("a", "b", "c"))
    (tmp_path / "fusion.py").write_text(ALIKE.replace("    pass", GROWS), encoding="utf-8")
    run(tmp_path, "--backend", "fusion.py:Mine", "--check", "none")
    assert (tmp_path / "rooms.txt").read_text().split() == ["60", "60"]


SLEEPS = """
    def integrate(self, frame):
        import time

        time.sleep(0.2)
        return super().integrate(frame)
"""


def test_all_voxels_are_compared_where_that_takes_less_than_the_fusion(folder) -> None:
    """Its sample would be 1 in 16 of them."""
    (folder / "fusion.py").write_text(ALIKE + SLEEPS, encoding="utf-8")
    said = " ".join(run(folder, "--backend", "fusion.py:Mine").stdout.split())
    assert "fusion by Mine equals numpy in all 60 voxels" in said


def test_a_single_wrong_voxel_is_found_without_naming_a_check(folder) -> None:
    (folder / "fusion.py").write_text(ALIKE + SLEEPS + ONE_WRONG, encoding="utf-8")
    said = " ".join(run(folder, "--backend", "fusion.py:Mine", code=3).stdout.split())
    assert "Mine and numpy DISAGREE" in said


ONE_WRONG = """
    def table(self):
        table = super().table()
        drift = table.drift_sum.copy()
        drift[7] += 0.01
        return replace(table, drift_sum=drift)
"""


def test_a_fast_one_is_checked_on_a_sample_with_its_bound(folder, monkeypatch) -> None:
    """The screen says how many wrong voxels the sample may have missed: of n at random none is wrong."""
    monkeypatch.setattr("semstab.backends.numpy_reference.MOST_OF_ALL", 30)
    said = " ".join(run(folder, "--backend", "fusion.py:Mine").stdout.split())
    found = re.search(
        r"numpy in (\d+) voxels of a random sample \(1 in \d+\); with 95% confidence at most ([\d.]+) % of all", said
    )
    assert found, said
    n, percent = int(found[1]), float(found[2])
    assert 0 < n <= 30
    assert (1 - percent / 100) ** n == pytest.approx(0.05, abs=0.01)


def test_conform_takes_it_by_its_file(folder) -> None:
    assert bench("conform", "fusion.py:Mine", "--only", "pinhole", cwd=folder).stdout == "pinhole: the same\n"
    (folder / "fusion.py").write_text(ALIKE + TWICE, encoding="utf-8")
    assert "evidence" in bench("conform", "fusion.py:Mine", "--only", "pinhole", cwd=folder, code=3).stderr


def test_conform_stops_where_a_program_fails_alike(folder) -> None:
    done = bench("conform", "fusion.py:Yours", cwd=folder, code=2)
    assert done.stderr.count("\n") == 3
    assert "in each of the first 3 cases" in done.stderr.splitlines()[-1]


def test_other_processes_know_it(folder) -> None:
    run(folder, "--backend", "fusion.py:Mine", "--jobs", "2")
    assert load_result(folder / "out").backend == "Mine"


def test_settings_of_a_run_name_its_file(folder) -> None:
    run(folder, "--backend", "fusion.py:Mine")
    (backend,) = load_config(folder / "out/config.yaml").backends
    assert (backend.name, backend.code) == ("Mine", f"{folder / 'fusion.py'}:Mine")


def test_a_changed_file_computes_its_units_again(folder) -> None:
    run(folder, "--backend", "fusion.py:Mine", "--check", "numpy")
    wrong = ALIKE.replace(
        "pass", "keeps_log = True\n    def table(self):\n        return super().table().rows(slice(1, None))"
    )
    (folder / "fusion.py").write_text(wrong, encoding="utf-8")
    said = run(folder, "--backend", "fusion.py:Mine", "--check", "numpy", code=3)
    assert "the backends disagree" in said.stderr


def test_evidence_that_does_not_sum_to_op_is_one_line(folder) -> None:
    (folder / "fusion.py").write_text(ALIKE.replace("pass", TWICE), encoding="utf-8")
    said = run(folder, "--backend", "fusion.py:Mine", code=2).stderr
    assert re.search(
        r"wall, a: backend 'Mine': the evidence of voxel \(-?\d+, -?\d+, -?\d+\) sums to (\d+), and its OP is \d+; add"
        r" one distribution over the classes for each frame that sees a voxel",
        said,
    )


@pytest.mark.parametrize(("text", "line"), [
    ("fusion.py:Others", "has no 'Others'"),
    ("nowhere.py:Mine", "there is no such file"),
    ("fusion.py:", "write FILE.py:NAME"),
])  # fmt: skip
def test_a_name_that_is_not_there_is_one_line(folder, text, line) -> None:
    said = run(folder, "--backend", text, code=2).stderr
    assert line in said
    assert len(said.strip().splitlines()) == 1


def test_a_name_of_a_built_in_backend_is_refused(tmp_path, monkeypatch) -> None:
    (tmp_path / "fusion.py").write_text(ALIKE.replace("Mine", "numba"), encoding="utf-8")
    monkeypatch.setattr("semstab.core.registry._code", {})
    load_config(overrides={"backends": f"{tmp_path / 'fusion.py'}:numba"})
    with pytest.raises(ConfigError, match="a built-in backend is called 'numba'"):
        backends.create("numba", voxel_size=1.0, num_classes=2)
