"""Fusion rules against their formulas, step by step."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_events import log_of, log_of_evidence, soft

from semstab.errors import ConfigError
from semstab.metrics import entropy, sbd, vss
from semstab.model.information import js_divergence, normalise
from semstab.statistics import RULES, fuse
from semstab.statistics.fusion_rules import labels


def step_by_step(evidence, rule, floor=0.01):
    """The belief of one voxel after each observation, from the rule's formula."""
    floored = normalise(np.maximum(evidence, floor))
    beliefs = []
    for t in range(1, len(evidence) + 1):
        if rule == "averaging":
            belief = evidence[:t].mean(axis=0)
        elif rule == "majority":
            belief = np.bincount(evidence[:t].argmax(axis=1), minlength=evidence.shape[1]) / t
        elif rule == "product":
            belief = floored[:t].prod(axis=0)
        else:
            belief = floored[:t].prod(axis=0) ** (1 / t)
        beliefs.append(belief / belief.sum())
    return np.array(beliefs)


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_is_its_formula(rule):
    evidence = soft(np.random.default_rng(0), 12, 5)
    fused = fuse(log_of_evidence(evidence), rule)
    for i, e in enumerate(evidence):
        beliefs = step_by_step(e, rule)
        np.testing.assert_allclose(fused.belief[i], beliefs[-1], atol=1e-12)
        assert sbd(fused)[i] == pytest.approx(js_divergence(beliefs[1:], beliefs[:-1]).mean())


def test_averaging_is_what_the_metrics_say_and_the_two_products_decide_alike():
    events = log_of_evidence(soft(np.random.default_rng(1), 20, 4))
    fused, table = fuse(events, "averaging"), events.table()
    np.testing.assert_allclose(vss(fused), vss(table))
    np.testing.assert_allclose(sbd(fused), sbd(table))
    np.testing.assert_allclose(entropy(fused), entropy(table))
    events = log_of_evidence(soft(np.random.default_rng(2), 200, 6))
    product, geometric = fuse(events, "product"), fuse(events, "geometric")
    assert np.array_equal(labels(product.belief), labels(geometric.belief))
    assert (vss(product) >= vss(geometric) - 1e-12).all()


def test_beliefs_neither_veto_nor_underflow_and_ties_go_to_the_lowest():
    fused = fuse(log_of_evidence([[[0.0, 1.0]] + [[0.9, 0.1]] * 9]), "product")
    assert fused.belief[0, 0] > 0.99
    fused = fuse(log_of([[0, 1] * 500]), "product")
    np.testing.assert_allclose(fused.belief, [[0.5, 0.5, 0]], atol=1e-9)
    assert labels(np.array([[0.5 - 1e-16, 0.5, 0], [0.1, 0.3, 0.6]])).tolist() == [0, 2]
    assert np.isnan(sbd(fuse(log_of([[1, -1]]), "majority"))[0])
    assert fuse(log_of(np.zeros((0, 2), dtype=int)), "geometric").belief.shape == (0, 3)


@pytest.mark.parametrize(("rule", "floor", "message"), [("mean", 0.01, "averaging, majority"), ("product", 0.5, "1/K")])
def test_what_makes_no_sense_is_refused(rule, floor, message):
    with pytest.raises(ConfigError, match=message):
        fuse(log_of([[0]]), rule, floor=floor)
