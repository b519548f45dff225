"""`semstab.fuse`: frames of a program in, all that a run says out, nothing written unless asked."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

import semstab
from semstab.core.files import ScratchFolder
from semstab.core.json_form import to_json
from semstab.datasets import GROUND_TRUTH, open_dataset
from semstab.errors import ConfigError, DataError

OPTIONS = {"width": 96, "height": 54, "frames": 10}
SIZE = 1.0


@pytest.fixture(scope="module")
def city():
    return open_dataset("city", OPTIONS).scene("scene0")


@pytest.fixture(scope="module")
def classes(city):
    return city.label_space(city.models[0]).classes


def frames_of(city, model, *, truth=False):
    """The frames of a label source as a program has them: arrays, and poses of three rows."""
    for i in range(len(city)):
        frame = city.frame(i, model)
        given = {"labels": frame.labels, "depth": frame.depth, "intrinsics": frame.intrinsics.matrix,
                 "T_wc": frame.T_wc[:3], "color": frame.color}  # fmt: skip
        yield given | ({"truth": city.frame(i, GROUND_TRUTH).labels} if truth else {})


@pytest.fixture(scope="module")
def steady(city, classes):
    return semstab.fuse(frames_of(city, "sim-steady"), voxel_size=SIZE, classes=classes, model="steady")


def test_a_generator_gives_what_a_run_gives(steady, city):
    run = semstab.run({
        "dataset": {"name": "city", "options": OPTIONS}, "scenes": ["scene0"], "models": ["sim-steady"],
        "voxel_size": SIZE, "taxonomy": None, "exclude": {}, "check": None, "check_geometry": False, "truth": False,
    })  # fmt: skip
    generated, other = steady.record(), run.record()
    assert generated.map_summary == other.map_summary
    for part in ("headline", "spots", "agreement"):
        assert to_json(getattr(generated.statistics, part)) == to_json(getattr(other.statistics, part))
    assert generated.statistics.verdict.level == other.statistics.verdict.level == steady.summary.verdict
    alpha = other.statistics.headline.alpha
    assert steady.summary.alpha == alpha.value
    assert (steady.summary.alpha_low, steady.summary.alpha_high, steady.summary.confidence) == (
        alpha.low, alpha.high, 0.95,
    )  # fmt: skip
    assert steady.summary.psa_op2 == other.statistics.agreement.psa_op2.value
    assert steady.summary.flicker == generated.image_space.compensated_flicker_percent > 0
    assert steady.summary.frames == len(city)
    assert len(steady.record().table()) == steady.summary.voxels


def test_frames_and_tensors_and_scores_are_taken(city, classes, steady):
    frames = [city.frame(i, "sim-steady") for i in range(len(city))]
    tensors = [{key: torch.from_numpy(np.array(value)) if isinstance(value, np.ndarray) else value
                for key, value in given.items()} for given in frames_of(city, "sim-steady")]  # fmt: skip
    eye = np.eye(len(classes), dtype=np.float32)
    soft = [{**given, "labels": None, "scores": eye[given["labels"]]} for given in frames_of(city, "sim-steady")]
    for given in (frames, tensors, soft):
        result = semstab.fuse(given, voxel_size=SIZE, classes=classes)
        assert result.summary.vss_op3 == pytest.approx(steady.summary.vss_op3, abs=1e-12)
        assert result.summary.alpha == pytest.approx(steady.summary.alpha, abs=1e-12)


def test_truth_tells_what_is_right(city, classes):
    result = semstab.fuse(
        frames_of(city, "sim-flicker", truth=True), voxel_size=SIZE, classes=classes, statistics=True, backend="open3d"
    )
    correctness = result.record().statistics.correctness
    assert correctness is not None
    assert 0.3 < correctness.accuracy_op2.value < 1
    assert result.record().unit.backend == "open3d"


def test_results_are_compared_gated_and_exported_as_runs_are(steady, city, classes, tmp_path):
    other = semstab.fuse(frames_of(city, "sim-flicker"), voxel_size=SIZE, classes=classes, model="flicker")
    comparison = semstab.compare(steady, other, out=tmp_path / "versus")
    assert [compared.name for compared in comparison.runs] == ["steady", "flicker"]
    assert (tmp_path / "versus/report.html").exists()
    assert repr(other).startswith("<FusedResult 'frames': 1 unit, fused by numba>\n  frames, flicker: ")
    assert [compared.source for compared in comparison.runs] == [None, None]
    assert repr(comparison).startswith("<RunComparison with steady on frames>\n  flicker: alpha -")
    again = semstab.fuse(frames_of(city, "sim-steady"), voxel_size=SIZE, classes=classes, model="steady")
    with pytest.raises(ConfigError, match=r"two results are named 'steady'; give each a name: semstab\.fuse"):
        semstab.compare(steady, again)
    gate = semstab.GateConfig(rules=("alpha drop < 0.02",))
    assert repr(semstab.gate(other, steady, gate)).splitlines()[0] == (
        "<GateResult: fails; flicker against steady on frames>"
    )
    assert [judgement.verdict for judgement in semstab.gate(other, steady, gate).judgements] == ["fails"]
    assert [judgement.verdict for judgement in semstab.gate(steady, steady, gate).judgements] == ["passes"]
    semstab.export(steady, tmp_path / "map.ply")
    assert (tmp_path / "map.ply").stat().st_size > 1000


def test_a_rule_of_every_class_names_those_that_it_leaves_out(city, classes):
    flown = semstab.fuse(frames_of(city, "sim-steady"), voxel_size=SIZE, classes=(*classes, "boat"), model="steady")
    result = semstab.gate(flown, None, semstab.GateConfig(rules=("class *: alpha > -2",)))
    assert "boat" not in [judgement.rule.class_name for judgement in result.judgements]
    assert [
        note
        for note in result.notes
        if note.startswith("class *: alpha > -2: left out, as seen nowhere twice in steady: ")
    ]
    assert any(note.endswith("boat") for note in result.notes)


def test_nothing_is_written_unless_asked_and_then_all_of_it(city, classes, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.chdir(tmp_path)
    result = semstab.fuse(
        frames_of(city, "sim-steady"), voxel_size=SIZE, classes=classes, recording=tmp_path / "seen.rrd"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"temporary", "seen.rrd"}
    assert (tmp_path / "seen.rrd").stat().st_size > 10_000
    result.report(tmp_path / "x.html")
    assert "alpha" in (tmp_path / "x.html").read_text(encoding="utf-8")
    folder = result.save(tmp_path / "run")
    assert (folder / "report.html").exists()
    saved, held = (fused.record().without_files() for fused in (semstab.load(folder).result, result))
    assert to_json(saved) == to_json(held)
    assert len(semstab.load(folder).table()) == result.summary.voxels
    with pytest.raises(ConfigError, match=r"is not empty"):
        result.save(folder)
    assert "verdict" in result._repr_html_()
    del result
    gc.collect()
    assert not [*temporary.iterdir()]


KILLED = """
import os, sys
import numpy as np
import semstab

