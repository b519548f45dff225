"""The command that README shows first, at a size for tests: `semstab-bench --backend open3d` on the built-in city."""

from __future__ import annotations

import json

from command_line import bench

SMALL = ("width=96", "height=54", "frames=4")


def test_the_built_in_city_from_the_command_line(tmp_path) -> None:
    small = [word for option in SMALL for word in ("--set", f"dataset.options.{option}")]
    result = bench("--backend", "open3d", *small, cwd=tmp_path)
    (folder,) = (tmp_path / "runs").iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    units = {(run["scene"], run["model"], run["backend"]) for run in summary["runs"]}
    models, backends = ("sim-steady", "sim-flicker"), ("open3d",)
    assert units == {(s, m, b) for s in ("scene0", "scene3") for m in models for b in backends}
    assert len(summary["agreement"]) == len(units)
    assert all(row["agrees"] and row["only_in"] == [0, 0] for row in summary["agreement"])
    assert {run["K"] for run in summary["runs"]} == {7}
    assert "seen in one frame only" in result.stdout
