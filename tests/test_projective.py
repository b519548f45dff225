"""Backend `open3d-projective` against a loop over voxels in plain Python."""

import dataclasses
import itertools
import math
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import Oracle

from semstab import Frame, Intrinsics, backends
from semstab.errors import ConfigError, DataError
from semstab.metrics import entropy, sbd, vss
from semstab.testing import EXACT, SUMS, assert_same_map, checks, random_frames, voxels

NAME = "open3d-projective"
K = 4


def projective(voxel_size, num_classes=K, initial_bytes=2**22, **options):
    with patch("semstab.backends.open3d_blocks.INITIAL_BYTES", initial_bytes):
        return backends.create(NAME, voxel_size=voxel_size, num_classes=num_classes, **options)


class LoopOverVoxels(Oracle):
    """The paper's evidence and measures of the `Oracle`, with the association turned round."""

    def __init__(self, voxel_size, num_classes, band=1.0, block_resolution=4):
        super().__init__(voxel_size, num_classes)
        self.band, self.block_resolution = band, block_resolution

    def integrate(self, frame):
        T_cw = np.linalg.inv(frame.T_wc).tolist()
        for q in sorted(self.near(frame)):
            s = self.told(frame, T_cw, q)
            if s is not None:
                self.observe(q, frame, [s])

    def near(self, frame):
        """The voxels of all blocks within band + 1.25 voxels of the centre of a voxel with a valid pixel's point."""
        reach = self.band + 1.25
        blocks = set()
        for v, u in np.argwhere(frame.valid).tolist():
            q = self.voxel(frame, self.world_point(frame, u, v, float(frame.depth[v, u])))
            ends = [[math.floor((i + 0.5 + side) / self.block_resolution) for side in (-reach, reach)] for i in q]
            blocks.update(itertools.product(*(range(low, high + 1) for low, high in ends)))
        corners = itertools.product(range(self.block_resolution), repeat=3)
        return {
            tuple(self.block_resolution * b + i for b, i in zip(block, corner, strict=True))
            for block, corner in itertools.product(blocks, list(corners))
        }

    def told(self, frame, T_cw, q):
        """The evidence of the pixel that the voxel's centre falls on, or None where it lies outside the band."""
        a, b, c = ((i + 0.5) * self.voxel_size for i in q)
        x, y, z = (row[0] * a + row[1] * b + row[2] * c + row[3] for row in T_cw[:3])
        if z <= 0:
            return None
        camera = frame.intrinsics
        u, v = round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)
        H, W = frame.shape
        if not (0 <= u < W and 0 <= v < H) or not self.has_depth(float(frame.depth[v, u])):
            return None
        if abs(float(frame.depth[v, u]) - z) > self.band * self.voxel_size:
            return None
        return self.evidence(frame, u, v)


@settings(checks, max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    voxel_size=st.sampled_from([0.3, 0.7]),
    band=st.sampled_from([0.5, 1.0, 1.6]),
    block_resolution=st.sampled_from([2, 4]),
)
def test_the_map_is_a_loop_over_voxels(seed, voxel_size, band, block_resolution):
    backend = projective(voxel_size, band=band, block_resolution=block_resolution)
    oracle = LoopOverVoxels(voxel_size, K, band, block_resolution)
    for frame in random_frames(seed, count=3, K=K):
        small = frame.every(5)
        backend.integrate(small)
        oracle.integrate(small)
    assert_same_map(backend.table(), oracle.table(), 1e-9)
    assert (backend.table().pixels == backend.table().op).all()


# --- By hand ----------------------------------------------------------------------------------------------------------


def wall(index, depth=2.6, labels=0, shape=(5, 5), T_wc=None):
    """A camera in the middle of voxel (0, 0, 0) of 1 m that looks along z at a wall; a pixel is 0.5 m wide at 2.5 m."""
    T = np.eye(4)
    T[:3, 3] = (0.5, 0.5, 0)
    camera = Intrinsics(5, 5, (shape[1] - 1) / 2, (shape[0] - 1) / 2)
    depth = np.broadcast_to(np.float32(depth), shape)
    return Frame(index, depth, camera, T if T_wc is None else T_wc, np.broadcast_to(np.uint8(labels), shape))


def test_a_wall_is_two_layers_thick():
    """Centres at z = 2.5 and 3.5 m lie within 1 m of the wall at 2.6 m, those at 1.5 m do not.

    At 2.5 m the centre of voxel x = 1 is 1 m off the axis, 2 pixels, and in the image; at 3.5 m it is 1.4 pixels off.
    x = 2 is outside.
    """
    table_of = projective(1.0)
    table_of.integrate(wall(0))
    expected = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (2, 3)]
    assert voxels(table_of.table()) == expected
    wide = projective(1.0, band=1.2)
    wide.integrate(wall(0))
    assert set(voxels(wide.table())) == {*expected, (0, 0, 1)}  # at 1.5 m the next centre is 3.3 pixels off


