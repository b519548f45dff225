"""The rerun recording, read back from its file and held against the run's own folder."""

from __future__ import annotations

import csv
import functools
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
import tiny_scene
from posed_config import configure

import semstab
from semstab import Frame, Intrinsics, LabelSpace, Result, VoxelTable, backends, metrics
from semstab.config import Config
from semstab.data.measures import measures
from semstab.data.records import Record, Variation
from semstab.data.results import UnitName
from semstab.engine import Observer
from semstab.engine.series import FrameRow
from semstab.engine.units import Plan, Unit, make_plan
from semstab.errors import ConfigError, DataError
from semstab.recording import (
    SERIES,
    Recording,
    Target,
    color_modes,
    drift,
    lacks_pictures,
    record_finished,
    timeline,
    voxel_maps,
)
from semstab.recording.layout import Legend, SceneBounds, direction, fit
from semstab.recording.timeline import Clock, log_file
from semstab.report.ranking import order_of_models
from semstab.report.terminal import row_of
from semstab.task import Task

NANOSECONDS = 1_000_000_000


def config_of(root: Path, backend: str = "numpy") -> Config:
    return configure(root, backends=[backend])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with a recording: two models on a wall that three frames see."""
    folder = tmp_path_factory.mktemp("recording")
    root = tiny_scene.write(folder / "data" / "wall")
    out = folder / "run"
    semstab.run(config_of(root), out=out, observers=[Recording(out / "recording.rrd")], report=False)
    return out


def read(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows by entity path, in the order in which they were logged; a file may hold its chunks in another."""
    return _read(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=8)
def _read(path: Path, _: int) -> dict[str, list[dict[str, Any]]]:
    reader = rr.chunk.RrdReader(path)
    (store,) = reader.recordings()
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in reader.stream(store=store):
        rows.setdefault(chunk.entity_path, []).extend(rows_of(chunk))
    return {path: sorted(of_path, key=lambda row: row["rerun.controls.RowId"]) for path, of_path in rows.items()}


@functools.lru_cache(maxsize=2)
def read_blueprints(path: Path) -> list[list[dict[str, Any]]]:
    """The rows of each blueprint, in no particular order."""
    reader = rr.chunk.RrdReader(path)
    return [
        [row | {"rerun.entity": chunk.entity_path} for chunk in reader.stream(store=store) for row in rows_of(chunk)]
        for store in reader.blueprints()
    ]


def rows_of(chunk: Any) -> list[dict[str, Any]]:
    """The rows of a chunk without dates: no Python type holds their nanoseconds."""
    batch = chunk.to_record_batch()
    return batch.drop_columns([field.name for field in batch.schema if str(field.type) == "timestamp[ns]"]).to_pylist()


def series(rows: dict[str, list[dict[str, Any]]], path: str) -> dict[int, float]:
    """Value by frame."""
    found = [row for row in rows.get(path, []) if "Scalars:scalars" in row]
    assert len({row["frame"] for row in found}) == len(found)
    return {row["frame"]: row["Scalars:scalars"][0] for row in found}


def grid(rows: dict[str, list[dict[str, Any]]], path: str) -> dict[str, Any]:
    """What a map shows at last, voxels sorted: indices, and each of `color_modes` by the name of its view."""
    chunks = []
    for at in sorted(at for at in rows if at.startswith(f"{path}/")):
        latest: dict[str, Any] = {}
        for row in sorted(rows[at], key=lambda row: (row["frame"], row["rerun.controls.RowId"])):
            if "Clear:is_recursive" in row:
                latest = {}
            latest |= {name: value for name, value in row.items() if value is not None}
        if "VoxelGridMap:voxel_indices" in latest:
            chunks.append(latest)
    index = [tuple(cell) for chunk in chunks for cell in chunk["VoxelGridMap:voxel_indices"]]
    order = sorted(range(len(index)), key=index.__getitem__)
    assert len(set(index)) == len(index)
    components = {name: f"{name}:values" for name, mode in color_modes().items() if mode.range}
    components |= {"class": "VoxelGridMap:colors", "category": "category:colors"}
    found: dict[str, Any] = {"voxel_indices": [index[i] for i in order]}
    for name, component in components.items():
        whole = [value for chunk in chunks for value in chunk[component]]
        assert len(whole) == len(index)
        found[name] = [whole[i] for i in order]
    return found | {
        "voxel_size": chunks[0]["VoxelGridMap:voxel_size"],
        "frame": max(chunk["frame"] for chunk in chunks),
    }


