"""Scans that were not deskewed: named by check, and mended by the option that it names."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from command_line import bench
from corners import corners
from scipy.spatial.transform import Rotation
from street import Street, write_street

from semstab.check import check
from semstab.configure import load_config
from semstab.datasets import open_dataset
from semstab.datasets.geometry.sweeps import SWEEPS, carried, deskewed, motion_in_sweep, share_of_sweep


def skewed(street, sweep):
    """The street as a sensor measures it that moves while it turns; a scan's pose is that of the sweep's middle."""
    around = [None, *street.poses, None]
    scans = []
    for k, points in enumerate(street.scans):
        motion, share = motion_in_sweep(*around[k : k + 3]), share_of_sweep(points, sweep)[:, None]
        moved = points - share * motion[3:]
        scans.append(Rotation.from_rotvec(-share * motion[:3]).apply(moved).astype(np.float32))
    return dataclasses.replace(street, scans=scans)


def checked(folder, **options):
    (found,) = check(load_config({"dataset": {"name": "semantickitti", "options": {"root": str(folder), **options}}}))
    return found


@pytest.mark.parametrize(("seed", "sweep"), corners([(0, "ccw-180"), (1, "cw-90")], always=[(0, "ccw-180")]))
def test_scans_that_were_not_deskewed_are_named_with_the_option_that_mends_them(seed, sweep, tmp_path) -> None:
    write_street(tmp_path / "00", skewed(Street.made(seed), sweep))
    (note,) = (line for line in checked(tmp_path).notes if "not deskewed" in line)
    assert f"--option deskew={sweep}" in note
    mended = checked(tmp_path, deskew=sweep)
    assert mended.verdict.state == "sound"
    assert not any("deskewed" in line for line in mended.notes)


def test_scans_that_were_deskewed_are_left_alone(tmp_path) -> None:
    write_street(tmp_path / "00", Street.made(1))
    assert not any("deskewed" in line for line in checked(tmp_path).notes)


def test_a_sensor_that_stands_still_tells_nothing(tmp_path) -> None:
    street = Street.made(0)
    still = Street(street.scans[:1] * 6, street.ids[:1] * 6, street.poses[:1] * 6)
    write_street(tmp_path / "00", still)
    assert not any("deskewed" in line for line in checked(tmp_path).notes)


def test_a_run_says_it_before_the_verdict(tmp_path) -> None:
    write_street(tmp_path / "00", skewed(Street.made(0), "ccw-180"))
    result = bench("run", "--data", tmp_path, "--model", "clean", "--voxel-size", "0.5", cwd=tmp_path)
    head = result.stdout.split("two views see")[0]
    assert "--option deskew=ccw-180" in " ".join(head.split())


@pytest.mark.parametrize("sweep", SWEEPS)
def test_the_option_gives_the_points_of_a_sensor_at_rest(sweep, tmp_path) -> None:
    """To 3 cm, but at the seam: the azimuth of a measured point is not quite that of the point at rest."""
    street = Street.made(5)
    write_street(tmp_path / "00", skewed(street, sweep))
    scene = open_dataset("semantickitti", {"root": tmp_path, "deskew": sweep}).scene("00")
    for k in (0, 4, 9):
        off = np.linalg.norm(scene.geometry(k).points.reshape(-1, 3) - street.scans[k], axis=1)
        assert np.quantile(off, 0.9) < 0.03
        skew = np.linalg.norm(skewed(street, sweep).scans[k] - street.scans[k], axis=1)
        assert np.quantile(skew, 0.9) > 0.3


def test_the_motion_counts_as_part_of_the_input(tmp_path) -> None:
    """Another pose of the next scan moves the points of this one."""
    digests = []
    for shift in (0.0, 0.5):
        street = Street.made(0)
        street.poses[3][0, 3] += shift
        write_street(tmp_path / f"{shift}" / "00", street)
        scene = open_dataset("semantickitti", {"root": tmp_path / f"{shift}", "deskew": "ccw-0"}).scene("00")
        digests.append(scene.digest([2], "clean"))
    assert digests[0] != digests[1]


def test_a_scan_without_neighbours_stays_as_it_is() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * 10
    assert not motion_in_sweep(None, np.eye(4), np.full((4, 4), np.nan)).any()
    np.testing.assert_allclose(deskewed(points, np.zeros(6), "cw-90"), points)


def test_points_in_the_middle_of_a_sweep_stay_and_those_at_its_end_go_half_the_way() -> None:
    motion = np.array([0, 0, 0.2, 1.0, 0, 0])
    points = np.array([[10.0, 0, 0], [-10.0, -1e-9, 0]])
    share = share_of_sweep(points, "ccw-180")
    np.testing.assert_allclose(share, [0, -0.5], atol=1e-9)
    back = Rotation.from_rotvec([0, 0, -0.1]).apply(points[1]) - [0.5, 0, 0]
    np.testing.assert_allclose(carried(points, motion, share), [points[0], back], atol=1e-8)