def frames(last):
    for i in range(4):
        labels, depth = np.zeros((8, 8), np.uint8), np.ones((8, 8), np.float32)
        K = np.array([[8, 0, 4], [0, 8, 4], [0, 0, 1]])
        yield dict(labels=labels, depth=depth, intrinsics=K, T_wc=np.eye(4))
    last()

class Killed(semstab.engine.Observer):
    def frame_fused(self, *given, **named):
        os.kill(os.getpid(), 9)

if sys.argv[1] == "frames":
    semstab.fuse(frames(lambda: os.kill(os.getpid(), 9)), voxel_size=0.1, backend="numpy")
semstab.fuse(frames(lambda: None), voxel_size=0.1, backend="numpy", observers=[Killed()])
"""


@pytest.mark.parametrize("when", ["frames", "fusion"])
def test_what_a_killed_program_left_is_removed_by_the_next(when, tmp_path, monkeypatch):
    done = subprocess.run([sys.executable, "-c", KILLED, when], env=os.environ | {"TMPDIR": str(tmp_path)}, check=False)
    assert done.returncode == -9
    left = set(tmp_path.glob("semstab-*"))
    assert len(left) == (1 if when == "frames" else 2)
    (tmp_path / "semstab-scratch-linked").symlink_to(tmp_path.parent)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = ScratchFolder()
    assert not any(path.exists() for path in left)
    (first.path / "mine").touch()
    second = ScratchFolder()
    assert (first.path / "mine").exists()  # held by this process
    assert any(tmp_path.parent.iterdir())
    first.remove()
    del second
    gc.collect()
    assert [path.name for path in tmp_path.iterdir()] == ["semstab-scratch-linked"]


def test_a_scratch_folder_that_another_process_removes_at_once_is_made_again(tmp_path, monkeypatch):
    made, make = [], tempfile.mkdtemp

    def removed_once(**options):
        made.append(make(dir=tmp_path, **options))
        if len(made) == 1:
            Path(made[0]).rmdir()
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", removed_once)
    with ScratchFolder() as folder:
        assert folder == Path(made[1]) / "files"
        assert folder.is_dir()


def test_what_cannot_be_fused_is_one_line(city, classes):
    (good, *_) = frames_of(city, "sim-steady")
    for wrong, message in (
        ({**good, "pose": np.eye(4)}, "frame 1: no field 'pose'"),
        ({key: value for key, value in good.items() if key != "depth"}, "frame 1: 'depth' is missing"),
        ({**good, "T_wc": np.eye(3)}, "frame 1, pose: the pose must be a 4x4 or 3x4 matrix"),
        ({**good, "labels": good["labels"][:9]}, "frame 1, labels: labels are 96x9 but depth is 96x54"),
    ):
        with pytest.raises(DataError, match=message):
            semstab.fuse([good, wrong], voxel_size=SIZE)
    with pytest.raises(DataError, match="there are no frames"):
        semstab.fuse([])
    with pytest.raises(DataError, match="there are labels up to 7, but 3 classes"):
        semstab.fuse(frames_of(city, "sim-steady"), voxel_size=SIZE, classes=classes[:3])
    with pytest.raises(ConfigError, match="voxel_sizes"):
        semstab.fuse([good], voxel_sizes=SIZE)


def test_frames_that_contradict_each_other_are_told_in_the_words_of_a_program(city):
    good = [f | {"T_wc": np.vstack([f["T_wc"][:3], [0, 0, 0, 1]])} for f in frames_of(city, "sim-steady")]
    for change, message in (
        (lambda f: {"T_wc": np.linalg.inv(f["T_wc"])}, r"T_wc that maps the world to the camera \(pass np.linalg.inv"),
        (lambda f: {"depth": f["depth"] * 1000}, r"depth of 1000 units a metre \(divide it by 1000\)"),
        (lambda f: {"T_wc": f["T_wc"] @ np.diag([1, -1, -1, 1])}, r"T_wc with opengl camera axes \(turn them: x right"),
    ):
        with pytest.raises(DataError, match=f"{message}.*; check_geometry=False fuses it as it is"):
            semstab.fuse([f | change(f) for f in good], voxel_size=SIZE)


def test_a_saved_run_says_that_its_frames_are_gone(steady, tmp_path):
    folder = steady.save(Path(tmp_path) / "run")
    config = semstab.load_config(folder / "config.yaml")
    config.dataset.options["token"] = "of another process"
    with pytest.raises(DataError, match=r"gave these frames to semstab\.fuse, and they no longer exist"):
        semstab.run(config)
