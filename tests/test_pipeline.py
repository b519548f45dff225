"""The run through the API: what it computes, what it keeps, and how it goes on after an interruption."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny_scene
import yaml
from posed_config import configure
from rich.console import Console

import semstab
from semstab import Result, metrics
from semstab.configure import load_config
from semstab.core.json_form import to_json
from semstab.data.measures import ENTROPY, SBD, VSS
from semstab.data.results import STAGES, UnitName
from semstab.datasets.files import options
from semstab.engine import Observer, load_result
from semstab.errors import ConfigError, DataError
from semstab.report.terminal import print_answer


@pytest.fixture
def root(tmp_path):
    return tiny_scene.write(tmp_path / "data" / "wall")


def without_times(result: Result) -> list:
    times = ("fuse_ms_per_frame", "stages_ms")
    runs = [
        {key: value for key, value in to_json(run.without_files()).items() if key not in times} for run in result.runs
    ]
    return [runs, to_json(result.agreement)]


class Watching(Observer):
    def __init__(self) -> None:
        self.seen: list[str] = []

    def run_started(self, plan, finished) -> None:
        self.seen.append(f"start {len(plan.tasks)}")
        self.seen += [f"kept {unit.name.model}" for unit in plan.units if unit.identity in finished]

    def frame_fused(self, task, frame, rows) -> None:
        self.seen += [f"{unit.slug} {row.report.frame}" for unit, row in rows.items()]

    def unit_finished(self, planned, content, table, error) -> None:
        self.seen.append(f"{planned.name.slug} {'failed' if table is None else f'done {len(table)}'}")

    def run_finished(self, result) -> None:
        self.seen.append("finished")


def test_ground_truth_of_a_static_wall_is_perfectly_stable(root) -> None:
    """Pixels are as large as voxels here, and the truth is tied to the wall: every voxel keeps one label."""
    (run,) = semstab.run(configure(root, models=["gt"]), report=False).runs
    # 8 columns, and one more a frame; 6 rows
    assert run.map_summary.voxels == (8 + 2) * 6
    assert run.map_summary.points == run.map_summary.observations == 3 * 48
    assert (run.map_summary[VSS], run.map_summary[SBD], run.map_summary[ENTROPY]) == (1.0, 0.0, 0.0)
    # of 10 columns, the outermost two a side are seen less often
    assert [row.voxels for row in run.map_summary.strata] == [2 * 6, 2 * 6, 6 * 6, 0]
    assert run.map_summary.recurrent.share == pytest.approx(0.6)
    # two of eight columns change their class at each step to the right
    assert run.flicker_percent == pytest.approx(25.0)


def test_observers_see_everything_and_every_model_goes_through_every_backend(root) -> None:
    watching = Watching()
    semstab.run(configure(root, models=["a"]), observers=[watching], report=False)
    unit = "wall__a__numpy"
    assert watching.seen == ["start 1", f"{unit} 0", f"{unit} 1", f"{unit} 2", f"{unit} done 60", "finished"]
    result = semstab.run(configure(root, backends=["open3d"]), report=False)
    assert [run.unit.slug for run in result.runs] == [
        "wall__a__open3d", "wall__a__numpy", "wall__b__open3d", "wall__b__numpy"
    ]  # fmt: skip
    assert [row.backends for row in result.agreement] == [("open3d", "numpy")] * 2
    assert result.agrees


def test_the_run_folder_holds_what_the_design_promises(root, tmp_path) -> None:
    out = tmp_path / "run"
    result = semstab.run(configure(root, events=True), out=out, command=["semstab-bench", "--x"], report=False)
    summary = json.loads((out / "summary.json").read_text())
    assert summary == json.loads(json.dumps(summary))
    assert summary["schema"] == 1
    first = summary["runs"][0]
    for key in (
        "scene", "model", "backend", "K", "voxel_size", "frames", "points", "observations", "voxels", "mean_op",
        "vss_all", "sbd_all", "entropy_all", "strata", "recurrent", "classes", "flicker_percent", "fuse_ms_per_frame",
    ):  # fmt: skip
        assert key in first
    assert first["strata"][0]["sbd"] is None
    assert first["strata"][3] == {
        "name": "OP>5", "share": 0.0, "voxels": 0, "vss": None, "sbd": None, "entropy": None, "margin": None,
        "sbd_voxels": 0,
    }  # fmt: skip
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["command"] == ["semstab-bench", "--x"]
    assert set(manifest["inputs"]) == {"wall/a", "wall/b"}
    assert manifest["peak_memory_bytes"] > 1e6
    unit = UnitName("wall", "a", "numpy")
    voxels = pq.read_table(out / "voxels" / f"{unit.slug}.parquet")
    assert {"ix", "iy", "iz", "op", "vss", "sbd", "entropy", "label", "evidence"} <= set(voxels.column_names)
    table = semstab.VoxelTable.load(out / "voxels" / f"{unit.slug}.parquet")
    np.testing.assert_array_equal(voxels.column("vss").to_numpy(), metrics.vss(table))
    assert table.classes == ("wall", "door", "window")
    assert metrics.summarise(table) == result.runs[0].map_summary
    events = semstab.Events.load(out / "events" / f"{unit.slug}.parquet")
    assert metrics.summarise(events.table()) == result.runs[0].map_summary
    rows = (out / "frames" / f"{unit.slug}.csv").read_text().splitlines()
    assert len(rows) == 4
    assert rows[1].split(",")[rows[0].split(",").index("drift")] == ""  # nothing was seen before
    assert not list(out.rglob(".*"))  # no temporary file is left


def test_the_frame_series_ends_where_the_table_is(root, tmp_path) -> None:
    """The map's running means, kept frame by frame, equal those of the final table."""
    for backend in ("numpy", "open3d"):
        out = tmp_path / backend
        (run,) = semstab.run(configure(root, models=["b"], backends=[backend], check=None), out=out, report=False).runs
        text = (out / "frames" / f"{run.unit.slug}.csv").read_text().splitlines()
        last = dict(zip(text[0].split(","), text[-1].split(","), strict=True))
        assert int(last["map_voxels"]) == run.map_summary.voxels
        assert float(last["map_vss_all"]) == pytest.approx(run.map_summary[VSS], abs=1e-12)
        assert float(last["map_entropy_all"]) == pytest.approx(run.map_summary[ENTROPY], abs=1e-12)
        assert float(last["map_recurrent"]) == pytest.approx(run.map_summary.recurrent.share, abs=1e-12)


