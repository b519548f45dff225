"""What a fresh machine has is enough: each command runs with the packages that `install_requires` brings alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

STUDY = """
dataset: {name: city, options: {width: 96, height: 54}}
scenes: [scene0]
models: [sim-flicker]
frames: {spacing: even, count: 5}
voxel_size: 0.8
sweeps: {voxel_size: [0.8, 1.6]}
backends: [numba]
"""
PYTHON = """
import numpy as np, semstab
from pathlib import Path

def frame(k):
    depth = np.full((48, 64), 5.0, np.float32)
    return {"labels": (np.indices((48, 64)).sum(0) // 16 + k) % 3, "depth": depth,
            "intrinsics": semstab.Intrinsics(60.0, 60.0, 31.5, 23.5), "T_wc": np.eye(4)}

result = semstab.fuse(map(frame, range(9)), voxel_size=0.5, backend="open3d")
result.report("fused.html")
assert result.record().table().to_arrow().num_rows > 0
assert semstab.load("a").table(scene="scene0", model="sim-flicker").op.max() > 1
try:
    semstab.load("a").summary
except semstab.SemstabError as error:
    assert "pip install 'semstab[pandas]'" in str(error), error
else:
    raise AssertionError("pandas is there")
"""


def test_every_command_runs_with_the_declared_packages_alone(tmp_path: Path) -> None:
    small = ["--option", "width=96", "--option", "height=54"]
    few = ["--frames", "::3", "--scene", "scene0", *small, "--voxel-size", "0.8"]
    (tmp_path / "study.yaml").write_text(STUDY)
    commands = [
        ["list"],
        ["run", "--backend", "open3d", *few, "--out", "a"],
        ["check", *few[:-2]],
        ["compare", "a:sim-steady", "a:sim-flicker", "--out", "compared"],
        ["gate", "a:sim-steady", "--against", "a:sim-flicker", "--rule", "alpha > 0", "--undecided", "pass"],
        ["show", "a"],
        ["show", "a", "verdicts", "--figures", "png"],
        ["view", "a"],
        ["study", "study.yaml", "--out", "s"],
        ["export", "a", "--model", "sim-flicker", "--to", "m.ply", "--to", "m.csv", "--to", "m.parquet"],
        ["python", PYTHON],
    ]
    script = Path(__file__).with_name("declared_only.py")
    done = subprocess.run(
        [sys.executable, str(script), json.dumps(commands)],
        cwd=tmp_path, env={**os.environ, "COLUMNS": "120"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert "viewer of a/recording.rrd" in done.stdout
    reports = ("a/report.html", "compared/report.html", "s/report.html", "fused.html")
    assert [
        name for name in (*reports, "a/recording.rrd", "m.ply", "m.csv") if not (tmp_path / name).stat().st_size
    ] == []
