"""The recording's pictures, flips, growing maps and comparisons, against what was fused, computed another way."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
import tiny_scene
from PIL import Image
from test_recording import config_of, grid, notes, read, series, verify

import semstab
from semstab import Frame, Intrinsics, LabelSpace, backends, metrics
from semstab.configure import load_config
from semstab.data.measures import SBD_MAX
from semstab.data.results import UnitName
from semstab.engine.units import make_plan
from semstab.errors import DataError
from semstab.recording import (
    Recording,
    camera,
    color_modes,
    drift,
    lacks_pictures,
    layout,
    loops,
    record_finished,
    voxel_maps,
)
from semstab.recording.drift import DriftLog, FrameView
from semstab.recording.timeline import Clock, entity
from semstab.task import read as read_frame

CLASSES = LabelSpace("abc", ("a", "b", "c"))


def config_with(root: Path, *names: str) -> Any:
    return config_of(root).model_copy(
        update={"backends": load_config(overrides={"backends": list(names)}).backends, "check": None}
    )


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A run of one model with colour, through two backends that differ by design."""
    folder = tmp_path_factory.mktemp("compared")
    root = tiny_scene.write(folder / "data" / "wall", models=("a",))
    (root / "color").mkdir()
    for i in range(tiny_scene.FRAMES):
        picture = np.full((8 * tiny_scene.HEIGHT, 8 * tiny_scene.WIDTH, 3), (10, 20, 200), np.uint8)
        cv2.imwrite(str(root / "color" / f"{i:04d}.jpg"), picture)
    config = config_with(root, "numba", "open3d-projective")
    out = folder / "run"
    semstab.run(config, out=out, observers=[Recording(out / "recording.rrd")], report=False)
    return config, out


@pytest.mark.parametrize(("given", "drawn", "lines"), [
    (["numba", "numpy"], "numba", ["numba"]),
    (["numba", {"name": "numpy", "check": False}], "numba", ["numba", "numpy"]),
    ([{"name": "numba", "check": False}, "numpy"], "numpy", ["numba", "numpy"]),
    (["open3d-projective", "numba"], "numba", ["open3d-projective", "numba"]),
    ([{"name": "open3d-projective", "check": True}, "numba"], "open3d-projective", ["open3d-projective"]),
])  # fmt: skip
def test_backends_that_need_not_agree_have_lines_of_their_own(tmp_path, given, drawn, lines) -> None:
    config = config_of(tiny_scene.write(tmp_path / "wall", models=("a",)))
    given_backends = load_config(overrides={"backends": given}).backends
    plan = make_plan(config.model_copy(update={"backends": given_backends, "check": None}))
    (task,) = plan.tasks
    assert layout.drawn(task) == drawn
    views = layout._plot("wall", "map_vss_all", [task])
    assert views.contents == [entity("map_vss_all", UnitName("wall", "a", backend)) for backend in lines]
    watching = Recording(tmp_path / "recording.rrd")
    watching.run_started(plan, {})
    fused = {
        UnitName("wall", "a", name): backends.create(name, voxel_size=0.25, num_classes=3) for name in task.backends
    }
    watching.group_started(dataclasses.replace(task, apart=()), config, fused)
    assert watching._fused is fused[UnitName("wall", "a", drawn)]


def frames_of(config: Any) -> list[Frame]:
    (task,) = make_plan(config).tasks
    return [read_frame(task, index) for index in task.indices]


def image(row: dict[str, Any], kind: str) -> np.ndarray:
    W, H = row[f"{kind}:format"][0]["width"], row[f"{kind}:format"][0]["height"]
    return np.frombuffer(bytes(row[f"{kind}:buffer"][0]), np.uint8).reshape(H, W)


