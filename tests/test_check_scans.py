"""Mistakes of scans, of their poses and their labels: `check` names them, and says nothing of a right drive."""

from __future__ import annotations

import doctor_scans
import numpy as np
import pytest
from corners import corners
from street import Street

from semstab import Frame
from semstab.check.scan_order import LENGTH, STRETCHES, in_order


@pytest.fixture(autouse=True)
def _of_fewer_rays(monkeypatch) -> None:
    monkeypatch.setattr(doctor_scans, "COLUMNS", 180)


MISTAKES = {mistake.name: mistake for mistake in doctor_scans.MISTAKES}


@pytest.mark.parametrize(
    "name",
    ["points with y mirrored", "labels of the points in reversed order", "poses moved by 0.42 m from a scan on"],
)
@pytest.mark.parametrize("seed", corners((0, 1), always=[0]))
def test_a_mistake_of_a_drive_is_named(name, seed) -> None:
    mistake = MISTAKES[name]
    (line,) = doctor_scans.said(mistake.plant(doctor_scans.drive(seed)))
    assert any(part in line for part in mistake.said), line


def test_nothing_is_said_of_a_right_drive() -> None:
    assert doctor_scans.said(doctor_scans.drive(0)) == []


def test_a_level_drive_that_is_upside_down_is_noted_as_its_poses_do_not_show_it() -> None:
    up, down = (
        doctor_scans.said(
            [
                Frame(k, points=points * np.float32([1, 1, z]), labels=(ids // 10).astype(np.uint8), T_wc=pose)
                for k, (points, ids, pose) in enumerate(Street.made(0))
            ]
        )
        for z in (1, -1)
    )
    assert up == []
    assert len(down) == 1
    assert "level surfaces lie above the sensors" in down[0]


def test_of_a_long_drive_stretches_of_successive_scans_are_compared() -> None:
    scans = doctor_scans.drive(0)
    long = doctor_scans.Drive([scans[k % len(scans)] for k in range(2 * STRETCHES * LENGTH)])
    chain = in_order(long, range(len(long)), None).chain
    assert len(chain.positions) == STRETCHES * LENGTH
    assert [*chain.positions[: LENGTH + 1]] == [*range(LENGTH), 23]
