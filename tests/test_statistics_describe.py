"""Everything about a map as content for JSON, the verdict, and the command that prints them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from compare_summaries import differences
from simulated_events import grid, log_of

from semstab.core.files import read_json, write_json
from semstab.core.json_form import from_json, to_json
from semstab.core.types import THIS_SCENE
from semstab.errors import ConfigError, DataError
from semstab.metrics import sbd
from semstab.model.contrast import BackboneComparison
from semstab.model.statistics import (
    UNKNOWN,
    CeilingShare,
    ClassCeilingShare,
    HeadlineStatistics,
    Interval,
    MapStatistics,
)
from semstab.model.voxels import VoxelTable
from semstab.statistics import (
    MapSample,
    analyse,
    compare_backbones,
    describe,
    expected_sbd,
    krippendorff_alpha,
    verdict,
)
from semstab.statistics.agreement import PSA
from semstab.statistics.intervals import probability_above
from semstab.statistics.verdict import LIMITS, level_probabilities

SIDE, F = 24, 8


def backbone(flicker, seed, place=0.0, seen=0.8):
    """The log of a simulated model on a floor: labels that flicker, and places that are wrong in every frame."""
    rng = np.random.default_rng(seed)
    true = np.random.default_rng(99).integers(0, 3, size=(SIDE**2, 1))
    stuck = rng.random((SIDE**2, 1)) < place
    noise = rng.random((SIDE**2, F)) < flicker
    labels = np.where(noise, rng.integers(0, 3, size=noise.shape), (true + stuck) % 3)
    labels[:, 1:][rng.random((SIDE**2, F - 1)) > seen] = -1
    return log_of(labels, index=grid(SIDE))


def ground_truth():
    return backbone(0.0, 1, seen=1.0).table()


@pytest.fixture(scope="module")
def described():
    events = backbone(0.2, 0, place=0.2)
    return analyse(MapSample.draw(events.table(), events, ground_truth()), name="sim")


def test_a_description_is_content_for_json_and_every_voxel_has_a_value(described, tmp_path):
    write_json(tmp_path / "statistics.json", described.summary)
    content = read_json(tmp_path / "statistics.json")
    assert content["agreement"]["alpha"]["value"] == described.summary.agreement.alpha.value
    assert content["strata"][0]["psa"] is None
    assert math.isnan(described.summary.strata[0].psa)
    assert to_json(from_json(MapStatistics, content, "statistics.json")) == content
    columns = described.columns(backbone(0.2, 0, place=0.2).table())
    assert {len(values) for values in columns.values()} == {SIDE**2}
    assert {"psa", "sbd_excess", "trend", "entropy_within", "entropy_between", "stable_wrong"} <= set(columns)
    assert 0 <= np.nanmin(columns["stable"]) < np.nanmax(columns["stable"]) <= 1


@pytest.mark.parametrize("soft", [False, True])
def test_how_many_voxels_are_summed_at_a_time_does_not_matter(monkeypatch, soft):
    """All numbers to 1e-12, also the ends of intervals, and which sums by class are known."""
    table = backbone(0.2, 0, place=0.2).table()
    table = replace(table, self_sum=np.where(np.arange(len(table)) == 7, 0.9, 1.0) * table.self_sum) if soft else table
    whole = analyse(MapSample.draw(table))
    monkeypatch.setattr("semstab.model.evidence.STRETCH", 50)
    parts = analyse(MapSample.draw(table))
    assert differences(to_json(whole.summary), to_json(parts.summary), tolerance=1e-12) == []
    for name in ("class_own", "sbd_excess"):
        np.testing.assert_allclose(whole.sums[name].sum(axis=0), parts.sums[name].sum(axis=0), rtol=1e-12)
    assert np.isnan(parts.sums["class_own"]).any() == soft


def test_a_description_holds_what_the_functions_say(described):
    events = backbone(0.2, 0, place=0.2)
    table, summary = events.table(), described.summary
    repeated = table.op >= 2
    assert (summary.repeated.voxels, summary.repeated.share) == (repeated.sum(), pytest.approx(repeated.mean()))
    assert summary.agreement.alpha.value == pytest.approx(krippendorff_alpha(table))
    assert summary.drift.excess.value == pytest.approx(np.nanmean(sbd(table) - expected_sbd(table)))
    parts = summary.uncertainty
    assert parts.entropy.value == pytest.approx(parts.within.value + parts.between.value)
    geometry = summary.geometry
    assert geometry.geometry.value == 0
    assert geometry.total.value == pytest.approx(1 - summary.agreement.psa.value)
    found = summary.correctness.quadrants
    parts_of_all = (found.stable_right, found.stable_wrong, found.unstable_right, found.unstable_wrong)
    assert sum(share.value for share in parts_of_all) == pytest.approx(1)
    assert summary.drift.trend.share.low < 0 < summary.drift.trend.share.high


def test_the_same_seed_gives_the_same_description():
    events = backbone(0.2, 3)
    a, b, other = (describe(events.table(), events, seed=seed) for seed in (4, 4, 5))
    assert to_json(a) == to_json(b)
    assert (a.seed, other.seed) == (4, 5)
    assert to_json(a.drift) == to_json(other.drift)  # of labels the null is exact
    assert to_json(a.agreement) == to_json(other.agreement)


def test_a_table_alone_is_described_as_far_as_it_goes():
    events = backbone(0.2, 0)
    alone, logged = describe(events.table()), describe(events.table(), events)
    assert alone.correctness is alone.geometry is alone.drift.trend is None
    assert to_json(alone.drift.null) == to_json(logged.drift.null)
    assert to_json(alone.agreement) == to_json(logged.agreement)
    assert "for these frames alone (no log)" in alone.verdict.line
    assert "for this scene flown again, from 8 frames" in logged.verdict.line


@pytest.mark.parametrize("labels", [np.zeros((0, 2), dtype=int), [[0, -1]], [[0, 0], [0, 0]]])
def test_maps_that_say_nothing_are_described_too(labels):
    events = log_of(labels)
    table = events.table()
    summary = describe(table, events, table, limit=table)
    assert summary.verdict.level == "no verdict"
    assert "no verdict" in summary.verdict.line


def test_events_of_another_map_and_one_backbone_are_refused():
    with pytest.raises(DataError, match="take both from one backend"):
        describe(log_of([[0, 1]]).table(), log_of([[0, -1]]))
    with pytest.raises(ConfigError, match="give two or more"):
        compare_backbones({"a": ground_truth()})


def test_backbones_beside_each_other():
    logs = {"steady": backbone(0.1, 5), "flickering": backbone(0.4, 6), "stuck": backbone(0.1, 7, place=0.3)}
    tables = {name: log.table() for name, log in logs.items()}
    content = compare_backbones(tables, logs, ground_truth())
    read = json.loads(json.dumps(to_json(content)))
    assert to_json(from_json(BackboneComparison, read, "summary.json")) == read
    by_alpha = next(row for row in content.paired.rankings if row.measure == "alpha")
    assert by_alpha.ranks[-1].backbone == "flickering"
    assert len(content.paired.differences) == 3 * 8
    assert content.standardised.of(PSA, "steady").value > 0.8


def between(low, high):
    return Interval((low + high) / 2, low, high, scope=THIS_SCENE, frames=60)


def judged(low, high, wrong=UNKNOWN, voxels=5000, blocks=40, ceiling=None, classes=()):
    """By alpha between frames as it is, or where there is a ceiling by the share of it that is reached."""
    middle = between(low, high)
    numbers = HeadlineStatistics(*[middle] * 5, wrong_of_stable=wrong)
    reach = None if ceiling is None else CeilingShare(500, middle, between(ceiling, ceiling), middle, classes)
    return verdict("net", headline=numbers, ceiling=reach, voxels=voxels, share=0.5, blocks=blocks)


def of_class(name, low, high, *, matters=True):
    share = between(low, high)
    return ClassCeilingShare(
        name, 200.0, matters, 0.5, 0.9, share, 1 - probability_above(share, LIMITS.usable, "agreement")
    )


@pytest.mark.parametrize(("low", "high", "level"), [
    (0.81, 0.9, "stable"), (0.79, 0.9, "stable"), (0.67, 0.7, "usable"), (0.6, 0.9, "usable"),
    (0.6, 0.98, "undecided"), (0.3, 0.66, "unstable"), (math.nan, math.nan, "no verdict"),
])  # fmt: skip
def test_the_most_probable_level_is_the_verdict(low, high, level):
    assert judged(low, high).level == level


def test_agreement_below_zero_stable_errors_and_few_places_are_said():
    line = judged(-0.2, -0.1, ceiling=0.9, classes=(of_class("tree", -0.2, -0.1),)).line
    assert "alpha between frames -0.15, no better than chance, is -15%" in line
    assert "probably unstable: tree (100%)" in line
    assert "chance" not in judged(0.1, 0.2, ceiling=0.9).line
    wrong = judged(0.9, 0.95, Interval(0.2, 0.1, 0.3))
    assert wrong.level == "misleading"
    assert "20% of the stable locations are wrong (10% to 30%)" in wrong.line
    assert judged(0.9, 0.95, Interval(0.06, 0.04, 0.1)).level == "stable"
    assert judged(0.9, 0.95, voxels=99).level == judged(0.9, 0.95, blocks=15).level == "no verdict"
    assert "more overlap between frames" in judged(0.9, 0.95, voxels=99).line
    assert "one class" in judged(math.nan, math.nan).line


def test_probabilities_of_the_levels_sum_to_one_and_the_line_says_what_to_do_and_why():
    for low, high in ((0.5, 0.6), (0.7, 0.9), (0.81, 0.9)):
        for scale in ("agreement", "plain"):
            levels = level_probabilities(between(low, high), scale)
            assert sum(levels.values()) == pytest.approx(1)
            assert min(levels.values()) >= 0
    half = level_probabilities(between(0.7, 0.9), "plain")
    assert half["stable"] == pytest.approx(0.5)
    assert judged(0.5, 0.6).line == (
        "net: unstable (100%), do not act on its labels: two frames agree at 55% of the locations (50% to 60%),"
        " alpha between frames 0.55 (0.50 to 0.60), its ceiling not known; 5000 locations seen twice or more, 50% of"
        " the map; for this scene flown again, from 60 frames"
    )


def test_agreement_is_judged_against_its_ceiling_and_the_line_names_unstable_classes_the_most_probable_first():
    found = judged(0.82, 0.9, ceiling=0.7)
    assert found.level == "stable"
    assert "alpha between frames 0.86 is 86% (82% to 90%) of its ceiling, 0.70" in found.line
    assert judged(0.82, 0.9, ceiling=0.4).level == "too coarse"
    assert judged(0.1, 0.2, ceiling=0.4).level == "unstable"
    good, bad, worse = of_class("road", 0.9, 1.0), of_class("person", 0.3, 0.6), of_class("tree", -0.1, 0.1)
    rare, unknown = of_class("car", 0.1, 0.2, matters=False), of_class("sign", math.nan, math.nan)
    found = judged(0.9, 1.0, ceiling=0.9, classes=(good, bad, worse, rare, unknown))
    assert found.level == "stable"
    assert "probably unstable: tree (100%), person (100%)" in found.line


def test_voxels_seen_once_change_no_verdict():
    events = backbone(0.3, 8, seen=0.3)
    table = events.table()
    again = table.op >= 2
    columns = ("ix", "iy", "iz", "op", "evidence", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum",
               "frame_entropy_sum")  # fmt: skip
    only = VoxelTable(*(getattr(table, name)[again] for name in columns), voxel_size=table.voxel_size)
    assert (~again).any()
    a, b = describe(table), describe(only)
    assert a.verdict.level == b.verdict.level
    assert to_json(a.agreement) == to_json(b.agreement)
