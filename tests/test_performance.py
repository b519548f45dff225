"""The cases of performance/ run and print their tables, at a size where their figures mean nothing."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Literal

import bench
import cases
import measuring
import pytest
from command_line import bench as bench_command
from corners import corners

from semstab.core.process import resident_bytes

ROOT = Path(__file__).parents[1]

SMALL = {
    "fusion": ("96x54", "--sizes 96x54 --rounds 1 --conditions", "noise 0.3 %"),
    "random-scenes": ("worst", "--sizes 96x54 --scenes 1 --percent 0.3 --voxels 2 --many 1 --rounds 1"),
    "casting": ("96x54", "--size 96x54 --triangles 200 --rounds 1"),
    "end-to-end": ("96x54", "--size 96x54 --frames 2 --runs 1 --noise 0 --voxel-size 1 --backend numpy --depth png"),
    "recording": ("ratio", "--size 96x54 --frames 2 --runs 1 --backend numpy"),
    "gpu": ("96x54", "--device CPU:0 --sizes 96x54 --classes 3 --voxels 9000 --rounds 2 --copied-megabytes 1 "
            "--cpu-backends numba"),
    "scores": ("96x54", "--sizes 96x54 --classes 3 --types float16 --rounds 1"),
    "scans": ("np.unique alone", "--points 2000 --scans 2 --rounds 1 --backends numba"),
    "statistics": ("all statistics", "--frames 4 --size 64x48 --voxel-size 0.2"),
    "growth": ("exponent", "--size 96x54 --frames 1 --voxels 4000 --classes 2 --times 1 2 --growing voxels "
               "--figure growth.png"),
    "filters": ("ms", "--size 32x24 --classes 3 --frames 5"),
    "tiles": ("the same", "--frames 3 --tile-size 64"),
    "threads": ("faster", "--sizes 96x54 --backends numba --threads 1 --rounds 1"),
}  # fmt: skip


def run_here(*words: object, **variables: str) -> measuring.Process:
    """Run `python -m semstab` with these words in this process."""
    assert words[:2] == ("-m", "semstab")
    started, cpu = time.perf_counter(), time.process_time()
    bench_command(*words[2:], cwd=Path(), recording=True, **variables)
    return measuring.Process(time.perf_counter() - started, time.process_time() - cpu, resident_bytes() / 1e9)


LONG = ("tiles", "end-to-end", "growth", "scores", "recording", "threads")
"""Cases that start processes or runs: each takes seconds at any size."""


@pytest.mark.parametrize("name", corners(SMALL, always=SMALL.keys() - {*LONG}))
def test_a_case_prints_its_table_and_writes_it(name, tmp_path, capsys, monkeypatch) -> None:
    text, words, *more = SMALL[name]
    monkeypatch.setattr("timed.tiles.SIZE", (160, 120))
    if name == "recording":  # four runs; those of other cases are processes
        monkeypatch.setattr("measuring.python", run_here)
    file = tmp_path / "figures.json"
    called([name, *words.split(), *more, "--json", str(file)], tmp_path, monkeypatch)
    assert text in capsys.readouterr().out
    assert json.loads(file.read_text())
    assert name != "growth" or (tmp_path / "growth.png").stat().st_size


@pytest.mark.parametrize(("folder", "entry"), [("performance", "bench"), ("simulations", "simulate")])
def test_the_help_of_an_entry_names_its_cases_and_each_case_has_a_module(folder, entry) -> None:
    command = [sys.executable, str(ROOT / folder / f"{entry}.py"), "--help"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = {line.split()[0]: line for line in said.splitlines() if line.startswith("  ")}
    cases = importlib.import_module(entry).CASES
    assert set(lines) == set(cases)
    assert all(line.split()[1:] for line in lines.values())


def options(
    kind: Literal["x", "y"] | None = None,
    trials: int = 3,
    only: str = "",
    noise: tuple[float, ...] = (0.0,),
    record: bool = False,
    class_: str = "a",
):
    raise AssertionError


def test_the_parameters_of_a_case_are_its_options() -> None:
    parser = cases.parser_of(options, "case", "")
    given = ["--kind", "y", "--trials", "5", "--noise", "0.5", "1", "--record", "--class", "b"]
    assert vars(parser.parse_args(given)) == {
        "kind": "y",
        "trials": 5,
        "only": "",
        "noise": [0.5, 1.0],
        "record": True,
        "class_": "b",
    }
    assert vars(parser.parse_args([]))["noise"] == (0.0,)


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


def called(words: list[str], folder: Path, monkeypatch) -> None:
    """Call the entry in this process, which is left as it was."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(logging.getLogger("semstab"), "setLevel", lambda level: None)  # it would stay for other tests
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)
    bench.main(words)


def test_the_benchmark_of_rivals_compares_a_program_of_the_user(tmp_path, capsys, monkeypatch) -> None:
    """Two of our own programs, which import most, run in this process; the third one and the rival are processes."""
    rivals = importlib.import_module("timed.rivals")
    start = rivals.run

    def run(command, files):
        if command[-2] not in ("open3d", "images"):
            return start(command, files)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            rivals.fuse(command[-2], *files, "64x48", 2, 7, 0.2)
        return json.loads(said.getvalue())

    monkeypatch.setattr(rivals, "run", run)
    program, file = tmp_path / "truncating.py", tmp_path / "figures.json"
    program.write_text(TRUNCATING)
    (tmp_path / "COMMIT").write_text("abc123\n")
    words = ["--size", "64x48", "--frames", "2", "--voxel-size", "0.2", "--json", str(file)]
    words += ["--rival", f"last={sys.executable} {program}", "--commit", f"last={tmp_path}"]
    called(["rivals", *words], tmp_path, monkeypatch)
    assert "last: abc123" in capsys.readouterr().out
    rows = {row["implementation"]: row for row in json.loads(file.read_text())["rows"]}
    ours, images, last = rows["semstab numba"], rows["semstab numba, depth images"], rows["last"]
    assert ours["missing"] == ours["extra"] == ours["label_differs"] == 0
    assert images["voxels"] == pytest.approx(ours["voxels"], rel=0.02)
    assert last["missing"] > 0  # the noise of a wall at 0 reaches below it
    assert 0 < last["label_differs"] < 0.5
