"""What docs/stability.md promises is there: names, keys, columns and codes, against tests/golden/stable.json."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from fresh import setup
from stable_surface import complaints, stable_surface

import semstab

SOURCE = Path(__file__).parents[1]
PAGE = SOURCE / "docs/stability.md"


@pytest.fixture(scope="module")
def promised() -> dict[str, list[str]]:
    return json.loads((SOURCE / "tests/golden/stable.json").read_text())


def test_what_is_promised_stays(promised) -> None:
    found = complaints(promised, stable_surface())
    assert not found, "\n".join(found)


@pytest.mark.parametrize(("surface", "name"), [
    ("semstab", "run"), ("semstab.run: arguments", "out"), ("semstab.VoxelTable: members", "to_pandas"),
    ("semstab.statistics", "statistics.describe"), ("command gate", "--against"), ("command run", "--out"),
    ("settings Config", "voxel_size"), ("settings Sweeps", "depth_noise"), ("settings GateConfig", "rules"),
    ("exit codes", "5"), ("summary.json", "runs"), ("summary.json", "schema 1"), ("summary.json: runs", "vss_all"),
    ("summary.json: runs.statistics", "verdict"), ("voxels/*.parquet", "op"), ("events/*.parquet", "frame"),
    ("frames/*.csv", "flicker_percent"), ("gate.json", "exit_code"), ("protocol FusionBackend", "integrate"),
    ("protocol Scene", "frame"), ("protocol Observer", "frame_fused"),
])  # fmt: skip
def test_each_surface_is_held(promised, surface, name) -> None:
    assert name in promised[surface]
    found = {**promised, surface: [promise for promise in promised[surface] if promise != name]}
    (line,) = complaints(promised, found)
    assert line.startswith(f"{surface}: {name} is gone; keep the old name for a minor version")


def test_a_new_name_is_promised_too(promised) -> None:
    (line,) = complaints(promised, {**promised, "commands": [*promised["commands"], "frobnicate"]})
    assert line.startswith(
        "commands: frobnicate is new, and will stay; say it in CHANGELOG.md, then run: python tests/"
    )


def test_the_page_names_each_exit_code(promised) -> None:
    (row,) = (line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| exit codes"))
    assert re.findall(r"\b\d+\b", row.split("|")[2]) == promised["exit codes"]


def test_the_version_is_one() -> None:
    citation = (SOURCE / "CITATION.cff").read_text(encoding="utf-8")
    changes = (SOURCE / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"(?m)^version: (.*)$", citation) == [semstab.__version__]
    assert re.findall(r"(?m)^## (\S+)", changes)[0] == semstab.__version__
    assert setup()["metadata"]["version"] == "attr: semstab.core.versions.VERSION"