def test_running_the_resolved_configuration_again_gives_the_same_numbers(root, tmp_path) -> None:
    first = semstab.run(configure(root), out=tmp_path / "one", report=False)
    again = semstab.run(load_config(tmp_path / "one" / "config.yaml"), out=tmp_path / "two", report=False)
    assert without_times(again) == without_times(first)
    assert (tmp_path / "one" / "config.yaml").read_text() == (tmp_path / "two" / "config.yaml").read_text()


def files_of(folder) -> dict:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_another_run_is_replaced_only_where_that_is_asked_for(root, tmp_path, caplog) -> None:
    out, change = tmp_path / "run", "voxel_size: 0.25 there, 0.5 here"
    semstab.run(configure(root), out=out, report=False)
    before = files_of(out)
    with pytest.raises(ConfigError, match=rf"holds another run \({change}\); choose another --out, or --overwrite"):
        semstab.run(configure(root, voxel_size=0.5), out=out, report=False)
    assert files_of(out) == before
    changed = semstab.run(configure(root, voxel_size=0.5), out=out, report=False, overwrite=True)
    assert f"earlier results of other settings ({change}) are replaced" in caplog.text
    assert changed.manifest["units"]["kept"] == 0


def test_another_option_of_a_model_is_another_run(root, tmp_path) -> None:
    """Two runs whose only difference lies deep in the options of the dataset."""

    def settings(seed):
        models = [{"model": "colour-clusters", "options": {"clusters": 2, "seed": seed}}]
        dataset = {"name": "predicted", "options": {"dataset": configure(root).dataset.model_dump(), "models": models}}
        return load_config({"dataset": dataset, "voxel_size": 0.25, "check": None})

    for name in ("depth", "color"):
        (root / name).mkdir(exist_ok=True)
    images = [np.full((6, 8, 3), 40 * k, np.uint8) for k in range(3)]
    for k, image in enumerate(images):
        image[:, ::2] = 255 - 30 * k
        cv2.imwrite(str(root / f"color/{k:04d}.png"), image)
    out = tmp_path / "run"
    semstab.run(settings(0), out=out, report=False)
    with pytest.raises(ConfigError, match=r"dataset\.options\.models\.0\.options\.seed: 0 there, 1 here"):
        semstab.run(settings(1), out=out, report=False)


