"""What is written by hand for compiled loops gives the numbers of plain loops."""

from __future__ import annotations

import numpy as np
import plain_loops
import pytest

from semstab.backends.shared import beliefs, columns, score_loops
from semstab.backends.shared.score_loops import LANES

RNG = np.random.default_rng(0)


def test_the_lowest_bit_of_a_mask():
    masks = [1, 2, 12, 1 << 40, -(2**63), *RNG.integers(1, 2**62, 200).tolist()]
    assert [columns.lowest_bit(mask) for mask in masks] == [(mask & -mask).bit_length() - 1 for mask in masks]


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_the_update_of_a_belief(kind):
    by_hand = plain_loops.compiled_call(beliefs.observe_eights)
    for op in (0, 1, 7, 300):
        evidence = (op * RNG.dirichlet(np.full(2 * LANES, 0.2))).astype(kind)
        sums, same = 5 * RNG.dirichlet(np.full(2 * LANES, 0.3)), evidence.copy()
        found = by_hand(evidence, sums, 0.2, 1 / max(op, 1), 1 / (op + 1))
        expected = plain_loops.observe_eights(same, sums, 0.2, 1 / max(op, 1), 1 / (op + 1))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
        np.testing.assert_array_equal(evidence, same)


def test_the_entropy_of_a_belief():
    by_hand = plain_loops.compiled_call(beliefs.plogp_eights)
    evidence = 9 * RNG.dirichlet(np.full(LANES, 0.5))
    assert by_hand(evidence, 1 / 9) == pytest.approx(plain_loops.plogp_eights(evidence, 1 / 9), rel=1e-13)


@pytest.mark.parametrize("K", [2, 7, 8, 41])
def test_the_sums_of_scores(K):
    scale_eight = plain_loops.compiled_call(score_loops.scale_eight)
    add_two = plain_loops.compiled_call(score_loops.add_two)
    scores = RNG.random((LANES + 2, K)).astype(np.float32)
    scores[3], scores[5] = 0, np.inf
    flat, room = scores.reshape(-1), -(-K // LANES) * LANES
    found, expected = ([np.arange(LANES), np.zeros(LANES), np.full(room, 9.0)] for _ in range(2))
    for (keys, scale, sums), scaled, added in (
        (found, scale_eight, add_two), (expected, plain_loops.scale_eight, plain_loops.add_two)
    ):  # fmt: skip
        scaled(flat, 0, K, keys, scale, 0)
        added(flat, 0, K, scale, 0, 8, sums, 0, True)
        added(flat, 0, K, scale, 6, 7, sums, 0, False)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[0][[3, 5]], -1)
    sound = found[0] >= 0
    np.testing.assert_allclose(found[1][sound], expected[1][sound], rtol=1e-12)
    np.testing.assert_allclose(found[2], expected[2], rtol=1e-12)
