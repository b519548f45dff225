"""What is said of the range up to which labels are reliable."""

import math

import numpy as np
import pytest
from simulated_events import cells_of

from semstab.data.statistics import UNKNOWN, Interval, RangeAgreement, RangeStratum
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
         "reliable at no range (alpha .30 (.20 to .40) from 10 to 20 m)"),
    ],
)  # fmt: skip
def test_the_text_names_a_range_that_has_a_number(strata, reliable, text) -> None:
    found = RangeAgreement(strata, 0.667, *reliable)
    assert (found.is_told, found.text) == ("farthest" not in text, text)


@pytest.mark.parametrize("reliable", [(0, 0, 20), (20, 20, 20)])
def test_nothing_is_said_where_it_is_not_known_or_labels_are_reliable_everywhere(reliable) -> None:
    assert not RangeAgreement((NEAR, MIDDLE), 0.667, *reliable).is_told


@pytest.mark.parametrize(("twice", "said"), [(100, False), (1500, True)])
def test_a_range_from_which_hardly_a_spot_was_seen_twice_has_no_alpha(twice, said) -> None:
    """Two views at the origin: 3,000 cells at 4 to 5 m, so many of them in both; 3,000 at 20 m, all in both."""
    rng, n = np.random.default_rng(0), 3000
    index = np.concatenate([np.stack([np.full(n, x), *np.divmod(np.arange(n), 60)], axis=1) for x in (16, 80)])
    labels = np.repeat(rng.integers(0, 3, 2 * n)[:, None], 2, axis=1)
    labels[twice:n, 1] = -1
    found = range_agreement(cells_of(labels, index=index, centres=[[0, 6, 7.5], [0.1, 6, 7.5]]))
    assert found is not None
    near, far = found.strata[0], found.strata[-1]
    assert math.isnan(near.alpha.value) != said
    assert far.alpha.value == pytest.approx(1)
    assert found.farthest == far.high