def test_outputs_of_earlier_results_do_not_stay_beside_new_ones(root, tmp_path) -> None:
    out = tmp_path / "run"
    semstab.run(configure(root), out=out)
    (out / "recording.rrd").write_bytes(b"of the first run")
    outputs = [out / name for name in ("report.html", "recording.rrd", "tables", "figures")]
    semstab.run(configure(root), out=out, report=False)
    assert all(path.exists() for path in outputs[:3])  # nothing was computed: they are of these results
    semstab.run(configure(root, voxel_size=0.5), out=out, report=False, overwrite=True)
    assert not any(path.exists() for path in outputs)


def test_a_run_of_other_data_with_the_same_names_is_not_replaced(root, tmp_path) -> None:
    out, moved, other = tmp_path / "run", tmp_path / "moved" / root.name, tmp_path / "other" / root.name
    semstab.run(configure(root), out=out, report=False)
    shutil.copytree(root, moved)
    again = semstab.run(configure(moved), out=out, report=False)
    assert again.manifest["units"]["computed"] == 0
    shutil.copytree(root, other)
    for file in other.rglob("labels/*/*.png"):
        cv2.imwrite(str(file), np.zeros((6, 8), np.uint8))
    with pytest.raises(ConfigError, match=r"holds another run \(dataset\.options\.root: "):
        semstab.run(configure(other), out=out, report=False)


def test_a_folder_of_something_else_is_refused(root, tmp_path) -> None:
    with pytest.raises(ConfigError, match="is not empty and holds no run"):
        semstab.run(configure(root), out=root, report=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="is a file"):
        semstab.run(configure(root), out=tmp_path / "file", report=False)


def test_a_folder_of_an_earlier_version_is_refused_and_not_touched(root, tmp_path) -> None:
    out, text = tmp_path / "run", "voxel_size: 0.2\n"
    (out / "units").mkdir(parents=True)
    (out / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"run: holds results of an earlier version .*; choose another folder"):
        semstab.run(configure(root), out=out, report=False)
    assert sorted(path.name for path in out.rglob("*")) == ["config.yaml", "units"]
    assert (out / "config.yaml").read_text() == text


def test_a_folder_that_a_killed_start_began_or_whose_unit_is_damaged_is_taken_over(root, tmp_path, caplog) -> None:
    out = tmp_path / "run"
    (out / "units").mkdir(parents=True)
    (out / ".semstab-ab12cd34.yaml").write_text("half")
    semstab.run(configure(root, models=["a"]), out=out, report=False)
    assert not list(out.rglob(".*"))
    out, config = tmp_path / "run", configure(root)
    whole = semstab.run(config, out=out, report=False)
    unit, *_ = sorted((out / "units").iterdir())
    unit.write_text('{"key": ')
    again = semstab.run(config, out=out, report=False)
    assert f"{unit.name}: damaged; the unit is computed again" in caplog.text
    assert again.manifest["units"]["computed"] == 1
    assert without_times(again) == without_times(whole)


def test_an_observer_that_fails_costs_nothing_else_and_is_told_at_the_end(root, tmp_path) -> None:
    class Failing(Observer):
        def frame_fused(self, task, frame, rows) -> None:
            raise OSError(28, "No space left on device", "recording.rrd")

    watching, out = Watching(), tmp_path / "run"
    with pytest.raises(OSError, match="No space left"):
        semstab.run(configure(root, models=["a"]), out=out, observers=[Failing(), watching], report=False)
    assert watching.seen[-1] == "finished"
    assert load_result(out).runs[0].map_summary.voxels == 60


