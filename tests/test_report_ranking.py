"""Several models: which one is more stable, with ties, and which cannot be ranked."""

from __future__ import annotations

import io
import math
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tiny_scene
from posed_config import configure
from rich.console import Console

import semstab
import semstab.comparison.ranking
import semstab.report.ranking
from semstab import gate
from semstab.configure import predicted_config, resolve
from semstab.core.palette import KINDS
from semstab.data.measures import SBD, VSS
from semstab.gating.gate import gate_config
from semstab.predict.predictor import parse_predictors
from semstab.report.comparison.own_models import own_models
from semstab.report.page import _card
from semstab.report.ranking import order_of_models, ranking
from semstab.report.terminal import print_summary

ERRORS = {"place": 0.05, "view": 0.05, "cell": 2.0, "flicker": 0.03}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """Two models that err alike, one that flickers, and one that says one class everywhere."""
    models = {
        "twin": ERRORS, "nervous": ERRORS | {"flicker": 0.3}, "other-twin": ERRORS,
        "constant": {"labeller": "constant"},
    }  # fmt: skip
    options = {"frames": 12, "width": 128, "height": 72, "seed": 1, "models": models}
    city = {
        "dataset": {"name": "city", "options": options},
        "scenes": ["scene0"],
        "voxel_size": 0.4,
        "check_geometry": False,
    }
    out = tmp_path_factory.mktemp("ranking") / "run"
    config = semstab.load_config(overrides={**city, "models": list(models), "check": None})
    return semstab.run(config, out=out, report=False), out


def printed(result, out) -> str:
    console = Console(file=io.StringIO(), width=100)
    print_summary(result, console, out=out)
    return console.file.getvalue()


def test_models_without_a_shown_difference_share_a_rank(result):
    ranks = dict(ranking(result[0]).ranks)
    assert sorted(ranks[1]) == ["other-twin", "twin"]
    assert ranks[3] == ("nervous",)


def test_every_pair_is_compared_and_corrected(result):
    found = ranking(result[0])
    assert [(difference.other, difference.model) for difference in found.differences] == [
        ("twin", "nervous"), ("twin", "other-twin"), ("nervous", "other-twin"),
    ]  # fmt: skip
    assert [difference.shown for difference in found.differences] == [True, False, True]
    assert all(difference.low <= difference.value <= difference.high for difference in found.differences)
    assert found.differences[1].p_holm > 0.05


def test_a_map_of_nearly_one_class_has_no_rank(result):
    assert ranking(result[0]).unranked == ("constant",)
    assert "not ranked, as nearly the whole map is one class: constant" in list(order_of_models(result[0]))


