import math

import numpy as np
import pytest
import scipy.spatial.distance
import scipy.stats
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semstab.data.information import entropy_bits, js_divergence, normalise
from semstab.testing import checks


def distributions(K):
    weights = hnp.arrays(np.float64, K, elements=st.just(0.0) | st.floats(1e-12, 1))
    return weights.filter(np.any).map(lambda w: w / w.sum())


pairs = st.integers(2, 9).flatmap(lambda K: st.tuples(distributions(K), distributions(K)))


@checks
@given(pairs)
def test_entropy_is_scipys(pair):
    p, _ = pair
    assert entropy_bits(p) == pytest.approx(scipy.stats.entropy(p, base=2), abs=1e-12)


@checks
@given(pairs)
def test_divergence_is_scipys(pair):
    p, q = pair
    assert js_divergence(p, q) == pytest.approx(scipy.spatial.distance.jensenshannon(p, q, base=2) ** 2, abs=1e-12)


@checks
@given(pairs)
def test_divergence_is_symmetric_bounded_and_0_for_equals(pair):
    p, q = pair
    assert js_divergence(p, q) == pytest.approx(js_divergence(q, p), abs=1e-15)
    assert 0 <= js_divergence(p, q) <= 1
    assert js_divergence(p, p) == 0


@checks
@given(pairs)
def test_divergence_is_the_entropy_that_mixing_adds(pair):
    p, q = pair
    added = entropy_bits((p + q) / 2) - (entropy_bits(p) + entropy_bits(q)) / 2
    assert js_divergence(p, q) == pytest.approx(added, abs=1e-12)


@checks
@given(pairs, st.floats(1e-3, 1e3))
def test_beliefs_do_not_depend_on_the_amount_of_evidence(pair, amount):
    p, _ = pair
    assume(p.min() == 0 or p.min() * amount > 1e-300)
    assert normalise(p * amount) == pytest.approx(p, abs=1e-12)


@pytest.mark.parametrize("K", [2, 3, 7, 300])
def test_a_uniform_distribution_has_the_largest_entropy(K):
    assert entropy_bits(np.full(K, 1 / K)) == pytest.approx(math.log2(K))


def test_a_certain_distribution_has_no_entropy():
    assert entropy_bits([0.0, 1.0, 0.0]) == 0


def test_functions_run_over_the_last_axis():
    p = np.array([[[1.0, 0.0], [0.5, 0.5], [0.25, 0.75]]])
    q = np.array([1.0, 0.0])
    assert entropy_bits(p).shape == js_divergence(p, q).shape == (1, 3)
    assert js_divergence(p, q)[0, 0] == 0


def test_nothing_is_the_divergence_of_no_distributions():
    none = np.zeros((0, 3))
    assert js_divergence(none, none).shape == entropy_bits(none).shape == normalise(none).shape[:1] == (0,)


def test_the_smallest_numbers_do_no_harm():
    tiny = np.nextafter(0, 1)  # m = tiny / 2 underflows to 0
    assert js_divergence([1.0, tiny], [1.0, 0.0]) == 0
    assert entropy_bits([1.0, tiny]) < 1e-300
