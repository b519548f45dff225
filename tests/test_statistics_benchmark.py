"""The benchmark of the statistics runs and prints its table, at a size where its figures mean nothing."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path

PERF = Path(__file__).parent / "perf"


def test_the_benchmark_prints_its_table_and_writes_it(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(PERF))
    small = ["--observations", "600", "--rounds", "1", "--json", str(tmp_path / "figures.json")]
    monkeypatch.setattr(sys, "argv", ["bench_statistics.py", *small])
    runpy.run_path(str(PERF / "bench_statistics.py"), run_name="__main__")
    assert "compiled, 100 a voxel" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "figures.json").read_text())["rows"]) == 10
