"""The switch of the published measures of time: what a run writes is what the metrics say of the same frames."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import shutil

import numpy as np
import predicted_scene
import pytest
from command_line import bench
from PIL import Image

from semstab import LabelSpace, datasets
from semstab.data.image_measures import ClipMean, WarpedOverlap
from semstab.engine import load_result
from semstab.errors import DataError
from semstab.metrics import (
    SelfConsistency,
    TemporalConsistency,
    VideoConsistency,
    VideoMeter,
    flow_by_depth,
    image_flow,
    occluded,
    warp_labels,
)
from semstab.report.tables import tables, to_json

WIDTH, HEIGHT = 128, 72
CITY = {"frames": 200, "width": WIDTH, "height": HEIGHT}
WORDS = (
    "--model", "sim-flicker", "--frames", ":10", "--check", "none", "--no-geometry-check", "--voxel-size", "1",
    *(word for key, value in CITY.items() for word in ("--option", f"{key}={value}")),
)  # fmt: skip
DATASET = datasets.open_dataset("city", CITY)
FORMS = ("vspw", "etc", "ssp")


@pytest.fixture(scope="module", params=["depth", "dis"])
def run(request, tmp_path_factory):
    """Both scenes of the city, by the command line."""
    folder = tmp_path_factory.mktemp(request.param)
    done = bench("run", "--video-measures", request.param, *WORDS, "--out", "out", cwd=folder)
    return request.param, folder / "out", done.stdout


@functools.cache
def frames_of(name, source):
    """The frames of a scene with rows of the run's taxonomy."""
    scene = DATASET.scene(name)
    mapping = scene.label_space(source).mapping_to(LabelSpace.load("uavid7"))
    frames = [scene.frame(k, source) for k in range(10)]
    return [dataclasses.replace(frame, labels=mapping.labels(frame.labels, source)) for frame in frames]


def by_hand(flow, frames):
    """TC over all pixels that stay in the image, and over those that are not hidden, in the three forms."""
    of_all, of_visible = ([TemporalConsistency(7, form) for form in FORMS] for _ in range(2))
    for a, b in itertools.pairwise(frames):
        if flow == "depth":
            motion, visible = flow_by_depth(a, b, depth_tolerance=math.inf)[0], flow_by_depth(a, b)[1]
        else:
            motion = image_flow(a.color, b.color)
            visible = ~occluded(motion, image_flow(b.color, a.color))
        x, y = np.rint(np.arange(WIDTH) + motion[..., 0]), np.rint(np.arange(HEIGHT)[:, None] + motion[..., 1])
        inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
        warped = warp_labels(b.predicted, motion)
        for all_pixels, not_hidden in zip(of_all, of_visible, strict=True):
            all_pixels.add(a.predicted, warped, inside)
            not_hidden.add(a.predicted, warped, inside & visible)
    return [metric.value for metric in of_all], [metric.value for metric in of_visible]


def test_a_run_says_what_the_metrics_say_of_its_frames(run):
    flow, out, _ = run
    records = json.loads((out / "summary.json").read_text())["runs"]
    for record in records:
        name, found = record["scene"], record["video_measures"]
        frames, truths = frames_of(name, "sim-flicker"), frames_of(name, "gt")
        published, of_truth, alone = VideoConsistency(8), VideoConsistency(8), SelfConsistency(8)
        for frame, truth in zip(frames, truths, strict=True):
            labelled = frame.predicted != 255
            published.add(frame.predicted, np.ones((HEIGHT, WIDTH), bool), truth.predicted)
            of_truth.add(frame.predicted, labelled & (truth.predicted != 255), truth.predicted)
            alone.add(frame.predicted, labelled)
        pairs = (("vc8_published", published.published), ("vc8", of_truth.value), ("self_vc8", alone.value))
        assert found["flow"] == flow
        assert {name: found[name]["value"] for name, _ in pairs} == pytest.approx(dict(pairs), abs=1e-12)
        assert (found["vc8_published"]["clips"], found["self_vc8"]["clips"]) == (len(frames) - 8, len(frames) - 7)
        assert found["vc16"] == {"value": None, "clips": 0}
        for name, expected in zip(("tc", "tc_seen"), by_hand(flow, frames), strict=True):
            assert [found[name][form] for form in FORMS] == pytest.approx(expected, abs=1e-12)
        assert found["tc"] != found["tc_seen"]


def test_the_table_has_each_scene_and_all_of_them_as_one_set_of_videos(run):
    flow, out, said = run
    (table,) = (table for table in tables(load_result(out)) if table.name == "video_measures")
    first, second, total = to_json(table)["rows"]
    assert (first["scene"], second["scene"], total["scene"]) == ("scene0", "scene3", "All videos")
    assert ("by depth and pose" if flow == "depth" else "by optical flow between the images") in table.caption
    together = TemporalConsistency(7, "etc")
    if flow == "depth":
        for name in ("scene0", "scene3"):
            for a, b in itertools.pairwise(frames_of(name, "sim-flicker")):
                motion, visible = flow_by_depth(a, b)
                together.add(a.predicted, warp_labels(b.predicted, motion), visible)
        assert total["tc_seen_etc"] == pytest.approx(together.value)
        assert total["tc_seen_vspw"] == pytest.approx(together.score("vspw"))
    assert total["tc_ssp"] == pytest.approx((first["tc_ssp"] + second["tc_ssp"]) / 2)
    assert total["vc8"] == pytest.approx((first["vc8"] + second["vc8"]) / 2)  # of as many clips
    assert "VC and TC as published: semstab-bench show out video_measures" in said


