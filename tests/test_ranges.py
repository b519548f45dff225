"""What is said of the range up to which labels are reliable."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_events import spots_of

from semstab.data.statistics import (
    UNKNOWN,
    Interval,
    MapStatistics,
    RangeAgreement,
    RangeStratum,
    StabilityVerdict,
    metres,
)
from semstab.statistics.ranges import range_agreement


def stratum(low, high, *alpha):
    return RangeStratum(low, high, 0.5, 1000, Interval(*alpha) if alpha else UNKNOWN)


NEAR, MIDDLE = stratum(0, 10, 0.9, 0.85, 0.95), stratum(10, 20, 0.6, 0.4, 0.8)


@pytest.mark.parametrize(
    ("strata", "reliable", "text"),
    [
        ((NEAR, MIDDLE), (10, 10, 20), "reliable up to 10 m (10 to 20 m)"),
        ((NEAR, stratum(10, 20)), (10, 10, 10), "reliable up to 10 m (the farthest seen)"),
        ((stratum(0, 10), stratum(10, 20, 0.3, 0.2, 0.4)), (0, 0, 0),
         "not reliable from 10 to 20 m (alpha .30 (.20 to .40))"),
        ((stratum(0, 5), stratum(5, 10, 0.9, 0.8, 0.95), stratum(10, 91.8376, 0.5, 0.4, 0.8)), (10, 10, 91.8376),
         "reliable up to 10 m (10 to 91.8 m, 0 to 5 m not assessed)"),
    ],
)  # fmt: skip
def test_the_text_names_a_range_that_has_a_number(strata, reliable, text) -> None:
    found = RangeAgreement(strata, 0.667, *reliable)
    assert (found.is_told, found.text) == ("farthest" not in text, text)


@pytest.mark.parametrize("reliable", [(0, 0, 20), (20, 20, 20), (10, 0, 20)])
def test_nothing_is_said_where_it_is_not_known_or_labels_are_reliable_everywhere(reliable) -> None:
    assert not RangeAgreement((NEAR, MIDDLE), 0.667, *reliable).is_told


@pytest.mark.parametrize(("twice", "said"), [(100, False), (208, False), (209, True), (1500, True)])
def test_a_range_from_which_hardly_a_spot_was_seen_twice_has_no_alpha(twice, said) -> None:
    """Two views at the origin: 3,000 spots at 4 to 5 m, `twice` in both, 9 beyond 5 m; 3,000 at 20 m, all in both."""
    rng, n = np.random.default_rng(0), 3000
    index = np.concatenate([np.stack([np.full(n, x), *np.divmod(np.arange(n), 60)], axis=1) for x in (16, 80)])
    labels = np.repeat(rng.integers(0, 3, 2 * n)[:, None], 2, axis=1)
    labels[twice:n, 1] = -1
    found = range_agreement(spots_of(labels, index=index, centres=[[0, 6, 7.5], [0.1, 6, 7.5]], spacing=0.25))
    assert found is not None
    near, far = found.strata[0], found.strata[-1]
    assert math.isnan(near.alpha.value) != said
    assert far.alpha.value == pytest.approx(1)
    assert found.farthest == far.high


def seen_from_afar(labels, distance=20):
    """Two views of 3,000 spots at 4 to 5 m, all of them in both, and of as many spots far away."""
    n = len(labels) // 2
    index = np.concatenate(
        [np.stack([np.full(n, x), *np.divmod(np.arange(n), 60)], axis=1) for x in (16, 4 * distance)]
    )
    found = range_agreement(spots_of(labels, index=index, centres=[[0, 6, 7.5], [0.1, 6, 7.5]], spacing=0.25))
    assert found is not None
    return found


def test_a_range_with_one_class_is_not_assessed() -> None:
    """All labels near by are of one class, but 30 of 3,000 that the views disagree about: alpha would be below 0."""
    rng = np.random.default_rng(0)
    labels = np.repeat(rng.integers(0, 3, 6000)[:, None], 2, axis=1)
    labels[:3000] = 0
    labels[:3000:100, 1] = 1
    found = seen_from_afar(labels)
    near = [row for row in found.strata if row.high <= 7]
    assert near[0].spots >= 200
    assert not any(row.is_assessed for row in near)
    assert found.strata[-1].is_assessed
    assert found.reliable == found.farthest
    assert "not reliable" not in found.text


def test_no_range_is_beyond_what_was_seen() -> None:
    labels = np.repeat(np.random.default_rng(0).integers(0, 3, 6000)[:, None], 2, axis=1)
    found = seen_from_afar(labels, 92)
    assert 92 < found.farthest < 93.5
    assert found.reliable == found.strata[-1].high == found.farthest


@pytest.mark.parametrize(("distance", "text"), [
    (0.0, "0"), (1.5, "1.5"), (30, "30"), (91.8376, "91.8"), (150, "150"), (1234.5, "1230"), (0.7, "0.7"),
])  # fmt: skip
def test_distances_are_rounded_down(distance, text) -> None:
    assert metres(distance) == text


@pytest.mark.parametrize(("level", "of_all", "told"), [
    ("stable", None, True), ("usable", None, True), ("undecided", None, False), ("unstable", None, False),
    ("uninformative", None, False), ("no verdict", None, False), ("stable", "unstable", False),
])  # fmt: skip
def test_a_range_is_printed_only_where_labels_are_acted_on(level, of_all, told) -> None:
    statistics = SimpleNamespace(
        verdict=StabilityVerdict(level, 0.9, "", of_all), ranges=RangeAgreement((NEAR, MIDDLE), 0.667, 10, 10, 20)
    )
    assert (MapStatistics.told_ranges.fget(statistics) is not None) == told
