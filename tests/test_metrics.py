"""The measures against the paper's tables, against hand-worked maps, and against each other."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import Frame, Intrinsics, VoxelTable, backends
from semstab.data.measures import ENTROPY, SBD, VSS, margin, measures
from semstab.data.results import Means, MeasureMeans, UnitName
from semstab.data.voxel_keys import voxel_keys
from semstab.errors import DataError
from semstab.metrics import (
    compare,
    dominant,
    entropy,
    flicker_percent,
    macro_mean,
    op,
    pool,
    sbd,
    strata,
    summarise,
    vss,
)
from semstab.metrics.agreement import COUNTS, SUMS
from semstab.testing import JS_HALF, SEQUENCES, as_frames, checks, sight_line


def voxel_table(op, evidence, drift_sum=None, classes=()):
    """A map of voxels (0, 0, 0), (0, 0, 1), ... with these rows."""
    zeros = np.zeros(len(op))
    return VoxelTable(
        zeros, zeros, np.arange(len(op)), op=op, evidence=evidence, drift_sum=zeros if drift_sum is None else drift_sum,
        pixels=op, first_frame=zeros, last_frame=zeros, self_sum=zeros, frame_entropy_sum=zeros, voxel_size=0.2,
        classes=classes,
    )  # fmt: skip


def fuse(frames, K=3):
    backend = backends.create("numpy", voxel_size=1.0, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


# --- The paper's tables -----------------------------------------------------------------------------------------------


def two_frames_that_disagree(disagreeing, voxels):
    """Every voxel is seen twice; the labels of the first `disagreeing` ones differ."""
    first = [(i + 0.5, 0) for i in range(voxels)]
    second = [(i + 0.5, 1 if i < disagreeing else 0) for i in range(voxels)]
    return fuse([sight_line(0, first), sight_line(1, second)])


def test_the_row_op_2_of_the_persistence_table_has_a_quarter_that_disagree():
    row = summarise(two_frames_that_disagree(65, 256)).strata[1]
    assert row.name == "OP=2"
    assert (round(row[VSS], 3), round(row[SBD], 4), round(row[ENTROPY], 4)) == (0.873, 0.0790, 0.1602)


@pytest.mark.parametrize("disagreeing", [0, 1, 254, 500, 1000])
def test_measures_at_op_2_are_linear_in_the_share_that_disagrees(disagreeing):
    f = disagreeing / 1000
    summary = summarise(two_frames_that_disagree(disagreeing, 1000))
    assert summary[VSS] == pytest.approx(1 - f / 2)
    assert summary[SBD] == pytest.approx(f * JS_HALF)
    assert summary[ENTROPY] == pytest.approx(f * math.log(2) / math.log(3))


SCENES = {  # voxels, sampled points, VSS, SBD, H: the paper's multi-scene table
    "scene0": (306957, 637068, 0.951, 0.0466, 0.0395),
    "scene1": (320725, 624234, 0.908, 0.0949, 0.0758),
    "scene3": (27904, 32999, 0.981, 0.0714, 0.0133),
    "scene5": (23862, 27433, 0.978, 0.1007, 0.0155),
    "scene8": (26454, 32169, 0.966, 0.1091, 0.0239),
}


def test_the_last_row_of_the_scene_table_holds_totals_and_macro_means():
    voxels, points, *measures = zip(*SCENES.values(), strict=True)
    assert (sum(voxels), sum(points)) == (705902, 1353903)
    mean_op = [p / v for p, v in zip(points, voxels, strict=True)]
    assert round(macro_mean(mean_op), 2) == 1.51
    assert round(sum(points) / sum(voxels), 2) == 1.92  # pooled it would be
    means = [round(macro_mean(column), digits) for column, digits in zip(measures, (3, 4, 4), strict=True)]
    assert means == [0.957, 0.0845, 0.0336]


def test_points_and_observations_are_counted_apart():
    summary = summarise(fuse([sight_line(0, [(0.2, 0), (0.4, 0), (1.5, 1)]), sight_line(1, [(0.5, 0)])]))
    assert (summary.points, summary.observations, summary.voxels, summary.mean_op) == (4, 3, 2, 1.5)
    summary = summarise(voxel_table(op=[1, 1, 3, 7], evidence=[[1, 0]] * 4))
    assert (summary.observations, summary.voxels, summary.mean_op) == (12, 4, 3.0)


def test_the_shares_of_the_persistence_table_are_of_all_voxels():
    counts = [5789, 2032, 1802, 377]
    ops = np.repeat([1, 2, 4, 9], counts)
    summary = summarise(voxel_table(ops, np.ones((len(ops), 2))))
    assert [round(100 * row.share, 2) for row in summary.strata] == [57.89, 20.32, 18.02, 3.77]
    assert sum(row.share for row in summary.strata) == pytest.approx(1)
    assert round(100 * summary.recurrent.share, 2) == 21.79


# --- Strata, recurrent voxels, classes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edges", "names"),
    [
        ([1, 2, 5], ["OP=1", "OP=2", "3<=OP<=5", "OP>5"]),
        ([1], ["OP=1", "OP>1"]),
        ([3], ["1<=OP<=3", "OP>3"]),
        ([2, 3, 9], ["1<=OP<=2", "OP=3", "4<=OP<=9", "OP>9"]),
    ],
)
def test_strata_follow_their_edges(edges, names):
    assert [row[0] for row in strata(edges)] == names


@checks
@given(st.sets(st.integers(1, 50), min_size=1, max_size=6), st.integers(1, 2**31 - 1))
def test_each_op_is_in_one_stratum(edges, value):
    assert sum(low <= value <= high for _, low, high in strata(sorted(edges))) == 1


def test_strata_count_their_edges_in():
    summary = summarise(voxel_table(op=[1, 2, 3, 5, 6], evidence=[[1, 0]] * 5))
    assert [row.voxels for row in summary.strata] == [1, 1, 2, 1]


def test_recurrent_means_seen_three_times_or_more():
    summary = summarise(voxel_table(op=[1, 2, 3, 4], evidence=[[1, 0], [1, 1], [2, 1], [2, 2]]))
    assert (summary.recurrent.name, summary.recurrent.voxels, summary.recurrent.share) == ("OP>=3", 2, 0.5)
    assert summary.recurrent[VSS] == pytest.approx((2 / 3 + 1 / 2) / 2)


def test_sbd_is_averaged_over_voxels_seen_twice_or_more():
    table = voxel_table(op=[1, 2, 3], evidence=[[1, 0]] * 3, drift_sum=[0, 0.3, 0.2])
    assert sbd(table)[1:].tolist() == [0.3, 0.1]
    summary = summarise(table)
    assert summary[SBD] == pytest.approx(0.2)
    assert math.isnan(summary.strata[0][SBD])
    assert [row.defined(SBD) for row in summary.strata] == [0, 1, 1, 0]


def test_classes_hold_the_voxels_that_they_dominate():
    evidence = [[2, 1, 0], [0, 1, 2], [0, 2, 2], [1, 1, 1]]
    table = voxel_table(op=[3, 3, 4, 3], evidence=evidence, classes=("road", "tree", "car"))
    assert dominant(table).tolist() == [0, 2, 1, 0]
    classes = summarise(table).classes
    assert [(row.name, row.voxels) for row in classes] == [("road", 2), ("tree", 1), ("car", 1)]
    assert classes[0][VSS] == pytest.approx((2 / 3 + 1 / 3) / 2)
    assert [row.name for row in summarise(voxel_table([1], [[1, 0, 0]])).classes] == ["0", "1", "2"]


def test_a_class_is_confused_with_the_one_that_has_most_evidence_where_it_dominates():
    """Where road dominates, tree has 1 and car 2; where tree does, nobody else has evidence; car dominates nowhere."""
    evidence = [[3, 1, 0], [2, 0, 1], [2, 0, 1], [0, 3, 0]]
    table = voxel_table(op=[4, 3, 3, 3], evidence=evidence, classes=("road", "tree", "car"))
    assert summarise(table).confused_with == {"road": "car"}


def test_means_of_nothing_are_undefined():
    summary = summarise(voxel_table(op=[1], evidence=[[1, 0]]))
    for row in (summary.strata[1], summary.recurrent, summary.classes[1]):
        assert (row.voxels, row.share) == (0, 0)
        assert math.isnan(row[VSS])
        assert math.isnan(row[SBD])
        assert math.isnan(row[ENTROPY])


def test_a_map_without_voxels_has_a_summary():
    summary = summarise(backends.create("numpy", voxel_size=0.2, num_classes=3).table())
    assert (summary.voxels, summary.points, summary.observations, summary.K) == (0, 0, 0, 3)
    undefined = [summary.mean_op, summary[VSS], summary[SBD], summary[ENTROPY], summary.recurrent.share]
    assert all(math.isnan(value) for value in undefined)


@checks
@given(SEQUENCES)
def test_strata_and_classes_partition_the_voxels(sequence):
    summary = summarise(fuse(as_frames(sequence)))
    for rows in (summary.strata, summary.classes):
        assert sum(row.voxels for row in rows) == summary.voxels
        for measure in measures():
            assert pool(rows, summary.voxels)[measure] == pytest.approx(summary[measure], nan_ok=True)


def test_pooling_weighs_scenes_by_their_voxels():
    one, three = {"vss": 1.0, "sbd": 0.1, "entropy": 0.0}, {"vss": 0.6, "sbd": math.nan, "entropy": 0.4}
    a = Means("OP=2", share=0.5, voxels=1, means=MeasureMeans(one, {"sbd": 1}))
    b = Means("OP=2", share=0.25, voxels=3, means=MeasureMeans(three, {"sbd": 0}))
    pooled = pool([a, b], voxels=14)
    assert (pooled.name, pooled.voxels, pooled.defined(SBD)) == ("OP=2", 4, 1)
    assert (pooled.share, pooled[VSS], pooled[SBD], pooled[ENTROPY]) == pytest.approx((4 / 14, 0.7, 0.1, 0.3))


def test_a_macro_mean_leaves_out_what_is_undefined():
    assert macro_mean([1.0, math.nan, 2.0]) == 1.5
    assert math.isnan(macro_mean([math.nan]))
    assert math.isnan(macro_mean([]))


# --- One voxel --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("evidence", "concentration", "uncertainty"),
    [([4, 0, 0, 0], 1, 0), ([1, 1, 1, 1], 0.25, 1), ([2, 2, 0, 0], 0.5, 0.5), ([0.5, 0, 0, 0.5], 0.5, 0.5)],
)
def test_vss_and_entropy_of_a_voxel(evidence, concentration, uncertainty):
    table = voxel_table([4], [evidence])
    assert vss(table)[0] == pytest.approx(concentration)
    assert entropy(table)[0] == pytest.approx(uncertainty)


@pytest.mark.parametrize(
    ("evidence", "lead"), [([4, 0, 0, 0], 1), ([1, 1, 1, 1], 0), ([2, 2, 0, 0], 0), ([1, 0, 2, 1], 0.25), ([1, 3], 0.5)]
)
def test_the_margin_is_how_far_the_dominant_class_is_ahead(evidence, lead):
    assert margin(voxel_table([4], [evidence]))[0] == pytest.approx(lead)


def test_op_is_the_number_of_frames():
    assert op(voxel_table([1, 5], [[1, 0]] * 2)).tolist() == [1, 5]


def test_the_same_evidence_is_less_uncertain_among_more_classes():
    of_two, of_four = voxel_table([2], [[1, 1]]), voxel_table([2], [[1, 1, 0, 0]])
    assert entropy(of_two)[0] == pytest.approx(1)
    assert entropy(of_four)[0] == pytest.approx(0.5)


# --- Flicker ----------------------------------------------------------------------------------------------------------


def labelled(labels, depth=None, dtype=np.uint8, index=0, **more):
    labels = np.array(labels, dtype=dtype)
    depth = np.ones(labels.shape[:2]) if depth is None else np.array(depth, dtype=float)
    kind = {"scores": labels} if labels.ndim == 3 else {"labels": labels}
    return Frame(index, depth, Intrinsics(1, 1, 0, 0), np.eye(4), **kind, **more)


SOFT = {"dtype": np.float32}


@pytest.mark.parametrize(
    ("previous", "current", "percent"),
    [
        (labelled([[0, 1, 2, 0]]), labelled([[0, 1, 1, 1]]), 50),
        (labelled([[0, 1]]), labelled([[0, 1]]), 0),
        (labelled([[0, 0, 0, 255, 0]], depth=[[1, 1, 0, 1, 1]]), labelled([[1, 0, 1, 1, 255]]), 50),
        (labelled([[0, 255]]), labelled([[255, 0]]), math.nan),
        (labelled([[[6, 4], [2, 8], [0, 0]]], **SOFT), labelled([[[4, 6], [1, 9], [1, 0]]], **SOFT), 50),
        (labelled([[0, 1]]), labelled([[[1, 0], [1, 0]]], **SOFT), 50),
        (labelled([[0, 255]]), labelled([[0, 65535]], dtype=np.uint16), 0),
    ],
    ids=["changes", "none", "valid in both", "none valid", "largest class", "labels with scores", "8 with 16 bits"],
)
def test_flicker_is_the_share_of_labels_that_change(previous, current, percent):
    assert flicker_percent(previous, current) == pytest.approx(percent, nan_ok=True)


def test_flicker_needs_frames_of_one_size():
    current = labelled([[0]], index=7, files={"depth": "depth/7.png"})
    with pytest.raises(DataError, match=r"^depth/7.png: frames 0 and 7 differ in size \(2x1 and 1x1\)$"):
        flicker_percent(labelled([[0, 1]]), current)


# --- Agreement --------------------------------------------------------------------------------------------------------

UNITS = (UnitName("s", "b", "numpy"), UnitName("s", "b", "open3d"))
TABLE = voxel_table(op=[1, 2, 4], evidence=[[1, 0], [1, 1], [3, 1]], drift_sum=[0, 0.3, 0.3])


def test_a_map_agrees_with_itself():
    row = compare(TABLE, TABLE, UNITS)
    assert row.agrees
    assert (row.scene, row.model, row.backends) == ("s", "b", ("numpy", "open3d"))
    assert (row.voxels, row.only_in) == ((3, 3), (0, 0))
    assert {name: (d.max, d.mean) for name, d in row.differences.items()} == dict.fromkeys(
        [*COUNTS, *SUMS, *(measure.key for measure in measures()), "label"], (0, 0)
    )


@pytest.mark.parametrize(
    ("column", "row", "value", "quantities"),
    [
        ("op", 2, 5, {"op", "sbd"}),
        ("drift_sum", 1, 0.4, {"drift_sum", "sbd"}),
        ("pixels", 1, 9, {"pixels"}),
        ("first_frame", 1, 9, {"first_frame"}),
        ("last_frame", 1, 9, {"last_frame"}),
        ("self_sum", 1, 0.25, {"self_sum"}),
        ("frame_entropy_sum", 1, 0.25, {"frame_entropy_sum"}),
        ("evidence", 1, [2, 2], {"evidence"}),
        ("evidence", 2, [1, 3], {"evidence", "label"}),
        ("evidence", 2, [2, 2], {"evidence", "vss", "entropy", "margin"}),
    ],
)
def test_a_difference_in_any_quantity_is_disagreement(column, row, value, quantities):
    values = np.array(getattr(TABLE, column))
    values[row] = value
    result = compare(TABLE, dataclasses.replace(TABLE, **{column: values}), UNITS)
    assert not result.agrees
    assert {name for name, difference in result.differences.items() if difference.max > 1e-9} == quantities
    assert result.first.column == (f"evidence_{np.argmax(value != TABLE.evidence[row])}" if np.ndim(value) else column)
    assert result.first.voxel == tuple(TABLE.index[row])


def test_differences_are_largest_and_mean_over_shared_voxels():
    drift = TABLE.drift_sum.copy()
    drift[2] = 0.6
    sbd_difference = compare(TABLE, dataclasses.replace(TABLE, drift_sum=drift), UNITS).differences["sbd"]
    assert (sbd_difference.max, sbd_difference.mean) == pytest.approx((0.1, 0.1 / 3))


def test_differences_within_the_tolerance_agree():
    other = dataclasses.replace(TABLE, drift_sum=TABLE.drift_sum + np.array([0, 1e-6, 0]))
    assert not compare(TABLE, other, UNITS).agrees
    assert compare(TABLE, other, UNITS, tolerance=1e-5).agrees


def test_the_tolerance_of_a_sum_is_relative_to_it():
    """65,536 observations of thirds: sums in another order differ by their rounding, and by no more."""
    large = dataclasses.replace(TABLE, self_sum=np.array([1.0, 2.0, 65536 / 3]))
    assert compare(large, dataclasses.replace(large, self_sum=np.add(large.self_sum, [0, 0, 1e-5])), UNITS).agrees
    assert not compare(large, dataclasses.replace(large, self_sum=np.add(large.self_sum, [0, 0, 1e-4])), UNITS).agrees
    assert not compare(large, dataclasses.replace(large, self_sum=np.add(large.self_sum, [1e-5, 0, 0])), UNITS).agrees


def test_the_first_number_that_differs_is_a_sentence():
    wrong = compare(dataclasses.replace(TABLE, op=np.array([1, 3, 5])), TABLE, UNITS).first
    assert str(wrong) == f"op of the voxel {tuple(TABLE.index[1].tolist())} is 3, expected 2 (and 1 more)"
    missing = compare(without(TABLE, 1), TABLE, UNITS).first
    assert str(missing) == f"the voxel {tuple(TABLE.index[1].tolist())} is missing"
    surplus = compare(TABLE, without(TABLE, 1), UNITS).first
    assert str(surplus) == f"the voxel {tuple(TABLE.index[1].tolist())} should not be there"


def test_an_sbd_that_one_map_lacks_is_a_difference_of_1():
    other = dataclasses.replace(TABLE, op=np.array([2, 2, 4]))
    assert compare(TABLE, other, UNITS).differences["sbd"].max == 1


def without(table, row):
    """The table less one voxel."""
    columns = {name: np.delete(getattr(table, name), row, axis=0) for name in COLUMNS}
    return dataclasses.replace(table, **columns)


COLUMNS = [
    field.name
    for field in dataclasses.fields(VoxelTable)
    if field.name not in ("voxel_size", "classes", "copies", "weight")
]


@pytest.mark.parametrize("row", [0, 1, 2])
def test_voxels_in_one_map_only(row):
    less = without(TABLE, row)
    for a, b, only_in in ((TABLE, less, (1, 0)), (less, TABLE, (0, 1))):
        result = compare(a, b, UNITS)
        assert not result.agrees
        assert (result.only_in, result.voxels) == (only_in, (len(a), len(b)))
        assert all(difference.max == 0 for difference in result.differences.values())
        assert compare(a, b, UNITS, voxel_share=0.34).agrees


def test_maps_that_share_no_voxel():
    result = compare(TABLE, dataclasses.replace(TABLE, ix=TABLE.ix + 1), UNITS)
    assert not result.agrees
    assert result.only_in == (3, 3)
    assert math.isnan(result.differences["vss"].max)


def test_empty_maps():
    empty = voxel_table([], np.zeros((0, 2)))
    result = compare(empty, backends.create("numpy", voxel_size=0.2, num_classes=2).table(), UNITS)
    assert result.agrees
    assert (result.voxels, result.only_in) == ((0, 0), (0, 0))
    assert compare(empty, TABLE, UNITS).only_in == (0, 3)
    assert not compare(TABLE, empty, UNITS).agrees


def test_maps_of_other_classes_or_voxel_sizes_cannot_be_compared():
    with pytest.raises(DataError, match=r"2 classes in voxels of 0\.2 m and of 5 in 0\.2 m cannot be compared"):
        compare(TABLE, voxel_table([1, 2, 4], np.ones((3, 5))), UNITS)
    with pytest.raises(DataError, match="cannot be compared"):
        compare(TABLE, dataclasses.replace(TABLE, voxel_size=0.4), UNITS)


def test_maps_whose_voxels_have_more_places_than_keys_are_refused():
    """2^21 voxels along each axis are 2^63 places, one more than keys."""
    side = 2**21
    last = np.array([[side - 1, side - 1, side - 2]], np.int32)
    _, keys = voxel_keys(np.zeros((1, 3), np.int32), last)
    assert keys.tolist() == [side * side * (side - 1) - 1]
    with pytest.raises(DataError, match="the maps span 2097152 x 2097152 x 2097152 voxels; leave out far depth"):
        voxel_keys(np.zeros((1, 3), np.int32), np.full((1, 3), side - 1, np.int32))
