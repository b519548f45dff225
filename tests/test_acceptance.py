"""Evidence from which on labels may be acted on: calibrated with truth, kept in a file, used by export and relabel."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest
import tiny_scene
from posed_config import configure
from posed_scene import fails
from scipy.stats import binomtest
from simulated_events import grid, log_of
from typer.testing import CliRunner

import semstab
from semstab import AcceptanceThresholds, VoxelTable
from semstab.cli import app
from semstab.data.measures import dominant, vss
from semstab.errors import ConfigError, DataError
from semstab.statistics.acceptance import calibrate, share_of_few_cubes
from semstab.statistics.correctness import Truth

CLASSES = ("road", "car", "tree")


def town(side=40, seed=0, classes=CLASSES):
    """A map in which roads are right, cars only where all frames agree, and trees never often enough."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 3, side * side)
    sure = rng.random(side * side) < 0.5
    wrong = np.where(truth == 0, 0.0, np.where(truth == 1, np.where(sure, 0.0, 0.6), 0.4))[:, None]
    labels = np.where(rng.random((side * side, 9)) < wrong, (truth[:, None] % 2) + 1, truth[:, None])
    table = log_of(labels, index=grid(side)).table()
    renamed = VoxelTable(**{**vars(table), "classes": classes})
    return renamed, Truth(truth >= 0, truth)


@pytest.fixture(scope="module")
def commit():
    return calibrate([town()], precision=0.95, on="a town")


def test_thresholds_are_as_low_as_labels_are_right_and_no_lower(commit):
    road, car, tree = (commit.classes[name] for name in CLASSES)
    assert (road.never, road.left) == (False, 1.0)
    assert not car.never
    assert car.by in ("belief", "margin")
    assert 0.2 < car.left < 0.9
    assert car.low >= 0.95
    assert tree.never
    table, truth = town(seed=1)
    decided = commit.decide(table)
    assert set(np.unique(decided)) == {-1, 0, 1}
    for k in (0, 1):
        assert (truth.label[decided == k] == k).mean() >= 0.95
    assert np.array_equal(decided[decided >= 0], dominant(table)[decided >= 0])
    assert commit.left == pytest.approx((commit.decide(town()[0]) >= 0).mean())


def test_labels_that_err_together_count_as_few():
    """As many labels and as many right ones; in one, those that are wrong stand side by side."""
    table, _ = town()
    rng = np.random.default_rng(0)
    label = dominant(table).astype(np.int64)
    apart = np.where(rng.random(len(label)) < 0.02, (label + 1) % 3, label)
    together = np.where(table.ix < 0.02 * 40, (label + 1) % 3, label)
    low = [
        calibrate([(table, Truth(true >= 0, true))], precision=0.5).classes["road"].low for true in (apart, together)
    ]
    assert low[0] > low[1]


def test_the_lower_end_of_few_cubes_is_that_of_clopper_and_pearson():
    """Cubes of unequal size tell as much as fewer equal ones; without an error the lower end is error^(1 / m)."""
    size = np.array([4.0, 4.0, 2.0, 1.0, 1.0])
    m = 12**2 / 38
    assert share_of_few_cubes(np.stack([size, size], axis=1), 0.05) == pytest.approx((1.0, 0.05 ** (1 / m)))
    right = np.r_[np.full(19, 3.0), 0.0]
    expected = binomtest(19, 20, alternative="greater").proportion_ci(0.95, method="exact").low
    assert share_of_few_cubes(np.stack([right, np.full(20, 3.0)], axis=1), 0.05) == pytest.approx((0.95, expected))


def test_labels_without_an_error_in_two_maps_have_the_lower_end_of_twice_the_cubes():
    index = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int32)
    table = dataclasses.replace(log_of(np.zeros((len(index), 3), int), index=index).table(), classes=("a", "b", "c"))
    label = dominant(table).astype(np.int64)
    scene = (table, Truth(label >= 0, label))
    one, two = (calibrate([scene] * count, precision=0.01).classes["a"].low for count in (1, 2))
    assert 0.5 < one < two < 1
    assert math.log(one) / math.log(two) == pytest.approx(2)


def test_a_file_keeps_it_and_another_kind_of_map_is_refused(commit, tmp_path):
    commit.save(file := tmp_path / "commit.yaml")
    again = semstab.AcceptanceThresholds.load(file)
    assert again == commit
    text = file.read_text()
    for bad, line in (
        (text.replace("by: op", "by: colour").replace("by: belief", "by: colour"), "by"),
        ("precision: 2", "precision"),
        (text.replace("schema: 1", "schema: 9"), "calibrate again"),
    ):
        file.write_text(bad)
        fails(ConfigError, f"commit.yaml: .*{line}", AcceptanceThresholds.load, file)
    table, truth = town(side=8, classes=("road", "car", "house"))
    fails(DataError, "with its taxonomy", commit.decide, table)
    large = VoxelTable(**{**vars(town(side=8)[0]), "voxel_size": 0.5})
    fails(DataError, "--voxel-size 0.5", commit.decide, large)
    fails(ConfigError, "precision 1.5", calibrate, [(table, truth)], precision=1.5)


def test_export_and_relabel_take_the_file(tmp_path):
    tiny_scene.write(tmp_path / "wall", models=("a",), frames=6)
    semstab.run(configure(tmp_path / "wall", check=None, statistics=True), out=tmp_path / "run", report=False)

    def cli(*words):
        done = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "80"})
        assert done.exit_code == 0, done.output
        return done.output

    file = tmp_path / "commit.yaml"
    text = cli("calibrate", tmp_path / "run", "--precision", 0.8, "--confidence", 0.6, "--out", file)
    thresholds = semstab.AcceptanceThresholds.load(file)
    assert f"{thresholds.left:.1%} of the voxels are left" in text
    table = semstab.load(tmp_path / "run").table()
    decided = thresholds.decide(table) >= 0
    assert 0 < decided.sum() < len(table)
    text = cli("export", tmp_path / "run", "--to", tmp_path / "map.csv", "--thresholds", file)
    assert f"{decided.sum()} voxels" in text
    cli("relabel", tmp_path / "run", "--out", tmp_path / "wall", "--thresholds", file)
    assert re.search(r'"op"|"belief"|"margin"', (tmp_path / "wall/labels/a-fused/relabelled.json").read_text())
    assert vss(table).max() <= 1
