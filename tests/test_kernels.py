"""Parts of the label path: the width of a voxel's face, and runs of equal words."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.backends.shared import tile_loops
from semstab.backends.shared.tile_loops import LANES, runs_of


@pytest.mark.parametrize("margin", [2.0**-31, 2.0**-30 * 1.01, 2.0**-20, 1e-3, 0.4, 1e4])
def test_a_voxels_face_is_as_wide_as_its_margin_at_least(margin) -> None:
    """A number with half the face added has none of the bits left exactly if it lies in the face."""
    half, face = tile_loops.face_terms(margin)
    assert half >= min(margin, 1.0)
    for fraction in (0.0, 0.99 * half, -0.99 * half, 1.01 * half, -1.01 * half, 0.5):
        bits = int(np.float64(tile_loops.REACH + 7 + fraction + half).view(np.int64))
        assert (bits & face == 0) == (abs(fraction) < half or half >= 0.5)


def test_runs_of_equal_words() -> None:
    rng = np.random.default_rng(2)
    for values in (1, 2, 50):
        words = np.append(rng.integers(0, values, 10 * LANES), -1)
        run_word, run_end = np.zeros((2, len(words) + LANES), dtype=np.int64)
        n = runs_of(words, run_word, run_end)
        last = np.flatnonzero(words[:-1] != words[1:])
        np.testing.assert_array_equal(run_end[:n], last + 1)
        np.testing.assert_array_equal(run_word[:n], words[last])