def test_the_pictures_are_drift_and_contradiction_of_the_pixels_voxel(compared) -> None:
    config, out = compared
    rows = read(out / "recording.rrd")
    pictures = {
        name: [row for row in rows[f"/wall/camera/a/{name}"] if "SegmentationImage:buffer" in row]
        for name in drift.PICTURES
    }
    reference = backends.create("numpy", voxel_size=0.25, num_classes=3)
    for t, frame in enumerate(frames_of(config)):
        before = {tuple(index): (bits, label) for index, bits, label in described(reference.table())}
        reference.integrate(frame)
        after = {tuple(index): (bits, label) for index, bits, label in described(reference.table())}
        drifted, contradicts = (image(pictures[name][t], "SegmentationImage") for name in ("drift", "contradictions"))
        v, u = np.mgrid[: frame.shape[0], : frame.shape[1]]
        K, T = frame.intrinsics, frame.T_wc
        points = (
            np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(frame.shape)], axis=-1) * frame.depth[..., None]
        )
        voxels = np.floor((points @ T[:3, :3].T + T[:3, 3]) / 0.25).astype(int)
        for at in np.ndindex(*frame.shape):
            voxel = tuple(voxels[at])
            assert drifted[at] == level(after[voxel][0] - before[voxel][0] if voxel in before else None)
            agrees = frame.labels[at] == before.get(voxel, after[voxel])[1]
            assert contradicts[at] == (drift.AGREES if agrees else drift.CONTRADICTS)


def level(bits: float | None) -> int:
    """By the definition of the levels: the k-th begins at SBD_MAX (k / LEVELS)^2."""
    if bits is None:
        return drift.FIRST_SEEN
    if bits < 1e-9:
        return drift.NO_DRIFT
    level = int(drift.LEVELS * (bits / SBD_MAX) ** 0.5 + 1e-9)
    return drift.NO_DRIFT + 1 + min(level, drift.LEVELS - 1)


def test_labels_camera_and_colour_are_those_of_the_frames(compared) -> None:
    config, out = compared
    rows = read(out / "recording.rrd")
    labels = [row for row in rows["/wall/camera/a/labels"] if "SegmentationImage:buffer" in row]
    poses = [row for row in rows["/wall/camera"] if "Transform3D:translation" in row]
    colors = [row for row in rows["/wall/camera/color"] if "EncodedImage:blob" in row]
    depths = [row for row in rows["/wall/depth"] if "DepthImage:buffer" in row]
    for frame, label, pose, color, depth in zip(frames_of(config), labels, poses, colors, depths, strict=True):
        assert {row["frame"] for row in (label, pose, color, depth)} == {frame.index}
        np.testing.assert_array_equal(image(label, "SegmentationImage"), frame.labels)
        np.testing.assert_allclose(pose["Transform3D:translation"][0], frame.T_wc[:3, 3], rtol=1e-6)
        decoded = cv2.imdecode(np.frombuffer(bytes(color["EncodedImage:blob"][0]), np.uint8), cv2.IMREAD_COLOR)
        assert decoded.shape[:2] == frame.shape
        np.testing.assert_allclose(decoded.mean(axis=(0, 1)), (10, 20, 200), atol=4)
        meters = np.frombuffer(bytes(depth["DepthImage:buffer"][0]), np.float16).reshape(frame.shape)
        np.testing.assert_allclose(meters, frame.depth, rtol=1e-3)


@pytest.mark.parametrize("kind", ["large", "cut off", "png", "cmyk", "not an image"])
def test_colour_of_any_format_is_encoded_as_a_small_jpeg(tmp_path, kind) -> None:
    picture = np.full((90, 120, 3), (10, 20, 200), dtype=np.uint8)
    _, jpeg = cv2.imencode(".jpg", picture)
    data = {
        "large": jpeg.tobytes(), "cut off": jpeg.tobytes()[:-9], "png": cv2.imencode(".png", picture)[1].tobytes(),
        "cmyk": cmyk(picture), "not an image": b"colour\xff\xd9",
    }[kind]  # fmt: skip
    file = tmp_path / "color.jpg"
    file.write_bytes(data)
    view = frame(0, np.zeros((6, 8)), {"color": str(file)})
    if kind in ("cut off", "not an image"):
        with pytest.raises(DataError, match=r"color\.jpg: the image cannot be decoded"):
            camera.color_of(view)
        return
    color = camera.color_of(view)
    assert color is not None
    decoded = cv2.imdecode(np.frombuffer(color, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape[:2] == (6, 8)
    np.testing.assert_allclose(decoded.mean(axis=(0, 1)), (10, 20, 200), atol=12 if kind == "cmyk" else 4)


def test_a_small_jpeg_of_that_size_is_recorded_as_it_is_and_a_damaged_one_refused(tmp_path) -> None:
    written = cv2.imencode(".jpg", np.full((90, 120, 3), (10, 20, 200), np.uint8))[1].tobytes()
    noise = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (90, 120, 3), np.uint8))[1].tobytes()
    file = tmp_path / "color.jpg"
    view = frame(0, np.zeros((90, 120)), {"color": str(file)})
    file.write_bytes(written)
    assert camera.color_of(view) == written
    file.write_bytes(noise)
    assert len(camera.color_of(view) or b"") < len(noise)
    file.write_bytes(written[:-9])
    with pytest.raises(DataError, match=r"color\.jpg: the image cannot be decoded"):
        camera.color_of(view)