def test_disagreement_is_reported_after_everything_is_written(root, tmp_path, monkeypatch) -> None:
    from semstab.backends.numpy_reference import NumpyReference

    table = NumpyReference.table

    def other(self):
        whole = table(self)
        return dataclasses.replace(whole, evidence=np.roll(whole.evidence, 1, axis=1))

    monkeypatch.setattr(NumpyReference, "table", other)
    result = semstab.run(configure(root, models=["a"], backends=["open3d"]), out=tmp_path / "run", report=False)
    assert not result.agrees
    assert result.agreement[0].differences["evidence"].max > 0.1
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["agreement"][0]["agrees"] is False


PLANTED = {
    "self_sum": lambda table: table.op,
    "frame_entropy_sum": lambda table: table.frame_entropy_sum * np.log(2),
    "first_frame": lambda table: table.first_frame + 1,
    "last_frame": lambda table: table.first_frame,
    "pixels": lambda table: np.minimum(table.pixels, 1),
    "drift_sum": lambda table: np.where(table.drift_sum < 0.1, 0, table.drift_sum),
}
"""A wrong column, from a right table."""


@pytest.mark.parametrize("column", PLANTED)
def test_a_wrong_column_is_named_with_its_voxel(root, tmp_path, monkeypatch, column) -> None:
    """The check of a run compares every column of the voxel table with the reference's."""
    from semstab.backends.numba_hash import NumbaHash

    table, tables = NumbaHash.table, []

    def planted(self):
        right = table(self)
        tables.append((right, dataclasses.replace(right, **{column: PLANTED[column](right)})))
        return tables[-1][1]

    monkeypatch.setattr(NumbaHash, "table", planted)
    monkeypatch.setattr("semstab.backends.numpy_reference.ONE_IN", 1)
    settings = configure(root, models=["a"], backends=["numba"], voxel_size=0.5)
    result = semstab.run(settings, out=tmp_path / "run", report=False)
    (row,) = result.agreement
    assert not result.agrees
    assert row.first is not None
    (right, wrong) = tables[0]
    (q,) = np.flatnonzero((right.index == row.first.voxel).all(axis=1))
    assert row.first.column == column
    assert (row.first.got, row.first.expected) == pytest.approx((getattr(wrong, column)[q], getattr(right, column)[q]))
    assert load_result(tmp_path / "run").agreement == result.agreement
    printed = io.StringIO()
    print_answer(result, Console(file=printed, width=80))
    words = " ".join(printed.getvalue().split())
    assert f"numba and numpy DISAGREE in 1 of 1 maps: wall, a: in numba {row.first}" in words


def test_a_map_whose_evidence_does_not_sum_to_op_is_no_result(root, tmp_path, monkeypatch) -> None:
    from semstab.backends.numba_hash import NumbaHash

    table = NumbaHash.table
    monkeypatch.setattr(NumbaHash, "table", lambda self: dataclasses.replace(right := table(self), op=right.op + 1))
    line = r"wall, a: backend 'numba': the evidence of voxel \(.*\) sums to \d+, and its OP is \d+; add one"
    with pytest.raises(DataError, match=line):
        semstab.run(configure(root, models=["a"], backends=["numba"], check=None), out=tmp_path / "run", report=False)


@pytest.mark.parametrize(("settings", "message"), [
    ({"models": ["c"]}, "wall: no model 'c'; known: a, b, gt"),
    ({"scenes": ["wal"]}, "posed_folder: no scene 'wal'; did you mean 'wall'"),
    ({"frames": {"start": 9}}, "wall: the selection of frames leaves none of its 3"),
    ({"backends": ["open4d"]}, "backend 'open4d' is not known; did you mean 'open3d'"),
    ({"backends": [{"name": "open3d", "options": {"block": 8}}]}, "has no option 'block'; it takes device, bl"),
    (
        {"backends": [{"name": "open3d", "options": {"device": "GPU"}}]},
        "device 'GPU' is not one; use CPU:0 or CUDA:0",
    ),
    ({"taxonomy": "uavid7"}, "no class takes 'wall, door, window' of "),
    ({"taxonomy": "uavid9"}, "taxonomy 'uavid9' is not known; did you mean 'uavid"),
])  # fmt: skip
def test_a_selection_that_does_not_fit_is_refused_before_anything_is_read(root, settings, message) -> None:
    with pytest.raises((ConfigError, DataError), match=message):
        semstab.run(configure(root, **settings), report=False)


