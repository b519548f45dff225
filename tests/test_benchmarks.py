"""The benchmark scripts run and print their tables, at a size where their figures mean nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SMALL = {
    "bench_fusion.py": ["--sizes", "96x54", "--rounds", "1", "--conditions", "noise 0.3 %"],
    "bench_scaling.py": ["--size", "96x54", "--voxels", "1000", "5000"],
    "bench_casting.py": ["--size", "96x54", "--triangles", "200", "--rounds", "1"],
    "bench_end_to_end.py": ["--size", "96x54", "--frames", "3", "--runs", "1", "--noise", "0", "--backend", "numpy",
                            "--depth", "png"],
    "bench_gpu.py": ["--device", "CPU:0", "--sizes", "96x54", "--classes", "3", "--voxels", "9000", "--rounds", "2",
                     "--copied-megabytes", "1", "--cpu-backends", "numba"],
}  # fmt: skip


@pytest.mark.parametrize("script", SMALL)
def test_a_benchmark_prints_its_table_and_writes_it(script, tmp_path) -> None:
    command = [sys.executable, str(BENCHMARKS / script), *SMALL[script], "--json", str(tmp_path / "figures.json")]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "96x54" in result.stdout
    assert json.loads((tmp_path / "figures.json").read_text())
