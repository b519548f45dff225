"""Rules of fusion against loops in plain Python, and from the command line to the tables."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
from command_line import bench
from hypothesis import given
from hypothesis import strategies as st

import semstab
from semstab import VoxelTable, backends
from semstab.backends.from_observations import FromObservations
from semstab.backends.numpy_reference import NumpySample, in_sample
from semstab.backends.rules import RULES, Rule
from semstab.backends.shared.association import observe
from semstab.configure import load_config
from semstab.data.information import js_divergence
from semstab.engine import load_result
from semstab.errors import ConfigError, DataError
from semstab.metrics import dominant, vss
from semstab.report.tables import tables
from semstab.testing import SEQUENCES, BackendConformance, as_frames, assert_same_map, checks, random_frames, sight_line

K, EACH = 3, [*RULES]


class Direct(FromObservations):
    """The reference's association behind the one method, as a user's backend has it."""

    def observe(self, frame):
        observed = observe(frame, self.voxel_size, self.num_classes)
        return observed.index, observed.s_bar, observed.pixels


class TestFromObservations(BackendConformance):
    def create(self, voxel_size, num_classes):
        return Direct(voxel_size, num_classes)


class TestNumbaObservations(BackendConformance):
    """The observations of the compiled loops, by the mean."""

    reach = 2**20

    def create(self, voxel_size, num_classes):
        return backends.create("numba+mean", voxel_size=voxel_size, num_classes=num_classes)


# --- Each rule, voxel by voxel ----------------------------------------------------------------------------------------


def one_by_one(rule, observations):
    """Return the evidence of a voxel from its observations (frame, s_bar, pixels, distance), in plain Python."""
    if rule == "bayes":  # as a product, not as a sum of logarithms
        p = [1 / K] * K
        for _, s, _, _ in observations:
            likelihood = [sum(s[j] * (0.9 if j == k else 0.1 / (K - 1)) for j in range(K)) for k in range(K)]
            p = [a * b for a, b in zip(p, likelihood, strict=True)]
            p = [value / sum(p) for value in p]
        return p
    newest = max(frame for frame, *_ in observations)
    assert newest == observations[-1][0]
    terms = {
        "mean": lambda frame, s, n, d: s,
        "votes": lambda frame, s, n, d: [n * value for value in s],
        "weighted": lambda frame, s, n, d: [value / d**2 for value in s],
        "recent": lambda frame, s, n, d: [value * 0.5 ** ((newest - frame) / 10) for value in s],
    }
    if rule in terms:
        return [math.fsum(term) for term in zip(*(terms[rule](*value) for value in observations), strict=True)]
    if rule == "max":
        return [max(column) for column in zip(*(s for _, s, *_ in observations), strict=True)]
    return observations[0 if rule == "first" else -1][1]


def seen_by(frames, voxel_size):
    """Return the observations of each voxel by its index."""
    voxels = defaultdict(list)
    for frame in frames:
        now = observe(frame, voxel_size, K)
        for q, s, n in zip(now.index.tolist(), now.s_bar.tolist(), now.pixels.tolist(), strict=True):
            centre = [(i + 0.5) * voxel_size for i in q]
            voxels[tuple(q)].append((frame.index, s, n, math.dist(centre, frame.T_wc[:3, 3])))
    return voxels


def fuse(name, frames, voxel_size=1.0, **options) -> VoxelTable:
    backend = backends.create(name, voxel_size=voxel_size, num_classes=K, **options)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


@pytest.mark.parametrize("name", ["numpy", "numba"])
@pytest.mark.parametrize("rule", EACH)
@checks
@given(st.data())
def test_a_rule_is_its_equation(name, rule, data) -> None:
    frames = data.draw(
        st.one_of(SEQUENCES.map(as_frames), st.integers(0, 50).map(lambda seed: random_frames(seed, K=K)))
    )
    table, voxels = fuse(name, frames, rule=rule), seen_by(frames, 1.0)
    assert sorted(voxels) == [tuple(q) for q in table.index.tolist()]
    for q, e in zip(table.index.tolist(), table.evidence[:].tolist(), strict=True):
        assert e == pytest.approx(one_by_one(rule, voxels[tuple(q)]), rel=1e-9, abs=1e-9)
    assert table.op.tolist() == [len(voxels[tuple(q)]) for q in table.index.tolist()]
    if rule != "mean":
        assert table.weight == pytest.approx(table.evidence.sum(axis=1))


@pytest.mark.parametrize("rule", EACH)
def test_numba_equals_the_reference(rule) -> None:
    frames = random_frames(3, count=6, K=K)
    assert_same_map(fuse("numba", frames, 0.3, rule=rule), fuse("numpy", frames, 0.3, rule=rule), 1e-9)


@pytest.mark.parametrize("rule", EACH)
def test_drift_is_between_successive_beliefs(rule) -> None:
    hits = [[(0.2, 0), (0.4, 0), (0.6, 1)], [(0.5, 1)], [(0.5, 2), (0.6, 0)]]
    frames = as_frames(hits)
    beliefs = [np.array(one_by_one(rule, seen_by(frames[:n], 1.0)[0, 0, 0])) for n in (1, 2, 3)]
    beliefs = [belief / belief.sum() for belief in beliefs]
    expected = js_divergence(beliefs[1], beliefs[0]) + js_divergence(beliefs[2], beliefs[1])
    assert fuse("numpy", frames, rule=rule).drift_sum == pytest.approx([expected])


def test_bayes_stays_able_to_change_its_mind() -> None:
    """After 1000 frames of class 0 its probability is 1 in float64; 1001 frames of class 1 outweigh them."""
    frames = [sight_line(t, [(0.5, 0 if t < 1000 else 1)]) for t in range(2001)]
    table = fuse("numba", frames, rule="bayes")
    assert dominant(table).tolist() == [1]
    assert vss(table) == pytest.approx([0.9 / 0.95])


@pytest.mark.parametrize(("rule", "options", "expected"), [
    ("bayes", {"error": 0.5}, [0.5, 0.25, 0.25]),
    ("weighted", {"distance": 0}, [1, 0, 0]),
    ("recent", {"half_life": 1}, [1, 0, 0]),
])  # fmt: skip
def test_options_of_a_rule(rule, options, expected) -> None:
    table = fuse("numpy", [sight_line(0, [(0.5, 0)])], rule=rule, rule_options=options)
    assert table.evidence[0] == pytest.approx(expected)


@pytest.mark.parametrize(("options", "line"), [
    ({"rule": "bays"}, "did you mean 'bayes'"),
    ({"rule": 3}, "use a name, or FILE.py:NAME"),
    ({"rule": "bayes", "rule_options": {"eror": 0.1}}, "rule 'bayes' has no option 'eror'; it takes error"),
    ({"rule": "first", "rule_options": {"error": 0.1}}, "it takes none"),
    ({"rule": "bayes", "rule_options": {"error": 1}}, "use a number between 0 and 1"),
    ({"rule": "recent", "rule_options": {"half_life": 0}}, "use a number of frames above 0"),
    ({"rule": "recent", "rule_options": {"half_life": "long"}}, "use a number"),
])  # fmt: skip
def test_what_a_rule_does_not_take_is_one_line(options, line) -> None:
    with pytest.raises(ConfigError, match=line):
        backends.check_options("numba", voxel_size=1.0, num_classes=K, **options)


def test_another_backend_has_the_mean_alone() -> None:
    with pytest.raises(ConfigError, match="backend 'torch' has no rules but the mean; numpy and numba have"):
        backends.create("torch+votes", voxel_size=1.0, num_classes=K)


# --- What a table holds -----------------------------------------------------------------------------------------------


def test_a_weight_is_kept_and_what_counts_frames_is_unknown(tmp_path) -> None:
    table = fuse("numba", random_frames(3, count=6, K=K), 0.3, rule="votes")
    assert not table.counts_frames
    table.save(tmp_path / "map.parquet")
    again = VoxelTable.load(tmp_path / "map.parquet")
    assert again.weight == pytest.approx(table.pixels)
    parts = VoxelTable.joined([again.rows(slice(0, 5)), again.rows(slice(5, None))])
    assert parts.weight.tolist() == table.weight.tolist()
    scaled = again.summing_to_op()
    assert scaled.evidence.sum(axis=1) == pytest.approx(table.op)
    assert vss(scaled) == pytest.approx(vss(table))
    assert np.isnan(scaled.self_sum).all()
    assert "weight" in table.to_arrow().column_names


def test_a_restricted_map_is_part_of_the_whole() -> None:
    frames = random_frames(5, count=4, K=K)
    whole = fuse("numba", frames, 0.3, rule="bayes")
    low, high = (tuple(int(i) for i in np.quantile(whole.index[:, :2], q, axis=0)) for q in (0.2, 0.8))
    for name in ("numba", "numpy"):
        part = fuse(name, frames, 0.3, rule="bayes", within=backends.Extent(low, high))
        assert 0 < len(part) < len(whole)
        assert_same_map(part, whole.rows(backends.Extent(low, high).holds(whole.index.T)), 1e-9)


def test_the_sample_fuses_by_the_rule() -> None:
    frames = random_frames(5, count=4, K=K)
    whole, sample = fuse("numpy", frames, 0.1, rule="recent"), NumpySample(0.1, K, rule="recent")
    for frame in frames:
        sample.integrate(frame)
    assert len(sample.table())
    assert_same_map(sample.table(), whole.rows(in_sample(whole.index.T, sample.one_in)), 0)


# --- One method -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("given_", "line"), [
    (None, "it returned a NoneType; return voxel indices, evidence, pixels"),
    (([[0, 0, 0]], [[1.0, 0]], [1]), r"shapes \(1, 3\), \(1, 2\) and \(1,\); return \(n, 3\), \(n, 3\) and \(n,\)"),
    (([[0.5, 0, 0]], [[1.0, 0, 0]], [1]), "voxel indices are whole numbers"),
    (([[0, 0, 0]], [[0.0, 0, 0]], [1]), "0 in all classes"),
    (([[0, 0, 0]], [[math.nan, 0, 0]], [1]), "not finite"),
    (([[0, 0, 0]] * 2, [[1.0, 0, 0]] * 2, [1, 1]), "it returned a voxel twice"),
])  # fmt: skip
def test_observations_that_are_none_leave_the_map_as_it_is(given_, line) -> None:
    class Wrong(Direct):
        wrong = False

        def observe(self, frame):
            return given_ if self.wrong else super().observe(frame)

    backend = Wrong(1.0, K)
    backend.integrate(sight_line(0, [(0.5, 0)]))
    backend.wrong = True
    with pytest.raises(DataError, match=f"Wrong.observe, frame 7: .*{line}"):
        backend.integrate(sight_line(7, [(1.5, 0)]))
    assert len(backend.table()) == 1


OWN = """
import numpy as np

