"""`semstab-bench study` as a process: killed and started again, interrupted, failing; what it prints and writes."""

from __future__ import annotations

import json
import random
import re
import signal
import time
from pathlib import Path

import pytest
import tiny_study
import yaml
from command_line import bench, started

from semstab.engine import run_study


@pytest.fixture
def root(tmp_path):
    return tiny_study.write(tmp_path / "wall", backbones=("a", "b", "c"))


@pytest.fixture
def file(root, tmp_path):
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(tiny_study.content(root, backends=["numpy"])))
    return path


def study(*arguments: str | Path, cwd: Path, code: int = 0, report: bool = False) -> tuple[str, str]:
    """What it prints to stdout and stderr."""
    done = bench("study", *arguments, cwd=cwd, code=code, columns=80, report=report)
    return done.stdout, done.stderr


def units(out: Path) -> int:
    return len(list((out / "units").glob("[!.]*.json"))) if out.exists() else 0


def wait_for_units(out: Path, count: int) -> None:
    deadline = time.monotonic() + 300
    while units(out) < count:
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_study_killed_at_random_moments_ends_with_the_same_summary(root, file, tmp_path, jobs) -> None:
    run_study(tiny_study.configure(root, backends=["numpy"]), tmp_path / "whole")
    moments = random.Random(jobs)
    for after in (moments.randrange(1, 6), moments.randrange(7, 12)):
        process = started("study", file, "--out", "out", "--jobs", jobs, "--quiet", cwd=tmp_path)
        wait_for_units(tmp_path / "out", after)
        time.sleep(moments.random() * 0.05)
        process.kill()
        process.communicate()
    kept = units(tmp_path / "out")
    counting = tiny_study.Counting()
    run_study(tiny_study.configure(root, backends=["numpy"]), tmp_path / "out", observers=[counting])
    assert counting.kept == kept > 0
    assert tiny_study.summary(tmp_path / "out") == tiny_study.summary(tmp_path / "whole")
    assert not list((tmp_path / "out").rglob(".*"))  # not even what was half-written when it was killed


def test_what_it_prints_fits_into_80_columns(file, tmp_path) -> None:
    arguments = (file, "--set", "backends=[numpy, numba]", "--set", "backbones=[a]", "--only", "backends")
    out, _ = study(*arguments, "--set", "statistics=true", cwd=tmp_path, report=True)
    files = ("report.html", "manifest.json", "config.yaml", "tables/scenes.csv", "figures/persistence.png")
    for name in (*files, "tables/quadrants.csv", "tables/verdicts.tex", "figures/correctness.png"):
        assert (tmp_path / "studies/tiny" / name).exists()
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "checked numpy against numba" in out
    assert "a: no verdict, too few locations were seen twice" in " ".join(out.split())
    assert "report  studies/tiny/report.html" in out
    assert len(out.splitlines()) <= 24
    page = (tmp_path / "studies/tiny/report.html").read_text()
    assert {"table-quadrants", "table-verdicts", "figure-correctness"} <= set(re.findall(r'id="([^"]+)"', page))
    runs = json.loads((tmp_path / "studies/tiny/summary.json").read_text())["runs"]
    (base,) = (run for run in runs if run["variation"]["sweep"] == "base")
    assert base["statistics"]["correctness"]["quadrants"]["voxels"] > 0
    assert {run["variation"]["sweep"] for run in runs} == {"base", "backends"}


def test_ctrl_c_keeps_what_is_finished(file, tmp_path) -> None:
    process = started("study", file, "--out", "out", "--jobs", "2", "--quiet", cwd=tmp_path)
    wait_for_units(tmp_path / "out", 1)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors.startswith("interrupted; what was finished is kept")
    assert len(errors.splitlines()) == 1
    assert units(tmp_path / "out") >= 1


def test_failing_units_are_one_line_each_and_the_others_are_reported(root, file, tmp_path) -> None:
    (root / "labels/b/0002.png").write_bytes(b"no image")
    (root / "depth/0003.png").write_bytes(b"no image")
    arguments = (file, "--out", "out", "--set", "backbones=[a, b]", "--only", "frame_count", "--only", "voxel_size")
    out, errors = study(*arguments, cwd=tmp_path, code=2)
    wall = tmp_path / "wall"
    of_b, of_a = (line for line in errors.splitlines() if line.startswith("error: "))  # others tell of progress
    assert of_b.startswith(f"error: wall, b: voxel_size 0.25 and 1 more: {wall}/labels/b/0002.png: not a PNG image")
    assert of_a.startswith(f"error: wall, a: frame_count 10: {wall}/depth/0003.png: not a PNG image")
    assert "semstab-bench show out sensitivity_frame_count" in out
    assert len(json.loads((tmp_path / "out" / "summary.json").read_text())["failures"]) == 4


def test_nothing_but_failures_is_still_a_summary(root, file, tmp_path) -> None:
    for name in "abc":
        (root / f"labels/{name}/0002.png").write_bytes(b"no image")
    out, errors = study(file, "--out", "out", "--only", "base", cwd=tmp_path, code=2)
    assert len(errors.splitlines()) == 3
    assert out == "  folder  out\n"
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["runs"] == []


def test_backends_that_disagree_end_with_their_own_code(file, tmp_path) -> None:
    settings = ("backends=[numpy, numba]", "backbones=[a]", "tolerance=0", "voxel_size=0.7")
    arguments = [word for setting in settings for word in ("--set", setting)]
    _, errors = study(file, *arguments, "--only", "backends", "--quiet", cwd=tmp_path, code=3)
    assert errors == "error: the backends disagree; the agreement in studies/tiny/summary.json says where\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["citi"], "study 'citi' is not known; did you mean 'city'?, or name a .yaml file"),
        (["nowhere.yaml"], "nowhere.yaml: cannot be read"),
        (["tiny.yaml", "--only", "voxelsize"], "study tiny: no part 'voxelsize'; did you mean 'voxel_size'?"),
        (["tiny.yaml", "--set", "sweeps.voxels=[1]"], "unknown setting 'sweeps.voxels'; did you mean 'voxel_size'?"),
        (
            ["tiny.yaml", "--jobs", "2", "--scheduler", "tcp://x:1"],
            "--jobs and --scheduler: the scheduler's workers do",
        ),
        (["tiny.yaml", "--out", "wall"], "is not empty and holds no run or study; choose another folder"),
    ],
)
def test_bad_input_is_one_line(file, tmp_path, arguments, message) -> None:
    _, errors = study(*arguments, cwd=tmp_path, code=2)
    assert len(errors.splitlines()) == 1
    assert errors.startswith("error: ")
    assert message in errors
