"""Places that the sampler looks at: a damaged pixel that shows thousands of kilometres takes no more time."""

from __future__ import annotations

import numpy as np

from semstab.statistics.loops.new_spots import MOST_PLACES, number_of


def test_the_number_of_places_in_a_block_is_bounded():
    assert number_of(1e30, 0.5) == MOST_PLACES
    assert number_of(np.inf, 0.0) == MOST_PLACES
    assert number_of(2.4, 0.7) == 3
    assert number_of(0.2, 0.1) == 0