def notes(rows: dict[str, list[dict[str, Any]]], scene: str = "wall") -> list[str]:
    return [row["TextLog:text"][0] for row in rows[f"/{scene}/log"]]


def verify(path: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    done = subprocess.run([rerun, "rrd", "verify", path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("start", [0.0, 1.4e9])
def test_numbers_that_are_sent_together_have_the_times_of_their_pictures(tmp_path, start) -> None:
    stamps = (start + np.random.default_rng(0).uniform(0, 1e4, 200)).tolist()
    stream, clock, frames = rr.RecordingStream("times"), Clock(), [*range(len(stamps))]
    stream.save(tmp_path / "times.rrd")
    for frame, stamp in zip(frames, stamps, strict=True):
        clock.set(stream, frame, stamp)
        stream.log("/alone", rr.Scalars(0.0))
    stream.send_columns("/together", clock.columns(frames, stamps), rr.Scalars.columns(scalars=stamps))
    stream.flush()
    stream.disconnect()
    reader = rr.chunk.RrdReader(tmp_path / "times.rrd")
    times: dict[str, list[int]] = {"/alone": [], "/together": []}
    for chunk in reader.stream(store=reader.recordings()[0]):
        if chunk.entity_path in times:
            times[chunk.entity_path] += chunk.to_record_batch().column("time").cast("int64").to_pylist()
    assert len(times["/alone"]) == len(stamps)
    assert sorted(times["/alone"]) == sorted(times["/together"])


@pytest.mark.parametrize("model", ["a", "b"])
def test_every_series_is_a_column_of_the_frame_csv(run, model) -> None:
    rows = read(run / "recording.rrd")
    with (run / "frames" / f"wall__{model}__numpy.csv").open() as file:
        frames = list(csv.DictReader(file))
    for row in frames:
        row["updated_voxels"] = str(int(row["voxels"]) - int(row["new_voxels"]))
    for column in SERIES:
        backend = "" if SERIES[column].of_model else "/numpy"
        defined = {int(row["frame"]): float(row[column]) for row in frames if row[column]}
        assert series(rows, f"/wall/series/{column}/{model}{backend}") == defined
        in_all_but = {"drift": 1, "flicker_percent": 1, "compensated_flicker_percent": 1}
        in_all_but |= {"association_ms": 3, "update_ms": 3}  # numpy tells no parts apart
        assert len(defined) == 3 - in_all_but.get(column, 0)


def test_lines_are_named_and_have_distinct_colours(run) -> None:
    rows = read(run / "recording.rrd")
    paths = ["map_vss_all/a/numpy", "map_vss_all/b/numpy", "flicker_percent/b"]
    styles = [next(row for row in rows[f"/wall/series/{path}"] if "SeriesLines:names" in row) for path in paths]
    assert [style["SeriesLines:names"] for style in styles] == [["a, numpy"], ["b, numpy"], ["b"]]
    colors = [style["SeriesLines:colors"] for style in styles]
    assert colors[0] != colors[1] == colors[2]


@pytest.mark.parametrize("model", ["a", "b"])
def test_the_final_voxels_are_those_of_the_run(run, model) -> None:
    rows = read(run / "recording.rrd")
    table = VoxelTable.load(run / "voxels" / f"wall__{model}__numpy.parquet")
    voxels = grid(rows, f"/wall/map/{model}/numpy")
    assert voxels["frame"] == 2
    np.testing.assert_array_equal(voxels["voxel_indices"], table.index)
    np.testing.assert_allclose(voxels["voxel_size"], [[0.25] * 3])
    for measure in measures():  # SBD of a voxel seen once is NaN
        np.testing.assert_allclose(voxels[measure.key], measure.of(table), rtol=1e-6)
    np.testing.assert_array_equal(voxels["op"], table.op)
    expected = voxel_maps.packed(metrics.CATEGORY_COLORS)[metrics.categories(table)]
    np.testing.assert_array_equal(voxels["category"], expected)


def test_a_map_of_one_class_has_no_categories(tmp_path) -> None:
    file, root = tmp_path / "run.rrd", tiny_scene.write(tmp_path / "data" / "wall", frames=60)
    for labels in (root / "labels/b").iterdir():
        cv2.imwrite(str(labels), np.zeros((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.uint8))
    config = configure(root, backends=["numpy"], statistics=True)
    result = semstab.run(config, out=tmp_path / "run", observers=[Recording(file)], report=False)
    assert result.record(model="b").statistics.verdict.level == "uninformative"
    colors = {model: {*grid(read(file), f"/wall/map/{model}/numpy")["category"]} for model in "ab"}
    assert colors["b"] == {*voxel_maps.packed([metrics.NOT_ASSESSED]).tolist()}
    assert colors["a"] <= {*voxel_maps.packed(metrics.CATEGORY_COLORS).tolist()}
    titles = [row.get("ViewBlueprint:display_name") for rows in read_blueprints(file) for row in rows]
    assert ["b: not assessed (uninformative)"] in titles
    assert ["a: not assessed (uninformative)"] not in titles
    assert any("uninformative: all of the observations of b are wall" in note for note in notes(read(file)))


def test_voxels_have_the_colours_of_the_legend(run) -> None:
    """Those with the most voxels come first in the end."""
    rows = read(run / "recording.rrd")
    assert rows["/wall/legend/names"][0]["Points2D:labels"] == ["wall", "door", "window"]
    final, names = (rows[entity][-1] for entity in ("/wall/legend", "/wall/legend/names"))
    colors = dict(zip(names["Points2D:labels"], final["Points2D:colors"], strict=True))
    labels = {unit: metrics.dominant(VoxelTable.load(run / "voxels" / f"wall__{unit}__numpy.parquet")) for unit in "ab"}
    used = np.bincount(np.concatenate([*labels.values()]), minlength=3)
    assert names["Points2D:labels"] == [("wall", "door", "window")[k] for k in np.argsort(-used, kind="stable")]
    drawn = grid(rows, "/wall/map/a/numpy")["class"]
    assert list(drawn) == [colors[("wall", "door", "window")[k]] for k in labels["a"]]


def test_the_legend_of_many_classes_is_two_lines_and_a_tab() -> None:
    classes = LabelSpace("many", tuple(f"class number {k}" for k in range(150)))
    legend = Legend([classes])
    assert legend.height(2) < legend.height()
    assert 2 < legend.room < 150
    legend.see(classes, np.array([7, 7, 3]))
    assert [name for name, _ in legend.entries[:3]] == ["class number 7", "class number 3", "class number 0"]


def test_the_blueprint_shows_every_series_and_every_model(run) -> None:
    maps = {f"{model}: {title}" for model in "ab" for title in (mode.title for mode in color_modes().values())}
    pictures = {f"{model}: {what}" for model in "ab" for what in ("labels", *drift.PICTURES.values())}
    for views in read_blueprints(run / "recording.rrd"):
        names = {row["ViewBlueprint:display_name"][0] for row in views if "ViewBlueprint:display_name" in row}
        others = {"Classes", "Notes", "Depth", "Top contributing frames", "Verdict"}
        assert names >= {*(one_series.plot for one_series in SERIES.values()), *maps, *pictures, *others}


def test_the_viewer_opens_on_the_stability_categories(run) -> None:
    for rows in read_blueprints(run / "recording.rrd"):
        containers = {row["rerun.entity"]: row for row in rows if "ContainerBlueprint:display_name" in row}
        (category,) = (
            at
            for at, row in containers.items()
            if row["ContainerBlueprint:display_name"] == [color_modes()["category"].tab]
        )
        opened = [row["ContainerBlueprint:active_tab"] for row in rows if row.get("ContainerBlueprint:active_tab")]
        assert [category.removeprefix("/")] in [[at.removeprefix("/") for at in tab] for tab in opened]


def test_the_verdict_is_that_of_the_terminal(run) -> None:
    (*_, last) = (row["TextDocument:text"][0] for row in read(run / "recording.rrd")["/wall/verdict"])
    result = semstab.load(run).result
    rows = [row_of(record) for record in result.select()]
    assert [line for line in last.splitlines() if line.startswith(("| a ", "| b "))] == [
        f"| {' | '.join(row[:3])} |" for row in rows
    ]
    assert last.startswith("".join(f"{line}\n" for line in order_of_models(result)))


def test_numbered_voxels_are_in_the_tab_that_explains_them_alone(run) -> None:
    for rows in read_blueprints(run / "recording.rrd"):
        queries = [content for row in rows for content in row.get("ViewContents:query") or []]
        for model in "ab":
            assert sum(content.endswith(f"/flips_at/{model}") for content in queries) == 1
            assert sum(content.endswith(f"/{model}/flips") for content in queries) == 1


def test_the_numbers_of_voxels_are_shown_beside_them_at_all_times(run) -> None:
    numbered = {path: rows for path, rows in read(run / "recording.rrd").items() if "/flips_at/" in path}
    assert len(numbered) == 2
    for (row,) in numbered.values():
        assert row["Points3D:labels"] == [str(k + 1) for k in range(len(row["Points3D:positions"]))]
        assert row["Points3D:show_labels"] == [True]
        assert all(":" in column or column.startswith("rerun.") for column in row), row  # no time


def test_every_map_is_seen_from_above(run) -> None:
    blueprints = read_blueprints(run / "recording.rrd")  # one when the run starts, one when a model is fused
    eyes = [row for rows in blueprints for row in rows if "EyeControls3D:look_target" in row]
    assert len(blueprints) == 3
    assert len(eyes) == 2 * 2 * (len(color_modes()) + 1)  # and the map beside the flips
    table = semstab.VoxelTable.load(run / "voxels" / "wall__a__numpy.parquet")
    for eye in eyes:
        assert eye["EyeControls3D:position"][0][1] < table.centers[:, 1].min()  # from above: up is -y


def test_each_view_of_a_map_shows_its_measure(run) -> None:
    """Of every chunk that there is, and in its own colours; of itself a grid shows the dominant class."""
    chunks = [at for at in read(run / "recording.rrd") if at.startswith("/wall/map/a/numpy/")]
    assert chunks
    for rows in read_blueprints(run / "recording.rrd"):
        for name, mode in color_modes().items():
            (view,) = (r["rerun.entity"] for r in rows if r.get("ViewBlueprint:display_name") == [f"a: {mode.title}"])
            for chunk in chunks:
                at = f"{view}/ViewContents/overrides{chunk}/visualizers/"
                instructions = [row for row in rows if row["rerun.entity"].startswith(at)]
                mappings = [
                    component
                    for row in instructions
                    for component in row.get("VisualizerInstruction:component_map") or []
                ]
                sources = {mapping["target"]: mapping["source_component"] for mapping in mappings}
                if name == "class":
                    assert not instructions
                elif name == "category":
                    assert sources == {"VoxelGridMap:colors": "category:colors"}
                else:
                    assert sources == {"VoxelGridMap:values": f"{name}:values", "VoxelGridMap:colors": None}
                    (defaults,) = (row for row in rows if row["rerun.entity"] == f"{view}/defaults")
                    np.testing.assert_allclose(defaults["VoxelGridMap:value_range"], [mode.range], rtol=1e-6)


@pytest.mark.parametrize("up", [None, np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 2.0])])
@pytest.mark.parametrize("aspect", [0.8, 2.0, 4.7])
def test_a_map_and_its_cameras_fill_the_view(up, aspect) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(4000, 3)) * (20, 2, 50) + (300, -40, 7)
    cameras = np.tile(np.eye(4), (5, 1, 1))
    cameras[:, :3, 3] = (300, -60, 7) + rng.normal(size=(5, 3)) * 10
    bounds = SceneBounds(points, cameras, up)
    target, distance = fit(bounds, aspect)
    toward, upright = direction(bounds)
    right = np.cross(upright, toward)
    right /= np.linalg.norm(right)
    in_view = np.concatenate([points, cameras[:, :3, 3]]) - (target + distance * toward)
    depth = -in_view @ toward  # by perspective projection, as the viewer does it
    half = math.tan(math.radians(55) / 2)
    x, y = in_view @ right / (aspect * half * depth), in_view @ np.cross(toward, right) / (half * depth)
    inside = (depth > 0) & (np.abs(x) <= 1) & (np.abs(y) <= 1)
    assert inside[len(points) :].all()
    assert inside.mean() > 0.97
    assert max(np.ptp(x[inside]), np.ptp(y[inside])) > 1.85  # of 2


def test_the_file_is_whole_and_the_world_stands_upright(run) -> None:
    verify(run / "recording.rrd")
    (row,) = read(run / "recording.rrd")["/wall"]
    assert row["ViewCoordinates:xyz"] == [[3, 2, 5]]  # right, down, forward: the scene says that up is -y


def test_a_start_that_finds_everything_kept_leaves_the_recording_alone(run) -> None:
    path = run / "recording.rrd"
    before = path.read_bytes()
    semstab.run(config_of(run.parent / "data" / "wall"), out=run, observers=[Recording(path)], report=False)
    assert path.read_bytes() == before
    whole = run.parent / "whole.rrd"  # from the run folder it is whole, but for what only the images show
    semstab.run(config_of(run.parent / "data" / "wall"), out=run, observers=[Recording(whole)], report=False)
    verify(whole)
    first, again = read(path), read(whole)
    for column in SERIES:
        entities = [at for at in first if at.startswith(f"/wall/series/{column}/")]
        assert entities
        assert all(series(again, at) == series(first, at) for at in entities)
    was, now = (grid(rows, "/wall/map/a/numpy") for rows in (first, again))
    assert {*color_modes()} < {*was}
    assert [repr(was[key]) for key in was] == [repr(now[key]) for key in was]


def test_a_resumed_run_says_what_it_does_not_show(tmp_path) -> None:
    class Interrupting(Observer):
        def frame_fused(self, task, frame, rows) -> None:
            if task.model == "b":
                raise KeyboardInterrupt

    config = config_of(tiny_scene.write(tmp_path / "data" / "wall"))
    path = tmp_path / "run" / "recording.rrd"
    first = Recording(path)
    with pytest.raises(KeyboardInterrupt):
        semstab.run(config, out=path.parent, observers=[first, Interrupting()], report=False)
    first.close()
    first.close()
    verify(path)
    rows = read(path)
    assert len(series(rows, "/wall/series/updated_voxels/a/numpy")) == 3
    assert len(series(rows, "/wall/series/updated_voxels/b/numpy")) == 1

    semstab.run(config, out=path.parent, observers=[Recording(path)], report=False)
    verify(path)
    rows = read(path)
    earlier, fused_now = sorted(notes(rows))
    assert earlier.startswith("a, numpy: 60 voxels")
    assert fused_now.startswith("b, numpy: 60 voxels")
    for model in "ab":
        assert len(series(rows, f"/wall/series/updated_voxels/{model}/numpy")) == 3
        table = VoxelTable.load(path.parent / "voxels" / f"wall__{model}__numpy.parquet")
        np.testing.assert_array_equal(grid(rows, f"/wall/map/{model}/numpy")["op"], table.op)
    assert "/wall/camera/b/labels" in rows
    assert not [row for row in rows["/wall/camera/a/labels"] if "SegmentationImage:buffer" in row]
    assert lacks_pictures(path.parent, path)
    record_finished(path.parent, path)
    assert not lacks_pictures(path.parent, path)


@pytest.mark.parametrize("fused_by", ["numba", "numpy", "open3d"])
def test_the_drift_of_a_run_is_that_of_its_own_map(tmp_path, monkeypatch, fused_by) -> None:
    """No second map is fused, and the recorded drift is the same."""
    monkeypatch.setattr("semstab.recording.observer.create", lambda *_, **__: pytest.fail("a second map"))
    config = config_of(tiny_scene.write(tmp_path / "wall"), fused_by)
    semstab.run(config, observers=[Recording(tmp_path / "x.rrd")])
    pictures = [
        row["SegmentationImage:buffer"]
        for row in read(tmp_path / "x.rrd")["/wall/camera/a/drift"]
        if "SegmentationImage:buffer" in row
    ]
    assert len(pictures) == 3
    assert pictures[0] != pictures[1]


def test_a_path_that_cannot_be_written_is_named(run, tmp_path) -> None:
    config = config_of(run.parent / "data" / "wall")
    with pytest.raises(ConfigError, match=r"recording cannot be written"):
        semstab.run(config, observers=[Recording(tmp_path)], report=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file/x\.rrd: the recording cannot be written"):
        semstab.run(config, observers=[Recording(tmp_path / "file" / "x.rrd")], report=False)


def test_without_a_recording_rerun_is_not_imported(run) -> None:
    program = (
        "import sys, semstab; from semstab.configure import load_config;"
        f"semstab.run(load_config({str(run / 'config.yaml')!r}));"
        "assert 'semstab.engine.execution' in sys.modules and 'rerun' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


# From here on the observer is driven by hand, with frames that no file format is needed for.


class Scene:
    """A camera 2 m above a floor, which looks down on it."""

    name = "floor 1"
    models = ("net/x",)
    ground_truth = False
    of_scans = False
    posed = True
    up = np.array([0.0, 0.1, 0.99])


CLASSES = LabelSpace("abc", ("a", "b", "c"))
UNIT = UnitName(Scene.name, "net/x", "numpy")


def frame(index: int, label: int, at: tuple[float, float, float], timestamp: float | None = None) -> Frame:
    T_wc = np.diag([1.0, -1.0, -1.0, 1.0])
    T_wc[:3, 3] = at
    labels = np.full((6, 8), label, dtype=np.uint8)
    depth = np.full((6, 8), 2.0, dtype=np.float32)
    return Frame(index, depth, Intrinsics(8.0, 8.0, 4.0, 3.0), T_wc, labels=labels, timestamp=timestamp)


def record_of(table: VoxelTable) -> Record:
    return Record(UNIT, "abc", 3, metrics.summarise(table), math.nan, 1.0, "key")


def planned(indices: Sequence[int] = (0,)) -> Unit:
    task = Task(Scene(), "net/x", indices, CLASSES.mapping_to(CLASSES), ("numpy",))
    return Unit.from_task(Variation(), Config(voxel_size=0.25), task, "key", image_space=True, stored=True)


def record(path: Path | Target, frames: list[Frame], *, finish: bool = True) -> tuple[Recording, VoxelTable]:
    """Drive a recording as the pipeline does."""
    watching = Recording(path)
    unit = planned([f.index for f in frames])
    task, config = unit.task, unit.config
    watching.run_started(Plan(config, {}, (unit,), ()), {})
    backend = backends.create("numpy", voxel_size=0.25, num_classes=3)
    watching.group_started(task, config, {UNIT: backend})
    for given in frames:
        watching.frame_fused(task, given, {UNIT: FrameRow(backend.integrate(given), given.timestamp, math.nan)})
    table = backend.table()
    if finish:
        made = record_of(table)
        watching.unit_finished(unit, made, table, None)
        watching.run_finished(Result("run", "numpy", (made,)))
    return watching, table


@pytest.mark.parametrize(("start", "kind"), [(12.5, "timedelta64[ns]"), (1.7e9, "datetime64[ns]")])
def test_timestamps_make_a_second_timeline(tmp_path, start, kind) -> None:
    path = tmp_path / "time.rrd"
    record(path, [frame(i, 0, (0.01, 0.01, 2.01), start + i) for i in (3, 5, 9)])
    verify(path)
    found: dict[int, int] = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        if chunk.entity_path == r"/floor\ 1/series/updated_voxels/net\/x/numpy" and not chunk.is_static:
            batch = chunk.to_record_batch()
            times = batch.column("time").to_numpy(zero_copy_only=False)
            assert times.dtype == kind
            found |= dict(zip(batch.column("frame").to_pylist(), times.astype(np.int64).tolist(), strict=True))
    assert found == {i: int((start + i) * NANOSECONDS) for i in (3, 5, 9)}
    assert set(read(path)[r"/floor\ 1"][0]) >= {"ViewCoordinates:xyz"}


def test_frames_without_a_timestamp_have_a_number_only(tmp_path) -> None:
    path = tmp_path / "mixed.rrd"
    record(path, [frame(0, 0, (0.01, 0.01, 2.01), 4.0), frame(1, 0, (0.01, 0.01, 2.01), None)])
    rows = read(path)[r"/floor\ 1/series/updated_voxels/net\/x/numpy"]
    assert {row["frame"]: "time" in row for row in rows if "frame" in row} == {0: True, 1: False}


def test_what_goes_wrong_beside_the_loop_is_said_and_the_file_is_closed(tmp_path, monkeypatch) -> None:
    path = tmp_path / "broken.rrd"
    watching, table = record(path, [frame(i, 0, (0.01, 0.01, 2.01)) for i in range(2)], finish=False)

    def fail(*_: object, **__: object) -> str:
        raise RuntimeError("no room")

    monkeypatch.setattr(voxel_maps.VoxelLogger, "finish", fail)
    watching.unit_finished(planned(), record_of(table), table, None)
    with pytest.raises(RuntimeError, match="no room"):
        watching.close()
    verify(path)
    assert set(series(read(path), r"/floor\ 1/series/map_vss_all/net\/x/numpy")) == {0, 1}


def test_jobs_run_in_order_and_few_are_pending() -> None:
    done: list[int] = []
    stream = rr.RecordingStream("test")
    thread = timeline.FrameJobs(stream, Clock())
    for number in range(20):
        thread.submit(number, None, functools.partial(done.append, number))
        assert number - len(done) <= timeline.MOST_PENDING
    thread.drain()
    assert done == list(range(20))
    thread.submit(20, None, functools.partial(done.remove, 99))
    with pytest.raises(ValueError, match="not in list"):
        thread.close()
    stream.disconnect()


def test_a_frame_whose_depth_reaches_nothing_has_a_camera(tmp_path) -> None:
    path = tmp_path / "sky.rrd"
    sky = frame(0, 0, (0.01, 0.01, 2.01))
    far = Frame(0, np.full_like(sky.depth, np.inf), sky.intrinsics, sky.T_wc, labels=sky.labels)
    record(path, [far, frame(1, 0, (0.01, 0.01, 2.01))])
    assert any("Pinhole:image_from_camera" in row for row in read(path)[r"/floor\ 1/camera"])


def test_utm_coordinates_are_recorded_relative_to_an_origin(tmp_path) -> None:
    path = tmp_path / "utm.rrd"
    _, table = record(path, [frame(i, i, (455_123.01, 5_412_345.01, 302.01)) for i in range(2)])
    rows = read(path)
    voxels = grid(rows, r"/floor\ 1/map/net\/x/numpy")
    origin = np.array([455_000, 5_412_000, 0]) * 4
    np.testing.assert_array_equal(np.array(voxels["voxel_indices"]) + origin, table.index)
    (text, _) = notes(rows, r"floor\ 1")
    assert text.startswith("map coordinates are relative to x = 455000.000 m, y = 5412000.000 m, z = 0.000 m")


def test_a_map_that_is_too_large_is_thinned_and_says_so(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(voxel_maps, "MAX_VOXELS", 40)
    path = tmp_path / "large.rrd"
    _, table = record(path, [frame(i, i % 3, (0.25 * i + 0.01, 0.01, 2.01)) for i in range(6)])
    rows = read(path)
    assert len(table) == 13 * 6
    drawn = grid(rows, r"/floor\ 1/map/net\/x/numpy")
    np.testing.assert_allclose(drawn["voxel_size"], [[0.5] * 3])
    blocks = table.index // 2
    np.testing.assert_array_equal(drawn["voxel_indices"], np.unique(blocks, axis=0))
    of_block = {tuple(block): set(table.op[(blocks == block).all(axis=1)].tolist()) for block in blocks}
    assert all(v in of_block[tuple(q)] for q, v in zip(drawn["voxel_indices"], drawn["op"], strict=True))
    assert "one voxel of each block of 2x2x2" in notes(rows, r"floor\ 1")[0]


@pytest.mark.parametrize("stamp", [1.7e9, -3.0, 1.7e12, 1.7e18, math.inf, math.nan])
def test_timestamps_of_any_unit_are_taken(stamp):
    """In other units than seconds, as some datasets have them, frames are shown by their number."""
    Clock().set(rr.RecordingStream("clock"), 3, stamp)


@pytest.mark.parametrize("frame", ["x", str(10**30)])
def test_a_damaged_series_is_one_line(run, tmp_path, frame) -> None:
    task, file = make_plan(config_of(run.parent / "data/wall")).tasks[0], tmp_path / "series.csv"
    file.write_text(f"frame,timestamp,drift\n{frame},,0.5\n")
    with pytest.raises(DataError, match="not a time series of a run"):
        log_file(rr.RecordingStream("damaged"), task.units[0], task, file, Clock())