def test_pixel_stride_keeps_every_nth_pixel_and_a_taxonomy_file_merges_classes(root, tmp_path) -> None:
    (run,) = semstab.run(configure(root, models=["gt"], pixel_stride=2), report=False).runs
    assert run.map_summary.points == 3 * 4 * 3
    assert run.map_summary[VSS] == 1.0
    path = tmp_path / "two.yaml"
    path.write_text(yaml.safe_dump({"classes": ["wall", {"name": "opening", "members": ["door", "window"]}]}))
    (run,) = semstab.run(configure(root, models=["gt"], taxonomy=str(path)), report=False).runs
    assert (run.taxonomy, run.map_summary.K) == ("two", 2)
    assert [row.name for row in run.map_summary.classes] == ["wall", "opening"]


def test_the_number_of_threads_changes_no_number(root, tmp_path) -> None:
    """And is no part of what a run folder is compared by: what one thread finished, four keep."""
    out = tmp_path / "run"
    one = semstab.run(configure(root, threads=1), out=out, report=False)
    four = semstab.run(configure(root, threads=4), out=tmp_path / "four", report=False)
    assert without_times(one) == without_times(four)
    watching = Watching()
    semstab.run(configure(root, threads=4), out=out, observers=[watching], report=False)
    assert watching.seen == ["start 2", "kept a", "kept b", "finished"]


def test_the_time_of_a_frame_is_told_by_stage(root, tmp_path) -> None:
    (run,) = semstab.run(configure(root, models=["a"]), out=tmp_path / "run", report=False).runs
    assert tuple(run.stages_ms) == STAGES
    assert all(run.stages_ms[stage] >= 0 for stage in ("decode", "wait", "flicker", "logging"))
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["runs"][0]["stages_ms"]["association"] is None  # numpy does not tell its parts apart
    (record,) = semstab.run(configure(root, models=["a"]), out=tmp_path / "run", report=False).runs
    assert record.stages_ms["decode"] == run.stages_ms["decode"]
    header, first, *_ = (tmp_path / "run" / "frames" / "wall__a__numpy.csv").read_text().splitlines()
    row = dict(zip(header.split(","), first.split(","), strict=True))
    assert float(row["decode_ms"]) > 0
    assert row["association_ms"] == ""


def test_colour_is_decoded_only_for_observers_that_want_it(root) -> None:
    (root / "color").mkdir()
    for i in range(tiny_scene.FRAMES):
        cv2.imwrite(str(root / f"color/{i:04d}.png"), np.full((6, 8, 3), i, np.uint8))
    decoded = []

    class Painting(Observer):
        def frame_fused(self, task, frame, rows) -> None:
            decoded.append(frame.color is not None)

    semstab.run(configure(root, models=["a"]), observers=[Painting()], report=False)
    Painting.wants_color = True
    semstab.run(configure(root, models=["a"]), observers=[Painting()], report=False)
    assert decoded == [False] * 3 + [True] * 3


def test_each_image_is_read_once(root, tmp_path, monkeypatch) -> None:
    """The key of a unit comes from the bytes that were decoded, and equals the one that a later start computes."""
    read = []
    monkeypatch.setattr(
        options, "file_digest", lambda path, digest=options.file_digest: (read.append(path.name), digest(path))[1]
    )
    config = configure(root, models=["a"])
    semstab.run(config, out=tmp_path / "run", report=False)
    assert not [name for name in read if name.endswith(".png")]
    watching = Watching()
    semstab.run(config, out=tmp_path / "run", observers=[watching], report=False)
    assert "kept a" in watching.seen
    assert len([name for name in read if name.endswith(".png")]) == 2 * tiny_scene.FRAMES


def test_a_backend_that_is_its_own_check_is_said_to_check_nothing(root, caplog):
    semstab.run(configure(root, backends=["numpy"], check="numpy", models=["a"]), report=False)
    assert "check: numpy is the backend that fuses, so it checks nothing" in caplog.text
    caplog.clear()
    semstab.run(configure(root, backends=["numpy"], models=["a"], check=None, check_geometry=True), report=False)
    assert "check" not in caplog.text
