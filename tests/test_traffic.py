"""Disagreement where the map has classes that move: how much there is, and what is left without these locations."""

from __future__ import annotations

import dataclasses
import shlex

import numpy as np
import pytest
from striped_floor import flight

import semstab
from semstab.core.json_form import from_json, to_json
from semstab.data.statistics import MapStatistics
from semstab.report.narrative import warnings
from semstab.statistics import spot_agreement

ROAD, GRASS, CAR, PERSON = range(4)


def frames(seed=0, frames=12, *, elsewhere=0.0):
    """Stripes of road, grass and cars; a third of the cars is called a person, in patches anew in every frame."""
    rng = np.random.default_rng(seed)
    for frame in flight(frames=frames, flicker=elsewhere, patch=4, seed=seed):
        mistaken = np.kron(rng.random((15, 20)) < 0.3, np.ones((4, 4), bool))
        labels = np.where((frame.labels == CAR) & mistaken, PERSON, frame.labels).astype(np.uint8)
        yield dataclasses.replace(frame, labels=labels)


def fused(classes=("road", "grass", "car", "person"), **settings):
    return semstab.fuse(frames(), voxel_size=0.25, classes=classes, **settings)


def test_all_disagreement_is_where_things_move() -> None:
    """But for 8 % of it, as alpha of the rest is .97.

    Of the spots at the edges of cars those remain that most views call road or grass: their disagreement is not quite
    extrapolated to 0.
    """
    result = fused()
    spots = result.record().statistics.spots
    assert spots.moving.classes == ("car", "person")
    assert spots.moving.disagreement == pytest.approx(1, abs=0.1)
    assert spots.moving.alpha == pytest.approx(1, abs=0.03)
    assert result.record().statistics.headline.alpha.value < 0.9
    (line,) = (text for text in warnings(result) if "move" in text)
    assert shlex.split(line[line.index("--set") :]) == ["--set", "exclude.classes=[car, person]"]
    assert f"{spots.moving.disagreement:.0%} of the disagreement" in line
    assert f"alpha is {spots.moving.alpha:.2f}".replace(" 0.", " .") in line


def test_alpha_without_them_is_that_of_a_run_without_them() -> None:
    result = semstab.fuse(frames(elsewhere=0.1), voxel_size=0.25, classes=("road", "grass", "car", "person"))
    moving = result.record().statistics.spots.moving
    rest = semstab.fuse(
        frames(elsewhere=0.1), voxel_size=0.25, classes=("road", "grass", "car", "person"),
        exclude={"classes": ["car", "person"]},
    ).record()  # fmt: skip
    assert moving.alpha == pytest.approx(rest.statistics.headline.alpha.value, abs=1e-12)
    assert 0.2 < moving.disagreement < 0.8


def test_nothing_is_said_where_names_are_of_things_that_stay() -> None:
    result = fused(("road", "grass", "parked car", "bench"))
    assert result.record().statistics.spots.moving is None
    assert not [text for text in warnings(result) if "move" in text]


def test_nothing_is_said_where_most_disagreement_is_elsewhere() -> None:
    result = fused(("car", "grass", "road", "kerb"))
    spots = result.record().statistics.spots
    assert spots.moving is None or spots.moving.disagreement < 0.1


def test_nothing_is_said_where_alpha_leaves_no_disagreement(monkeypatch) -> None:
    """Alpha of spots without a size may come out as 1 where there are few, though their labels differ."""
    monkeypatch.setattr(spot_agreement, "value", lambda sums, key: 1.2)
    assert fused().record().statistics.spots.moving is None


def test_it_is_kept_with_the_result() -> None:
    statistics = fused().record().statistics
    assert from_json(MapStatistics, to_json(statistics), "there").spots.moving == statistics.spots.moving
