"""The four findings: worked out by hand where they show, where they do not, and where nothing can be said."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import records
from records import study, voxels
from simulated_events import log_of
from wall_study import BACKBONES, wall_study

from semstab.metrics import op, vss
from semstab.model.statistics import Estimate, ExcessOverChance, Interval
from semstab.report.averages import ENOUGH, Level, describe, pooled
from semstab.report.findings import (
    HARDLY,
    VISIBLE_VSS,
    Answer,
    denser_sampling,
    falling_drift,
    findings,
    less_association,
    more_disagreement,
)
from semstab.statistics import describe as describe_map

SURE, SPLIT, CALM = [1, 0, 0], [3, 1, 0], [3.6, 0.4, 0]
N = ENOUGH

UNKNOWN = Interval(np.nan, np.nan, np.nan)
FALLS = ExcessOverChance(Interval(0.1, 0.05, 0.15), Interval(0.01, 0.005, 0.015))
COIN = ExcessOverChance(Interval(0.0, -0.05, 0.05), Interval(0.0, -0.005, 0.005))
STATISTICS = describe_map(log_of([[0, 1], [0, 0]]).table())


def record(table, *what, beyond=FALLS, **more):
    """A record whose statistics say so much of a coin."""
    made = records.record(table, *what, **more)
    agreement = dataclasses.replace(STATISTICS.agreement, vss=UNKNOWN)
    said = dataclasses.replace(STATISTICS, excess_over_chance=beyond, agreement=agreement)
    return dataclasses.replace(made, summary=dataclasses.replace(made.summary, statistics=said))


def level(value, *groups):
    return Level(value, (pooled([record(voxels(*groups))]),))


def seen(once, often, evidence):
    """Voxels seen once, which all agree, and voxels seen four times with this evidence."""
    return (once, 1, SURE), (often, 4, evidence)


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    return wall_study(tmp_path_factory.getbasetemp())[0]


def test_recurrent_voxels_that_disagree_more_as_much_and_too_few():
    outcome = more_disagreement(pooled([record(voxels(*seen(3 * N, N, SPLIT)))]))
    assert (outcome.verdict, outcome.why) == (Answer.SHOWN, "")
    assert outcome.numbers == (
        "VSS 0.7500 for OP>=3 against 0.9375 over all voxels: 25.0% of the evidence disagrees, not 6.2%. From OP=2"
        " to OP>=3 PSA falls by 0.1000 (0.0500 to 0.1500)."
    )
    outcome = more_disagreement(pooled([record(voxels((N, 1, SPLIT), (N, 4, SPLIT)))]))
    assert outcome.verdict is Answer.NOT_SHOWN
    assert "agree as well" in outcome.why
    outcome = more_disagreement(pooled([record(voxels(*seen(3 * N, N - 1, SPLIT)))]))
    assert (outcome.verdict, outcome.why) == (Answer.UNTESTED, "999 voxels have OP>=3; 1,000 are needed.")


def test_a_coin_shows_no_disagreement_nor_drift():
    """VSS and SBD of a coin move with OP as if something were found."""
    groups = (3 * N, 1, SURE, 0.0), (N, 2, SURE, 0.08), (N, 4, SPLIT, 0.05)
    for test in (more_disagreement, falling_drift):
        assert test(pooled([record(voxels(*groups))])).verdict is Answer.SHOWN
        outcome = test(pooled([record(voxels(*groups), beyond=COIN)]))
        assert outcome.verdict is Answer.NOT_SHOWN
        assert "coin" in outcome.why
        assert test(pooled([records.record(voxels(*groups))])).verdict is Answer.UNTESTED


def test_a_tossed_coin_is_told_from_findings():
    """0.9 against 0.1, tossed once, twice and up to ten times a place."""
    rng = np.random.default_rng(0)
    seen_by = rng.integers(1, 11, 4000)
    labels = np.where(np.arange(10) < seen_by[:, None], rng.random((4000, 10)) < 0.1, -1)
    events = log_of(labels, K=2)
    found = describe_map(events.table(), events).excess_over_chance
    assert found.disagreement.low <= 0 <= found.disagreement.high
    assert found.drift_below_null.low <= 0 <= found.drift_below_null.high


@pytest.mark.parametrize(("gap", "verdict"), [(1.2, Answer.SHOWN), (0.8, Answer.NOT_SHOWN)])
def test_a_difference_counts_from_the_last_printed_decimal_on(gap, verdict):
    """Half of the voxels recur: the aggregate lies in the middle."""
    evidence = [1 - 2 * gap * VISIBLE_VSS, 2 * gap * VISIBLE_VSS, 0]
    assert more_disagreement(pooled([record(voxels(*seen(N, N, evidence)))])).verdict is verdict


def test_the_findings_of_the_walls_against_their_voxels(walls):
    finding = findings(walls)[0]
    for row in finding.evidence:
        tables = [r.table() for r in walls.select(backbone=row.backbone)]
        values, seen_by = (np.concatenate([measure(table) for table in tables]) for measure in (vss, op))
        every, recurrent = values.mean(), values[seen_by >= 3].mean()
        assert ("as well as all" in row.outcome.why) == (every - recurrent < VISIBLE_VSS)
        assert f"VSS {recurrent:.4f} for OP>=3 against {every:.4f}" in row.outcome.numbers
    assert [row.backbone for row in finding.evidence] == list(BACKBONES)
    # Errors anew in every frame: more looks, more disagreement; noise tears apart what meets. It is no finding
    by_name = {finding.name: finding for finding in findings(walls)}
    assert by_name["drift"].verdict is not Answer.SHOWN
    assert any("coin" in row.outcome.why for row in by_name["disagreement"].evidence)
    assert {row.condition for row in by_name["association"].evidence} == {"voxel size", "depth noise"}
    assert all(row.outcome.numbers for row in by_name["sampling"].evidence)


def drifting(*sbd_by_op):
    return pooled([record(voxels(*((n, op, SURE, sbd) for n, op, sbd in sbd_by_op)))])


def test_sbd_that_falls_from_stratum_to_stratum_or_rises_once():
    outcome = falling_drift(drifting((N, 1, 0.0), (N, 2, 0.08), (N, 4, 0.05), (N, 9, 0.02)))
    assert outcome.verdict is Answer.SHOWN
    assert outcome.numbers == (
        "SBD 0.0800 at OP=2, 0.0500 at 3<=OP<=5, 0.0200 at OP>5; lower by 0.0100 (0.0050 to 0.0150) than in random"
        " order for OP>=3."
    )
    outcome = falling_drift(drifting((N, 2, 0.05), (N, 4, 0.06), (N, 9, 0.02)))
    assert (outcome.verdict, outcome.why) == (Answer.NOT_SHOWN, "No fall from OP=2 to 3<=OP<=5.")
    assert falling_drift(drifting((N, 2, 0.05), (N - 1, 4, 0.06), (N, 9, 0.02))).verdict is Answer.SHOWN  # too small
    assert falling_drift(drifting((9 * N, 1, 0.0), (N, 2, 0.05))).verdict is Answer.UNTESTED  # one stratum


def test_numbers_below_zero_are_said_the_other_way_round():
    below = Estimate(-0.01, -0.015, -0.005)
    against = dataclasses.replace(drifting((N, 2, 0.05), (N, 4, 0.02)), drift_below_null=below, disagreement=below)
    assert "; higher by 0.0100 (0.0050 to 0.0150) than in random order" in falling_drift(against).numbers
    assert more_disagreement(against).numbers.endswith("From OP=2 to OP>=3 PSA rises by 0.0100 (0.0050 to 0.0150).")
    nothing = dataclasses.replace(against, drift_below_null=Estimate(-1e-6, -2e-5, 1e-4))
    assert "; neither lower nor higher (0.0000 to 0.0001) than in random order" in falling_drift(nothing).numbers


def test_noise_and_finer_voxels_that_lower_recurrence_and_raise_vss():
    """Where the same places agree as before at each OP, of a coin as well there would be fewer that were seen often."""
    found = [level(0.0, *seen(N, N, SPLIT)), level(0.01, *seen(3 * N, N, CALM))]
    outcome = less_association(describe("depth_noise"), found)
    assert outcome.verdict is Answer.SHOWN
    assert outcome.numbers == "0 → 1 % of depth: VSS 0.8750 → 0.9750; OP>=3 50.00 → 25.00%."
    found = [level(0.1, *seen(3 * N, N, CALM)), level(0.4, *seen(N, N, SPLIT))]
    outcome = less_association(describe("voxel_size"), found)
    assert outcome.verdict is Answer.SHOWN
    assert outcome.numbers.startswith("0.4 → 0.1 m: VSS 0.8750 → 0.9750")
    found = [level(0.0, *seen(N, N, SPLIT)), level(0.01, *seen(3 * N, N, SPLIT))]
    outcome = less_association(describe("depth_noise"), found)
    assert outcome.verdict is Answer.NOT_SHOWN
    assert outcome.why == "At 1 % of depth a coin would show it: VSS rises no more than fewer observations make it."


def test_every_level_has_to_follow():
    found = [level(0.0, *seen(N, N, SPLIT)), level(0.1, *seen(3 * N, N, SPLIT)), level(0.2, *seen(N, 3 * N, SPLIT))]
    outcome = less_association(describe("translation_noise"), found)
    assert outcome.verdict is Answer.NOT_SHOWN
    assert "VSS hardly rises or falls: -0.0625 at 0.2 m." in outcome.why
    assert "The share does not fall at 0.2 m." in outcome.why
    assert "1.0 pixels" in outcome.why


@pytest.mark.parametrize("found", [
    [level(0.1, *seen(N, N, SPLIT)), level(0.2, *seen(3 * N, N, SPLIT))],  # no undisturbed level
    [level(0.1, *seen(N, N, SPLIT))],
    [level(0.0, *seen(N, N - 1, SPLIT)), level(0.1, *seen(3 * N, 1, SPLIT))],  # recurrence was never there
])  # fmt: skip
def test_noise_without_a_level_to_compare_with_is_untested(found):
    assert less_association(describe("depth_noise"), found).verdict is Answer.UNTESTED


def sampled(fewer, more):
    return denser_sampling(describe("frame_count"), [level(20, *fewer), level(80, *more)])


def test_denser_sampling_that_uncovers_what_was_there():
    outcome = sampled(seen(90 * N, 10 * N, SPLIT), seen(10 * N, 10 * N, [2.9, 1.1, 0]))
    assert outcome.verdict is Answer.SHOWN
    assert outcome.numbers == (
        "20 → 80 frames: VSS over all voxels 0.9750 → 0.8625, for OP>=3 0.7500 → 0.7250; OP>=3 10.00 → 50.00%."
    )


@pytest.mark.parametrize(("fewer", "more", "verdict", "why"), [
    (seen(9 * N, N, SPLIT), seen(N, N, SPLIT), Answer.NOT_SHOWN,
     "A coin would show it: VSS falls no more than more observations make it."),
    (seen(N, N, SPLIT), seen(9 * N, N, SPLIT), Answer.NOT_SHOWN, "VSS over all voxels does not fall."),
    (seen(9 * N, 10, SPLIT), seen(N, N, SPLIT), Answer.UNTESTED, None),
])  # fmt: skip
def test_denser_sampling_that_shows_nothing(fewer, more, verdict, why):
    outcome = sampled(fewer, more)
    assert outcome.verdict is verdict
    assert why in (None, outcome.why)


@pytest.mark.parametrize(("share", "verdict"), [(0.9, Answer.SHOWN), (1.1, Answer.NOT_SHOWN)])
def test_recurrent_vss_may_move_by_half_as_much(share, verdict):
    # With half of the voxels recurrent before, a share x after and VSS falling by m among them, the aggregate falls by
    # 0.25 (x - 0.5) + m x: at x = 0.8 m is half of that where m = 0.0625.
    move = 0.0625 * share
    evidence = [0.75 - move, 0.25 + move, 0]
    outcome = sampled(seen(4 * N, 4 * N, SPLIT), seen(2 * N, 8 * N, evidence))
    fall = 0.25 * 0.3 + move * 0.8
    assert (move <= HARDLY * fall) == (verdict is Answer.SHOWN)
    assert outcome.verdict is verdict


def test_a_finding_is_shown_where_every_backbone_and_not_only_pooling_shows_it():
    """In each scene the recurrent voxels agree better than the others; the scene that disagrees has more of them."""
    clear = record(voxels((9 * N, 1, [9, 1, 0]), (N, 4, SURE)), scene="clear")
    unclear = record(voxels((N, 1, [1, 1, 0]), (9 * N, 4, [3, 2, 0])), scene="unclear")
    finding = findings(study(clear, unclear))[0]
    (row,) = finding.evidence
    assert more_disagreement(pooled([clear, unclear])).verdict is Answer.SHOWN
    assert (row.verdict, row.scenes) == (Answer.NOT_SHOWN, (0, 2))
    assert "by themselves only 0 of 2" in row.outcome.why
    agreeing = record(voxels((N, 1, SPLIT), (N, 4, SPLIT)), backbone="agreeing")
    disagreeing = record(voxels(*seen(N, N, SPLIT)), backbone="disagreeing")
    untested = record(voxels((N, 1, SPLIT)), backbone="unseen")
    both = findings(study(agreeing, disagreeing, untested))[0]
    assert (both.verdict, both.counts, both.said) == (Answer.NOT_SHOWN, (1, 2), "shown in 1 of 2 tests")
    assert findings(study(disagreeing, untested))[0].verdict is Answer.SHOWN
    assert findings(study(untested))[0].verdict is Answer.UNTESTED


def test_without_sweeps_two_findings_cannot_be_tested_and_repeats_are_averaged():
    found = findings(study(record(voxels(*seen(N, N, SPLIT)))))
    assert [finding.verdict for finding in found[2:]] == [Answer.UNTESTED] * 2
    assert all(row.outcome.why.startswith("The study varies n") for finding in found[2:] for row in finding.evidence)
    base = [record(voxels(*seen(N, N, SPLIT)), "depth_noise", 0.0)]
    noisy = [record(voxels(*seen(n * N, N, SPLIT)), "depth_noise", 0.01, repeat) for repeat, n in enumerate((3, 1))]
    (row,) = findings(study(record(voxels(*seen(N, N, SPLIT))), *base, *noisy))[2].evidence
    assert "VSS 0.8750 → 0.9062; OP>=3 50.00 → 37.50%" in row.outcome.numbers
