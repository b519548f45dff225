"""A run is the smallest study: the same numbers, files and options, whichever command or process does the work."""

from __future__ import annotations

import csv
import itertools
import json
import re

import numpy as np
import pytest
import tiny_scene
import yaml
from command_line import bench
from compare_summaries import differences
from posed_config import dataset_of
from test_recording import read

import semstab
from semstab.config import BACKENDS
from semstab.configure import load_config
from semstab.engine import load_result
from semstab.engine.units import make_plan
from semstab.metrics import compare, compensated_flicker, image_space
from semstab.recording import Recording, Target, lacks_pictures, record_finished
from semstab.task import read as read_frame

TIMES = {"decode_ms", "wait_ms", "fuse_ms", "association_ms", "update_ms"}


@pytest.fixture
def root(tmp_path):
    return tiny_scene.write(tmp_path / "data" / "wall", frames=6)


def settings(root, **more):
    return {"dataset": dataset_of(root), "backends": ["numba", "numpy"], "check": None, "voxel_size": 0.25, **more}


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def series(file):
    rows = csv.DictReader(file.read_text().splitlines())
    return [{key: cell for key, cell in row.items() if key not in TIMES} for row in rows]


def same(one, other):
    """Summaries, voxels and time series of two folders are the same, but for times and the name."""
    assert differences(summary(one) | {"name": ""}, summary(other) | {"name": ""}, tolerance=0) == []
    for a, b in zip(load_result(one).records, load_result(other).records, strict=True):
        assert (a.key, a.variation) == (b.key, b.variation)
        if a.voxels_file is not None:
            assert compare(a.table(), b.table(), (a.unit, b.unit), tolerance=0).agrees
            assert series(a.series) == series(b.series)
    files = [sorted(str(file.relative_to(folder)) for file in folder.rglob("*")) for folder in (one, other)]
    assert files[0] == files[1]


def test_a_run_equals_the_study_without_sweeps_voxel_for_voxel(root, tmp_path) -> None:
    file = tmp_path / "wall.yaml"
    file.write_text(yaml.safe_dump(settings(root, statistics=True)))
    bench("--config", file, "--rerun", "off", "--out", "run", "-q", cwd=tmp_path)
    bench("study", file, "--out", "study", "-q", cwd=tmp_path)
    same(tmp_path / "run", tmp_path / "study")
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "config.yaml", "manifest.json", "summary.json", "digests.json", "units", "voxels", "frames", "observations",
        "overview", "sums", "truth",
    }  # fmt: skip


def test_a_run_in_several_processes_is_the_same_run(root, tmp_path) -> None:
    """Its recording has the same series and maps; the images are added from the finished folder."""
    one, two = tmp_path / "one", tmp_path / "two"
    recording = Recording(Target(one / "recording.rrd"))
    semstab.run(load_config(overrides=settings(root)), out=one, observers=[recording], report=False)
    file = tmp_path / "wall.yaml"
    file.write_text(yaml.safe_dump(settings(root)))
    bench("--config", file, "--jobs", "2", "--out", "two", "-q", cwd=tmp_path, recording=True)
    assert load_result(two).manifest["units"]["executor"] == "2 local processes"
    same(one, two)
    assert [lacks_pictures(out, out / "recording.rrd") for out in (one, two)] == [False, True]
    record_finished(two, two / "recording.rrd")
    assert set(read(one / "recording.rrd")) == set(read(two / "recording.rrd"))


def test_a_study_writes_frame_series_and_where_asked_a_recording_of_its_base_units(root, tmp_path) -> None:
    content = settings(root, sweeps={"voxel_size": [0.5]}, name="tiny")
    out = tmp_path / "study"
    semstab.run_study(
        load_config(overrides=content), out, observers=[Recording(Target(out / "recording.rrd"))], report=False
    )
    slugs = {f"wall__{model}__{backend}" for model in "ab" for backend in ("numba", "numpy")}
    assert {file.stem for file in (out / "frames").iterdir()} == slugs
    result = load_result(out)
    (base, *_) = result.select()
    rows = series(base.series)
    assert len(rows) == 6
    assert int(rows[-1]["map_voxels"]) == base.map_summary.voxels
    logged = set(read(out / "recording.rrd"))
    for model in "ab":
        assert f"/wall/series/map_vss_all/{model}/numba" in logged
        assert f"/wall/series/map_vss_all/{model}/numpy" in logged
        assert f"/wall/camera/{model}/labels" in logged
    assert [record.unit.backend for record in result.select(BACKENDS)] == ["numpy", "numpy"]


def test_a_kept_unit_that_gained_a_measure_is_computed_again(root, tmp_path) -> None:
    """What a unit has is part of its key."""
    from semstab.data.measures import Measure, registered

    config, out = load_config(overrides=settings(root, backends=["numpy"])), tmp_path / "run"
    semstab.run(config, out=out, report=False)
    ones = Measure(key="ones", title="Ones", better="higher", of=lambda table: np.ones(len(table.op)), range=(0, 1))
    with registered(ones):
        result = semstab.run(config, out=out, report=False)
        assert result.manifest["units"] == {
            "units": 2, "kept": 0, "computed": 2, "failed": 0, "executor": "in this process"
        }  # fmt: skip
        assert result.runs[0].map_summary[ones] == 1.0


def test_a_backend_of_ones_own_that_breaks_leaves_its_trace(root, tmp_path, monkeypatch) -> None:
    from semstab.backends.numpy_reference import NumpyReference

    def broken(self, frame):
        raise ZeroDivisionError("by\nzero")

    monkeypatch.setattr(NumpyReference, "integrate", broken)
    out = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        semstab.run(load_config(overrides=settings(root, models=["a"])), out=out, report=False)
    log = (out / "failures.log").read_text()
    (message,) = (failure.message for failure in load_result(out).failures)
    assert re.fullmatch(r"ZeroDivisionError: by zero \(test_one_engine\.py, line \d+\)", message)
    assert log.startswith(f"{message}\nTraceback")
    assert [run.unit.backend for run in load_result(out).runs] == ["numba"]
    monkeypatch.undo()
    semstab.run(load_config(overrides=settings(root, models=["a"])), out=out, report=False)
    assert not (out / "failures.log").exists()


def test_large_frames_are_sampled_for_what_is_measured_in_the_image(root, monkeypatch) -> None:
    """Each pixel of the sample is looked up in the whole frame before: fusion need not wait for all of them."""
    monkeypatch.setattr(image_space, "SIDE", 4)  # of frames of 8x6: every second pixel
    (task, *_) = make_plan(load_config(overrides=settings(root))).tasks
    frames = [read_frame(task, index) for index in task.indices]
    meter = image_space.ImageSpaceMeter()
    for frame in frames:
        meter.add(frame, None)
    pairs = [compensated_flicker(a, b.every(2)).flicker_percent for a, b in itertools.pairwise(frames)]
    assert meter.result(1.0).compensated_flicker_percent == pytest.approx(np.mean(pairs))
    assert meter.result(1.0).flicker_percent == 1.0
