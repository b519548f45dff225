"""What is the same for many voxels is computed once: the numbers are those of all voxels one by one."""

from __future__ import annotations

import numpy as np
import pytest
from compare_summaries import differences
from simulated_events import grid, log_of_evidence

from semstab.core.json_form import to_json
from semstab.model.events import Events
from semstab.model.evidence import Evidence
from semstab.model.voxels import VoxelTable
from semstab.statistics import analyse, join_truth, kinds, patterns
from semstab.statistics.kinds import Kinds

SIDE, F, K = 120, 6, 3


def flight(wrong):
    """The log of a clean map whose places few frames see; of some looks the label errs, of others pixels disagree."""
    rng = np.random.default_rng(3)
    label = np.where(
        rng.random((SIDE**2, F)) < wrong, rng.integers(0, K, (SIDE**2, F)), np.arange(SIDE**2)[:, None] % K
    )
    evidence = np.eye(K)[label]
    mixed = rng.random((SIDE**2, F)) < wrong
    evidence[mixed] = 0.5 * evidence[mixed] + 0.5 * np.eye(K)[rng.integers(0, K, mixed.sum())]
    seen = np.arange(F) < rng.integers(1, F + 1, (SIDE**2, 1))
    return log_of_evidence(evidence, seen=seen, index=grid(SIDE))


def looked_at(log, true, monkeypatch, few, most):
    monkeypatch.setattr(kinds, "FEW", few)
    monkeypatch.setattr(patterns, "MOST", most)
    table, limit = log.table(), true
    return analyse(table, log, true, limit=limit), analyse(table), analyse(table, truth=true)


@pytest.mark.parametrize(("wrong", "kinds_found"), [(0.02, True), (0.5, False)])
def test_one_voxel_of_each_kind_tells_what_all_of_them_do(monkeypatch, wrong, kinds_found):
    log, true = flight(wrong), flight(0.1).table()
    found = Kinds.found(log.table(), log, join_truth(log.table(), true))
    assert (len(found.one.table) < SIDE**2 / 2) == kinds_found
    assert len(found.patterns.table) < patterns.MOST * len(found.one.table)
    assert found.one.table.voxels.sum() == found.patterns.table.copies.sum() == SIDE**2
    for few, every in zip(
        looked_at(log, true, monkeypatch, kinds.FEW, patterns.MOST),
        looked_at(log, true, monkeypatch, SIDE**3, 0.0),
        strict=True,
    ):
        assert not differences(to_json(few.summary), to_json(every.summary), tolerance=1e-11)
        assert not differences(to_json(few.table), to_json(every.table), tolerance=1e-12)
        np.testing.assert_allclose(few.sums.columns, every.sums.columns, rtol=1e-12, atol=1e-12)
        assert few.maps.keys() == every.maps.keys()
        for name, values in few.maps.items():
            np.testing.assert_array_equal(values, every.maps[name], err_msg=name)


@pytest.mark.parametrize("classes", [9_000, 31_000])
def test_kinds_are_told_apart_as_long_as_they_are_no_more_than_half_of_the_voxels(classes):
    n = 60_000
    once, label = np.ones(n), (np.arange(n) % classes).astype(np.uint16)
    index = {"ix": np.arange(n), "iy": np.zeros(n), "iz": np.zeros(n)}
    table = VoxelTable(
        **index, op=once, evidence=Evidence(np.arange(n + 1), label, once, classes), drift_sum=0 * once, pixels=once,
        first_frame=0 * once, last_frame=0 * once, self_sum=once, frame_entropy_sum=0 * once, voxel_size=1.0,
    )  # fmt: skip
    found = Kinds.found(table)
    one = found.one.table
    if 2 * classes > n:
        assert one is table
        assert found.of is None
        return
    assert len(one) == classes
    assert one.copies.sum() == one.pixels.sum() == n
    np.testing.assert_array_equal(one.evidence.label[found.of], label)


def looks_of_two(n):
    """The evidence and frames of n voxels of which two frames saw two classes each."""
    return np.tile([[0.5, 0.5, 0.0], [0.25, 0.75, 0.0]], (n, 1, 1)), np.tile([3, 5], (n, 1))


@pytest.mark.parametrize(("changed", "alone"), [("frame", True), ("weight", True), ("order", True), ("nothing", False)])
def test_voxels_that_differ_in_a_look_are_of_two_kinds(changed, alone):
    n = 4096
    evidence, frames = looks_of_two(n)
    if changed == "frame":
        frames[-1, 1] = 6
    if changed == "weight":
        evidence[-1, 1] = [0.75, 0.25, 0.0]
    if changed == "order":
        evidence[-1] = evidence[-1, ::-1]
    log = Events(
        ix=np.arange(n), iy=0 * np.arange(n), iz=0 * np.arange(n), voxel=np.repeat(np.arange(n), 2),
        frame=frames.ravel(), evidence=Evidence.of(evidence.reshape(2 * n, K)), pixels=np.ones(2 * n, np.int64),
        voxel_size=1.0,
    )  # fmt: skip
    found = Kinds.found(log.table(), log)
    in_its_cube = found.every.places.at == found.every.places.at[-1]
    assert found.one.table.copies[found.of[-1]] == (1 if alone else np.count_nonzero(in_its_cube))


@pytest.mark.parametrize(
    "column", ["op", "drift_sum", "self_sum", "frame_entropy_sum", "label", "weight", "truth", "cube"]
)
def test_voxels_that_differ_in_anything_that_is_summed_are_of_two_kinds(column):
    n, T = 4096, np.full(4096, 2.0)
    columns = dict.fromkeys(("iy", "iz", "drift_sum", "first_frame", "last_frame", "frame_entropy_sum"), 0 * T)
    columns |= {"ix": np.arange(n) + 0.0, "op": T, "pixels": T, "self_sum": T}
    label, weight, true = np.zeros(n, np.uint16), T.copy(), np.zeros(n, np.int64)
    {**columns, "label": label, "weight": weight, "truth": true, "cube": columns["ix"]}[column][-1] += (
        1 + (column == "cube") * 2**20
    )
    evidence = Evidence(np.arange(n + 1), label, weight, K)
    table = VoxelTable(**columns, evidence=evidence, voxel_size=1.0)
    truth = kinds.Truth(np.ones(n, np.bool_), true)
    assert Kinds.found(table, truth=truth).one.table.copies.tolist()[-1] == 1


TWO = [[0.75, 0.25, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
"""Two looks at two classes."""


@pytest.mark.parametrize(
    ("one", "other", "count"),
    [
        (TWO, [[0.75, 0.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]], 1),
        (TWO, TWO[::-1], 2),
        (TWO, [[0.25, 0.75, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]], 2),
        (TWO, [[0.5, 0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]], 2),
        ([[0.99, 0.01, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]], [[0.99, 0.0, 0.0, 0.01], [0.0, 0.0, 0.0, 1.0]], 2),
        (TWO * 3, TWO * 3, 64),
    ],
    ids=["other classes", "order", "ranks", "weights", "hardly seen", "many looks"],
)
def test_voxels_have_one_pattern_where_looks_differ_in_the_names_of_classes_only(one, other, count):
    log = log_of_evidence([one, other] * 32, index=grid(8))
    assert len(Kinds.found(log.table(), log).patterns.table) == count
