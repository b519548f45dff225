"""Sums by frame and cube of space: they give back every number, add up, and know what a frame is worth."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from simulated_events import grid, log_of, log_of_evidence, soft
from striped_floor import K, fused, sampled
from striped_floor import flight as over_stripes

from semstab.core.arrays import distinct_keys, stable_order
from semstab.core.json_form import to_json
from semstab.data.measures import Measure, dominant, entropy, margin, registered, sbd, vss
from semstab.errors import DataError
from semstab.metrics.agreement import rows_of
from semstab.statistics import class_agreement, correctness, expected_sbd, krippendorff_alpha, psa
from semstab.statistics.accumulate import cluster_sums_of, sums_of_spots
from semstab.statistics.agreement import consistency_posterior
from semstab.statistics.cluster_sums import (
    FUNCTIONALS,
    MOST_CLASSES,
    ClusterSums,
    FrameGroups,
    aligned,
    count_distinct,
    distinct_rows,
    value,
)
from semstab.statistics.intervals import (
    coverage,
    difference,
    difference_over_frames,
    estimate,
    mean_over_frames,
    same_flight,
    scope_of,
)
from semstab.statistics.observations import PARTS


def flight(side=12, F=9, K=3, soft_evidence=False, seed=0):
    """A floor of which each frame sees a strip, and the true class of each voxel."""
    rng = np.random.default_rng(seed)
    index = grid(side)
    visible = np.abs(index[:, :1] - np.linspace(0, side, F)) <= 3
    truth = rng.integers(0, K, len(index))
    labels = np.where(rng.random(visible.shape) < 0.3, rng.integers(0, K, visible.shape), truth[:, None])
    evidence = soft(rng, len(index), F, K) if soft_evidence else np.eye(K)[labels]
    some = visible.any(axis=1)
    log = log_of_evidence(evidence[some], visible[some], index=index[some])
    return log.table(), log, truth[some]


@pytest.mark.parametrize(("K", "there"), [(MOST_CLASSES, True), (MOST_CLASSES + 1, False)])
def test_sums_by_class_are_there_up_to_so_many_classes(K, there):
    table, log, truth = flight(K=K)
    again = (table.op >= 2) & (truth == 1)
    expected = (dominant(table) == truth)[again].mean() if there else np.nan
    for given in (log, None):
        sums = cluster_sums_of(table, given, truth)
        found = value(sums, "accuracy", 1) if there else value(sums, "miou")
        assert found == pytest.approx(expected, nan_ok=True)
        assert value(sums, "accuracy") == pytest.approx((dominant(table) == truth)[table.op >= 2].mean())


@pytest.mark.parametrize("soft_evidence", [False, True])
def test_the_sums_give_every_number_back(soft_evidence):
    table, log, truth = flight(soft_evidence=soft_evidence)
    again, often = table.op >= 2, table.op >= 3
    right = dominant(table) == truth
    consistent = np.where(often, consistency_posterior(table), 0.0)
    excess, by_truth = sbd(table) - expected_sbd(table), correctness(table.evidence[again], truth[again])
    expected = {
        "psa": psa(table)[again].mean(), "voxel_alpha": krippendorff_alpha(table), "vss": vss(table)[often].mean(),
        "entropy": entropy(table)[again].mean(), "accuracy": right[again].mean(),
        "observation_accuracy": log.evidence[again[log.voxel], truth[log.voxel[again[log.voxel]]]].mean(),
        "wrong_of_consistent": (consistent * ~right).sum() / consistent.sum(), "miou": by_truth.miou,
        "ece": by_truth.ece,
        "sbd_excess": np.nan if soft_evidence else np.nanmean(excess[again]),
    }  # fmt: skip
    for given in (log, None):
        sums = cluster_sums_of(table, given, truth, sbd_excess=excess)
        assert {key: value(sums, key) for key in expected} == pytest.approx(expected, abs=1e-12, nan_ok=True)
    sums = cluster_sums_of(table, log, truth)
    by_class = [row.voxel_alpha_op2 for row in class_agreement(table, log)]
    assert [value(sums, "voxel_alpha", k) for k in range(3)] == pytest.approx(by_class)
    true_one = again & (truth == 1)
    assert value(sums, "accuracy", 1) == pytest.approx(right[true_one].mean())
    said_one = again & (dominant(table) == 1)
    assert value(sums, "precision", 1) == pytest.approx(right[said_one].mean())
    assert value(sums, "iou", 1) == pytest.approx((right & true_one).sum() / (true_one | said_one).sum())


def stripes(voxel_size=0.3, **options):
    """The sums of a flight over stripes, with those of its spots, and the spots."""
    frames = list(over_stripes(8, flicker=0.3, patch=5, **options))
    backend, spots = fused(frames, voxel_size), sampled(frames)
    return cluster_sums_of(backend.table(), backend.events(), spots=spots), spots


def lever_by_hand(spots):
    """How far the parabola through disagreement at three distances falls to 0, in falls from the second to the first.

    The third answers are two pixels away, of which the second ones are one.
    """
    (first, near), (second, far), (third, _) = spots.logs()
    again = first.table().op[first.voxel] >= 2
    disagreement = [1 - psa(log.table())[log.voxel[again]].mean() for log in (first, second, third)]
    same_cell, one = near[again].mean(), far[again].mean()
    distances = np.sqrt([same_cell, one, same_cell + 4 * (one - same_cell)])
    at_zero = np.polyfit(distances, disagreement, 2)[-1]
    return (disagreement[0] - at_zero) / (disagreement[1] - disagreement[0])


def test_the_sums_of_spots_give_alpha_back():
    whole, spots = stripes()
    logs = [log for log, _ in spots.logs()[:2]]
    expected = [krippendorff_alpha(log.table()) for log in logs]
    assert [value(part, "voxel_alpha") for part in whole.answers[:2]] == pytest.approx(expected)
    lever = lever_by_hand(spots)
    assert 0.1 < lever < 1
    assert value(whole, "alpha") == pytest.approx(expected[0] + lever * (expected[0] - expected[1]))
    by_class = [[row.voxel_alpha_op2 for row in class_agreement(log.table(), log)] for log in logs]
    for k in range(K):
        assert value(whole, "alpha", k) == pytest.approx(by_class[0][k] + lever * (by_class[0][k] - by_class[1][k]))
    alone = sums_of_spots(spots)
    assert value(alone, "alpha") == pytest.approx(value(whole, "alpha"))
    assert np.isnan(value(alone, "psa"))


def test_where_the_second_answers_are_the_first_ones_alpha_is_that_of_the_first_ones():
    """There is nothing to extrapolate from: no pixel beside shows the surface."""
    spots = stripes()[1]
    alone = replace(spots, neighbour=spots.label, beyond=spots.label, far=spots.near)
    found = sums_of_spots(alone)
    assert value(found, "alpha") == pytest.approx(value(sums_of_spots(spots).answers[0], "voxel_alpha"), abs=1e-12)


def test_alpha_stays_within_its_range_where_second_answers_agree_far_less():
    whole, _ = stripes()
    first, second, third = whole.answers
    parts = []
    for part, share in ((first, 1.0), (second, 0.5), (third, 0.0)):
        columns = part.columns.copy()
        columns[:, part.layout["agreeing"]] = share * part["observations"]
        parts.append(replace(part, columns=columns))
    sums = replace(whole, answers=tuple(parts))
    assert value(sums, "alpha") == 1.0
    assert estimate(sums, "alpha").value == 1.0
    assert difference(sums, sums, "alpha").value == 0.0


def test_without_spots_there_is_no_alpha():
    table, log, _ = flight()
    sums = cluster_sums_of(table, log)
    assert sums.answers == ()
    assert np.isnan(value(sums, "alpha"))
    assert not np.isnan(value(sums, "voxel_alpha"))


def test_sums_of_spots_become_coarser_with_those_of_the_map():
    whole, _ = stripes()
    larger = whole.coarsened(2 * whole.edge, 4)
    assert [part.edge for part in (larger, *larger.answers)] == [2 * whole.edge] * 4
    for wide, fine in zip(larger.answers, whole.answers, strict=True):
        assert wide.cells < fine.cells
        assert wide.step == fine.step == 1
    for key in ("alpha", "voxel_alpha"):
        assert value(larger, key) == pytest.approx(value(whole, key))


def test_sums_of_two_maps_are_aligned_with_their_spots():
    """The frames of one map are not known, those of its spots are; the cubes of the other are larger."""
    one, other = stripes()[0].coarsened(2.0, 2), stripes(seed=1)[0].coarsened(4.0, 1)
    a, b = aligned(one.coarsened(2.0, 0), other)
    assert (a.edge, a.step, b.edge, b.step) == (4.0, 0, 4.0, 0)
    for part in (*a.answers, *b.answers):
        assert (part.edge, part.step) == (4.0, 1)
    assert [value(a, "alpha"), value(b, "alpha")] == pytest.approx([value(one, "alpha"), value(other, "alpha")])
    without = cluster_sums_of(flight()[0]).coarsened(4.0, 0)
    a, b = aligned(replace(without, voxel_size=0.3), other)
    assert (a.answers, np.isnan(value(a, "alpha"))) == ((), True)
    assert value(b, "alpha") == pytest.approx(value(other, "alpha"))


def test_a_file_holds_a_map_and_the_three_answers_of_its_spots(tmp_path):
    whole, spots = stripes()
    whole.save(tmp_path / "sums.parquet")
    back = ClusterSums.load(tmp_path / "sums.parquet")
    for part, written in zip((back, *back.answers), (whole, *whole.answers), strict=True):
        for name in ("cell", "frame", "columns"):
            np.testing.assert_array_equal(getattr(part, name), getattr(written, name))
        for name in ("edge", "step", "voxel_size", "K", "classes", "truth", "fused"):
            assert getattr(part, name) == getattr(written, name)
    assert [part.voxel_size for part in (back, *back.answers)] == [0.3, *[spots.spacing / PARTS] * 3]
    assert value(back, "alpha") == value(whole, "alpha")


def test_a_file_is_read_by_the_names_of_its_columns(tmp_path):
    table, log, truth = flight()
    whole = cluster_sums_of(table, log, truth)
    whole.save(tmp_path / "sums.parquet")
    content = pq.read_table(tmp_path / "sums.parquet")
    further = content.select(content.column_names[::-1]).append_column("further", content.column("psa"))
    pq.write_table(further, tmp_path / "swapped.parquet")
    np.testing.assert_array_equal(ClusterSums.load(tmp_path / "swapped.parquet").columns, whole.columns)
    pq.write_table(content.drop_columns(["entropy"]), tmp_path / "without.parquet")
    without = ClusterSums.load(tmp_path / "without.parquet")
    expected = {key: np.nan if key == "entropy_op2" else value(whole, key) for key in FUNCTIONALS}
    assert {key: value(without, key) for key in FUNCTIONALS} == pytest.approx(expected, nan_ok=True, rel=0)
    assert np.isnan([getattr(estimate(without, "entropy_op2"), end) for end in ("value", "low", "high")]).all()
    assert np.isnan(difference(without, whole, "entropy_op2").value)
    assert difference(without, whole, "psa").value == 0
    about = json.loads(content.schema.metadata[b"semstab"]) | {"K": 1000, "classes": []}
    pq.write_table(content.replace_schema_metadata({"semstab": json.dumps(about)}), tmp_path / "sums.parquet")
    with pytest.raises(DataError, match="columns of sums for 1000 classes"):
        ClusterSums.load(tmp_path / "sums.parquet")


@pytest.mark.parametrize(
    "change",
    [
        {"schema": 9}, {"schema": 5}, {"kind": "InfluenceSums"}, {"step": [1, 1]}, {"step": [1, 3, 1]},
        {"fused": [10**400, 8, 8]},
        {"step": [2**40, 2**40, 2**40]},
    ],
)  # fmt: skip
def test_a_file_of_another_kind_is_refused(tmp_path, change):
    whole, _ = stripes()
    whole.save(tmp_path / "sums.parquet")
    content = pq.read_table(tmp_path / "sums.parquet")
    about = json.loads(content.schema.metadata[b"semstab"]) | change
    pq.write_table(content.replace_schema_metadata({"semstab": json.dumps(about)}), tmp_path / "other.parquet")
    with pytest.raises(DataError, match=r"not a file of cluster sums|it is damaged, or of another version"):
        ClusterSums.load(tmp_path / "other.parquet")


def test_sums_become_coarser_and_a_file_holds_them(tmp_path):
    table, log, truth = flight(side=16)
    whole = cluster_sums_of(table, log, truth)
    coarse = whole.coarsened(4 * whole.edge, 2)
    assert (coarse.edge, coarse.step, coarse.frames) == (4 * whole.edge, 2, 5)
    assert coarse.cells < whole.cells
    assert value(coarse, "voxel_alpha") == pytest.approx(value(whole, "voxel_alpha"))
    whole.save(tmp_path / "sums.parquet")
    again = ClusterSums.load(tmp_path / "sums.parquet")
    assert np.array_equal(again.columns, whole.columns)
    assert (again.edge, again.step, again.truth) == (whole.edge, 1, True)
    assert aligned(again, coarse)[0].cells == coarse.cells
    with pytest.raises(DataError, match="not a file of cluster sums"):
        ClusterSums.load(__file__)


def test_a_share_is_the_frames_own_quality():
    """Frame 2 errs alone: all that agreement loses is its doing, though the others disagree with it as well."""
    labels = np.zeros((50, 5), dtype=int)
    labels[:25, 2] = 1
    table = (log := log_of(labels, index=grid(8)[:50])).table()
    sums = cluster_sums_of(table, log)
    of_frames = sums.frame >= 0
    share = np.bincount(sums.frame[of_frames], weights=sums["agreeing"][of_frames, 0]) / 50
    assert share.sum() == pytest.approx((table.op * psa(table)).mean())
    lost = share - share[0]
    assert lost[[0, 1, 3, 4]] == pytest.approx(0)
    assert lost[2] == pytest.approx(-2 * 25 / 50)


def test_a_series_over_frames_and_how_much_of_a_map_is_covered():
    rng = np.random.default_rng(0)
    found = mean_over_frames(np.arange(1, 80), values := rng.normal(3.0, 1.0, 79))
    assert (found.value, found.frames, found.undecided) == (pytest.approx(values.mean()), 79, "")
    assert 0.9 < (found.high - found.low) / (2 * 1.99 * values.std() / np.sqrt(79)) < 1.6
    assert "too few frames" in mean_over_frames(np.arange(8), np.append(values[:7], np.nan)).undecided
    table, log, truth = flight(side=16)
    left = table.index[:, 0] < 12
    whole = cluster_sums_of(table, log, truth)
    part = cluster_sums_of(rows_of(table, np.flatnonzero(left)))
    assert coverage(part, whole).value == pytest.approx(left[table.op >= 2].mean() - 1)
    assert (coverage(whole, whole).low, coverage(whole, whole).high) == (0.0, 0.0)
    larger = whole.coarsened(2 * whole.edge, 0)
    for ours, theirs in ((part, larger), (larger, part)):  # on the larger cubes of the two
        alike = [sums.coarsened(larger.edge, 0) for sums in (ours, theirs)]
        assert to_json(coverage(ours, theirs, same_frames=False)) == to_json(coverage(*alike, same_frames=False))
    assert same_flight(whole, whole)
    assert whole.frame_count == whole.coarsened(whole.edge, 2 * whole.step).frame_count
    assert not same_flight(whole, part)
    other = cluster_sums_of(table, log, 1 - truth)
    assert difference(whole, other, "accuracy").high > 0
    nothing = difference(whole, other, "voxel_alpha")
    assert (nothing.value, nothing.low, nothing.high, nothing.decided) == (0.0, 0.0, 0.0, True)
    series = dict(enumerate(values))
    assert difference_over_frames(series, series | {99: 0.0}).high == 0.0
    assert difference_over_frames({f: v + 1 for f, v in series.items()}, series).value == pytest.approx(1)


def test_a_map_seen_once_has_no_numbers_and_a_large_one_few_cubes():
    table = (log := log_of(np.zeros((9, 1), dtype=int), index=grid(3))).table()
    for given in (log, None):
        sums = cluster_sums_of(table, given, np.zeros(9, dtype=np.int64), sbd_excess=np.full(9, np.nan))
        assert np.isnan([value(sums, key) for key in ("alpha", "voxel_alpha", "miou", "ece", "sbd_excess")]).all()
    labels = np.zeros((40 * 40, 150), dtype=int)
    log = log_of(labels, index=grid(40))
    sums = cluster_sums_of(log.table(), log)
    assert (sums.cells, sums.edge) == (256, 0.5)
    assert (sums.frames, sums.step) == (38, 4)


def test_measures_of_the_register_have_sums_of_their_own(tmp_path):
    """A measure that is declared here has a mean over the voxels, and an interval, from a file of sums."""
    table, log, truth = flight(side=24)
    often = Measure(
        key="often",
        title="Often",
        better="higher",
        range=(0.0, 1.0),
        of=lambda rows: np.where(rows.op > 2, 0.5, np.nan),
    )
    before = cluster_sums_of(table, log, truth)
    with registered(often):
        for given in (log, None):
            whole = cluster_sums_of(table, given, truth, sbd_excess=np.zeros(len(table)))
            whole.save(tmp_path / "sums.parquet")
            for sums in (whole, ClusterSums.load(tmp_path / "sums.parquet"), whole.without_truth()):
                found = {key: value(sums, key) for key in ("sbd", "margin", "often")}
                again = table.op >= 3
                expected = {"sbd": sbd(table)[again].mean(), "margin": margin(table)[again].mean(), "often": 0.5}
                assert found == pytest.approx(expected)
                interval = estimate(sums, "margin", scope=scope_of(sums, key="margin"))
                assert interval.low < expected["margin"] < interval.high
                assert interval.scope == "these frames"
            assert value(whole, "ece") == pytest.approx(value(before, "ece"))
        assert np.isnan(value(before, "often"))
    again = ClusterSums.load(tmp_path / "sums.parquet")
    assert {"sbd_sum", "margin_count"} < set(again.layout)
    assert "often_sum" not in again.layout
    assert value(again, "accuracy") == pytest.approx(value(before, "accuracy"))
    assert value(whole, "margin") == value(again, "margin")
    content = pq.read_table(tmp_path / "sums.parquet")
    old = content.drop_columns([name for name in content.column_names if name.endswith(("_sum", "_count"))])
    pq.write_table(old, tmp_path / "old.parquet")
    old = ClusterSums.load(tmp_path / "old.parquet")
    assert np.isnan(value(old, "sbd"))
    assert {key: value(old, key) for key in FUNCTIONALS} == pytest.approx(
        {key: value(again, key) for key in FUNCTIONALS}, rel=0, nan_ok=True
    )
    assert difference(old, again, "psa").value == 0


@pytest.mark.parametrize("count", [3, 255, 256, 70_000, 2**33])
def test_the_order_of_small_numbers_is_that_of_numpy(count: int) -> None:
    number = np.random.default_rng(count).integers(0, count, 500)
    assert stable_order(number, count).tolist() == np.argsort(number, kind="stable").tolist()


@pytest.mark.parametrize("reach", [3, 2**40])
def test_rows_are_counted_as_they_are_told_apart(reach) -> None:
    rng = np.random.default_rng(0)
    for rows in (rng.integers(-reach, reach, (n, 3)) for n in (0, 1, 500)):
        distinct, of = distinct_rows(rows)
        np.testing.assert_array_equal(distinct, np.unique(rows, axis=0))
        np.testing.assert_array_equal(distinct[of], rows)
        assert count_distinct(rows) == len(distinct)


@pytest.mark.parametrize(("most", "step"), [(9, 1), (8, 1), (7, 2), (4, 4), (2, 8), (1, 16)])
def test_groups_of_frames_are_the_smallest_that_are_few_enough(most: int, step: int) -> None:
    frame = np.array([9, 0, 3, 3, 5, 6, 8, 1, 2, 0], np.int32)
    found = FrameGroups.at_most(most, frame)
    assert (found.step, found.frames) == (step, 8)
    assert found.groups.tolist() == sorted({*(frame // step).tolist()})
    assert found.groups[found.of].tolist() == (frame // step).tolist()


@pytest.mark.parametrize("most", [3, 40, 200, 10**12])
def test_distinct_keys_are_those_of_numpy_whether_they_are_counted_or_put_in_order(most: int) -> None:
    for n in (0, 1, 50, 100):
        key = np.random.default_rng([most, n]).integers(-most // 2, most // 2 + 1, n)
        keys, of = distinct_keys(key)
        expected, expected_of = np.unique(key, return_inverse=True)
        assert keys.tolist() == expected.tolist()
        assert of.tolist() == expected_of.tolist()
