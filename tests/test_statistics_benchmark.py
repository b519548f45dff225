"""The benchmarks of the statistics run and print their tables, at a size where the figures mean nothing."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

PERF = Path(__file__).parent / "perf"


def test_the_benchmark_prints_its_table_and_writes_it(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(PERF))
    small = ["--frames", "4", "--size", "64x48", "--voxel-size", "0.2", "--json", str(tmp_path / "figures.json")]
    monkeypatch.setattr(sys, "argv", ["bench_statistics.py", *small])
    runpy.run_path(str(PERF / "bench_statistics.py"), run_name="__main__")
    assert "all statistics" in capsys.readouterr().out
    assert {"fusion", "table", "all statistics"} < set(json.loads((tmp_path / "figures.json").read_text())["seconds"])


def test_the_benchmark_of_whole_runs_prints_its_tables(capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(PERF))
    small = ["--frames", "4", "--size", "64x48", "--voxel-size", "0.2", "--runs", "1"]
    monkeypatch.setattr(sys, "argv", ["bench_run.py", *small])
    runpy.run_path(str(PERF / "bench_run.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert "as it is" in printed
    assert "with --statistics" in printed
