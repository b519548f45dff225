"""Matched-region flicker on hand-worked maps, and against a brute-force matching."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semstab.errors import ConfigError, DataError
from semstab.metrics import RegionChange, matched_region_flicker
from semstab.testing import checks

SIDE = 40
TILES = np.kron(np.arange(1, 26).reshape(5, 5), np.ones((SIDE, SIDE), dtype=int)).astype(np.uint16)
"""25 regions of 40x40 pixels."""


def change(previous, current, **options):
    return matched_region_flicker(np.array(previous), np.array(current), **options)


def assert_unchanged(found: RegionChange, regions: int) -> None:
    assert (found.flicker_percent, found.matched, found.births, found.deaths) == (0, regions, 0, 0)
    assert found.variation_of_information == pytest.approx(0, abs=1e-9)


# --- By hand ----------------------------------------------------------------------------------------------------------


def test_nothing_changes():
    assert_unchanged(change(TILES, TILES), regions=25)


def test_permuted_ids_are_no_change():
    permuted = np.concatenate([[0], np.random.default_rng(0).permutation(25) + 100]).astype(np.uint16)[TILES]
    assert_unchanged(change(TILES, permuted), regions=25)


def test_a_region_that_is_split_in_half_keeps_one_half():
    split = TILES.copy()
    split[:SIDE, : SIDE // 2] = 99
    found = change(TILES, split)
    assert found.flicker_percent == pytest.approx(2)
    assert (found.matched, found.births, found.deaths) == (25, 1, 0)
    assert found.variation_of_information == pytest.approx(1 / 25)  # one bit in one region of 25
    assert change(split, TILES).deaths == 1


def test_a_shift_by_3_pixels_of_40():
    found = change(TILES, np.roll(TILES, 3, axis=1))
    assert found.flicker_percent == pytest.approx(7.5)
    assert (found.matched, found.births, found.deaths) == (25, 0, 0)


def test_pixels_unassigned_in_both_maps_did_not_change():
    assert change([[0, 0, 1, 1]], [[0, 0, 7, 7]]).flicker_percent == 0
    assert change([[0, 0, 1, 1]], [[0, 7, 7, 7]]).flicker_percent == pytest.approx(25)
    found = change([[0, 0]], [[3, 3]])
    assert (found.flicker_percent, found.matched, found.births, found.deaths) == (100, 0, 1, 0)


def test_regions_that_hardly_overlap_are_not_one():
    previous, current = [[1, 1, 1, 1, 0, 0, 0]], [[0, 0, 0, 2, 2, 2, 2]]  # IoU 1/7
    found = change(previous, current)
    assert (found.matched, found.births, found.deaths, found.flicker_percent) == (0, 1, 1, 100)
    found = change(previous, current, iou_threshold=0.1)
    assert (found.matched, found.births, found.deaths) == (1, 0, 0)
    assert found.flicker_percent == pytest.approx(100 * 6 / 7)


def test_pixels_that_are_not_valid_do_not_count():
    valid = np.array([[True, True, False]])
    found = change([[1, 1, 2]], [[5, 5, 9]], valid=valid)
    assert (found.flicker_percent, found.matched, found.births) == (0, 1, 0)


def test_without_a_valid_pixel_it_is_undefined():
    found = change([[1]], [[1]], valid=np.array([[False]]))
    assert math.isnan(found.flicker_percent)
    assert math.isnan(found.variation_of_information)
    assert (found.matched, found.births, found.deaths) == (0, 0, 0)


def test_maps_must_have_one_size():
    with pytest.raises(DataError, match=r"differ in size \(2x1 and 1x1\)"):
        change([[1, 2]], [[1]])


@pytest.mark.parametrize("threshold", [-0.1, 1, math.nan])
def test_the_threshold_is_a_share(threshold):
    with pytest.raises(ConfigError, match="iou_threshold"):
        change([[1]], [[1]], iou_threshold=threshold)


# --- Against every possible matching ----------------------------------------------------------------------------------


def best_matching(previous, current):
    """The largest sum of IoUs over all one-to-one matchings, by trying them all."""
    rows, columns = (sorted(set(ids.ravel().tolist()) - {0}) for ids in (previous, current))
    if len(rows) > len(columns):
        return best_matching(current, previous)
    iou = {
        (i, j): np.sum((previous == i) & (current == j)) / np.sum((previous == i) | (current == j))
        for i in rows
        for j in columns
    }
    chosen = (zip(rows, order, strict=True) for order in itertools.permutations(columns, len(rows)))
    return max(sum(iou[pair] for pair in pairs) for pairs in chosen)


REGION_MAPS = hnp.arrays(np.int64, (4, 5), elements=st.integers(0, 4))


@checks
@given(REGION_MAPS, REGION_MAPS)
def test_the_matching_is_the_best_one(previous, current):
    from semstab.metrics.flicker import _Contingency

    table = _Contingency.between(previous.ravel(), current.ravel())
    found = 0.0
    for p, q in table.pairs(0):
        inside = int(table.shared[p, q])
        found += inside / (int(table.shared[p].sum()) + int(table.shared[:, q].sum()) - inside)
    assert found == pytest.approx(best_matching(previous, current))


@checks
@given(REGION_MAPS, st.permutations([1, 2, 3, 4]))
def test_renamed_regions_are_the_same_ones(regions, names):
    count = len(set(regions.ravel().tolist()) - {0})
    assert_unchanged(change(regions, np.array([0, *names])[regions]), regions=count)


@checks
@given(REGION_MAPS, REGION_MAPS)
def test_counts_add_up_and_variation_of_information_is_symmetric(previous, current):
    found, back = change(previous, current), change(current, previous)
    assert 0 <= found.flicker_percent <= 100
    assert found.matched + found.births == len(set(current.ravel().tolist()) - {0})
    assert found.matched + found.deaths == len(set(previous.ravel().tolist()) - {0})
    assert found.variation_of_information == pytest.approx(back.variation_of_information)
    assert found.variation_of_information >= 0


@checks
@given(REGION_MAPS, REGION_MAPS)
def test_variation_of_information_is_that_of_its_definition(previous, current):
    pairs = list(zip(previous.ravel().tolist(), current.ravel().tolist(), strict=True))
    n, expected = len(pairs), 0.0
    for p, q in set(pairs):
        joint = pairs.count((p, q)) / n
        expected -= joint * math.log2(joint / (previous == p).mean())
        expected -= joint * math.log2(joint / (current == q).mean())
    assert change(previous, current).variation_of_information == pytest.approx(expected, abs=1e-9)