from semstab.backends.from_observations import FromObservations
from semstab.backends.shared.association import observe


def sharp(e, seen, *, power=2.0):
    return e + seen.s_bar**power


def negative(e, seen):
    return e - seen.s_bar


def flat(e, seen):
    return e[:, 0]


class Mine(FromObservations):
    def observe(self, frame):
        return observe(frame, self.voxel_size, self.num_classes)
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    tiny_scene.write(tmp_path / "wall", models=("a",))
    (tmp_path / "own.py").write_text(OWN, encoding="utf-8")
    return tmp_path


def test_a_rule_of_ones_own(folder) -> None:
    rule = f"{folder / 'own.py'}:sharp"
    frame = sight_line(0, [(0.2, 0), (0.4, 0), (0.6, 1)])
    table = fuse("numba", [frame], rule=rule, rule_options={"power": 3.0})
    assert table.evidence[0] == pytest.approx([8 / 27, 1 / 27, 0])


@pytest.mark.parametrize(("name", "line"), [
    ("negative", "evidence that is negative, not finite or 0"),
    ("flat", r"returned shape \(1,\) of a state of \(1, 3\)"),
])  # fmt: skip
def test_a_rule_that_fails_leaves_the_map_as_it_is(folder, name, line) -> None:
    backend = backends.create("numpy", voxel_size=1.0, num_classes=K, rule=f"{folder / 'own.py'}:{name}")
    with pytest.raises(DataError, match=line):
        backend.integrate(sight_line(0, [(0.5, 0)]))
    assert len(backend.table()) == 0
    assert Rule.from_name("mean")(np.zeros((0, K)), None).shape == (0, K)