def cmyk(picture: np.ndarray) -> bytes:
    """As JPEG in the colours of printers, which browsers and viewers show wrongly or not at all."""
    buffer = io.BytesIO()
    Image.fromarray(picture[..., ::-1]).convert("CMYK").save(buffer, "JPEG")
    return buffer.getvalue()


def test_backends_that_differ_are_laid_over_each_other(compared) -> None:
    _, out = compared
    rows = read(out / "recording.rrd")
    first, second = (
        semstab.VoxelTable.load(out / "voxels" / f"wall__a__{name}.parquet") for name in ("numba", "open3d-projective")
    )
    a, b = ({tuple(index) for index in table.index.tolist()} for table in (first, second))
    drawn = {
        part: {tuple(index) for row in rows[rf"/wall/difference/a/numba\ and\ open3d-projective/{part}"]
               for index in row["VoxelGridMap:voxel_indices"]}
        for part in ("only_first", "only_second", "changed")
    }  # fmt: skip
    assert drawn["only_first"] == a - b
    assert drawn["only_second"] == b - a
    vss = [dict(zip(map(tuple, t.index.tolist()), metrics.vss(t), strict=True)) for t in (first, second)]
    assert drawn["changed"] == {voxel for voxel in a & b if abs(vss[0][voxel] - vss[1][voxel]) > 1e-9}
    (report,) = rows[r"/wall/difference_report/a/numba\ and\ open3d-projective"]
    assert report["TextDocument:text"][0].startswith(
        f"{len(a - b)} voxels in numba only, {len(b - a)} in open3d-projective only; of {len(a & b)} in both"
    )
    assert any("in open3d-projective only" in note for note in notes(rows))
    np.testing.assert_array_equal(grid(rows, "/wall/map/a/open3d-projective")["op"], second.op)


# From here on frames are made by hand.


def frame(index: int, labels: np.ndarray, files: dict[str, str] | None = None) -> Frame:
    depth = np.full(labels.shape, 2.0, dtype=np.float32)
    T_wc = np.eye(4)
    T_wc[:3, 3] = 0.01
    H, W = labels.shape
    camera_ = Intrinsics(8.0, 8.0, W / 2, H / 2)
    return Frame(index, depth, camera_, T_wc, labels=labels.astype(np.uint8), files=files or {})


@contextlib.contextmanager
def saved(path: Path) -> Iterator[rr.RecordingStream]:
    stream = rr.RecordingStream("test")
    stream.save(path)
    yield stream
    stream.flush()
    stream.disconnect()


@pytest.mark.parametrize(
    ("name", "options"),
    [("numpy", {}), ("numba", {}), ("numba", {"evidence": "float32"}), ("open3d", {}), ("torch", {})],
)
def test_a_backend_says_the_changes_that_a_frame_made(name, options) -> None:
    if name == "torch":
        pytest.importorskip("torch")
    rng = np.random.default_rng(5)
    reference = backends.create("numpy", voxel_size=0.5, num_classes=4)
    fused = backends.create(name, voxel_size=0.5, num_classes=4, **options)
    assert fused.changes() is None
    for index in range(5):
        view = frame(index, rng.integers(0, 4, (10, 14)))
        old = {tuple(i): (d, k) for i, d, k in described(reference.table())}
        reference.integrate(view)
        fused.integrate(view)
        new = {tuple(i): (d, k) for i, d, k in described(reference.table())}
        changes = fused.changes()
        assert len(changes.index) == len(new)
        for voxel, bits, before, after in zip(
            changes.index.tolist(), changes.drift, changes.before, changes.after, strict=True
        ):
            assert after == new[tuple(voxel)][1]
            if tuple(voxel) in old:
                assert before == old[tuple(voxel)][1]
                assert bits == pytest.approx(new[tuple(voxel)][0] - old[tuple(voxel)][0], abs=1e-6)
            else:
                assert np.isnan(bits)
                assert before == after


