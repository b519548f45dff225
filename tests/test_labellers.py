"""Labellers that agree with themselves for the wrong reasons: none is called stable without a warning that says why."""

from __future__ import annotations

import numpy as np
import pytest

import semstab
from semstab.config import VerdictSettings
from semstab.datasets.city.labellers import LABELLERS
from semstab.report.narrative import warnings

NAMES = [f"trick-{name}" for name in LABELLERS]


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The labellers over a small city, without ground truth."""
    return labelled(tmp_path_factory.mktemp("labellers"), ["sim-steady", *NAMES], truth=False)


def labelled(folder, models, **settings):
    city = {"name": "city", "options": {"frames": 10, "width": 192, "height": 108}}
    fixed = {"dataset": city, "scenes": ["scene0"], "check": None, "voxel_size": 0.4, "check_geometry": False}
    semstab.run(semstab.load_config(overrides={**fixed, "models": models, **settings}), out=folder, report=False)
    return semstab.load_result(folder)


def statistics_of(result, name):
    (record,) = result.select(model=name)
    return record.statistics


@pytest.mark.parametrize("name", NAMES)
def test_no_labeller_is_stable_without_a_warning_that_names_it(result, name):
    assert statistics_of(result, name).verdict.level != "stable" or any(name in text for text in warnings(result))


def test_what_is_left_out_counts_and_caps_the_verdict(result):
    """Of the spots hardly one has a label of the model that leaves out all borders: it has no verdict at all."""
    assert statistics_of(result, "sim-steady").spots.labelled > 0.95
    for name in ("trick-border-ignoring", "trick-hard-ignoring"):
        found = statistics_of(result, name)
        assert found.spots.labelled < 0.9
        assert found.verdict.level != "stable"
        assert found.verdict.level == "no verdict" or any(
            "have no label in most frames" in text and name in text for text in warnings(result)
        )
    assert statistics_of(result, "trick-hard-ignoring").verdict.level == "usable"
    assert "of the locations have no label" in statistics_of(result, "trick-hard-ignoring").verdict.line


def test_coarse_labels_meet_few_edges(result):
    recall = {name: result.select(model=name)[0].image_space.edge_recall for name in ("sim-steady", *NAMES)}
    assert recall["sim-steady"] > 0.9
    assert max(recall[f"trick-{name}"] for name in ("constant", "blur-81", "coarse-48", "by-row")) < 0.4
    assert recall["trick-blur-31"] < recall["sim-steady"] - 0.2


def test_the_limits_of_a_verdict_are_settings(result, tmp_path):
    assert VerdictSettings().model_dump() == {
        "stable": 0.8, "usable": pytest.approx(2 / 3), "labelled": 0.9, "class_locations": 100.0,
    }  # fmt: skip
    verdict = {"stable": 0.99, "class_locations": 1e9}
    found = statistics_of(labelled(tmp_path / "run", ["sim-steady"], verdict=verdict, truth=False), "sim-steady")
    assert found.verdict.level == "usable"
    assert np.isfinite(statistics_of(result, "sim-steady").spots.critical_classes[0].unstable)
    assert not found.spots.critical_classes