def test_a_model_that_gives_one_class_in_a_short_run_has_no_place_in_the_order(tmp_path):
    """Chance alone would always agree: its alpha is undefined, of all pixels, too."""
    root = tiny_scene.write(tmp_path / "wall")
    for labels in (root / "labels/b").iterdir():
        cv2.imwrite(str(labels), np.zeros((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.uint8))
    found = semstab.run(configure(root, statistics=True), out=tmp_path / "run", report=False)
    assert found.record(model="b").statistics.verdict.level == "no verdict"
    assert math.isnan(found.record(model="b").statistics.headline.alpha.value)
    assert "b     no verdict     -" in printed(found, tmp_path / "run")
    assert not any("b" in text.split() for text in order_of_models(found))


SIX = ["colour-clusters,clusters=6,name=six", "colour-clusters,clusters=6,seed=2,name=other"]


def test_models_with_other_classes_are_named_and_the_rest_is_compared(tmp_path):
    """The second run has the maps of the first."""
    city = {"name": "city", "options": {"frames": 6, "width": 96, "height": 54}}
    given = {"dataset": city, "check": None, "scenes": ["scene0"], "voxel_size": 0.5, "statistics": True}
    for models, compared, said in (
        (SIX, ("six", "other"), "not compared, as the classes of the others differ: five"),
        (SIX[:1], None, "not compared, as their classes differ: six, five"),
    ):
        predictors = parse_predictors([*models, "colour-clusters,clusters=5,name=five"])
        result = semstab.run(resolve(predicted_config(predictors, None, given)), out=tmp_path / "run", report=False)
        *answer, last = order_of_models(result)
        assert last == said
        assert [text.split()[0] in compared for text in answer] == ([True] if compared else [])
        assert bool(own_models(result)) == bool(compared)


def test_the_answer_stands_above_the_table(result):
    text = printed(*result)
    assert text.index("most stable first: 1. ") < text.index("alpha (95 % CI)")
    assert "; 3. nervous" in text
    assert "Holm over 3 pairs" in " ".join(text.split())


def test_the_report_has_the_same_answer(result):
    semstab.run(semstab.load_config(result[1] / "config.yaml"), out=result[1])  # draws the report alone
    assert "; 3. nervous" in (result[1] / "report.html").read_text()


def of_some(result, models, out):
    """The run of these models alone, in a copy of the folder: their maps are kept."""
    config = semstab.load_config(result[1] / "config.yaml", {"models": models})
    return semstab.run(config, out=shutil.copytree(result[1], out), report=False)


def with_measures(record, vss, sbd, miou):
    """The record with other means over voxels with OP >= 3 and another mIoU."""
    table, correctness = record.map_summary, record.statistics.correctness
    means = replace(table.recurrent.means, value=table.recurrent.means.value | {VSS.key: vss, SBD.key: sbd})
    correctness = replace(correctness, miou_op2=replace(correctness.miou_op2, value=miou))
    return replace(
        record, map_summary=replace(table, recurrent=replace(table.recurrent, means=means, voxels=2000)),
        statistics=replace(record.statistics, correctness=correctness),
    )  # fmt: skip


def test_two_models_are_one_sentence(result, tmp_path):
    found = of_some(result, ["twin", "nervous"], tmp_path / "run")
    (text,) = order_of_models(found)
    assert text.startswith("nervous is less stable than twin: alpha lower by ")
    assert printed(found, tmp_path / "run").index(text[:40]) < 300


@pytest.mark.parametrize(("vss", "sbd", "miou", "said"), [
    (0.04, 0.5, 0.15,
     "VSS (OP>=3) (.942 against .902), SBD (.010 against .020) and mIoU (.580 against .430) are better"),
    (0.04, 1.0, -0.1, "VSS (OP>=3) (.942 against .902) is better"),
    (0.01, 0.95, 0.01, None),
    (-0.1, 2.0, -0.1, None),
])  # fmt: skip
def test_measures_that_say_the_opposite_of_alpha_are_named_in_one_line(result, tmp_path, vss, sbd, miou, said):
    """By alpha nervous is less stable than twin; here other measures of nervous are better, by so much."""
    numbers = {"twin": (0.942 - vss, 0.02, 0.58 - miou), "nervous": (0.942, 0.02 * sbd, 0.58)}
    found = of_some(result, ["twin", "nervous"], tmp_path / "run")
    found = replace(found, records=tuple(with_measures(r, *numbers[r.unit.model]) for r in found.records))
    told = list(order_of_models(found))
    assert len(told) == 1 + (said is not None)
    if said is not None:
        assert told[1].startswith("measures disagree: alpha is better for twin, but ")
        assert f"{said} for nervous" in told[1]
        assert told[1][:45] in printed(found, tmp_path / "run")


def test_a_model_that_leaves_out_its_errors_is_not_shown_to_be_more_stable(result, tmp_path, monkeypatch):
    """By common observations twin is the more stable one."""
    found = of_some(result, ["twin", "nervous"], tmp_path / "run")
    common = semstab.comparison.ranking._common

    def silent(files):
        return common(files)[0], {"twin": 0.5, "nervous": 0.6}

    monkeypatch.setattr("semstab.comparison.ranking._common", silent)
    semstab.comparison.ranking._ranking.cache_clear()
    first, second, *_ = order_of_models(found)
    (difference,) = ranking(found).differences
    semstab.comparison.ranking._ranking.cache_clear()
    assert (difference.shown, difference.silent) == (False, True)
    assert first.startswith("nervous is not shown to differ from twin: alpha lower by ")
    assert second.startswith("twin has a higher alpha than nervous on what both label, but a lower one if what it")


def test_both_levels_are_printed_where_they_differ(result, tmp_path):
    """Twin labels 92 % of the pixels, and is usable of all."""
    for models, who in ((["twin", "nervous"], "twin: "), (["twin"], "")):
        found = of_some(result, models, tmp_path / "_".join(models))
        verdict = found.record(model="twin").statistics.verdict
        for name, content in {"level": "stable", "of_all": "usable", "labelled": 0.92}.items():
            object.__setattr__(verdict, name, content)
        said = "stable of the 92 % that it labels, usable of all"
        assert f"{who}{said}" in " ".join(printed(found, tmp_path / "run").split())
        assert _card("twin", [found.record(model="twin")])["scenes"][0] == {
            "scene": "scene0", "level": said, "kind": KINDS["usable"], "probability": "",
        }  # fmt: skip


def test_one_model_has_no_ranking(result, tmp_path):
    alone = of_some(result, ["twin"], tmp_path / "run")
    assert ranking(alone).ranks == ranking(alone).differences == ()
    assert list(order_of_models(alone)) == []


def test_a_gate_on_alpha_of_nearly_one_class_is_undecided(result):
    decided = gate(
        f"{result[1]}:constant", f"{result[1]}:twin", gate_config(rules=["alpha drop < 0.02", "alpha > 0.5"])
    )
    assert [judgement.verdict for judgement in decided.judgements] == ["undecided", "undecided"]
    assert "nearly the whole map is one class" in decided.judgements[0].reason


@pytest.mark.parametrize("frames", [3, 12])
def test_a_run_and_compare_say_the_same_of_the_same_pair(tmp_path, frames):
    root = tiny_scene.write(tmp_path / "wall", ("a", "b"), frames=frames)
    result = semstab.run(configure(root), out=tmp_path / "run", report=False)
    (one,) = ranking(result).differences
    comparison = semstab.compare(f"{tmp_path}/run:a", f"{tmp_path}/run:b")
    (row,) = (row for row in comparison.overall[0].contrasts if row.measure == "alpha")
    found, expected = (one.value, one.low, one.high), row.difference
    assert found == pytest.approx((expected.value, expected.low, expected.high), nan_ok=True)
    assert (one.scope, one.undecided) == (expected.scope, expected.undecided)