def described(table: semstab.VoxelTable) -> list[tuple[list[int], float, int]]:
    return list(zip(table.index.tolist(), table.drift_sum.tolist(), metrics.dominant(table).tolist(), strict=True))


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_every_pixel_shows_its_voxel_whatever_becomes_of_the_map(stride) -> None:
    log, fused = DriftLog(0.05), backends.create("numba", voxel_size=0.05, num_classes=4)
    rng = np.random.default_rng(1)
    first, second = rng.integers(0, 4, (2, 90, 121))
    second[0, :3] = 255
    followed(log, fused, frame(0, first))
    changes = followed(log, fused, frame(1, second))
    whole = changes.pictures(1)
    assert np.unique(whole["contradictions"]).tolist() == [drift.NO_VOXEL, drift.AGREES, drift.CONTRADICTS]
    np.testing.assert_array_equal(whole["drift"] == drift.NO_VOXEL, second == 255)
    followed(log, fused, frame(2, np.zeros((90, 121))))
    for name, picture in changes.pictures(stride).items():
        np.testing.assert_array_equal(picture, whole[name][::stride, ::stride])


def alternating(count: int) -> list[Frame]:
    """One voxel's class alternates from frame to frame; the others stay."""
    views = []
    for index in range(count):
        labels = np.zeros((6, 8))
        labels[2:4, 2:4] = 1 if index % 2 else 2
        views.append(frame(index, labels, {"labels": f"somewhere/{index:03d}.png"}))
    return views


def followed(log: DriftLog, fused: backends.FusionBackend, view: Frame) -> drift.FrameChanges:
    fused.integrate(view)
    return log.follow(view, fused.changes())


def tracked(views: list[Frame]) -> tuple[DriftLog, semstab.VoxelTable]:
    log, fused = DriftLog(1.0), backends.create("numba", voxel_size=1.0, num_classes=3)
    for view in views:
        followed(log, fused, view)
    return log, fused.table()


def test_the_voxel_that_flickers_comes_first_with_its_top_contributing_frames(tmp_path) -> None:
    log, table = tracked(alternating(6))
    worst = table.centers[table.drift_sum.argmax()]
    np.testing.assert_allclose(table.centers[drift.top_voxels(table)[0]], worst)
    with saved(tmp_path / "flips.rrd") as stream:
        log.log(stream, "s", "net", CLASSES, table, np.zeros(3), Clock())
    verify(tmp_path / "flips.rrd")
    rows = read(tmp_path / "flips.rrd")
    reference = backends.create("numpy", voxel_size=1.0, num_classes=3)
    expected = {}
    for view in alternating(6):  # the lane has a state where the reference's dominant class changes
        reference.integrate(view)
        now = reference.table()
        (row,) = np.flatnonzero((np.abs(now.centers - worst) < 1e-6).all(axis=1))
        name = CLASSES.classes[metrics.dominant(now)[row]]
        if name != next(reversed(expected.values()), None):
            expected[view.index] = name
    lane = {row["frame"]: row["StateChange:state"][0] for row in rows["/s/flips/net/voxel_1"] if "frame" in row}
    assert lane == expected
    numbers = {row["frame"]: row for row in rows["/s/camera/net/flips"]}
    for view in alternating(6):
        (H, W), found = view.shape, numbers[view.index]
        at = np.reshape(found["Points2D:positions"], (-1, 2))
        assert len(at) == len(found["Points2D:labels"])
        assert np.all((at > 0) & (at < (W, H - 0.09 * W)))  # the number stands below its point
    (report,) = (row["TextDocument:text"][0] for row in rows["/s/flips_report/net"])
    first, _, _ = report.partition("**voxel 2**")
    blamed = {int(frame) for frame in re.findall(r"- frame (\d+) \(0*\1\.png\): ", first)}
    assert blamed >= set(list(expected)[1:])
    assert 1 in blamed  # two classes are level then, so none of them flips, but no frame moved the belief more


