"""Label sources of regions without classes: their flicker is measured, nothing of them is fused."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest
import tiny_study
from tiny_study import Counting, configure, summary

from semstab.api import run_study
from semstab.engine import load_result
from semstab.errors import ConfigError
from semstab.metrics import matched_region_flicker

FRAMES = 4


@pytest.fixture
def root(tmp_path):
    """Two regions tied to the wall, which moves by a pixel a frame; their ids change from frame to frame."""
    root = tiny_study.write(tmp_path / "wall", models=("a",), frames=FRAMES)
    (root / "labels/regions").mkdir()
    for i, labels in enumerate(regions()):
        cv2.imwrite(str(root / f"labels/regions/{i:04d}.png"), labels)
    return root


def regions() -> list[np.ndarray]:
    columns = np.arange(8)
    return [np.tile(np.where(columns + i < 5, 200 + 2 * i, 300 - i).astype(np.uint16), (6, 1)) for i in range(FRAMES)]


def test_regions_are_matched_by_where_they_are(root, tmp_path) -> None:
    config = configure(root, frames={}, region_maps=["regions"], sweeps={}, backends=["numpy"])
    result = run_study(config, tmp_path / "out", report=False)
    (found,) = result.regions
    pairs = [matched_region_flicker(*pair).flicker_percent for pair in itertools.pairwise(regions())]
    assert (found.scene, found.model) == ("wall", "regions")
    assert found.flicker_percent == pytest.approx(np.mean(pairs)) == 12.5  # one of eight columns changes its region
    assert found.compensated_flicker_percent == 0  # the regions are tied to the wall
    assert found.compensated_share == pytest.approx(7 / 8)
    assert [record.unit.model for record in result.records] == ["a"]  # by default all but these
    assert load_result(tmp_path / "out").regions == result.regions
    assert set(result.manifest["inputs"]) == {"wall/a", "wall/regions"}


def test_they_are_kept_and_computed_again_like_units(root, tmp_path) -> None:
    config = configure(root, frames={}, region_maps=["regions"], sweeps={"voxel_size": [0.5]}, backends=["numpy"])
    run_study(config, tmp_path / "out", report=False)
    again = Counting()
    run_study(config, tmp_path / "out", observers=[again], report=False)
    assert (again.units, again.kept) == (3, 3)
    cv2.imwrite(str(root / "labels/regions/0001.png"), np.full((6, 8), 7, np.uint16))
    changed = Counting()
    result = run_study(config, tmp_path / "out", observers=[changed], report=False)
    assert changed.computed == ["wall__regions__none region_maps None"]
    run_study(config, tmp_path / "fresh", report=False)
    assert summary(tmp_path / "out") == summary(tmp_path / "fresh")
    assert result.regions[0].compensated_flicker_percent > 0


def test_settings_of_the_map_do_not_touch_them(root, tmp_path) -> None:
    run_study(
        configure(root, frames={}, region_maps=["regions"], sweeps={}, backends=["numpy"]),
        tmp_path / "out",
        report=False,
    )
    other = configure(
        root, frames={}, region_maps=["regions"], sweeps={}, backends=["numpy"], voxel_size=0.7, strata=[1]
    )
    counting = Counting()
    run_study(other, tmp_path / "out", observers=[counting], report=False)
    assert counting.computed == ["wall__a__numpy base None"]


def test_a_source_of_regions_that_fails_is_a_failure(root, tmp_path) -> None:
    (root / "labels/regions/0002.png").write_bytes(b"no image")
    config = configure(root, frames={}, region_maps=["regions"], sweeps={}, backends=["numpy"])
    result = run_study(config, tmp_path / "out", report=False)
    assert result.regions == ()
    assert [failure.unit.model for failure in result.failures] == ["regions"]
    assert len(result.records) == 1


def test_one_frame_has_no_flicker_and_a_source_that_is_not_there_is_refused(root, tmp_path) -> None:
    config = configure(root, frames={"count": 1}, region_maps=["regions"], sweeps={}, backends=["numpy"])
    (found,) = run_study(config, tmp_path / "out", report=False).regions
    assert math.isnan(found.flicker_percent)
    with pytest.raises(ConfigError, match="wall: no region map 'region'; did you mean 'regions'"):
        run_study(
            configure(root, frames={}, region_maps=["region"], sweeps={}, backends=["numpy"]),
            tmp_path / "out",
            report=False,
        )
