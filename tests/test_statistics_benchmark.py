"""The benchmarks of the statistics run and print their tables, at a size where the figures mean nothing."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def test_the_benchmark_prints_its_table_and_writes_it(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    small = ["--frames", "4", "--size", "64x48", "--voxel-size", "0.2", "--json", str(tmp_path / "figures.json")]
    monkeypatch.setattr(sys, "argv", ["bench_statistics.py", *small])
    runpy.run_path(str(BENCHMARKS / "bench_statistics.py"), run_name="__main__")
    assert "all statistics" in capsys.readouterr().out
    assert {"fusion", "table", "all statistics"} < set(json.loads((tmp_path / "figures.json").read_text())["seconds"])


def test_the_benchmark_of_whole_runs_prints_its_tables():
    """In a process of its own, as it sets the threads of numba, which can be done but once."""
    small = ["--frames", "4", "--size", "64x48", "--voxel-size", "0.2", "--runs", "1"]
    command = [sys.executable, str(BENCHMARKS / "bench_run.py"), *small]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "as it is" in done.stdout
    assert "with --statistics" in done.stdout
