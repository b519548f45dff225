"""Everything about a map as content for JSON, the verdict, and the command that prints them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from compare_summaries import differences
from simulated_events import grid, log_of, spots_of

from semstab import VoxelTable
from semstab.core.files import read_json, write_json
from semstab.core.json_form import from_json, to_json
from semstab.core.types import THESE_FRAMES, THIS_SCENE
from semstab.data.statistics import UNKNOWN, ClassAlpha, HeadlineStatistics, Interval, MapStatistics, SpotAgreement
from semstab.errors import DataError
from semstab.metrics import sbd
from semstab.statistics import MapSample, analyse, describe, expected_sbd, krippendorff_alpha, verdict
from semstab.statistics.intervals import probability_above
from semstab.statistics.verdict import LIMITS, level_probabilities

SIDE, F = 24, 8


def said(flicker, seed, place=0.0, share_seen=0.8):
    """Labels of a simulated model on a floor, which flicker, and places that are wrong in every frame."""
    rng = np.random.default_rng(seed)
    true = np.random.default_rng(99).integers(0, 3, size=(SIDE**2, 1))
    stuck = rng.random((SIDE**2, 1)) < place
    noise = rng.random((SIDE**2, F)) < flicker
    labels = np.where(noise, rng.integers(0, 3, size=noise.shape), (true + stuck) % 3)
    labels[:, 1:][rng.random((SIDE**2, F - 1)) > share_seen] = -1
    return labels


def model(*arguments, **options):
    """The log of these labels."""
    return log_of(said(*arguments, **options), index=grid(SIDE))


def spots(*arguments, **options):
    """The same of spots."""
    return spots_of(said(*arguments, **options), index=grid(SIDE))


def ground_truth():
    return model(0.0, 1, share_seen=1.0).table()


@pytest.fixture(scope="module")
def described():
    events = model(0.2, 0, place=0.2)
    return analyse(MapSample.draw(events.table(), events, ground_truth()), spots(0.2, 0, place=0.2), name="sim")


def test_a_description_is_content_for_json_and_every_voxel_has_a_value(described, tmp_path):
    write_json(tmp_path / "statistics.json", described.summary)
    content = read_json(tmp_path / "statistics.json")
    assert content["schema"] == 1
    assert content["agreement"]["voxel_alpha_op2"]["value"] == described.summary.agreement.voxel_alpha_op2.value
    assert content["headline"]["alpha"]["value"] == described.summary.headline.alpha.value
    assert content["strata"][0]["psa"] is None
    assert math.isnan(described.summary.strata[0].psa)
    assert to_json(from_json(MapStatistics, content, "statistics.json")) == content
    columns = described.columns(model(0.2, 0, place=0.2).table())
    assert {len(values) for values in columns.values()} == {SIDE**2}
    assert {"psa", "sbd_excess", "flip_rate", "entropy_within", "entropy_between", "consistent_wrong"} <= set(columns)
    assert 0 <= np.nanmin(columns["consistent"]) < np.nanmax(columns["consistent"]) <= 1


@pytest.mark.parametrize("soft", [False, True])
def test_how_many_voxels_are_summed_at_a_time_does_not_matter(monkeypatch, soft):
    """All numbers to 1e-12, also the ends of intervals, and which sums by class are known."""
    table = model(0.2, 0, place=0.2).table()
    table = replace(table, self_sum=np.where(np.arange(len(table)) == 7, 0.9, 1.0) * table.self_sum) if soft else table
    whole = analyse(MapSample.draw(table))
    monkeypatch.setattr("semstab.data.evidence.STRETCH", 50)
    monkeypatch.setattr("semstab.data.evidence.STRETCH_ENTRIES", 50)
    assert len([*table.evidence.stretches()]) > 10
    assert whole.summary.flipping.share.value > 0
    parts = analyse(MapSample.draw(table))
    assert differences(to_json(whole.summary), to_json(parts.summary), tolerance=1e-12) == []
    for name in ("class_own", "sbd_excess"):
        np.testing.assert_allclose(whole.sums[name].sum(axis=0), parts.sums[name].sum(axis=0), rtol=1e-12)
    assert np.isnan(parts.sums["class_own"]).any() == soft


def test_a_description_holds_what_the_functions_say(described):
    events = model(0.2, 0, place=0.2)
    table, summary = events.table(), described.summary
    repeated = table.op >= 2
    assert (summary.repeated.voxels, summary.repeated.share) == (repeated.sum(), pytest.approx(repeated.mean()))
    assert summary.agreement.voxel_alpha_op2.value == pytest.approx(krippendorff_alpha(table))
    assert summary.headline.alpha.value == pytest.approx(krippendorff_alpha(table))  # each spot is alone in its voxel
    found = summary.spots
    assert (found.spots, found.views, found.frames, found.spacing) == (repeated.sum(), F, F, 0.125)
    shares = table.evidence[:][repeated].sum(axis=0) / table.op[repeated].sum()
    assert found.chance == pytest.approx((shares**2).sum(), abs=0.001)
    assert (found.largest_class, found.largest_share) == (str(shares.argmax()), pytest.approx(shares.max()))
    by_class = {row.name: row.voxel_alpha_op2 for row in summary.agreement.classes}
    assert {row.name: row.alpha.value for row in found.classes} == pytest.approx(by_class)
    assert summary.drift.excess.value == pytest.approx(np.nanmean(sbd(table) - expected_sbd(table)))
    flipped = summary.drift.flips
    assert flipped.excess.value == pytest.approx(flipped.rate.value - flipped.null.value)
    parts = summary.uncertainty
    assert parts.entropy_op2.value == pytest.approx(parts.within.value + parts.between.value)
    geometry = summary.geometry
    assert geometry.geometry.value == 0
    assert geometry.total.value == pytest.approx(1 - summary.agreement.psa_op2.value)
    found = summary.correctness.quadrants
    parts_of_all = (found.consistent_right, found.consistent_wrong, found.inconsistent_right, found.inconsistent_wrong)
    assert sum(share.value for share in parts_of_all) == pytest.approx(1)


def test_the_same_seed_gives_the_same_description():
    events = model(0.2, 3)
    a, b, other = (describe(events.table(), events, seed=seed) for seed in (4, 4, 5))
    assert to_json(a) == to_json(b)
    assert (a.seed, other.seed) == (4, 5)
    assert to_json(a.drift) == to_json(other.drift)  # of labels the null is exact
    assert to_json(a.agreement) == to_json(other.agreement)


def test_the_order_is_known_where_a_quarter_of_the_locations_tell_of_it():
    found = describe(model(0.2, 0).table())
    of = [
        replace(found, drift=replace(found.drift, voxels=n), repeated=replace(found.repeated, voxels=100))
        for n in (24, 25)
    ]
    assert [drift.order_known for drift in of] == [False, True]


def values(section):
    return [value.value for value in vars(section).values() if isinstance(value, Interval)]


def test_a_number_has_one_interval_wherever_it_stands():
    events = model(0.2, 0)
    found = describe(events.table(), events, events.table(), spots=spots(0.2, 0))
    assert found.agreement.psa_op2 == found.headline.psa_op2
    assert found.correctness.accuracy_op2 == found.headline.accuracy_op2
    assert found.correctness.quadrants.wrong_of_consistent_op3 == found.headline.wrong_of_consistent_op3
    assert found.uncertainty.entropy_op2.scope == found.headline.wrong_of_consistent_op3.scope == THESE_FRAMES
    assert found.headline.psa_op2.scope == THIS_SCENE


def test_a_table_alone_is_described_as_far_as_it_goes():
    events = model(0.2, 0)
    observed = spots(0.2, 0)
    alone, logged = describe(events.table(), spots=observed), describe(events.table(), events, spots=observed)
    assert alone.correctness is alone.geometry is alone.drift.flips is None
    assert to_json(alone.drift.null) == to_json(logged.drift.null)
    assert values(alone.agreement) == pytest.approx(values(logged.agreement), abs=1e-12)
    assert alone.headline.alpha == logged.headline.alpha
    assert (alone.headline.psa_op2.scope, logged.headline.psa_op2.scope) == (THESE_FRAMES, THIS_SCENE)
    for found in (alone, logged):
        assert "for this scene flown again, from 8 frames" in found.verdict.line


def test_without_spots_there_is_no_verdict_and_the_line_says_what_to_give():
    events = model(0.2, 0)
    found = describe(events.table(), events)
    assert (found.spots, found.correlogram, found.verdict.level) == (None, None, "no verdict")
    assert math.isnan(found.headline.alpha.value)
    assert "no spots were sampled; give the observations of a `Sampler`" in found.verdict.line


@pytest.mark.parametrize("labels", [np.zeros((0, 2), dtype=int), [[0, -1]], [[0, 0], [0, 0]]])
def test_maps_that_say_nothing_are_described_too(labels):
    events = log_of(labels)
    table = events.table()
    summary = describe(table, events, table, limit=table, spots=spots_of(labels))
    assert summary.verdict.level == "no verdict"
    assert "no verdict" in summary.verdict.line


def test_events_of_another_map_are_refused():
    with pytest.raises(DataError, match="take both from one backend"):
        describe(log_of([[0, 1]]).table(), log_of([[0, -1]]))


def between(low, high):
    return Interval((low + high) / 2, low, high, scope=THIS_SCENE, frames=60)


def judged(low, high, wrong=UNKNOWN, voxels=5000, **spots):
    """By alpha in that interval, of observations as these are unless said otherwise."""
    numbers = HeadlineStatistics(*[between(low, high)] * 5)
    fields = {
        "spacing": 0.125, "spots": 800, "cubes": 40, "frames": 60, "views": 60, "chance": 0.4,
        "largest_class": "grass", "largest_share": 0.5, "labelled": 1.0, "classes": (),
    } | spots  # fmt: skip
    return verdict(
        "net", headline=replace(numbers, wrong_of_consistent_op3=wrong), spots=SpotAgreement(**fields), voxels=voxels,
        share=0.5,
    )  # fmt: skip


def of_class(name, low, high, *, matters=True):
    alpha = between(low, high)
    return ClassAlpha(name, 200.0, matters, alpha, 1 - probability_above(alpha, LIMITS.usable, "agreement"), 0.1)


@pytest.mark.parametrize(("low", "high", "level"), [
    (0.81, 0.9, "stable"), (0.79, 0.9, "stable"), (0.67, 0.7, "usable"), (0.6, 0.79, "usable"),
    (0.6, 0.9, "undecided"), (0.6, 0.98, "undecided"), (0.3, 0.66, "unstable"), (math.nan, math.nan, "no verdict"),
])  # fmt: skip
def test_the_most_probable_level_is_the_verdict(low, high, level):
    assert judged(low, high).level == level


def test_agreement_below_zero_is_no_better_than_chance():
    assert "alpha -.15 (-.20 to -.10), no better than chance" in judged(-0.2, -0.1).line
    assert "chance" not in judged(0.1, 0.2).line


def test_stable_errors_are_misleading():
    wrong = judged(0.9, 0.95, Interval(0.2, 0.1, 0.3))
    assert wrong.level == "misleading"
    assert "20% of the consistent locations are wrong (10% to 30%)" in wrong.line
    assert judged(0.9, 0.95, Interval(0.06, 0.04, 0.1)).level == "stable"


def test_few_locations_have_no_verdict():
    assert judged(0.9, 0.95, spots=99).level == judged(0.9, 0.95, cubes=15).level == "no verdict"
    assert judged(0.9, 0.95, spots=0).level == "no verdict"
    assert "more overlap between frames" in judged(0.9, 0.95, spots=99).line
    assert judged(0.9, 0.95, voxels=100, spots=100, cubes=16).level == "stable"
    few = judged(0.9, 0.95, voxels=99, spots=100, cubes=16)
    assert few.level == "no verdict"
    assert "too few locations to act on; use smaller voxels" in few.line


def test_a_camera_that_stood_still_has_no_verdict_and_one_frame_needs_more_overlap():
    assert (
        "no verdict, all frames show one view: the camera stood still, or moved by less"
        in judged(0.9, 0.95, views=1).line
    )
    assert "stood still" not in judged(math.nan, math.nan, views=1, frames=1, spots=0).line
    assert (
        "no verdict, no spot was sampled: no pixel has both depth and a label"
        in judged(math.nan, math.nan, views=0).line
    )


def test_a_map_of_nearly_one_class_is_uninformative_whatever_its_alpha_is():
    found = judged(0.9, 0.95, chance=0.94, largest_share=0.97)
    assert found.level == "uninformative"
    assert math.isnan(found.probability)
    assert "97% of the observations are grass" in found.line
    assert judged(0.1, 0.2, chance=0.94).level == "uninformative"
    assert judged(0.9, 0.95, chance=0.93).level == "stable"


def test_a_model_that_labels_little_is_at_most_usable():
    found = judged(0.9, 0.95, labelled=0.85)
    assert (found.level, found.probability > 0.99) == ("usable", True)
    assert "15% of the locations have no label in most frames" in found.line
    assert judged(0.9, 0.95, labelled=0.9).level == "stable"
    assert judged(0.1, 0.2, labelled=0.1).level == "unstable"


def test_probabilities_of_the_levels_sum_to_one_and_the_line_says_what_to_do_and_why():
    for low, high in ((0.5, 0.6), (0.7, 0.9), (0.81, 0.9)):
        levels = level_probabilities(between(low, high))
        assert sum(levels.values()) == pytest.approx(1)
        assert min(levels.values()) >= 0
    assert level_probabilities(replace(between(0.7, 0.9), value=LIMITS.stable))["stable"] == pytest.approx(0.5)
    assert judged(0.5, 0.6).line == (
        "net: unstable (100%), do not act on its labels: alpha .55 (.50 to .60), two views see the same class at"
        " 73% of the spots; 5000 locations seen twice or more, 50% of the map; for this scene flown again, from 60"
        " frames"
    )


def test_the_line_names_unstable_classes_the_most_probable_first():
    good, bad, worse = of_class("road", 0.9, 1.0), of_class("person", 0.3, 0.6), of_class("tree", -0.1, 0.1)
    rare, unknown = of_class("car", 0.1, 0.2, matters=False), of_class("sign", math.nan, math.nan)
    found = judged(0.9, 1.0, classes=(good, bad, worse, rare, unknown))
    assert found.level == "stable"
    assert "alpha .95 (.90 to 1.00), probably unstable: tree (100%), person (100%)," in found.line


def test_voxels_seen_once_change_no_verdict():
    events = model(0.3, 8, share_seen=0.3)
    table = events.table()
    again = table.op >= 2
    columns = ("ix", "iy", "iz", "op", "evidence", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum",
               "frame_entropy_sum")  # fmt: skip
    only = VoxelTable(*(getattr(table, name)[again] for name in columns), voxel_size=table.voxel_size)
    assert (~again).any()
    a, b = describe(table), describe(only)
    assert a.verdict.level == b.verdict.level
    assert to_json(a.agreement) == to_json(b.agreement)