def test_without_the_switch_there_is_no_such_table(tmp_path):
    bench("run", *WORDS, "--frames", ":2", "--scene", "scene0", "--out", "out", cwd=tmp_path)
    (record,) = load_result(tmp_path / "out").select()
    assert record.video_measures is None
    assert "video_measures" not in [table.name for table in tables(load_result(tmp_path / "out"))]


def test_a_map_in_tiles_has_the_same(run, tmp_path):
    flow, out, _ = run
    words = (*WORDS, "--scene", "scene0", "--tile-size", "64", "--out", "tiled")
    bench("run", "--video-measures", flow, *words, cwd=tmp_path)
    (tiled,) = load_result(tmp_path / "tiled").select()
    assert tiled.in_tiles
    assert repr(tiled.video_measures) == repr(load_result(out).select(scene="scene0")[0].video_measures)


def painted(frames):
    """A wall of two colours that the camera passes; labels are those of the wall."""
    for k in range(frames):
        frame = predicted_scene.frame(k, 1)
        labels = np.broadcast_to((np.arange(80) + 2 * k) // 9 % 2, (48, 80)).astype(np.uint8)
        yield dataclasses.replace(frame, labels=labels)


def measured(frames, truths=None, flow="depth"):
    meter = VideoMeter(2, flow)
    for frame, truth in itertools.zip_longest(frames, truths or ()):
        meter.add(frame, truth)
    return meter.result()


def test_without_ground_truth_there_is_the_consistency_of_the_prediction_alone():
    found = measured(painted(10))
    nothing = ClipMean(math.nan, 0)
    assert repr([found.vc8_published, found.vc8, found.vc16]) == repr([nothing] * 3)
    assert (found.self_vc8.clips, found.tc_seen.vspw) == (3, 1)


def test_pixels_without_a_label_count_as_published_and_not_in_ours():
    """Half of each image has none: the same 'label' for ever, which the truth does not contradict."""
    frames = list(painted(10))
    lower = np.arange(48)[:, None] >= 24
    halves = [dataclasses.replace(f, labels=np.where(lower, f.labels, np.uint8(255))) for f in frames]
    truths = [dataclasses.replace(f, labels=np.zeros((48, 80), np.uint8)) for f in frames]
    found = measured(halves, truths)
    assert found.vc8_published.value == pytest.approx((1 + found.vc8.value) / 2)


def test_pixels_without_depth_count_where_no_warp_needs_them():
    frames = [dataclasses.replace(f, depth=np.where(np.arange(80) < 40, 0, f.depth)) for f in painted(9)]
    whole, half = measured(painted(9)), measured(frames)
    assert half.self_vc8 == whole.self_vc8
    assert np.sum(half.tc.sums) < 0.6 * np.sum(whole.tc.sums)


def test_optical_flow_needs_images():
    frames = [dataclasses.replace(f, color=None) for f in painted(2)]
    with pytest.raises(DataError, match="there is no image for optical flow; use --video-measures depth"):
        measured(frames, flow="dis")


def test_larger_images_are_brought_to_the_labels():
    frames = [dataclasses.replace(f, color=np.array(f.color).repeat(2, 0).repeat(2, 1)) for f in painted(3)]
    assert measured(frames, flow="dis").tc == measured(painted(3), flow="dis").tc


def test_videos_of_other_classes_are_not_pooled_by_class():
    from semstab.report.tables.video_measures import _tc

    two, three = (WarpedOverlap(1.0, 1.0, ssp, ((1,) * K,) * 4) for K, ssp in ((2, 1.0), (3, 0.5)))
    assert _tc([two, three])[2] == 0.75
    assert np.isnan(_tc([two, three])[:2]).all()


@pytest.mark.parametrize(("words", "said"), [
    (("--video-measures", "raft"), "video_measures"),
    (("--data", "flight", "--model", "net", "--video-measures", "dis"), "there are no images for optical flow"),
])  # fmt: skip
def test_what_cannot_be_measured_is_one_line(tmp_path, words, said):
    scene = predicted_scene.write(tmp_path / "flight", frames=3)
    (scene / "labels/net").mkdir(parents=True)
    (scene / "scene.yaml").write_text("classes: [dark, bright]\n")
    shutil.rmtree(scene / "color")
    for frame in painted(3):
        Image.fromarray(np.array(frame.labels)).save(scene / f"labels/net/{frame.index:03d}.png")
    done = bench(*words, "--out", "out", cwd=tmp_path, code=2)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
