"""Places that the sampler looks at, and the area for which a spot stands, whichever way a surface is turned."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semstab.core.compiled import serial
from semstab.data.frames import Frame, Intrinsics
from semstab.statistics import Sampler
from semstab.statistics.loops.cells import EDGE, area_in_cell, hash_cell, refill
from semstab.statistics.loops.new_spots import MOST_PLACES, number_of

H, W, FOCAL, DISTANCE = 120, 160, 150.0, 5.0
PINHOLE = Intrinsics(fx=FOCAL, fy=FOCAL, cx=(W - 1) / 2, cy=(H - 1) / 2)


@serial
def area(normal, x, y, z):
    return area_in_cell(normal, x, y, z)


def test_the_number_of_places_in_a_block_is_bounded():
    assert number_of(1e30, 0.5) == MOST_PLACES
    assert number_of(np.inf, 0.0) == MOST_PLACES
    assert number_of(2.4, 0.7) == 3
    assert number_of(0.2, 0.1) == 0


@pytest.mark.parametrize("normal", [(0.0, 0, 1), (1.0, -1, 0), (-1.0, 1, 1), (-3.0, 0.5, 8), (1e-9, -1.0, 1e-9)])
def test_the_area_of_a_plane_in_a_cube_is_that_of_points_drawn_on_it(normal):
    rng = np.random.default_rng(0)
    point, along = rng.uniform(0.2, 0.8, 3), np.linalg.svd(np.array([normal]))[2][1:]
    drawn = point + rng.uniform(-2, 2, (200_000, 2)) @ along
    inside = ((drawn > 0) & (drawn < 1)).all(axis=1).mean() * 16
    assert area(normal, *point) == pytest.approx(inside, abs=0.05)


def test_no_plane_has_more_than_the_square_of_the_spacing_in_a_cell():
    largest = EDGE**2 * area((1.0, 1.0, 0.0), 0.5, 0.5, 0.5)
    assert 0.95 < largest < 1
    assert (EDGE + 1 / 64) ** 2 * largest / EDGE**2 > 1


def wall(turned, frames=6):
    """A wall, five metres away, from cameras that move along it and turn; the world is turned, too."""
    v, u = np.mgrid[:H, :W]
    rays = np.stack([(u - PINHOLE.cx) / FOCAL, (v - PINHOLE.cy) / FOCAL, np.ones((H, W))], axis=-1)
    for k in range(frames):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_euler("y", 16 * k - 40, degrees=True).as_matrix(), (0.4 * k - 1, 0, 0)
        depth = (DISTANCE / (rays @ T[2, :3])).astype(np.float32)
        T[:3] = turned @ T[:3]
        yield Frame(index=k, depth=depth, T_wc=T, intrinsics=PINHOLE, labels=np.full((H, W), k % 3, np.uint8))


def scan_of(frame):
    """The frame as a scan, whose x axis is the one that looks ahead."""
    v, u = np.mgrid[:H, :W]
    rays = np.stack([np.ones((H, W)), (u - PINHOLE.cx) / FOCAL, (v - PINHOLE.cy) / FOCAL], axis=-1)
    points = (rays * frame.depth[..., None]).astype(np.float32).reshape(1, -1, 3)
    T = frame.T_wc.copy()
    T[:3, :3] = T[:3, [2, 0, 1]]
    return Frame(index=frame.index, T_wc=T, labels=frame.labels.reshape(1, -1), points=points)


def spots_on_wall(turned, as_scans):
    """How many spots a turned wall has where all frames see it, and how many squares of the spacing."""
    sampler = Sampler(3, moving=False)
    for frame in wall(turned):
        sampler.add(scan_of(frame) if as_scans else frame)
    sample = sampler.sample()
    at = sample.point @ turned
    assert np.abs(at[:, 2] - DISTANCE).max() < 0.01
    return np.count_nonzero((np.abs(at[:, :2]) < 1).all(axis=1)), (2 / sample.spacing) ** 2


@pytest.mark.parametrize("as_scans", [False, True])
def test_a_wall_has_as_many_spots_whichever_way_it_is_turned(as_scans):
    """Cells that it meets in the square of their edge are 1 to 1.7. One spot stands for the square of the spacing."""
    counts = [spots_on_wall(Rotation.random(random_state=seed).as_matrix(), as_scans) for seed in range(8)]
    spots, squares = np.transpose(counts)
    assert np.abs(spots / squares - 1).max() < 4 / np.sqrt(squares.min())
    assert spots.sum() / squares.sum() == pytest.approx(1, abs=0.04)


def test_a_bounded_sample_keeps_and_adds_no_spot_of_cells_that_were_met():
    """Frames of the same places with other labels add answers, not spots, whatever was dropped before."""
    sampler, turned = Sampler(3, 40_000, moving=False), Rotation.random(random_state=1).as_matrix()
    counts, shares = [], []
    for times in range(8):
        for frame in wall(turned):
            sampler.add(dataclasses.replace(frame, labels=((frame.labels + times) % 3).astype(np.uint8)))
        sample = sampler.sample()
        counts.append(len(sample.within(1 << 28).point))
        shares.append(sample.share)
    assert set(counts) == {counts[0]} != {0}
    assert shares[-1] < shares[0] == 1 << 32


def test_a_larger_table_has_all_cells_that_were_met_and_are_in_the_sample():
    low, cells = np.array([-1000, 500, 0]), np.random.default_rng(0).integers(0, 50, (300, 3))
    cells = np.unique(cells, axis=0)
    hashed = np.array([hash_cell(*cell) for cell in (cells + low).tolist()], np.int64)
    keys = ((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]).astype(np.int64)
    table, larger, fewer = np.full(1024, -1), np.full(4096, -1), np.full(1024, -1)
    table[:: 1024 // len(keys)][: len(keys)] = keys
    assert refill(table, 1 << 32, low, larger) == len(keys)
    assert sorted(larger[larger >= 0].tolist()) == sorted(keys.tolist())
    assert refill(larger, 1 << 30, low, fewer) == np.count_nonzero(hashed < 1 << 30) > 50
    assert sorted(fewer[fewer >= 0].tolist()) == sorted(keys[hashed < 1 << 30].tolist())