def test_the_report_counts_look_ups():
    backend = projective(1.0)
    report = backend.integrate(wall(7))
    assert (report.frame, report.points, report.voxels, report.new_voxels, report.map_voxels) == (7, 18, 18, 18, 18)
    again = backend.integrate(wall(8))
    assert (again.new_voxels, again.map_voxels, again.map_vss_all, again.map_recurrent) == (0, 18, 1, 0)
    assert report.association_seconds + report.update_seconds == pytest.approx(report.seconds)
    assert backend.events() is None


# --- What holds for any frames ----------------------------------------------------------------------------------------


def fuse(frames, **options):
    backend = projective(0.25, **options)
    reports = [backend.integrate(frame) for frame in frames]
    return backend.table(), [dataclasses.replace(report, **NO_TIMES) for report in reports]


NO_TIMES = {"seconds": 0.0, "association_seconds": 0.0, "update_seconds": 0.0}


@settings(checks, max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_measures_stay_in_their_bounds(seed):
    table, _ = fuse(random_frames(seed, count=3, K=K))
    assert (table.op >= 1).all()
    assert np.allclose(table.evidence.sum(axis=1), table.op)
    assert ((vss(table) >= 1 / K - 1e-12) & (vss(table) <= 1 + 1e-12)).all()
    assert ((entropy(table) >= 0) & (entropy(table) <= 1 + 1e-12)).all()
    assert (np.isnan(sbd(table)) == (table.op == 1)).all()
    assert (np.nan_to_num(sbd(table)) >= 0).all()
    assert (np.nan_to_num(sbd(table)) <= 1).all()


def test_the_same_frames_give_the_same_map_bit_for_bit():
    frames = random_frames(seed=3, count=5, K=K)
    (one, reports_one), (two, reports_two) = fuse(frames), fuse(frames)
    for column in (*EXACT, *SUMS):
        np.testing.assert_array_equal(getattr(one, column), getattr(two, column), err_msg=column)
    assert reports_one == reports_two


def test_a_map_that_grows_forgets_nothing():
    frames = random_frames(seed=4, count=5, K=K)
    assert_same_map(fuse(frames)[0], fuse(frames, initial_bytes=0)[0], 0)


def test_coordinates_as_large_as_utm_shift_the_map_and_change_nothing():
    frames = random_frames(seed=5, count=3, K=K)
    shift = np.array([500_000, 4_000_000, -64])
    moved = [dataclasses.replace(frame, T_wc=frame.T_wc + np.pad(shift[:, None], ((0, 1), (3, 0)))) for frame in frames]
    here, there = fuse(frames)[0], fuse(moved)[0]
    assert (there.index == here.index + 4 * shift).all()
    assert there.op.tolist() == here.op.tolist()
    np.testing.assert_allclose(there.evidence, here.evidence, rtol=0, atol=1e-12)


def test_voxels_are_projected_in_parts():
    frames = random_frames(seed=6, count=2, K=K)
    whole, _ = fuse(frames)
    with patch("semstab.backends.open3d_projective.CHUNK", 1000):
        parts, _ = fuse(frames)
    assert_same_map(whole, parts, 0)


def test_a_frame_without_a_valid_pixel_adds_nothing():
    backend = projective(1.0)
    report = backend.integrate(wall(0, depth=0))
    assert (report.points, report.map_voxels, len(backend.table())) == (0, 0, 0)
    backend.integrate(wall(1))
    assert len(backend.table()) == 18


# --- Errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (wall(3, labels=9), "frame 3, labels: label id 9 is outside 0 to 3"),
        (dataclasses.replace(wall(3), labels=None, scores=np.ones((5, 5, 2))), "scores hold 2 classes, the map 4"),
        (wall(3, depth=3e6), r"frame 3 spans .* more than 2\^20 voxels of 1 m"),
    ],
)
def test_a_frame_that_cannot_be_fused_leaves_the_map_unchanged(frame, message):
    backend = projective(1.0)
    backend.integrate(wall(0))
    with pytest.raises(DataError, match=message):
        backend.integrate(frame)
    table = backend.table()
    assert (len(table), table.op.max()) == (18, 1)


@pytest.mark.parametrize("band", [0, -1, math.inf, math.nan])
def test_a_band_must_be_positive(band):
    with pytest.raises(ConfigError, match="band = "):
        projective(1.0, band=band)


def test_it_says_that_it_is_not_pointwise():
    assert backends.REGISTRY.load(NAME).pointwise is False
    assert backends.takes_option(NAME, "band")
