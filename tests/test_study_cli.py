"""`semstab-bench study`: killed, interrupted and started again, failing; what it prints and writes."""

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
from test_study_executors import children, gone, wait_until

from semstab.api import run_study


@pytest.fixture
def root(tmp_path):
    return tiny_study.write(tmp_path / "wall", models=("a", "b", "c"))


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


def test_a_study_interrupted_and_killed_at_random_moments_ends_with_the_same_summary(root, file, tmp_path) -> None:
    """Ctrl-C is one line and leaves what is finished; no worker outlives its parent."""
    moments, out, workers = random.Random(2), tmp_path / "out", set[int]()
    for end, after in ((signal.SIGINT, moments.randrange(1, 5)), (signal.SIGKILL, moments.randrange(5, 12))):
        process = started("study", file, "--out", "out", "--jobs", "2", "--quiet", cwd=tmp_path)
        wait_until(lambda: units(out) >= after, 300, 0.005)  # noqa: B023 - called at once
        time.sleep(moments.random() * 0.05)
        workers |= children(process.pid)
        process.send_signal(end)
        _, errors = process.communicate(timeout=30)
        if end == signal.SIGINT:
            assert process.returncode == 130
            assert errors.startswith("interrupted; finished work is stored")
            assert len(errors.splitlines()) == 1
    assert workers
    wait_until(lambda: all(map(gone, workers)))
    finished, counting = units(out), tiny_study.Counting()
    run_study(tiny_study.configure(root, backends=["numpy"]), out, observers=[counting], report=False)
    assert counting.kept == finished > 0
    run_study(tiny_study.configure(root, backends=["numpy"]), tmp_path / "whole", report=False)
    assert tiny_study.summary(out) == tiny_study.summary(tmp_path / "whole")
    assert not list(out.rglob(".*"))  # not even what was half-written when it was killed


def test_what_it_prints_fits_into_80_columns(file, tmp_path) -> None:
    arguments = (file, "--set", "backends=[numpy, numba]", "--set", "models=[a]", "--only", "backends")
    out, _ = study(*arguments, "--set", "statistics=true", cwd=tmp_path, report=True)
    files = ("report.html", "manifest.json", "config.yaml", "tables/scenes.csv", "tables/verdicts.csv")
    for name in files:
        assert (tmp_path / "studies/tiny" / name).exists()
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "fusion by numpy equals numba" in out
    assert "a: no verdict, too few locations were seen twice" in " ".join(out.split())
    assert "report  studies/tiny/report.html" in out
    assert len(out.splitlines()) <= 24
    page = (tmp_path / "studies/tiny/report.html").read_text()
    assert {"table-quadrants", "table-verdicts", "table-correctness"} <= set(re.findall(r'id="([^"]+)"', page))
    runs = json.loads((tmp_path / "studies/tiny/summary.json").read_text())["runs"]
    (base,) = (run for run in runs if run["variation"]["sweep"] == "base")
    assert base["statistics"]["correctness"]["quadrants"]["voxels"] > 0
    assert {run["variation"]["sweep"] for run in runs} == {"base", "backends"}


def test_failing_units_are_one_line_each_and_the_others_are_reported(root, file, tmp_path) -> None:
    (root / "labels/b/0002.png").write_bytes(b"no image")
    (root / "depth/0003.png").write_bytes(b"no image")
    arguments = (file, "--out", "out", "--set", "models=[a, b]", "--only", "frame_count", "--only", "voxel_size")
    out, errors = study(*arguments, cwd=tmp_path, code=2)
    of_b, of_a = (line for line in errors.splitlines() if line.startswith("error: "))  # others tell of progress
    assert of_b.startswith(f"error: wall, b: voxel_size 0.25 and 1 more: {root}/labels/b/0002.png: not a PNG image")
    assert of_a.startswith(f"error: wall, a: frame_count 10: {root}/depth/0003.png: not a PNG image")
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
    settings = ("backends=[numpy, numba]", "models=[a]", "tolerance=0", "voxel_size=0.7")
    arguments = [word for setting in settings for word in ("--set", setting)]
    _, errors = study(file, *arguments, "--only", "backends", "--quiet", cwd=tmp_path, code=3)
    (line,) = errors.splitlines()
    assert re.fullmatch(
        r"error: the backends disagree \(wall, a: evidence_\d of the voxel \(.*\) is [\d.]+, expected [\d.]+\);"
        r" the agreement in studies/tiny/summary\.json shows where",
        line,
    )
