"""Agreement with distances between classes: the sums, where distances come from, and what a run says of them."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import krippendorff
import numpy as np
import pytest
from command_line import bench, error_of
from hypothesis import given
from hypothesis import strategies as st
from posed_writer import write_posed
from simulated_events import grid, spots_of

import semstab
from semstab import LabelSpace
from semstab.data.distances import distances_of, tree_distances
from semstab.errors import DataError
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import estimate
from semstab.statistics.meaning import points_of, products_of, share_near

RELIABILITY = np.array([
    [1, 2, 3, 3, 2, 1, 4, 1, 2, 0, 0, 0], [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, 0, 3],
    [0, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, 0], [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, 0],
]).T  # fmt: skip
"""Four observers, twelve units, 0 where a value is missing (Krippendorff 2011, Computing Krippendorff's
Alpha-Reliability): alpha is .743 for nominal values and .849 for numbers."""


def told(labels, distances, K):
    return sums_of_spots(replace(spots_of(labels, K), distances=np.asarray(distances, float)))


def by_hand(labels, distances):
    """1 less the mean distance of two labels of one spot over that of any two labels, pair by pair."""
    rows = [row[row >= 0] for row in labels if (row >= 0).sum() > 1]
    every = np.concatenate(rows)
    observed = sum(
        distances[a, b] / (len(row) - 1) for row in rows for a, b in itertools.permutations(row.tolist(), 2)
    ) / len(every)
    apart = distances[np.ix_(every, every)].sum() / (len(every) * (len(every) - 1))
    return 1 - observed / apart


def test_distances_of_numbers_give_the_published_alpha():
    numbers = np.arange(5.0)
    sums = told(RELIABILITY - 1, (numbers[:, None] - numbers) ** 2, 5)
    assert round(value(sums, "alpha"), 3) == 0.743
    assert round(value(sums, "alpha_by_meaning"), 3) == 0.849


@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.integers(2, 5))
def test_distances_of_numbers_give_the_alpha_of_another_program(seed, K, views):
    rng = np.random.default_rng(seed)
    labels = np.where(rng.random((30, views)) < 0.5, rng.integers(0, K, (30, 1)), rng.integers(-1, K, (30, views)))
    numbers = np.arange(float(K))
    ours = value(told(labels, (numbers[:, None] - numbers) ** 2, K), "alpha_by_meaning")
    data = np.where(labels < 0, np.nan, labels.astype(float)).T
    assert ours == pytest.approx(krippendorff.alpha(data, level_of_measurement="interval"), abs=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_any_distances_give_alpha_of_all_pairs(seed):
    """Also those that no points have, as of a near b near c with a far from c."""
    rng = np.random.default_rng(seed)
    labels = np.where(rng.random((60, 5)) < 0.7, rng.integers(0, 4, (60, 1)), rng.integers(-1, 4, (60, 5)))
    distances = rng.random((4, 4))
    distances = np.triu(distances, 1) + np.triu(distances, 1).T
    if seed:
        distances[[0, 1, 1, 2], [1, 0, 2, 1]] = 0.01
        assert np.abs(points_of(products_of(distances))[1]).max() > 0.1
    assert value(told(labels, distances, 4), "alpha_by_meaning") == pytest.approx(by_hand(labels, distances), abs=1e-12)


def test_classes_that_are_alike_give_alpha_with_its_interval():
    rng = np.random.default_rng(0)
    labels = np.where(rng.random((256, 9)) < 0.8, rng.integers(0, 3, (256, 1)), rng.integers(0, 3, (256, 9)))
    sums = sums_of_spots(replace(spots_of(labels, 3, grid(16)), distances=1 - np.eye(3)))
    alpha, meaning = estimate(sums, "alpha"), estimate(sums, "alpha_by_meaning")
    assert (meaning.value, meaning.low, meaning.high) == pytest.approx((alpha.value, alpha.low, alpha.high), abs=1e-9)


def test_sums_with_distances_are_read_back(tmp_path):
    sums = told(RELIABILITY - 1, tree_distances(("a", "a", "b", "", "")), 5)
    sums.save(tmp_path / "sums.parquet")
    back = ClusterSums.load(tmp_path / "sums.parquet")
    for part, written in zip(back.answers, sums.answers, strict=True):
        assert dict(part.layout) == dict(written.layout)
        np.testing.assert_array_equal(part.columns, written.columns)
    assert value(back, "alpha_by_meaning") == value(sums, "alpha_by_meaning")


def test_disagreement_between_near_classes_is_told():
    """0 and 1 are of one group: 3 of 4 pairs that differ are theirs."""
    labels = np.array([[0, 1], [0, 1], [1, 0], [2, 0], [3, 3], [2, 2], [0, 0], [1, 1]])
    distances = tree_distances(("a", "a", "", ""))
    assert distances[0, 1] == 0.5
    pairs = np.zeros((4, 4))
    for a, b in labels:
        pairs[a, b] += 1
        pairs[b, a] += 1
    assert share_near(pairs / pairs.sum(), distances) == pytest.approx(0.75)
    assert np.isnan(share_near(np.diag([1.0, 2.0]) / 3, 1 - np.eye(2)))


# --- Where distances come from ----------------------------------------------------------------------------------------

SPACE = LabelSpace("small", ("car", "truck", "tree"), groups=("vehicle", "vehicle", ""))


def test_a_taxonomy_with_groups_is_a_tree(tmp_path):
    assert distances_of(SPACE).tolist() == [[0, 0.5, 1], [0.5, 0, 1], [1, 1, 0]]
    assert distances_of(replace(SPACE, groups=())) is None
    SPACE.save(tmp_path / "small.yaml")
    assert LabelSpace.load(tmp_path / "small.yaml") == SPACE


def test_a_table_and_embeddings_are_read(tmp_path):
    (tmp_path / "d.csv").write_text(",tree,car,Truck\ntruck,1,.2,0\ncar,1,0,.2\ntree,0,1,1\n")
    assert distances_of(SPACE, tmp_path / "d.csv").tolist() == [[0, 0.2, 1], [0.2, 0, 1], [1, 1, 0]]
    np.save(tmp_path / "d.npy", np.array([[0, 0.2, 1], [0.2, 0, 1], [1, 1, 0]]))
    assert distances_of(SPACE, tmp_path / "d.npy")[0, 1] == 0.2
    np.save(tmp_path / "e.npy", np.array([[2.0, 0], [3, 3], [0, 1]]))
    assert distances_of(SPACE, tmp_path / "e.npy") == pytest.approx(
        np.array([[0, 1 - 0.5**0.5, 1], [1 - 0.5**0.5, 0, 1 - 0.5**0.5], [1, 1 - 0.5**0.5, 0]])
    )


@pytest.mark.parametrize(("values", "words"), [
    (np.zeros((3, 3)), "all distances are 0"),
    (np.ones((2, 4)), "has 3 classes, so (3, D) is needed"),
    (np.array([[1, 0], [0, 0], [0, 1.0]]), "the embedding of 'truck' has no length"),
    (np.array([[1, 0], [np.nan, 0], [0, 1.0]]), "the embedding of 'truck' has no length or is not finite"),
    (np.array([[0, 1, 1], [2, 0, 1], [1, 1, 0.0]]), "the distance of 'car' and 'truck' is"),
    (np.array([[0, -1, 1], [-1, 0, 1], [1, 1, 0.0]]), "the distance of 'car' and 'truck' is negative"),
    (np.array(["a", "b"]), "it is no .npy of numbers"),
])  # fmt: skip
def test_what_cannot_be_a_distance_is_one_line(tmp_path, values, words):
    np.save(tmp_path / "d.npy", values)
    with pytest.raises(DataError, match=re.escape(words)):
        distances_of(SPACE, tmp_path / "d.npy")


@pytest.mark.parametrize(("text", "words"), [
    (",car,truck\ncar,0,1\ntruck,1,0\n", "'tree' of small has no"),
    (",car,truck,tree\ncar,0,1,x\ntruck,1,0,1\ntree,1,1,0\n", "'car' and 'tree' is no number"),
    ("", "'car' of small has no row"),
])  # fmt: skip
def test_a_table_that_lacks_something_is_one_line(tmp_path, text, words):
    (tmp_path / "d.csv").write_text(text)
    with pytest.raises(DataError, match=re.escape(words)):
        distances_of(SPACE, tmp_path / "d.csv")
    with pytest.raises(DataError, match=r"a table \(\.csv, \.npy\) or embeddings"):
        distances_of(SPACE, tmp_path / "d.txt")


# --- The command line -------------------------------------------------------------------------------------------------


OPTIONS = (
    "--voxel-size", "0.1", "--taxonomy", "small.yaml", "--check", "none", "--no-geometry-check", "-o", "run",
)  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A wall; the model `net` takes cars for trucks, `worse` takes as many for trees."""
    base, rng = tmp_path_factory.mktemp("meaning"), np.random.default_rng(0)
    sources = {"net": [], "worse": []}
    for i in range(16):
        truth = np.tile(((np.arange(48) + 6 * i) // 10 % 3).astype(np.uint8), (36, 1))
        flips = (rng.random((9, 12)) < 0.3).repeat(4, axis=0).repeat(4, axis=1)
        T = np.eye(4)
        T[:3, 3] = [0.25 * i + 0.01, 0.01, 0.01]
        depth = np.full(truth.shape, 2, np.float32)
        for name, other in (("net", [1, 0, 2]), ("worse", [2, 1, 0])):
            labels = np.where(flips, np.array(other)[truth], truth).astype(np.uint8)
            camera = semstab.Intrinsics(48, 48, 24, 18)
            sources[name].append(semstab.Frame(i, depth, camera, T, labels=labels))
    names = [f"{i:04d}" for i in range(16)]
    write_posed(base / "wall", names, sources, classes=[*SPACE.classes], up_axis="-y")
    SPACE.save(base / "small.yaml")
    bench("wall", *OPTIONS, cwd=base)
    return base


def test_the_screen_compare_and_gate_say_how_far_labels_agree_by_meaning(home):
    result = semstab.load_result(home / "run")
    numbers = {record.unit.model: record.statistics for record in result.select()}
    net, worse = numbers["net"].spots.meaning, numbers["worse"].spots.meaning
    assert net.alpha.value > worse.alpha.value + 0.1
    assert (net.near, worse.near) == (1.0, 0.0)
    screen = " ".join(bench("show", "run", cwd=home).stdout.split())
    assert (
        f"net: by meaning: alpha {net.alpha.text()}; 100 % of the disagreement is between classes of near meaning"
        in screen
    )
    compared = semstab.compare(f"{home / 'run'}:net", f"{home / 'run'}:worse")
    rows = {row.measure: row for row in compared.overall[0].contrasts}
    assert rows["alpha_by_meaning"].base == pytest.approx(net.alpha.value, abs=1e-9)
    for model, rule, code in (("net", "alpha by meaning > 0.5", 0), ("worse", "alpha by meaning > 0.9", 4)):
        bench("gate", "run", "--model", model, "--rule", rule, cwd=home, code=code)


def test_distances_that_do_not_fit_end_a_run_before_it_begins(home):
    np.save(home / "d.npy", np.ones((5, 4)))
    line = error_of("wall", "--distances", "d.npy", "-o", "never", cwd=home)
    assert "has 3 classes" in line
    assert not (home / "never").exists()


def test_other_distances_are_measured_anew(home):
    """A run whose distances changed is no run to go on with."""
    np.save(home / "d.npy", np.array([[0, 1, 0.1], [1, 0, 1], [0.1, 1, 0]]))
    bench("wall", *OPTIONS, "--distances", "d.npy", "--overwrite", cwd=home)
    numbers = {record.unit.model: record.statistics for record in semstab.load_result(home / "run").select()}
    assert numbers["worse"].spots.meaning.near == 1.0
    assert numbers["worse"].spots.meaning.alpha.value > numbers["net"].spots.meaning.alpha.value
