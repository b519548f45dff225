"""Gates: rules as text, three outcomes of each, and what a pipeline reads of them."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from pathlib import Path
from xml.etree import ElementTree

import gate as simulation
import numpy as np
import pytest
import tiny_scene
from flights import Flight
from posed_config import configure
from posed_scene import fails
from simulated_events import grid, log_of
from typer.testing import CliRunner

import semstab
from semstab.cli import app
from semstab.comparison import gate as judging
from semstab.comparison import gate_report
from semstab.comparison.gate import GateResult, Judgement, gate, gate_config, parse
from semstab.errors import ConfigError, DataError
from semstab.model.statistics import Interval
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.cluster_sums import value
from semstab.statistics.intervals import difference


@pytest.mark.parametrize(("text", "key", "change", "below", "limit", "class_name", "scene"), [
    ("alpha drop < 0.02", "alpha", "drop", True, 0.02, None, None),
    ("alpha > 0.8", "alpha", None, False, 0.8, None, None),
    ("Accuracy drop<1%", "accuracy", "drop", True, 0.01, None, None),
    ("class human: recall > 0.6", "recall", None, False, 0.6, "human", None),
    (
        "scene street 1: class traffic light: IoU drop <= .05", "iou", "drop", True, 0.05, "traffic light",
        "street 1",
    ),
    ("flicker rise < 0.5%", "flicker", "rise", True, 0.5, None, None),
    ("stable-and-wrong rise < 1e-2", "wrong of stable", "rise", True, 0.01, None, None),
    ("alpha between drop < -0.01", "alpha between", "drop", True, -0.01, None, None),
])  # fmt: skip
def test_a_rule_is_read(text, key, change, below, limit, class_name, scene):
    rule = parse(text)
    found = (rule.measure.name, rule.change, rule.below, rule.limit, rule.class_name, rule.scene)
    assert found == (key, change, below, pytest.approx(limit), class_name, scene)


@pytest.mark.parametrize(("text", "line"), [
    ("alpha", "write [scene NAME:] [class NAME|*:] MEASURE [drop|rise] <|> NUMBER[%]"),
    ("alpha drop 0.02", "not understood"), ("alpha < 1e999", "too large"),
    ("alhpa drop < 0.02", "no measure 'alhpa'; did you mean 'alpha'?"),
    ("recall > 0.6", "recall is of a class; write 'class NAME: recall > 0.6'"),
    ("class car: ece < 0.1", "ece is of all classes; leave 'class car:' out"),
    ("coverage > 0.9", "coverage is relative to a baseline"),
])  # fmt: skip
def test_a_rule_that_is_none_is_said_in_one_line(text, line):
    fails(ConfigError, re.escape(line), parse, text)


@pytest.mark.parametrize(("text", "low", "high", "expected"), [
    ("alpha drop < 0.02", -0.01, 0.019, "passes"),
    ("alpha drop < 0.02", 0.005, 0.015, "passes"),  # a loss is shown, and that it is small
    ("alpha drop < 0.02", 0.005, 0.03, "fails"),
    ("alpha drop < 0.02", -0.005, 0.03, "undecided"),
    ("alpha drop < -0.02", -0.03, -0.01, "undecided"),  # a gain of 0.02 is asked for
    ("alpha drop < -0.02", -0.01, 0.01, "fails"),
    ("alpha rise < 0.02", 0.005, 0.03, "undecided"),  # no loss
    ("ece rise < 0.02", 0.005, 0.03, "fails"),
    ("alpha > 0.8", 0.81, 0.9, "passes"),
    ("alpha > 0.8", 0.7, 0.79, "fails"),
    ("alpha > 0.8", 0.7, 0.9, "undecided"),
    ("alpha > 0.8", math.nan, 0.9, "undecided"),
])  # fmt: skip
def test_what_an_interval_says_of_a_rule(text, low, high, expected):
    found = Interval((low + high) / 2, low, high)
    assert judging.verdict(parse(text), found) == expected
    assert judging.verdict(parse(text), dataclasses.replace(found, undecided="too few")) == "undecided"


def test_settings_come_from_a_file_and_the_command(tmp_path):
    (file := tmp_path / "gate.yaml").write_text("rules: ['alpha > 0.8']\nlevel: 0.01\n")
    found = gate_config(file, ["psa > 0.9"], undecided="fail")
    assert (found.rules, found.level, found.undecided) == (("alpha > 0.8", "psa > 0.9"), 0.01, "fail")
    fails(ConfigError, "there is no rule; write e.g.", gate_config)
    for content, line in (("rulez: []", "did you mean 'rules'"), ("level: 0.7", "level"), ("- a", "expected settings")):
        file.write_text(content)
        fails(ConfigError, f"gate.yaml: .*{line}", gate_config, file)


def models(frames=20, side=16, seed=0):
    """Two classes on a floor; the log of a model that errs in one look of ten, and the true classes."""
    rng = np.random.default_rng(seed)
    truth = (np.add.outer(np.arange(side), np.arange(side)) % 7 > 3).astype(int).ravel()
    labels = np.where(rng.random((side * side, frames)) < 0.1, 1 - truth[:, None], truth[:, None])
    return labels, truth


def sums(labels, truth, side=16):
    log = log_of(labels, K=2, index=grid(side))
    return cluster_sums_of(log.table(), log, truth)


def test_a_planted_fault_fails_itself_passes_and_three_frames_are_undecided():
    labels, truth = models()
    base = sums(labels, truth)
    faulty = labels.copy()
    faulty[:, ::3] = np.where(faulty[:, ::3] == 1, 0, faulty[:, ::3])
    rule = parse("alpha drop < 0.02")

    def outcome(new, old, rule=rule):
        k = None if rule.class_name is None else 1
        return judging.verdict(rule, judging.bounded(rule, new, old, k=k))

    assert outcome(sums(faulty, truth), base) == "fails"
    assert outcome(base, base) == "passes"
    assert outcome(base, base.without_truth()) == "passes"
    assert outcome(sums(faulty, truth), base, parse("class b: alpha drop < 0.02")) == "fails"
    assert outcome(sums(faulty, truth), base, parse("look accuracy drop < 0.02")) == "fails"
    fixed = judging.bounded(rule, sums(faulty, truth), base, scope="these frames")
    loose = judging.bounded(rule, sums(faulty, truth), base)
    assert fixed.high - fixed.low < loose.high - loose.low
    assert outcome(sums(faulty[:, :3], truth), sums(labels[:, :3], truth)) == "undecided"
    assert outcome(sums(labels[:, :3], truth), sums(labels[:, :3], truth)) == "passes"  # the very same


def test_a_rule_of_each_class_shares_the_level_and_voxel_sizes_must_be_the_same(run, tmp_path):
    rules = gate_config(rules=["class *: alpha > 0.1", "class wall: alpha > 0.1"], level=0.06)
    *each, alone = gate(f"{run}:a", None, rules).judgements
    assert [row.rule.text for row in each] == [f"class {name}: alpha > 0.1" for name in ("wall", "door", "window")]
    assert each[0].found.low < alone.found.low
    closer = gate(f"{run}:a", None, gate_config(rules=["class wall: alpha > 0.1"], level=0.02)).judgements[0]
    assert closer.found.low == pytest.approx(each[0].found.low)
    data = run.parent / "wall"
    semstab.run(configure(data, check=None, voxel_size=0.4, backbones=["a"]), out=tmp_path / "large", report=False)
    fails(
        DataError, "run it with --voxel-size", gate, tmp_path / "large", f"{run}:a", gate_config(rules=["psa drop < 1"])
    )


def test_a_class_that_is_nowhere_has_no_value_and_ends_are_one_sided():
    labels, truth = models()
    log = log_of(labels, K=3, index=grid(16))
    found = judging.bounded(parse("class c: recall > 0.5"), cluster_sums_of(log.table(), log, truth), k=2)
    assert math.isnan(found.value)
    assert judging.verdict(parse("class c: recall > 0.5"), found) == "undecided"
    (labels, truth), (other, _) = models(), models(seed=1)
    new, base = sums(labels, truth), sums(other, truth)
    for key in ("alpha", "look_accuracy"):
        found = judging.bounded(parse(f"{key.replace('_', ' ')} rise < 1"), new, base)
        both = difference(new, base, key, same_frames=True, level=0.9)
        assert (found.value, found.low, found.high) == (both.value, both.low, both.high)
        assert found.value == pytest.approx(value(new, key) - value(base, key))


def test_simulated_pairs_without_a_difference_seldom_fail_and_a_loss_of_the_margin_seldom_passes():
    """A small part of simulations/gate.py; docs/gate.md has the whole table."""
    margin, fails_, _, passes, _, _ = simulation.rates(Flight(32, 1.5, 1.0, 15, 15, "uneven"), 25, 0)
    assert 0.03 < margin < 0.12
    assert fails_ <= 0.12
    assert passes <= 0.16


def cli(*words):
    return CliRunner().invoke(app, words, env={"COLUMNS": "80", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a wall with the label sources a and b, and ground truth."""
    base = tmp_path_factory.mktemp("gate")
    tiny_scene.write(base / "wall", frames=9)
    semstab.run(configure(base / "wall", check=None), out=base / "run", report=False)
    return base / "run"