# --- Runs -------------------------------------------------------------------------------------------------------------


def run(folder: Path, *words: str, code: int = 0):
    common = ["--data", "wall", "--voxel-size", "0.25", "--rerun", "off", "--report", "off", "--out", "out"]
    return bench(*common, *words, cwd=folder, code=code)


def test_rules_stand_side_by_side(folder) -> None:
    said = " ".join(run(folder, "--rule", "mean", "--rule", "bayes", "--rule", "own.py:sharp").stdout.split())
    for rule in ("bayes", "sharp"):
        assert re.search(rf"fusion by numba\+{rule} equals numpy in \d+ voxels of a random sample \(1 in 16\)", said)
        assert f"numba+{rule} differs from numba by design" in said
    assert "numba+bayes, numba+sharp: this rule does not count frames" in said
    result = load_result(folder / "out")
    assert [row.backends for row in result.compared] == [("numba", "numba+bayes"), ("numba", "numba+sharp")]
    mean, bayes = (result.record(backend=name).table() for name in ("numba", "numba+bayes"))
    assert mean.weight is None
    assert bayes.weight == pytest.approx(1)
    assert np.array_equal(mean.op, bayes.op)
    statistics = result.record(backend="numba+bayes").statistics
    assert math.isnan(statistics.agreement.psa_op2.value)
    assert math.isnan(statistics.agreement.voxel_alpha_op2.value)
    assert math.isnan(statistics.correctness.quadrants.consistent_right.value)
    assert statistics.correctness.accuracy_op2.value > 0.5
    (table,) = (made for made in tables(result) if made.name == "fusion_correctness")
    keys, (group,) = [column.key for column in table.columns], table.groups
    assert [row[0] for row in group.rows] == ["numba", "numba+bayes", "numba+sharp"]
    for row in group.rows:
        correctness = result.record(backend=row[0]).statistics.correctness
        assert row[keys.index("accuracy_op2")] == pytest.approx(correctness.accuracy_op2.value)
        assert row[keys.index("ece_op2")] == next(
            stratum.ece for stratum in correctness.strata if stratum.name == "OP>=2"
        )


