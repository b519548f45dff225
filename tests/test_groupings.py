"""Which distinctions between classes hold: merges of classes, what their choice flatters, and their taxonomy."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from command_line import bench, error_of
from posed_writer import write_posed
from simulated_events import grid, spots_of

import semstab
from semstab.data.statistics import CONFIDENCE
from semstab.report.charts import Joint, tree_chart
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value
from semstab.statistics.groupings import Coincidences, grouped, groupings, groups_after, halves_of, merges_of

CLASSES = ["wall", "door", "curtain", "window", "blinds"]
CONFUSED = ((1, 2), (3, 4))
"""Door and curtain, window and blinds: a view takes one for the other."""


def flight(rng, side=24, frames=12, confused=0.5, wrong=0.02):
    """Labels (places, frames) in blocks of 4 x 4 places; a view takes a class for the one it is confused with."""
    block = rng.integers(0, 5, (side // 4, side // 4))
    truth = block.repeat(4, axis=0).repeat(4, axis=1).ravel()
    labels = np.repeat(truth[:, None], frames, axis=1)
    other = np.arange(5)
    for a, b in CONFUSED:
        other[[a, b]] = b, a
    labels = np.where(rng.random(labels.shape) < confused, other[labels], labels)
    return np.where(rng.random(labels.shape) < wrong, rng.integers(0, 5, labels.shape), labels)


def sampled(labels, K=5):
    return replace(spots_of(labels, K, grid(int(len(labels) ** 0.5))), classes=tuple(CLASSES[:K]))


def test_coincidences_are_those_of_all_pairs_of_views():
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 3, (40, 5))
    spots = spots_of(labels, 3)
    pairs = np.zeros((3, 3))
    for row in labels:
        given = row[row >= 0]
        for a, b in itertools.permutations(range(len(given)), 2):
            pairs[given[a], given[b]] += 1 / (len(given) - 1)
    found = halves_of(spots, sums_of_spots(spots))
    assert found.sum(axis=0) == pytest.approx(pairs)


def test_alpha_of_groups_is_that_of_the_labels_of_groups():
    spots = sampled(flight(np.random.default_rng(1)))
    whole = Coincidences.from_counts(halves_of(spots, sums_of_spots(spots)).sum(axis=0))
    assert whole.alpha() == pytest.approx(value(sums_of_spots(spots), "alpha"), abs=1e-3)
    for group in ([0, 1, 1, 2, 2], [0, 0, 1, 1, 0], [0, 1, 2, 2, 3]):
        of = np.array(group)
        expected = value(sums_of_spots(grouped(spots, of)), "alpha")
        assert whole.merged(of).alpha() == pytest.approx(expected, abs=1e-3)  # chance of all pairs, of other spots


def test_each_merge_is_the_best_one():
    spots = sampled(flight(np.random.default_rng(2), wrong=0.2))
    whole = Coincidences.from_counts(halves_of(spots, sums_of_spots(spots)).sum(axis=0))
    steps = merges_of(whole)
    assert len(steps) == 3  # two groups are left
    for n, _ in enumerate(steps):
        before = groups_after(5, steps[:n])
        others = [
            whole.merged(groups_after(5, [*steps[:n], pair])).alpha()
            for pair in itertools.combinations(range(5), 2)
            if before[pair[0]] != before[pair[1]]
        ]
        assert whole.merged(groups_after(5, steps[: n + 1])).alpha() == pytest.approx(max(others))


def test_classes_that_are_confused_are_merged_and_no_others():
    spots = sampled(flight(np.random.default_rng(3)))
    found = groupings(spots, sums_of_spots(spots))
    assert found is not None
    assert found.told is not None
    assert found.told.level == "stable"
    assert found.told.merged == (("door", "curtain"), ("window", "blinds"))
    assert (found.classes, found.told.groups) == (5, 3)
    assert found.told.alpha.low < found.told.alpha.value < found.told.alpha.high
    assert re.match(
        r"stable if 5 classes become 3, worth \d\.\d of equal share: door \+ curtain, window \+ blinds; alpha",
        found.text,
    )


def test_labels_that_are_stable_need_no_groups():
    spots = sampled(flight(np.random.default_rng(4), confused=0))
    found = groupings(spots, sums_of_spots(spots))
    assert found is not None
    assert (found.stable, found.usable, found.text) == (None, None, "")


def test_labels_at_random_have_no_groups_on_which_views_agree():
    """The best of many merges looks better than chance where it was chosen, and not on the other half."""
    for seed in range(20):
        labels = np.random.default_rng(seed).integers(0, 5, (576, 6))
        spots = sampled(labels)
        found = groupings(spots, sums_of_spots(spots))
        assert found is not None
        assert found.text == ""
        assert max(merge.alpha for merge in found.merges) < 0.1


def test_the_choice_of_merges_does_not_flatter():
    """Merges chosen on one flight have at least the stated alpha on a long flight over the same place, in the mean."""
    stated, later, chosen = [], [], []
    for seed in range(10):
        spots, again = (
            sampled(flight(np.random.default_rng(seed), side=40, frames=frames, confused=0.35, wrong=0.15))
            for frames in (4, 30)
        )
        whole = Coincidences.from_counts(halves_of(spots, sums_of_spots(spots)).sum(axis=0))
        for n, merge in enumerate(groupings(spots, sums_of_spots(spots)).merges):
            group = groups_after(5, merges_of(whole)[: n + 1])
            stated.append(merge.alpha)
            chosen.append(whole.merged(group).alpha())
            later.append(value(sums_of_spots(grouped(again, group)), "alpha"))
    assert np.mean(later) - 0.05 < np.mean(stated) < np.mean(later) + 0.005
    assert np.mean(stated) < np.mean(chosen)


def test_two_classes_have_nothing_to_merge():
    spots = spots_of(np.random.default_rng(0).integers(0, 2, (64, 4)), 2, grid(8))
    assert groupings(spots, sums_of_spots(spots)) is None


def test_a_tree_has_all_leaves_and_joints():
    joints = [Joint(("a",), ("b",), 0.6), Joint(("c",), ("a", "b"), 0.5), Joint(("c", "a", "b"), ("d & e",), 0.9)]
    drawn = tree_chart(joints, "alpha", (0.8,), 0.4)
    assert [name for name in ("a", "b", "c", "d &amp; e") if f">{name}</text>" in drawn] == ["a", "b", "c", "d &amp; e"]
    assert drawn.count("<title>") == len(joints)
    assert drawn.count('class="guide"') == 1


# --- The command line -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A wall of five classes that twelve frames see; two pairs of classes are confused, in blocks of pixels."""
    base, rng = tmp_path_factory.mktemp("groupings"), np.random.default_rng(0)
    other = np.array([0, 2, 1, 4, 3])
    frames = []
    for i in range(16):
        truth = np.tile(((np.arange(96) + 12 * i) // 20 % 5).astype(np.uint8), (72, 1))
        flips = (rng.random((9, 12)) < 0.5).repeat(8, axis=0).repeat(8, axis=1)
        T = np.eye(4)
        T[:3, 3] = [0.25 * i + 0.01, 0.01, 0.01]
        depth = np.full(truth.shape, 2, np.float32)
        labels = np.where(flips, other[truth], truth).astype(np.uint8)
        frames.append(semstab.Frame(i, depth, semstab.Intrinsics(96, 96, 48, 36), T, labels=labels))
    write_posed(base / "wall", [f"{i:04d}" for i in range(16)], {"net": frames}, classes=CLASSES, up_axis="-y")
    bench("wall", "--voxel-size", "0.1", "-o", "run", cwd=base, report=True)
    return base


def test_the_screen_the_report_and_a_table_say_which_classes_hold(home):
    screen = " ".join(bench("show", "run", cwd=home).stdout.split())
    assert re.search(
        r"stable if 5 classes become 3, worth .* of equal share: door \+ curtain, window \+ blinds; alpha", screen
    )
    page = (home / "run/report.html").read_text()
    assert "Which distinctions hold" in page
    table = bench("show", "run", "merges", cwd=home).stdout
    assert "door" in table
    assert "Groups left" in table


def test_a_run_with_the_groups_as_taxonomy_has_the_alpha_that_was_promised(home):
    out = bench("export", "run", "--to", "groups.yaml", cwd=home).stdout
    assert "3 groups of classes, stable" in out
    written = yaml.safe_load((home / "groups.yaml").read_text())
    assert [entry["name"] for entry in written["classes"]] == ["wall", "door + curtain", "window + blinds"]
    bench("wall", "--voxel-size", "0.1", "--taxonomy", "groups.yaml", "-o", "again", cwd=home)
    (before,), (after,) = (semstab.load_result(home / name).select() for name in ("run", "again"))
    promised = before.statistics.groupings.told.alpha
    assert after.statistics.verdict.level == "stable"
    assert after.statistics.headline.alpha.value == pytest.approx(promised.value, abs=0.02)
    assert promised.scope == after.statistics.headline.alpha.scope
    assert CONFIDENCE == 0.95


def test_without_groups_there_is_no_taxonomy_to_write(home):
    bench("export", "run", "--to", "groups.yaml", cwd=home)
    bench("wall", "--voxel-size", "0.1", "--taxonomy", "groups.yaml", "-o", "again", "--overwrite", cwd=home)
    line = error_of("export", "again", "--to", "more.yaml", cwd=home)
    assert "has no groups of classes to write" in line
    assert not (home / "more.yaml").exists()