def test_the_command_says_what_came_of_each_rule(run, tmp_path):
    out = [tmp_path / name for name in ("gate.xml", "gate.md", "gate.json")]
    options = [part for file in out for part in ("--out", str(file))]
    kept = tmp_path / "base.zip"
    done = cli("gate", f"{run}:a", "--save-baseline", str(kept))
    assert done.exit_code == 0
    assert 0 < kept.stat().st_size < 1_000_000
    rules = ["--rule", "alpha drop < 0.02", "--rule", "flicker rise < 1", "--rule", "alpha > 0.999"]
    done = cli("gate", f"{run}:a", "--against", str(kept), *rules, *options)
    assert done.exit_code == 4
    text = done.output
    assert re.search(r"PASSES\s+alpha drop < 0.02", text)
    assert re.search(r"FAILS\s+alpha > 0.999", text)
    assert "1 fails, 2 pass: the gate fails" in text
    assert all(len(line) <= 80 for line in text.splitlines())
    suite = ElementTree.parse(out[0]).getroot()
    assert (suite.get("tests"), suite.get("failures"), len(suite.findall("testcase/failure"))) == ("3", "1", 1)
    assert "❌ fails | `alpha > 0.999`" in out[1].read_text()
    content = json.loads(out[2].read_text())
    assert [row["verdict"] for row in content["rules"]] == ["passes", "passes", "fails"]