def test_a_rule_alone_is_checked_by_the_reference_with_that_rule(folder) -> None:
    said = run(folder, "--rule", "recent", "--check", "numpy").stdout
    assert "fusion by numba+recent equals numpy+recent in all 60 voxels" in " ".join(said.split())


def test_a_backend_of_one_method_fuses_by_any_rule(folder) -> None:
    said = run(folder, "--backend", "own.py:Mine", "--rule", "votes", "--check", "numpy").stdout
    assert "fusion by Mine+votes equals numpy+votes in all 60 voxels" in " ".join(said.split())


def test_settings_name_rules_with_options(folder) -> None:
    content = {"name": "numba", "options": {"rule": "recent", "rule_options": {"half_life": 3}}}
    slow = {"name": "numba+slow", "options": {"rule": "recent", "rule_options": {"half_life": 30}}}
    config = load_config(overrides={"backends": [content, slow]})
    assert [backend.name for backend in config.backends] == ["numba+recent", "numba+slow"]
    assert config.backends[1].ruled == slow["options"]


def test_a_changed_rule_computes_its_units_again(folder) -> None:
    run(folder, "--rule", "own.py:sharp")
    before = load_result(folder / "out").record().table().evidence[:]
    (folder / "own.py").write_text(OWN.replace("e + seen.s_bar**power", "seen.s_bar"), encoding="utf-8")
    run(folder, "--rule", "own.py:sharp")
    assert not np.array_equal(load_result(folder / "out").record().table().evidence[:], before)


@pytest.mark.parametrize(("words", "line"), [
    (["--rule", "bays"], "rule 'bays' is not known; did you mean 'bayes'?"),
    (["--rule", "votes", "--backend", "open3d"], "backend 'open3d' has no rules but the mean"),
    (["--rule", "own.py:other"], "has no 'other'"),
    (["--rule", "own.py:negative"], "evidence that is negative, not finite or 0 in all classes"),
])  # fmt: skip
def test_a_rule_that_is_not_there_is_one_line(folder, words, line) -> None:
    said = run(folder, *words, code=2).stderr
    assert line in said
    assert len(said.strip().splitlines()) == 1


def test_frames_in_memory_are_fused_by_a_rule() -> None:
    fused = [semstab.fuse(random_frames(3, count=4, K=K), voxel_size=0.3, rule=rule) for rule in ("mean", "first")]
    assert [unit.backend for unit in fused] == ["numba", "numba+first"]
    assert fused[1].summary.sbd_op3 == 0 < fused[0].summary.sbd_op3
