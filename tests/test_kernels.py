"""The quick way to a pixel's voxel equals the protocol's expression, at voxel faces and far from the origin as well."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from semstab.backends.shared import pixel_keys, tile_loops
from semstab.backends.shared.keys import HALF
from semstab.backends.shared.tile_loops import LANES, runs_of_eight
from semstab.model.labels import IGNORE_8BIT

W = 300
coordinate = st.one_of(
    st.floats(-1e6, 1e6), st.integers(-40, 40).map(lambda n: n * 0.2), st.sampled_from([0.0, 5.6e6, -3.2e6])
)


@settings(deadline=None, max_examples=300)
@given(
    st.lists(coordinate, min_size=3, max_size=3),
    st.sampled_from([0.05, 0.2, 0.25, 1.0]),
    st.booleans(),
    st.floats(0.1, 2e5),
    st.integers(0, 2**31),
)
def test_keys_equal_the_protocols_expression(t, size, aligned, far, seed) -> None:
    """Aligned cameras look along an axis from a voxel's corner: many of their points lie on a face."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, 3] = t
    if not aligned:
        T[:3, :3] = Rotation.random(random_state=seed % 2**31).as_matrix()
    depth = rng.uniform(0, far, W) if not aligned else rng.integers(0, 40, W) * size
    depth = np.where(rng.random(W) < 0.1, rng.choice([0.0, -1.0, np.nan, np.inf], W), depth).astype(np.float32)
    labels = rng.choice([0, 1, IGNORE_8BIT], W).astype(np.uint8)
    ray_x, ray_y = (np.arange(W) - 150) / 300, 0.25
    origin = np.floor(T[:3, 3] / size)
    exact, quick = np.empty(W, dtype=np.int64), np.empty(W, dtype=np.int64)
    terms = pixel_keys.frame_terms(ray_x, T, size)
    lost = pixel_keys.exact_keys_of_row(depth, labels, ray_x, ray_y, T, size, *origin, IGNORE_8BIT, exact)
    assert pixel_keys.keys_of_row(depth, labels, ray_x, ray_y, T, size, *origin, IGNORE_8BIT, *terms, quick) == lost
    np.testing.assert_array_equal(quick, exact)


def test_most_pixels_take_the_quick_way() -> None:
    """Else it would only cost: of a tilted view hardly a block is in doubt."""
    rng = np.random.default_rng(1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=3).as_matrix(), [3.1, -7.7, 5.6e6]
    ray_x = (np.arange(pixel_keys.BLOCK) - 128.3) / 300
    rays, margin = pixel_keys.frame_terms(ray_x, T, 0.2)
    offset = T[:3, 3] / 0.2 - np.floor(T[:3, 3] / 0.2) + HALF
    start = T[:3, 2] / 0.2
    out, labels = np.empty(pixel_keys.BLOCK, dtype=np.int64), np.zeros(pixel_keys.BLOCK, dtype=np.uint8)
    doubts = 0
    for _ in range(200):
        depth = rng.uniform(1, 50, pixel_keys.BLOCK).astype(np.float32)
        doubts += bool(pixel_keys.keys_fused(depth, labels, IGNORE_8BIT, *rays, *start, *offset, margin, out))
    assert doubts <= 2


def test_pixels_without_depth_are_not_in_doubt() -> None:
    """They stand at the camera, here in a corner of voxels."""
    n = pixel_keys.BLOCK
    rays, margin = pixel_keys.frame_terms((np.arange(n) - 128.3) / 300, np.eye(4), 0.2)
    nothing, labels, out = np.zeros(n, np.float32), np.zeros(n, np.uint8), np.empty(n, dtype=np.int64)
    at = (0.0, 0.0, 5.0, HALF, HALF, HALF)
    assert not pixel_keys.keys_fused(nothing, labels, IGNORE_8BIT, *rays, *at, margin, out)
    assert (out == -1).all()


@pytest.mark.parametrize("margin", [2.0**-31, 2.0**-30 * 1.01, 2.0**-20, 1e-3, 0.4, 1e4])
def test_a_voxels_face_is_as_wide_as_its_margin_at_least(margin) -> None:
    """A number with half the face added has none of the bits left exactly if it lies in the face."""
    half, face = tile_loops.face_terms(margin)
    assert half >= min(margin, 1.0)
    for fraction in (0.0, 0.99 * half, -0.99 * half, 1.01 * half, -1.01 * half, 0.5):
        bits = int(np.float64(tile_loops.REACH + 7 + fraction + half).view(np.int64))
        assert (bits & face == 0) == (abs(fraction) < half or half >= 0.5)


@pytest.mark.parametrize("features", [None, ""])
def test_runs_are_the_same_with_and_without_wide_vectors(features, monkeypatch) -> None:
    """None: the instructions of this machine."""
    if features is not None:
        monkeypatch.setattr("numba.core.codegen.JITCPUCodegen.magic_tuple", lambda _: ("", "", features))

    @nb.njit
    def runs(words, run_word, run_end):
        n = 0
        for at in range(0, words.shape[0] - LANES, LANES):
            n = runs_of_eight(words, at, run_word, run_end, n)
        return n

    rng = np.random.default_rng(2)
    for values in (1, 2, 50):
        words = np.append(rng.integers(0, values, 10 * LANES), -1)
        run_word, run_end = np.zeros((2, len(words) + LANES), dtype=np.int64)
        n = runs(words, run_word, run_end)
        last = np.flatnonzero(words[:-1] != words[1:])
        np.testing.assert_array_equal(run_end[:n], last + 1)
        np.testing.assert_array_equal(run_word[:n], words[last])
