"""The tables that hold a study against the paper: what is compared, what holds, and what is not there."""

from __future__ import annotations

import dataclasses
import math

import pytest

import semstab
from semstab.config import SHARED
from semstab.data.measures import SBD, VSS
from semstab.report.means import levels, pooled
from semstab.report.tables import tables
from semstab.report.tables.paper import _changes_little, _finding, falls, paper

STUDY = {
    "name": "paper", "dataset": {"name": "city", "options": {"width": 96, "height": 54, "frames": 40}},
    "scenes": ["scene0"], "models": ["sim-steady", "sim-flicker"], "taxonomy": "uavid7", "shared_taxonomy": "uavid3",
    "voxel_size": 0.5, "frames": {"stop": 12}, "check": None,
    "sweeps": {"voxel_size": [0.5, 1.0], "frame_count": [6, 12]},
}  # fmt: skip


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    return semstab.run_study(STUDY, tmp_path_factory.mktemp("paper") / "out", report=False)


def rows(table):
    return {row[0]: row[1:] for _, row in table.rows()}


def test_findings_are_the_papers_numbers_and_those_of_the_study(result) -> None:
    findings, _ = paper(result)
    found = rows(findings)
    pooled_means = pooled(result.select(model="sim-flicker"))
    once = next(row for row in pooled_means.strata if row.name == "OP=1")
    assert found["VSS: seen once → OP>=3"] == (
        "1.000 → 0.869", f"{once[VSS]:.3f} → {pooled_means.recurrent[VSS]:.3f}", "yes",
    )  # fmt: skip
    both = [pooled(result.select(SHARED, model=name)) for name in ("sim-flicker", "sim-steady")]
    here = " → ".join(f"{level.every[VSS]:.4f}" for level in both)
    assert found["VSS of all voxels: SegEarth-OV → SegFormer"] == ("0.9657 → 0.9848", here, "yes")
    small, large = levels(result, "voxel_size", "sim-flicker")
    here = " → ".join(f"{level.mean(lambda means: 100 * means.recurrent.share):.2f}" for level in (small, large))
    assert found["Voxels of 0.1 → 0.4 m: share with OP>=3, %"] == ("3.90 → 42.61", here, "yes")


def test_what_the_study_did_not_vary_is_left_open(result) -> None:
    found = rows(paper(result)[0])
    assert found["Depth noise of 0 → 0.3 %: share with OP>=3, %"] == ("22.12 → 9.81", "--", "--")


def test_numbers_stand_beside_each_other(result) -> None:
    _, published = paper(result)
    pooled_means = pooled(result.select(model="sim-flicker"))
    stratum = next(row for row in pooled_means.strata if row.name == "OP=2")
    row = next(row for group, row in published.rows() if row[0] == "OP=2")
    assert row[1:5] == (20.32, 0.873, 0.0790, 0.1602)
    assert row[5:8] == (100 * stratum.share, stratum[VSS], stratum[SBD])
    assert "sim-flicker stands for SegEarth-OV" in published.caption


def test_other_studies_have_no_such_tables(result) -> None:
    names = {table.name for table in tables(result)}
    assert {"findings", "published"} <= names
    other = dataclasses.replace(result, name="mine")
    assert paper(other) == []


@pytest.mark.parametrize(("theirs", "ours", "holds"), [
    ((3, 2, 1), (0.9, 0.5, 0.1), True), ((3, 2, 1), (0.9, 0.1, 0.5), False), ((1, 2), (5, 9), True),
    ((1, 2), (9, 5), False), ((1, 2), (5, math.nan), None), ((1, 2), (), None),
])  # fmt: skip
def test_a_finding_holds_where_numbers_move_as_the_papers(theirs, ours, holds) -> None:
    assert _finding("", theirs, ours, 2).holds is holds


def test_little_is_less_than_a_third_of_the_change_beside_it() -> None:
    assert _changes_little("", (1, 2), (0.9, 0.89), -0.05, 2).holds is True
    assert _changes_little("", (1, 2), (0.9, 0.87), -0.05, 2).holds is False
    assert _changes_little("", (1, 2), (0.9, 0.87), math.nan, 2).holds is None
    assert [falls([3, 2]), falls([2, 2])] == [True, False]
