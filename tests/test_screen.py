"""Lines of a screen: shares that sum to the whole, columns as wide as the terminal allows, signs, and models apart."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.core.palette import MODEL_COLORS, dash, marker, model_color
from semstab.data.statistics import StabilityVerdict, short
from semstab.metrics import CATEGORY_COLORS
from semstab.report.tables.backends import one_in
from semstab.report.terminal import laid_out, percents


@pytest.mark.parametrize("seed", range(20))
def test_shares_of_a_whole_sum_to_100_percent(seed) -> None:
    shares = np.random.default_rng(seed).dirichlet(np.ones(4) / 2)
    whole = [int(text.removesuffix(" %")) for text in percents(shares.tolist())]
    assert sum(whole) == 100
    assert np.abs(np.array(whole) - 100 * shares).max() < 1


def test_undefined_shares_are_dashes() -> None:
    assert percents([0.25, float("nan")]) == ["25 %", "-"]


def test_a_zero_has_no_sign() -> None:
    assert short(-0.001) == ".00"
    assert short(-0.02) == "-.02"


def test_names_are_cut_only_where_the_terminal_is_narrow() -> None:
    rows = [["model", "verdict", "alpha", "agree"], ["a-long-name-of-a-model-2", "stable", ".93", "95"]]
    assert "a-long-name-of-a-model-2" in laid_out(rows, 80)[1]
    cut = laid_out(rows, 40)[1]
    assert len(cut) <= 40
    assert cut.split()[0].endswith("model-2")
    assert {len(line) for line in laid_out(rows, 40)} == {len(cut)}


@pytest.mark.parametrize(
    ("drawn", "said"), [((), ""), ((1, 1), ""), ((64,), "1 in 64"), ((128, 64, 128), "1 in 64 to 128")]
)
def test_the_share_that_was_compared_has_one_form(drawn, said) -> None:
    class Row:
        def __init__(self, share: int) -> None:
            self.one_in = share

    assert one_in([Row(share) for share in drawn]) == said


@pytest.mark.parametrize(
    ("level", "p", "said"),
    [
        ("unstable", 0.97, "(probability .97)"),
        ("stable", 0.999, "(probability > .99)"),
        ("undecided", 0.5, ""),
        ("stable", float("nan"), ""),
    ],
)
def test_the_probability_of_a_verdict_is_no_p_value(level, p, said) -> None:
    assert StabilityVerdict(level, p, "").in_words == said


def test_models_of_one_colour_differ_in_marker_or_dash() -> None:
    count = 2 * len(MODEL_COLORS)
    styles = {(model_color(k), dash(k), marker(k)) for k in range(count)}
    assert len(styles) == count
    assert len({model_color(k) for k in range(12)}) == 12


def test_no_model_has_the_colour_of_a_stability_category() -> None:
    models, categories = np.array(MODEL_COLORS, float), np.array(CATEGORY_COLORS, float)
    assert np.linalg.norm(models[:, None] - categories, axis=2).min() > 50
