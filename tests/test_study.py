"""A study through the API: its grid, what is kept and what computed again, and that shared frames change no number."""

from __future__ import annotations

import csv
import dataclasses
import itertools
import json
import shutil
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_study
from tiny_study import Counting, Interrupting, configure, summary

import semstab
from semstab.api import run_study
from semstab.config import BACKENDS, Config
from semstab.configure import resolve
from semstab.core.json_form import to_json
from semstab.data.image_measures import ImageSpace
from semstab.data.records import Variation
from semstab.data.results import UnitName
from semstab.datasets.files.scene import FileScene
from semstab.engine import load_result
from semstab.engine.folder import Folder
from semstab.engine.frame_loop import run_job
from semstab.engine.units import Unit, make_plan
from semstab.engine.work import Start, Work, jobs_of
from semstab.errors import ConfigError, DataError
from semstab.metrics import SelfConsistency, VideoConsistency, compare, compensated_flicker, flicker_percent, summarise
from semstab.task import read


@pytest.fixture
def root(tmp_path):
    return tiny_study.write(tmp_path / "wall")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished study, its result, and what an observer counted."""
    folder, counting = tmp_path_factory.mktemp("finished"), Counting()
    config = configure(tiny_study.write(folder / "wall"))
    result = run_study(config, folder / "out", observers=[counting], command=["semstab-bench", "study"], report=False)
    return folder / "out", result, counting


@pytest.fixture
def out(finished, tmp_path):
    """A copy of its folder."""
    return shutil.copytree(finished[0], tmp_path / "out")


def count(config, out, **options) -> Counting:
    counting = Counting()
    run_study(config, out, observers=[counting], **options, report=False)
    return counting


def test_every_unit_has_the_numbers_of_a_run_with_its_settings(root, tmp_path) -> None:
    """Though its frames were decoded once for all of them."""
    config = resolve(configure(root, shared_taxonomy=None, strata=[1, 3], models=["a"]))
    result = run_study(config, tmp_path / "out", report=False)
    cells = make_plan(config).units
    assert [record.variation for record in result.records] == [cell.variation for cell in cells]
    distinct = {record.key: (cell, record) for cell, record in reversed([*zip(cells, result.records, strict=True)])}
    for cell, record in distinct.values():
        (run,) = semstab.run(cell.config, out=tmp_path / "run" / record.key, report=False).runs
        replaced = {"key": "", "variation": Variation(), "image_space": ImageSpace()}
        expected, found = (to_json(dataclasses.replace(unit.without_files(), **replaced)) for unit in (run, record))
        for name in tiny_study.TIMES:
            expected.pop(name), found.pop(name)
        np.testing.assert_equal(found, expected)
        if record.voxels_file is not None:
            voxels = semstab.VoxelTable.load(tmp_path / "run" / record.key / "voxels" / f"{record.unit.slug}.parquet")
            assert compare(record.table(), voxels, (record.unit, record.unit), tolerance=0).agrees


def test_the_grid_goes_through_every_sweep_scene_and_model(root) -> None:
    cells = make_plan(configure(root, seed=7)).units
    assert [(cell.variation.sweep, cell.variation.value, cell.variation.repeat) for cell in cells[::2]][:7] == [
        ("base", None, 0), ("voxel_size", 0.25, 0), ("voxel_size", 0.5, 0), ("depth_noise", 0.0, 0),
        ("depth_noise", 0.05, 0), ("depth_noise", 0.05, 1), ("frame_count", 5, 0),
    ]  # fmt: skip
    noisy = [cell.config.perturbation for cell in cells if cell.variation.value == 0.05]
    assert [(noise.depth_noise, noise.seed) for noise in noisy] == [(0.05, 7), (0.05, 7), (0.05, 8), (0.05, 8)]
    counted = [cell for cell in cells if cell.variation.sweep == "frame_count"]
    assert [(cell.name.model, len(cell.task.indices)) for cell in counted] == [("a", 5), ("a", 10)]
    assert counted[0].task.indices == [0, 2, 4, 7, 9]
    assert [cell.name.backend for cell in cells if cell.variation.sweep == BACKENDS] == ["numba", "numba"]


def test_a_point_at_the_base_settings_is_the_base_unit(finished) -> None:
    out, result, counting = finished
    of_a = [record for record in result.records if record.unit.model == "a"]
    base = of_a[0]
    twins = [record.variation for record in of_a[1:] if record.key == base.key]
    assert twins == [
        Variation("voxel_size", 0.25), Variation("depth_noise", 0), Variation("frame_count", 5),
        Variation("pixel_stride", 1),
    ]  # fmt: skip
    same = [(record.map_summary, record.stages_ms) for record in of_a if record.key == base.key]
    assert same == [(base.map_summary, base.stages_ms)] * 5
    # base, voxel 0.5, two noisy ones, stride 2 and backend numba for each model; ten frames for a
    assert counting.units == len(counting.computed) == 2 * 6 + 1
    assert len(list((out / "units").iterdir())) == 13
    assert {record.voxels_file is None for record in of_a if record.variation.sweep in ("base", "backends")} == {False}
    assert {record.voxels_file for record in of_a if record.variation.sweep not in ("base", "backends")} == {None}


@pytest.fixture
def decoded(monkeypatch) -> list[tuple[int, str]]:
    """Frames and label sources as they are decoded."""
    pairs: list[tuple[int, str]] = []
    frame = FileScene.frame

    def counted(self, index, model, *, color=True):
        pairs.append((index, model))
        return frame(self, index, model, color=color)

    monkeypatch.setattr(FileScene, "frame", counted)
    return pairs


def test_frames_are_decoded_once_for_all_units_of_a_model(root, tmp_path, decoded) -> None:
    run_study(configure(root), tmp_path / "out", report=False)
    predicted = [pair for pair in decoded if pair[1] != "gt"]
    # a's ten frames for the sweep of frame_count, b's five
    once = Counter([(i, "a") for i in range(10)] + [(i, "b") for i in (0, 2, 4, 7, 9)])
    assert set(predicted) == set(once)
    again = Counter(predicted) - once
    assert max(again.values(), default=0) == 1  # frames that see the worst places, for their pictures in the report
    assert sum(again.values()) <= 2 * 4
    assert len(decoded) - len(predicted) == 10 + 5  # the truth of the same frames, once


def test_maps_that_exceed_the_memory_bound_are_put_off_and_the_numbers_are_the_same(
    root, tmp_path, finished, decoded, monkeypatch
) -> None:
    monkeypatch.setattr("semstab.engine.memory_budget.resident_bytes", lambda: 0)  # what is estimated counts alone
    run_study(configure(root, memory_gb=0.0002), tmp_path / "tight", report=False)
    assert len(decoded) > 25
    assert summary(tmp_path / "tight") == summary(finished[0])


def test_a_unit_that_would_not_fit_into_memory_fails_before_it_is_fused(root, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("semstab.engine.memory_budget.resident_bytes", lambda: 0)  # what is estimated counts alone
    small = {"memory_gb": 0.00003, "tile_size": "off"}
    config = configure(root, backends=["numpy"], sweeps={"pixel_stride": [8]}, **small)
    result = run_study(config, tmp_path / "out", report=False)
    assert {failure.variation.sweep for failure in result.failures} == {"base"}
    assert "would take" in result.failures[0].message
    assert [record.variation.sweep for record in result.records] == ["pixel_stride"] * 2


def test_an_interrupted_study_goes_on_where_it_was(root, tmp_path, finished) -> None:
    config, out = configure(root), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_study(config, out, observers=[Interrupting(4)], report=False)
    assert not (out / "summary.json").exists()
    resumed = count(config, out)
    assert (resumed.kept, len(resumed.computed)) == (4, 13 - 4)
    assert count(config, out).computed == []
    assert summary(out) == summary(finished[0])
    assert not list(out.rglob(".*"))


def test_a_changed_setting_computes_only_what_it_touches(root, out) -> None:
    finer = tiny_study.SWEEPS | {"voxel_size": [0.125, 0.25, 0.5]}
    assert count(configure(root, sweeps=finer), out).computed == [
        "wall__a__numpy voxel_size 0.125", "wall__b__numpy voxel_size 0.125"
    ]  # fmt: skip
    more = tiny_study.SWEEPS | {"depth_noise": {"values": [0, 0.05], "repeats": 3}}
    assert len(count(configure(root, sweeps=more), out).computed) == 2
    # tolerance and name change no unit, and fewer sweeps need none
    assert count(configure(root, name="other", tolerance=1e-6, sweeps={}), out).computed == []
    # other strata change all of them
    few = {"sweeps": {"pixel_stride": [2]}, "backends": ["numpy"]}
    assert count(configure(root, **few), out).computed == []
    assert len(count(configure(root, **few, strata=[1, 4]), out).computed) == 4


def test_what_was_a_sweep_becomes_the_base_with_all_that_a_base_has(root, out, tmp_path) -> None:
    coarse = configure(root, voxel_size=0.5, sweeps={}, backends=["numpy"])
    assert len(count(coarse, out).computed) == 2  # now with its voxels and in image space
    run_study(coarse, tmp_path / "fresh", report=False)
    assert summary(out) == summary(tmp_path / "fresh")
    # the voxels of the first base were overwritten: it is computed again, its sweeps are not
    assert sorted(count(configure(root), out).computed) == ["wall__a__numpy base None", "wall__b__numpy base None"]


def test_a_changed_input_computes_what_reads_it(root, out) -> None:
    config = configure(root)
    cv2.imwrite(str(root / "labels/a/0003.png"), np.zeros((6, 8), np.uint8))  # not among the base frames
    assert count(config, out).computed == ["wall__a__numpy frame_count 10"]
    cv2.imwrite(str(root / "labels/b/0002.png"), np.zeros((6, 8), np.uint8))
    assert len(count(config, out).computed) == 6


def test_every_file_that_was_lost_or_damaged_is_computed_again_and_told(root, tmp_path, caplog) -> None:
    out = tmp_path / "out"
    config = configure(root, models=["a"], sweeps={}, backends=["numpy"], events=True, statistics=True)
    run_study(config, out, report=False)
    missing, changed = (Path.unlink, "is missing"), (flip, "has changed since it was written")
    folders = ("voxels", "truth", "events", "observations", "frames", "sums", "overview")
    for name, (damage, said) in [("voxels", missing), *((name, changed) for name in folders)]:
        file = next((out / name).glob("wall__*"))
        before = file.read_bytes()
        damage(file)
        caplog.clear()
        assert len(count(config, out).computed) == 1, file
        assert f"{file}: {said}; its unit is computed again" in caplog.text
        assert name in ("frames", "overview") or file.read_bytes() == before  # times; a ZIP's dates
    assert count(config, out).computed == []


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def test_a_second_backend_that_is_computed_again_keeps_its_series(root, tmp_path) -> None:
    """Its flicker without camera motion is that of the first one, which is not computed again."""
    out, config = tmp_path / "out", configure(root, models=["a"], sweeps={}, backends=["numpy", "numba"])
    run_study(config, out, report=False)
    file = out / "frames/wall__a__numba.csv"

    def column() -> list[str]:
        with file.open(newline="") as lines:
            return [row["compensated_flicker_percent"] for row in csv.DictReader(lines)]

    before = column()
    assert any(before)
    file.unlink()
    assert len(count(config, out).computed) == 1
    assert column() == before


def test_a_failing_unit_is_reported_and_the_others_finish(root, tmp_path) -> None:
    (root / "depth/0003.png").write_bytes(b"no image")  # read by the sweep of frame_count alone
    (root / "labels/b/0002.png").write_bytes(b"no image")  # among the base frames of b
    counting, out = Counting(), tmp_path / "out"
    result = run_study(configure(root), out, observers=[counting], report=False)
    assert len(counting.failed) == 1 + 6
    assert len(counting.computed) == 6
    assert {failure.unit.model for failure in result.failures} == {"a", "b"}
    (of_a,) = [failure for failure in result.failures if failure.unit.model == "a"]
    assert of_a.variation == Variation("frame_count", 10)
    assert "depth/0003.png: not a PNG image" in of_a.message
    assert all("labels/b/0002.png" in failure.message for failure in result.failures if failure is not of_a)
    assert load_result(out).failures == result.failures
    # mended, it goes on
    shutil.copy(root / "depth/0002.png", root / "depth/0003.png")
    shutil.copy(root / "labels/b/0001.png", root / "labels/b/0002.png")
    assert len(count(configure(root), out).computed) == 7


def test_the_result_is_read_back_from_its_folder(finished, out, tmp_path) -> None:
    folder, result, _ = finished
    again = load_result(folder)
    assert json.dumps(to_json(again)) == json.dumps(to_json(result))
    assert again.manifest["command"] == ["semstab-bench", "study"]
    assert again.manifest["units"] == {
        "units": 13, "kept": 0, "computed": 13, "failed": 0, "executor": "in this process"
    }  # fmt: skip
    assert set(again.manifest["inputs"]) == {"wall/a", "wall/b"}
    assert again.up == {"wall": (0.0, -1.0, 0.0)}
    assert summarise(again.select()[0].table()) == again.select()[0].map_summary
    assert (again.scenes, again.models) == (("wall",), ("a", "b"))
    with pytest.raises(DataError, match=r"summary\.json: cannot be read"):
        load_result(tmp_path)
    content = json.loads((out / "summary.json").read_text())
    (out / "summary.json").write_text(json.dumps({**content, "schema": 2}))
    with pytest.raises(DataError, match=r"summary\.json: is not a summary of this version of semstab; run it again"):
        load_result(out)
    (out / "summary.json").write_text('{"name": "x"}')
    with pytest.raises(DataError, match=r"summary\.json: is not a summary of this version"):
        load_result(out)


def test_stability_in_image_space_is_that_of_the_base_frames(root, tmp_path) -> None:
    config = resolve(configure(root, frames={}, sweeps={"pixel_stride": [2]}, backends=["numpy"]))
    result = run_study(config, tmp_path / "out", report=False)
    (task, _) = [cell.task for cell in make_plan(config).units][:2]
    frames = [read(task, i) for i in range(10)]
    truth = [read(dataclasses.replace(task, model="gt"), i) for i in range(10)]
    pairs = list(itertools.pairwise(frames))
    compensated = [compensated_flicker(*pair) for pair in pairs]
    self_vc8, vc8 = SelfConsistency(8), VideoConsistency(8)
    for frame, true in zip(frames, truth, strict=True):
        self_vc8.add(frame.predicted, frame.valid)
        vc8.add(frame.predicted, frame.valid & true.valid, true.predicted)
    found = result.select()[0].image_space
    assert found.flicker_percent == pytest.approx(np.mean([flicker_percent(*pair) for pair in pairs]))
    assert found.compensated_flicker_percent == pytest.approx(np.mean([row.flicker_percent for row in compensated]))
    assert found.compensated_share == pytest.approx(7 / 8)  # a column of eight leaves the view with each frame
    assert (found.self_vc8, found.vc8) == (self_vc8.value, vc8.value)
    assert np.isnan([found.self_vc16, found.vc16]).all()  # ten frames have no clip of 16
    swept = result.select("pixel_stride")[0].image_space
    assert np.isnan(list(dataclasses.astuple(swept))).all()


def test_ground_truth_is_consistent_and_frames_without_it_are_in_no_clip(root, tmp_path) -> None:
    config = configure(root, frames={}, models=["gt", "a"], sweeps={}, backends=["numpy"])
    gt, a = run_study(config, tmp_path / "out", report=False).select()
    assert np.isnan(gt.image_space.vc8)  # nothing to compare it with
    assert gt.image_space.compensated_flicker_percent == 0
    assert a.image_space.compensated_flicker_percent > 0
    (root / "labels/gt/0005.png").unlink()
    config = configure(root, frames={}, models=["a"], sweeps={}, backends=["numpy"])
    (a,) = run_study(config, tmp_path / "out", report=False).select()
    assert np.isnan(a.image_space.vc8)
    assert a.image_space.self_vc8 >= 0


def test_statistics_come_with_every_unit_and_all_of_them_where_they_are_wanted(root, tmp_path) -> None:
    config = configure(root, sweeps={"voxel_size": [0.5]}, backends=["numpy"], models=["a", "gt"])
    before = run_study(config, tmp_path / "out", report=False).records
    wanted = configure(root, sweeps={"voxel_size": [0.5]}, backends=["numpy"], models=["a", "gt"], statistics=True)
    assert len(count(wanted, tmp_path / "out").computed) == 4
    result = run_study(wanted, tmp_path / "out", report=False)
    settings = make_plan(resolve(wanted)).units[0].config.model_copy(update={"events": True})
    run = semstab.run(settings, out=tmp_path / "run", report=False).runs[0]
    events = semstab.Events.load(tmp_path / "run" / "events" / f"{run.unit.slug}.parquet")
    base, gt, *swept = result.records
    assert base.statistics.agreement.psa_op2.value == pytest.approx(psa_by_definition(events))
    assert base.statistics.drift.flips is not None  # the events were kept
    assert base.statistics.correctness is not None  # against the truth, which no map of the truth itself has
    assert gt.statistics.correctness is None
    assert all(record.statistics.voxel_size == 0.5 for record in swept)
    one, other = before[0].statistics.agreement, base.statistics.agreement
    assert (one.kappa_op2, one.within, one.classes) == (other.kappa_op2, other.within, other.classes)
    assert one.psa_op2.value == pytest.approx(other.psa_op2.value)  # whose interval needs the log
    assert before[0].statistics.drift.flips is None
    right = before[0].statistics.correctness.miou_op2.value, base.statistics.correctness.miou_op2.value
    assert right[0] == pytest.approx(right[1])  # whose interval needs the log
    again = run_study(config, tmp_path / "out", report=False).records
    assert to_json([record.statistics for record in again]) == to_json([record.statistics for record in before])


def psa_by_definition(events) -> float:
    """The mean over voxels of how often two of its observations agree."""
    voxels = [events.evidence[events.voxel == v] for v in range(len(events.ix))]
    pairs = [[float(a @ b) for a, b in itertools.combinations(vectors, 2)] for vectors in voxels if len(vectors) > 1]
    return float(np.mean([np.mean(products) for products in pairs]))


def test_units_fused_by_another_backend_are_checked_unless_they_differ_by_design(root, tmp_path) -> None:
    result = run_study(
        configure(root, sweeps={}, backends=["numpy", "numba", "open3d-projective"]), tmp_path / "out", report=False
    )
    assert [row.backends for row in result.agreement] == [("numpy", "numba")] * 2
    assert all(row.agrees for row in result.agreement)
    assert [record.unit.backend for record in result.select(BACKENDS)] == ["numba"] * 2 + ["open3d-projective"] * 2
    unchecked = configure(root, sweeps={}, backends=["numpy", {"name": "numba", "check": False}])
    assert run_study(unchecked, tmp_path / "out", report=False).agreement == ()
    assert [run.unit.backend for run in result.runs][:3] == ["numpy", "numba", "open3d-projective"]


def test_models_are_compared_in_the_shared_taxonomy(root, tmp_path) -> None:
    path = tmp_path / "two.yaml"
    path.write_text("classes: [wall, {name: opening, members: [door, window]}]\n")
    result = run_study(
        configure(root, sweeps={}, backends=["numpy"], shared_taxonomy=str(path)), tmp_path / "out", report=False
    )
    assert [record.map_summary.K for record in result.select("shared_taxonomy")] == [2, 2]
    assert [record.taxonomy for record in result.select("shared_taxonomy")] == ["two", "two"]
    # the file's content counts, not its name
    path.rename(tmp_path / "zwei.yaml")
    renamed = configure(root, sweeps={}, backends=["numpy"], shared_taxonomy=str(tmp_path / "zwei.yaml"))
    assert len(count(renamed, tmp_path / "out").computed) == 2  # the name stands in the summary
    (tmp_path / "zwei.yaml").write_text("classes: [{name: wall, members: [door]}, window]\nname: zwei\n")
    assert len(count(renamed, tmp_path / "out").computed) == 2


def test_a_scene_can_have_frames_of_its_own(tmp_path) -> None:
    for name in ("long", "short"):
        tiny_study.write(tmp_path / "data" / name, models=("a",))
    frames = {"long": {"stop": 8, "stride": 4}}
    sweeps = {"frame_count": {"values": [2, 8], "scenes": ["long"]}}
    config = configure(tmp_path / "data", frames={}, scene_frames=frames, sweeps=sweeps, backends=["numpy"])
    cells = make_plan(config).units
    assert [[*cell.task.indices] for cell in cells] == [[0, 4], [*range(10)], [0, 7], [*range(8)]]
    listed = configure(
        tmp_path / "data", frames={"list": [1, 2, 5, 6, 9]}, sweeps={"frame_count": [3]}, backends=["numpy"]
    )
    assert [[*cell.task.indices] for cell in make_plan(listed).units][2:] == [[1, 5, 9]] * 2


@pytest.mark.parametrize(("settings", "message"), [
    ({"scene_frames": {"hall": {}}}, "scene_frames: 'hall' is not among wall"),
    ({"sweeps": {"voxel_size": {"values": [1], "scenes": ["x"]}}}, "voxel_size.scenes: 'x' is not among wall"),
    ({"backends": ["numpy", {"name": "numba", "models": ["x"]}]}, "backends.models: 'x' is not among a, b"),
    ({"sweeps": {"frame_count": [11]}}, "frame_count: wall has 10 frames over the extent of the base ones, not 11"),
    ({"backends": [{"name": "numpy", "options": {"x": 1}}]}, "backend 'numpy' has no option 'x'"),
    ({"shared_taxonomy": "uavid3"}, "no class takes 'wall, door, window'"), ({"models": ["c"]}, "no model 'c'"),
])  # fmt: skip
def test_what_does_not_fit_together_is_refused_before_anything_is_read(root, tmp_path, settings, message) -> None:
    with pytest.raises((ConfigError, DataError), match=message):
        run_study(configure(root, **settings), tmp_path / "out", report=False)
    assert not (tmp_path / "out").exists()


def test_a_worker_without_the_folder_sends_the_voxels_back_and_jobs_fail_as_a_whole(root, tmp_path) -> None:
    config = resolve(configure(root, sweeps={}, backends=["numpy"], models=["a"]))
    plan = make_plan(config)
    (cell,) = plan.units
    elsewhere = tmp_path / "elsewhere"
    (done,) = run_job((Work.from_unit(cell, Start("start", elsewhere)),))
    assert not elsewhere.exists()
    folder = Folder(tmp_path / "out", plan)
    folder.save(done)
    folder.close()
    counting = Counting()
    result = run_study(config, tmp_path / "out", observers=[counting], report=False)
    assert counting.kept == 1
    assert summarise(result.select()[0].table()) == result.select()[0].map_summary
    config = resolve(configure(root, sweeps={"voxel_size": [0.5]}, backends=["numpy"], models=["a"]))
    start = Start("start", tmp_path)
    units = [dataclasses.replace(unit, name=UnitName("hall", "a", "numpy")) for unit in make_plan(config).units]
    errors = [work.error for work in run_job(tuple(Work.from_unit(unit, start) for unit in units))]
    assert errors == [errors[0]] * 2
    assert "scene 'hall' is not there" in errors[0]


def works(model: str, identities: str, stored: str = "") -> list[Work]:
    name, start = UnitName("s", model, "numpy"), Start("", Path())
    units = [Unit(name, Variation(), Config(), None, identity, stored=identity in stored) for identity in identities]
    return [Work(start, unit, range(1)) for unit in units]


def names(job: tuple[Work, ...]) -> str:
    return "".join(work.unit.identity for work in job)


def test_jobs_are_halved_until_every_worker_has_one_and_watched_works_stay_in_one() -> None:
    both = [*works("s", "123456"), *works("t", "78")]
    assert [names(job) for job in jobs_of(both, 2)] == ["123456", "78"]
    assert [names(job) for job in jobs_of(both, 4)] == ["1", "23", "456", "78"]
    assert [len(job) for job in jobs_of(both, 100)] == [1] * 8
    assert "".join(names(job) for job in jobs_of(both, 5)) == "12345678"
    assert jobs_of([], 3) == []
    # Observers see all backends of a frame together
    assert [names(job) for job in jobs_of(works("a", "123456", stored="15"), 9)] == ["15", "2", "3", "4", "6"]
