"""The benchmark scripts run and print their tables, at a size where their figures mean nothing."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import logging
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SMALL = {
    "fusion": ("96x54", "--sizes 96x54 --rounds 1 --conditions", "noise 0.3 %"),
    "random_scenes": ("worst", "--sizes 96x54 --scenes 1 --noise 0.3 --many 1 --rounds 1"),
    "scaling": ("96x54", "--size 96x54 --voxels 1000 5000"),
    "casting": ("96x54", "--size 96x54 --triangles 200 --rounds 1"),
    "end_to_end": ("96x54", "--size 96x54 --frames 2 --runs 1 --noise 0 --voxel-size 1 --backend numpy --depth png"),
    "gpu": ("96x54", "--device CPU:0 --sizes 96x54 --classes 3 --voxels 9000 --rounds 2 --copied-megabytes 1 "
            "--cpu-backends numba"),
    "spots": ("96x54, 0.3 %", "--sizes 96x54 --rounds 1 --warm 2 --frames 3"),
    "statistics": ("all statistics", "--frames 4 --size 64x48 --voxel-size 0.2"),
}  # fmt: skip


@pytest.mark.parametrize("name", SMALL)
def test_a_benchmark_prints_its_table_and_writes_it(name, tmp_path, capsys, monkeypatch) -> None:
    text, words, *more = SMALL[name]
    script, file = BENCHMARKS / f"bench_{name}.py", tmp_path / "figures.json"
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logging.getLogger("semstab"), "setLevel", lambda level: None)  # it would stay for other tests
    monkeypatch.setattr(sys, "argv", [str(script), *words.split(), *more, "--json", str(file)])
    runpy.run_path(str(script), run_name="__main__")
    assert text in capsys.readouterr().out
    assert json.loads(file.read_text())


def test_the_benchmark_of_whole_runs_prints_its_tables() -> None:
    """In a process of its own, as it sets the threads of numba, which can be done but once."""
    words = ["--frames", "2", "--size", "32x24", "--voxel-size", "0.8", "--runs", "1"]
    command = [sys.executable, str(BENCHMARKS / "bench_run.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "as it is" in done.stdout
    assert "with --statistics" in done.stdout


TRUNCATING = """
import json, sys
import numpy as np

data = open(sys.argv[1], "rb").read()
size, (K, frames) = np.frombuffer(data, "<f8", 1)[0], np.frombuffer(data, "<i8", 2, 8)
at, found = 24, {}
for _ in range(frames):
    n = int(np.frombuffer(data, "<i8", 1, at)[0])
    points = np.frombuffer(data, "<f8", 3 * n, at + 32).reshape(n, 3)
    for point, label in zip(points, np.frombuffer(data, "<i4", n, at + 32 + 24 * n)):
        found[tuple(np.trunc(point / size))] = label
    at += 32 + 28 * n
assert at == len(data) and K == 7
with open(sys.argv[2], "wb") as out:
    out.write(np.array(len(found), "<i8").tobytes())
    out.write(((np.array(list(found)) + 0.5) * size).astype("<f8").tobytes())
    out.write(np.array(list(found.values()), "<i4").tobytes())
print(json.dumps({"ms": [1.0] * int(frames), "bytes": 0, "peak_bytes": 0}))
"""
"""A program that fuses by truncation towards zero, and keeps the last label."""


def called(name: str, words: list[str], monkeypatch) -> None:
    """Call a script's main in this process."""
    monkeypatch.setattr(logging.getLogger("semstab"), "setLevel", lambda level: None)  # it would stay for other tests
    monkeypatch.setattr(sys, "argv", [name, *words])
    imported(name, monkeypatch).main()


def imported(name: str, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module(name)


def test_the_benchmark_of_rivals_compares_a_program_of_the_user(tmp_path, capsys, monkeypatch) -> None:
    """Two of our own programs, which import most, run in this process; the third one and the rival are processes."""
    rivals = imported("bench_rivals", monkeypatch)
    start = rivals.run

    def run(command, files):
        if command[-1] not in ("open3d", "images"):
            return start(command, files)
        size = argparse.Namespace(size="64x48", frames=2, classes=7, voxel_size=0.2)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            rivals.fuse(command[-1], *files, size)
        return json.loads(said.getvalue())

    monkeypatch.setattr(rivals, "run", run)
    program, file = tmp_path / "truncating.py", tmp_path / "figures.json"
    program.write_text(TRUNCATING)
    (tmp_path / "COMMIT").write_text("abc123\n")
    words = ["--size", "64x48", "--frames", "2", "--voxel-size", "0.2", "--json", str(file)]
    words += ["--rival", f"last={sys.executable} {program}", "--commit", f"last={tmp_path}"]
    called("bench_rivals", words, monkeypatch)
    assert "last: abc123" in capsys.readouterr().out
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    ours, images, last = rows["semstab numba"], rows["semstab numba, depth images"], rows["last"]
    assert ours["missing"] == ours["extra"] == ours["label_differs"] == 0
    assert images["voxels"] == pytest.approx(ours["voxels"], rel=0.02)
    assert last["missing"] > 0  # the noise of a wall at 0 reaches below it
    assert 0 < last["label_differs"] < 0.5


def test_the_benchmark_of_growth_prints_its_exponents_and_draws_them(tmp_path, capsys, monkeypatch) -> None:
    words = [
        "--size",
        "96x54",
        "--frames",
        "1",
        "--voxels",
        "4000",
        "--classes",
        "2",
        "--times",
        "1",
        "2",
        "--growing",
        "voxels",
    ]
    called("bench_growth", [*words, "--figure", str(tmp_path / "growth.png")], monkeypatch)
    assert "exponent" in capsys.readouterr().out
    assert (tmp_path / "growth.png").stat().st_size
