"""The screen of a run over many scenes: a row a model first, then a line a scene, on forty lines."""

from __future__ import annotations

import dataclasses

import pytest
from scipy import stats
from striped_floor import flight

import semstab
from semstab.report.terminal import screen
from semstab.report.terminal.many_scenes import over_scenes

MODELS = ("espnetv2-0.5", "espnetv2-1.0", "dicenet-0.75", "dicenet-1.0", "random")


@pytest.fixture(scope="module")
def result():
    """Eleven scenes and five models: the records of one, under other names."""
    (record,) = semstab.fuse(list(flight(10, flicker=0.1)), voxel_size=0.1, classes="abc").records
    return dataclasses.replace(
        semstab.fuse(list(flight(3)), voxel_size=0.1, classes="abc"),
        records=tuple(renamed(record, f"scene{n:02d}", model) for n in range(11) for model in MODELS),
    )


def renamed(record, scene, model):
    unit = dataclasses.replace(record.unit, scene=scene, model=model)
    return dataclasses.replace(record, unit=unit)


def test_eleven_scenes_and_five_models_take_forty_lines(result):
    lines = list(screen(result))
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 80
    first = next(k for k, line in enumerate(lines) if line.startswith("  all scenes"))
    assert [line.split()[0] for line in lines[first + 2 : first + 7]] == [*MODELS]
    scenes = next(k for k, line in enumerate(lines) if line.startswith("  by scene"))
    assert scenes > first
    assert [line.split()[0] for line in lines[scenes + 1 : scenes + 12]] == [f"scene{n:02d}" for n in range(11)]
    assert not any("reliable up to" in line for line in lines)


def test_a_model_that_truth_refutes_is_named_once_for_all_scenes(result):
    def misleading(record):
        statistics = record.statistics
        verdict = dataclasses.replace(statistics.verdict, level="misleading")
        wrong = dataclasses.replace(statistics.headline.wrong_of_consistent_op3, value=0.57, low=0.43, high=0.7)
        headline = dataclasses.replace(statistics.headline, wrong_of_consistent_op3=wrong)
        statistics = dataclasses.replace(statistics, verdict=verdict, headline=headline)
        return dataclasses.replace(record, statistics=statistics)

    records = [misleading(r) if r.unit.model == "random" and r.unit.scene < "scene03" else r for r in result.records]
    text = " ".join(" ".join(screen(dataclasses.replace(result, records=tuple(records)))).split())
    assert "random: MISLEADING in 3 of 11 scenes, 57 % of the voxels whose frames agree have a wrong class" in text


def test_the_interval_over_scenes_is_students():
    alphas = [0.9, 0.8, 0.95, 0.7]
    found, expected = over_scenes(alphas), stats.ttest_1samp(alphas, 0).confidence_interval(0.95)
    assert (found.low, min(found.high, 1.0)) == pytest.approx((expected.low, min(expected.high, 1.0)))
    assert over_scenes(alphas[:2]).text() == ".85"