def test_a_number_is_drawn_where_it_lies_inside_the_image() -> None:
    T_wc = np.array([[1.0, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    seen_by = FrameView(None, Intrinsics(100.0, 100.0, 50.0, 40.0), T_wc, (80, 100))
    pixels, inside = seen_by.project(np.array([[5.0, 0, 2], [5.2, 0.1, 2], [5.0, 0, -2], [5.98, 0, 2], [8, 0, 2]]))
    assert inside.tolist() == [True, True, False, False, False]  # behind, at the edge, outside
    np.testing.assert_allclose(pixels[:2], [[50.5, 40.5], [60.5, 45.5]])


def test_of_each_location_that_drifts_one_voxel_is_shown() -> None:
    fused = backends.create("numba", voxel_size=0.05, num_classes=3)
    for index in range(4):
        labels = np.zeros((60, 80))
        labels[10:20, 10:20] = labels[40:50, 60:70] = index % 2 + 1
        fused.integrate(frame(index, labels))
    table = fused.table()
    index = table.index[drift.top_voxels(table)]
    assert len(index) > 2
    distance = np.abs(index[:, None] - index).max(axis=2)
    assert distance[~np.eye(len(index), dtype=bool)].min() >= drift.APART


def test_the_numbered_voxels_are_listed_in_the_order_of_their_drift(tmp_path) -> None:
    """Of two that change, the one that is later in the table changes more often."""
    views = []
    for index in range(6):
        labels = np.zeros((6, 8))
        labels[:1, :1] = 1 if index == 3 else 0
        labels[5:, 7:] = 1 + index % 2
        views.append(frame(index, labels))
    log, fused = DriftLog(0.05), backends.create("numba", voxel_size=0.05, num_classes=3)
    for view in views:
        followed(log, fused, view)
    table = fused.table()
    rows = drift.top_voxels(table)
    assert rows[0] > rows[1]
    with saved(tmp_path / "flips.rrd") as stream:
        log.log(stream, "s", "net", CLASSES, table, np.zeros(3), Clock())
    (text,) = (row["TextDocument:text"][0] for row in read(tmp_path / "flips.rrd")["/s/flips_report/net"])
    stated = [float(bits) for bits in re.findall(r"drift ([\d.]+) bits in all", text)]
    np.testing.assert_allclose(stated, table.drift_sum[rows], atol=6e-4)


def test_the_log_of_flips_is_bounded_and_keeps_those_of_the_worst(monkeypatch) -> None:
    log, table = tracked(alternating(12))
    monkeypatch.setattr(drift, "MAX_MOVES", 12)
    bounded, _ = tracked(alternating(12))
    bounded_moves, every = (np.concatenate(log_of_flips._moves) for log_of_flips in (bounded, log))
    worst = drift.packed(table.index[drift.top_voxels(table)[:1]])
    assert len(bounded_moves) <= 12
    assert (
        set(every["frame"][every["voxel"] == worst])
        >= set(bounded_moves["frame"][bounded_moves["voxel"] == worst])
        != set()
    )


def grow(path: Path, labels: list[np.ndarray], *, finish: bool) -> tuple[dict[str, list[dict[str, Any]]], Any]:
    """The rows of a map that grows by these frames, and its table."""
    fused = backends.create("numba", voxel_size=0.25, num_classes=3)
    growing = voxel_maps.VoxelLogger("/map", CLASSES, np.zeros(3, dtype=np.int64), frames=len(labels))
    with saved(path) as stream:
        for index, of_frame in enumerate(labels):
            stream.set_time("frame", sequence=index)
            report = fused.integrate(frame(index, of_frame))
            for job in growing.update(stream, report.map_voxels, fused.table):
                job()
        if finish:
            growing.finish(stream, fused.table())
    return read(path), fused.table()


def test_what_a_growing_map_logs_is_bounded(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(voxel_maps, "BUDGET", 600)
    monkeypatch.setattr(voxel_maps, "MAX_VOXELS", 2000)
    rng = np.random.default_rng(0)  # every voxel changes with every frame
    rows, table = grow(tmp_path / "grown.rrd", [rng.integers(0, 3, (12, 16)) for _ in range(20)], finish=True)
    logged = sum(len(row["vss:values"]) for at in rows for row in rows[at] if at.startswith("/map/"))
    assert 300 + len(table) < logged <= 600 + len(table)
    voxels = grid(rows, "/map")
    np.testing.assert_allclose(voxels["vss"], metrics.vss(table), rtol=1e-6)
    np.testing.assert_array_equal(voxels["voxel_indices"], table.index)


def test_a_map_within_the_budget_is_logged_with_each_frame(tmp_path) -> None:
    rows, table = grow(tmp_path / "grown.rrd", [np.full((12, 16), index % 3) for index in range(4)], finish=False)
    assert {row["frame"] for row in rows["/map/00"]} == {0, 1, 2, 3}
    voxels = grid(rows, "/map")
    np.testing.assert_array_equal(voxels["voxel_indices"], table.index)
    np.testing.assert_array_equal(voxels["op"], table.op)


def test_chunks_that_a_thinned_map_lacks_are_cleared(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(voxel_maps, "MAX_VOXELS", 60)
    fused = backends.create("numba", voxel_size=0.25, num_classes=3)
    growing = voxel_maps.VoxelLogger("/map", CLASSES, np.zeros(3, dtype=np.int64), frames=1)
    with saved(tmp_path / "thin.rrd") as stream:
        small = np.full((12, 16), 255)
        small[:8, :4] = 1
        for labels in (small, np.full((12, 16), 1)):
            report = fused.integrate(frame(0, labels))
            for job in growing.update(stream, report.map_voxels, fused.table):
                job()
        note = growing.finish(stream, fused.table())
    assert "one voxel of each block" in note


def test_500_frames_of_4k_stay_below_the_size_that_is_stated() -> None:
    """By what each part may at most take, uncompressed; docs/viewer.md states the sum."""
    W, H = (-(-side // camera.stride_of((2160, 3840))) for side in (3840, 2160))
    assert (W, H) == (480, 270)  # a power of 2 smaller
    noise = np.random.default_rng(0).integers(0, 256, (H, W, 3)).astype(np.uint8)  # no picture compresses worse
    _, jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, camera.JPEG_QUALITY])
    color = 500 * jpeg.size
    labels, looked_up, depth = W * H, 2 * (W // 2) * (H // 2), 2 * (W // 2) * (H // 2)
    voxels = (voxel_maps.BUDGET + voxel_maps.MAX_VOXELS) * (3 * 4 + 4 * len(color_modes()))
    assert 500 * (labels + looked_up + depth) + color + voxels < 0.5e9


def test_a_killed_run_leaves_a_recording_that_optimize_makes_whole(tmp_path) -> None:
    """Without its footer `verify` complains of that alone; `rerun rrd optimize` writes one."""
    root = tiny_scene.write(tmp_path / "data" / "wall", models=("a",))
    path = tmp_path / "killed.rrd"
    program = f"""
import os, signal, time, semstab
from semstab.engine import Observer
from semstab.configure import load_config
from semstab.recording import Recording
class Killing(Observer):
    def unit_finished(self, *_):
        time.sleep(1)
        os.kill(os.getpid(), signal.SIGKILL)
config = load_config(overrides={{"dataset": {{"name": "posed_folder", "options": {{"root": {str(root)!r}}}}},
    "backends": ["numba"], "check": None, "voxel_size": 0.25}})
semstab.run(config, observers=[Recording({str(path)!r}), Killing()])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    rerun = Path(sys.executable).with_name("rerun")
    said = subprocess.run([rerun, "rrd", "verify", path], capture_output=True, text=True, check=False).stderr
    assert "Missing RRD footer" in said
    assert "1 errors" in said
    whole = tmp_path / "whole.rrd"
    subprocess.run([rerun, "rrd", "optimize", path, "-o", whole], capture_output=True, check=True)
    verify(whole)
    assert set(series(read(whole), "/wall/series/map_vss_all/a/numba")) == {0, 1, 2}


@pytest.fixture(scope="module")
def again(compared):
    """Recordings made from run folders: of a whole map, of one in tiles, of one without its dataset."""
    config, out = compared
    tiled = out.parent / "tiled"
    options = {"backends": config.backends[:1], "tile_size": 8}
    recording = Recording(tiled / "recording.rrd")
    semstab.run(config.model_copy(update=options), out=tiled, observers=[recording], report=False)
    assert len(list((tiled / "voxels").glob("*/*.parquet"))) > 1
    assert lacks_pictures(tiled, tiled / "recording.rrd")
    verify(tiled / "recording.rrd")
    record_finished(tiled, tiled / "recording.rrd")
    record_finished(out, out / "again.rrd")
    data = Path(config.dataset.options["root"])
    data.rename(data.with_name("away"))
    record_finished(out, out / "without.rrd")
    data.with_name("away").rename(data)
    return out / "again.rrd", tiled / "recording.rrd", out / "without.rrd"


def test_a_recording_made_from_the_folder_is_that_of_the_run(compared, again) -> None:
    """Each entity has the same rows, but for the layout of the map in time."""
    once, replayed = (by_entity(path) for path in (compared[1] / "recording.rrd", again[0]))
    assert once.keys() == replayed.keys()
    assert [at for at in once if "/series/" not in at and at != "/__properties" and once[at] != replayed[at]] == []
    for at in (at for at in once if "/series/" in at):
        assert series(read(again[0]), at) == series(read(compared[1] / "recording.rrd"), at)
    assert not lacks_pictures(compared[1], compared[1] / "recording.rrd")


def test_a_map_in_tiles_has_the_pictures_and_flips_of_the_whole_map(compared, again) -> None:
    once, tiled = (by_entity(path) for path in (compared[1] / "recording.rrd", again[1]))
    pictures = [at for at in once if any(part in at for part in ("/camera", "flips", "/depth", "/trajectory"))]
    assert "/wall/flips/a/voxel_1" in pictures
    assert [at for at in pictures if once[at] != tiled[at]] == []
    maps = [grid(read(path), "/wall/map/a/numba") for path in (compared[1] / "recording.rrd", again[1])]
    assert repr(maps[0]) == repr(maps[1])  # NaN where a voxel was seen once


def test_without_its_dataset_a_run_is_recorded_without_pictures(compared, again) -> None:
    whole, without = (read(path) for path in (compared[1] / "recording.rrd", again[2]))
    entity = "/wall/series/map_vss_all/a/numba"
    assert series(without, entity) == series(whole, entity)
    assert grid(without, "/wall/map/a/numba")["op"] == grid(whole, "/wall/map/a/numba")["op"]
    assert lacks_pictures(compared[1], again[2])


def by_entity(path: Path) -> dict[str, list[str]]:
    return {
        entity: sorted(repr({name: value for name, value in row.items() if "RowId" not in name}) for row in rows)
        for entity, rows in read(path).items()
    }


def test_levels_of_drift_lie_between_their_edges() -> None:
    edges, rng = drift.LEVEL_EDGES[1:-1], np.random.default_rng(0)
    near = edges.astype(np.float32)
    below, above = (np.nextafter(near, np.float32(end)) for end in (0, 1))
    values = np.concatenate([near, below, above, np.float32([-1e-9, 1e-45, 2, 1e9]), rng.random(500, np.float32) ** 4])
    expected = np.searchsorted(edges, values, side="right") + loops.NO_DRIFT + 1
    assert [loops.level_of(value, edges) for value in values] == expected.tolist()
    assert loops.level_of(np.float32(0), edges) == loops.NO_DRIFT
    assert loops.level_of(np.float32(np.nan), edges) == loops.FIRST_SEEN


def test_the_first_voxel_of_each_block_stands_for_it() -> None:
    index = np.random.default_rng(1).integers(-40, 40, (2000, 3))
    for shift in (1, 3):
        first = np.sort(np.unique(index >> shift, axis=0, return_index=True)[1])
        np.testing.assert_array_equal(loops.first_of_blocks(index, shift), first)