@pytest.mark.parametrize(("arguments", "line"), [
    (["--rule", "alpha drop < 0.02"], "a drop is from a baseline; give --against RUN"),
    (["--rule", "class q: alpha > 0.1"], "no class 'q'"),
    (["--rule", "scene q: alpha > 0.1"], "no scene 'q'; known: wall"),
    (["--rule", "flicker < 99", "--scope", "other-scenes"], "flicker is known by frame alone"),
    (["--rule", "alpha > 0.1", "--scope", "some"], "scope"),
    (["--rule", "class door: recall > 0.1"], "has no recall of wall; run it with --statistics"),
    (["--rule", "accuracy > 0.1"], "has no accuracy of wall; run it with --statistics"),
    (["--rule", "sbd excess < 0.1", "--out", "x.txt"], "format '.txt' is not known"),
    (["--rule", "alpha > 0.1", "--undecided", "maybe"], "undecided"),
    (["--rule", "alpha > 0.1", "--against", "nowhere"], "there is no such folder"),
])  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(run, arguments, line):
    done = cli("gate", f"{run}:a", *arguments)
    assert done.exit_code == 2
    assert line in " ".join(done.output.split())
    assert "Traceback" not in done.output


def test_reports_hold_whatever_names_are():
    rule = parse("class <a|b>&\x07: recall > 0.6")
    result = GateResult(
        "a|b`c", "", ("s|t",), 0.05, "fail", (Judgement(rule, "undecided", Interval(0.5, 0.4, 0.7), 0.5, math.nan),)
    )
    assert result.failed
    case = ElementTree.fromstring(gate_report.junit(result)).find("testcase")
    assert case.get("name") == "class <a|b>&?: recall > 0.6"
    assert case.find("failure") is not None
    assert "class <a\\|b>" in gate_report.markdown(result)
    assert not dataclasses.replace(result, undecided="pass").failed
    assert "skipped" in gate_report.junit(dataclasses.replace(result, undecided="pass"))


def test_a_plan_says_how_many_frames_a_rule_needs(run):
    """The standard error falls with the square root of the frames: half the margin takes four times as many."""
    rules = ["--rule", "alpha drop < 0.1", "--rule", "alpha drop < 0.05", "--rule", "coverage drop < 0.1"]
    done = cli("gate", f"{run}:a", "--against", f"{run}:b", "--plan", *rules)
    assert done.exit_code == 0
    wide, narrow = (
        int(n.replace(",", "")) for n in re.findall(r"alpha drop < [\d.]+: ([\d,]+) \(9 now\)", done.output)
    )
    assert narrow == pytest.approx(4 * wide, rel=0.1)
    assert "coverage drop < 0.1: no number of frames tells" in done.output
    result = gate(f"{run}:a", f"{run}:b", gate_config(rules=["alpha drop < 0.1"]))
    (each,) = result.judgements
    half = (each.found.high - each.found.low) / 2
    assert wide == pytest.approx(9 * (half / 0.1) ** 2, rel=1.5)


def test_the_documented_rules_are_rules():
    text = (Path(__file__).parents[1] / "docs/gate.md").read_text()
    rules = re.findall(r"--rule '([^']+)'", text)
    assert len(rules) > 5
    for rule in rules:
        parse(rule)
