"""Videos without depth and poses: flicker by optical flow, frames that stand out, files, and what needs a map."""

from __future__ import annotations

import csv
import json
import shutil

import cv2
import numpy as np
import pytest
from command_line import bench
from rerun.chunk import RrdReader
from video_scene import CLASSES, COUNT, H, W, texture, views, write

import semstab
from semstab.datasets import open_dataset, recognise
from semstab.errors import ConfigError, DataError
from semstab.metrics.video_flicker import VideoFlickerMeter, lone_pixels
from semstab.pixels.warp import Correspondence
from semstab.recording import lacks_pictures, record_finished
from semstab.task import open_scenes


def options(folder, **more):
    return {"dataset": {"name": "video", "options": {"root": str(folder), "classes": CLASSES, **more}}}


def rows_of(file):
    return list(csv.DictReader(file.read_text().splitlines()))


def frames(folder):
    scene = open_dataset("video", {"root": folder, "classes": CLASSES}).scene(folder.name)
    return [scene.frame(k, "right") for k in range(len(scene))]


def test_the_motion_is_removed(tmp_path) -> None:
    """Every frame is the one before, moved: no label changes at what is seen, though many do in place."""
    result = semstab.run(options(write(tmp_path / "clip")))
    right = result.record(model="right")
    assert right.image_space.flicker_percent > 3
    assert right.image_space.compensated_flicker_percent < 0.4
    assert right.image_space.compensated_share > 0.9
    assert (result.scenes, set(result.models)) == (("clip",), {"right", "flips"})


def test_flicker_is_the_share_of_what_changed(tmp_path) -> None:
    """A block of a static image has another class in every second frame."""
    image, labels = (pixels[:, :W] for pixels in texture())
    for k in range(6):
        (tmp_path / "labels/net").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        flickering = labels.copy()
        flickering[:24] = k % 2
        cv2.imwrite(str(tmp_path / f"labels/net/{k}.png"), flickering)
    (record,) = semstab.run(options(tmp_path), out=tmp_path / "out", report=False).records
    assert record.image_space.flicker_percent == pytest.approx(25)
    assert record.image_space.compensated_flicker_percent == pytest.approx(25)
    assert record.image_space.compensated_share == 1
    alone = [row["lone_percent"] for row in rows_of(record.series)]
    assert [float(share) for share in alone[1:-1]] == [pytest.approx(25)] * 4
    assert alone[0] == alone[-1] == ""


def test_the_frames_that_are_wrong_stand_out_and_not_those_beside_them(tmp_path) -> None:
    result = semstab.run(options(write(tmp_path / "clip", wrong=(5, 12))), out=tmp_path / "out", report=False)
    flips, right = (result.record(model=name) for name in ("flips", "right"))
    assert sorted(outlier.name for outlier in flips.outlying_frames.frames) == ["0005", "0012"]
    assert right.outlying_frames.frames == ()
    assert [row["name"] for row in rows_of(flips.series) if row["outlying"] == "1"] == ["0005", "0012"]
    with np.load(tmp_path / "out/overview/clip__flips.npz") as pictures:
        assert {*pictures["lone_frames"].tolist()} == {5, 12}


def test_a_pixel_stands_alone_where_both_neighbours_agree(tmp_path) -> None:
    first, middle, last = frames(write(tmp_path / "clip"))[:3]
    still = Correspondence(np.arange(H * W, dtype=np.int32).reshape(H, W))
    lone = lone_pixels(middle, [(first, still), (last, still)])
    a, b, c = first.labels, middle.labels, last.labels
    assert lone.pixels == H * W
    assert lone.share == pytest.approx(np.mean((a == c) & (a != b)))


def test_a_change_of_the_size_begins_anew(tmp_path) -> None:
    meter, (one, two) = VideoFlickerMeter(len(CLASSES)), frames(write(tmp_path / "clip"))[:2]
    meter.add(one, None)
    assert np.isnan(meter.add(two.every(2), None))
    assert np.isfinite(meter.add(two.every(2), None))
    assert meter.lone == []


def test_a_run_writes_what_it_found(tmp_path) -> None:
    folder = write(tmp_path / "clip", wrong=(5, 12))
    words = "run", "--dataset", "video", "--data", folder, "--option", f"classes=[{','.join(CLASSES)}]", "--out", "out"
    done = bench(*words, "--video-measures", "dis", cwd=tmp_path, report=True, recording=True)
    text = " ".join(done.stdout.split())
    assert "least flicker first: 1. right, 2. flips" in text
    assert "frames that stand out, flips: 2 of 18, 0005 0012" in text
    assert "need depth and poses" in text
    out = tmp_path / "out"
    rows = rows_of(out / "frames/clip__flips__none.csv")
    assert [row["name"] for row in rows if row["outlying"] == "1"] == ["0005", "0012"]
    assert len(rows) == COUNT
    summary = json.loads((out / "summary.json").read_text())
    assert {run["model"] for run in summary["runs"]} == {"right", "flips"}
    assert "voxels" not in rows[0]
    assert (out / "tables/flicker.csv").read_text().count("\n") == 3
    assert {path.stem for path in (out / "tables").glob("*.csv")} == {"flicker", "frames", "video_measures"}
    page = (out / "report.html").read_text()
    assert "least flicker first" in page
    assert "a video has no depth and no poses" in page
    assert "flips, 0005: alone at" in page
    assert (out / "recording.rrd").stat().st_size > 10_000
    told = bench(*words, cwd=tmp_path).stderr
    assert "earlier results of other settings (video_measures: dis there, None here) are replaced" in told
    refused = bench(*words, "--frames", ":9", cwd=tmp_path, code=2)
    assert "choose another --out, or --overwrite" in refused.stderr


def test_runs_over_videos_are_shown_compared_and_gated(tmp_path) -> None:
    folder = write(tmp_path / "clip", wrong=(3, 5, 8, 12, 16))
    result = semstab.run(options(folder), out=tmp_path / "out", report=False)
    right, flips = (result.record(model=name) for name in ("right", "flips"))
    screen = bench("show", "out", cwd=tmp_path).stdout
    assert "least flicker first: 1. right, 2. flips" in screen
    assert "0005" in bench("show", "out", "frames", cwd=tmp_path).stdout
    (scene,) = semstab.compare(tmp_path / "out:right", tmp_path / "out:flips").scenes
    ((row,),) = (against.contrasts for against in scene.against)
    (first, second) = (record.image_space.compensated_flicker_percent for record in (right, flips))
    assert (row.measure, row.base, row.other) == (
        "compensated_flicker_percent",
        pytest.approx(first),
        pytest.approx(second),
    )
    assert row.difference.value == pytest.approx(second - first)
    bench("compare", "out:right", "out:flips", "--out", "compared", cwd=tmp_path)
    page = (tmp_path / "compared/report.html").read_text()
    assert f"{second:.2f} % against {first:.2f} %" in page
    gated = ("gate", "out:flips", "--against", "out:right", "--rule")
    assert "flicker rise" in bench(*gated, "flicker rise < 90", cwd=tmp_path).stdout
    bench("gate", "out:right", "--rule", "flicker > 50", cwd=tmp_path, code=4)
    refused = bench(*gated, "alpha drop < .1", cwd=tmp_path, code=2)
    assert "clip is a video, without depth and poses; a rule may bound its flicker" in refused.stderr


def test_other_processes_measure_the_same(tmp_path) -> None:
    write(tmp_path / "clips/a", wrong=(5,))
    write(tmp_path / "clips/b", wrong=(7,))
    words = (
        "--dataset", "video", "--data", "clips", "--option", f"classes=[{','.join(CLASSES)}]", "--frames", ":9",
        "--report", "on",
    )  # fmt: skip
    for out, jobs in (("one", "1"), ("two", "2")):
        bench("run", *words, "--out", out, "--jobs", jobs, cwd=tmp_path)
    assert _numbers(tmp_path / "one") == _numbers(tmp_path / "two")


def test_a_video_file_is_recognised_and_predicted_on(tmp_path) -> None:
    film = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (W, H))
    for image, _ in views():
        film.write(image)
    film.release()
    assert recognise(tmp_path / "clip.avi")[0] == "video"
    scene = open_dataset("video", {"root": tmp_path / "clip.avi"}).scene("clip")
    assert len(scene) == COUNT
    np.testing.assert_allclose(scene.timestamps, np.arange(COUNT) / 10)
    one = scene.color(7)
    assert np.abs(one.astype(int) - views()[7][0]).mean() < 8
    assert [scene.frame_name(k) for k in (0, 12)] == ["000000", "000012"]
    for index in (19, 3, 4, 2):
        np.testing.assert_array_equal(scene.color(index), scene.color(index))
    done = bench(tmp_path / "clip.avi", "--predict", "colour-clusters", "--out", "out", cwd=tmp_path)
    assert "20 frames of 128x96" in done.stdout
    assert len(list((tmp_path / "out/predictions/clip/labels/colour-clusters").glob("*.png"))) == COUNT


def test_a_model_of_one_class_is_not_ranked(tmp_path) -> None:
    folder = write(tmp_path / "clip", wrong=(5,))
    for k in range(COUNT):
        (folder / "labels/blind").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / f"labels/blind/{k:04d}.png"), np.zeros((H, W), np.uint8))
    words = "--dataset", "video", "--data", folder, "--option", f"classes=[{','.join(CLASSES)}]", "--out", "out"
    done = bench("run", *words, cwd=tmp_path, report=True)
    assert "least flicker first: 1. right, 2. flips\n" in done.stdout
    assert "uninformative: all of the labels of blind are left" in done.stdout
    assert "uninformative: all of the labels of blind" in (tmp_path / "out/report.html").read_text()


@pytest.mark.parametrize("images", ["", "images", "rgb"])
def test_images_are_found_beside_their_labels(images, tmp_path) -> None:
    write(tmp_path / "clip", images=images)
    dataset = open_dataset("video", {"root": tmp_path / "clip", "classes": CLASSES})
    assert dataset.scenes == ("clip",)
    assert set(dataset.scene("clip").models) == {"right", "flips"}
    assert open_dataset("video", {"root": tmp_path, "classes": CLASSES}).scenes == ("clip",)


@pytest.mark.parametrize("images", ["", "images"])
def test_a_folder_of_images_alone_names_the_dataset(images, tmp_path) -> None:
    write(tmp_path / "clip", images=images)
    with pytest.raises(DataError, match=r"clip: holds images, without the depth and poses .*--dataset video measures"):
        recognise(tmp_path / "clip")


def test_what_needs_a_map_says_so(tmp_path) -> None:
    folder = write(tmp_path / "clip")
    given = ("--dataset", "video", "--data", folder)
    classes = ("--option", f"classes=[{','.join(CLASSES)}]", "--frames", ":3")
    told = bench("run", *given, *classes, "--voxel-size", "0.1", "--out", "sized", cwd=tmp_path).stderr
    assert "voxel_size: a video has no map, so that this is not used" in told
    assert "not used" not in bench("run", *given, *classes, "--out", "plain", cwd=tmp_path).stderr
    assert "a video, without depth and poses" in bench("check", *given, cwd=tmp_path, code=2).stderr
    with pytest.raises(ConfigError, match="without depth and poses"):
        open_scenes(semstab.load_config(options(folder)))
    with pytest.raises(DataError, match="a video has no depth; use --video-measures dis"):
        semstab.run({**options(folder), "video_measures": "depth"})
    refused = bench("run", *given, "--predict", "colour-clusters", "--filter", "ema-warped:0.6", cwd=tmp_path, code=2)
    assert "looks at depth and pose, which a video does not have" in refused.stderr


@pytest.mark.parametrize(
    ("content", "said"), [(b"", "no video that OpenCV can decode"), (b"no video" * 99, "no video that OpenCV can")]
)
def test_a_file_that_is_no_video_is_one_line(content, said, tmp_path, capfd) -> None:
    (tmp_path / "clip.mp4").write_bytes(content)
    with pytest.raises(DataError, match=f"clip.mp4: {said}"):
        open_dataset("video", {"root": tmp_path / "clip.mp4"}).scene("clip")


def test_missing_labels_and_a_single_frame_are_named(tmp_path) -> None:
    folder = write(tmp_path / "clip")
    (folder / "labels/right/0003.png").unlink()
    with pytest.raises(DataError, match=r"1 missing: labels/right/0003.png"):
        semstab.run(options(folder))
    result = semstab.run(options(folder, incomplete="skip"))
    assert result.records[0].frames == COUNT - 1
    with pytest.raises(DataError, match="clip: a single frame is selected"):
        semstab.run({**options(folder), "frames": {"stop": 1}})
    with pytest.raises(DataError, match="no images here"):
        open_dataset("video", {"root": _empty(tmp_path)})


def _empty(tmp_path):
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


def test_truth_gives_consistency_where_it_stays_the_same(tmp_path) -> None:
    folder = write(tmp_path / "clip", wrong=(5,))
    (folder / "labels/right").rename(folder / "truth")
    (record,) = semstab.run(options(folder, ground_truth="truth/{name}")).records
    assert record.unit.model == "flips"
    assert 0 < record.image_space.vc8 < 1


def _numbers(out):
    """What a run leaves, without times and the command line."""
    runs = json.loads((out / "summary.json").read_text())["runs"]
    runs = [{name: value for name, value in run.items() if "_ms" not in name} for run in runs]
    series = {file.name: rows_of(file) for file in sorted(out.glob("frames/*.csv"))}
    tables = {file.name: file.read_bytes() for file in sorted(out.glob("tables/*"))}
    timeless = {
        name: [{key: value for key, value in row.items() if not key.endswith("_ms")} for row in rows]
        for name, rows in series.items()
    }
    return runs, timeless, tables


def test_truth_of_unknown_classes_is_left_out_and_named(tmp_path, caplog) -> None:
    folder = write(tmp_path / "clip")
    shutil.copytree(folder / "labels/right", folder / "labels/gt")
    with_classes = open_dataset("video", {"root": folder, "classes": CLASSES}).scene("clip")
    assert with_classes.ground_truth
    assert not caplog.records
    unknown = open_dataset("video", {"root": folder}).scene("clip")
    assert not unknown.ground_truth
    assert "clip: the classes of gt are not known, so it is not read" in caplog.text


def test_a_killed_run_goes_on_with_the_next_video(tmp_path, monkeypatch) -> None:
    for name in ("a", "b"):
        write(tmp_path / "clips" / name, wrong=(5,))
    words = "--dataset", "video", "--data", tmp_path / "clips", "--option", f"classes=[{','.join(CLASSES)}]"
    bench("run", *words, "--out", "whole", cwd=tmp_path, report=True)
    measured, add = [], VideoFlickerMeter.add

    def killed(meter, frame, truth):
        measured.append(frame.index)
        if len(measured) > 3 * COUNT:
            raise KeyboardInterrupt
        return add(meter, frame, truth)

    monkeypatch.setattr(VideoFlickerMeter, "add", killed)
    bench("run", *words, "--out", "out", cwd=tmp_path, code=130)
    measured.clear()
    again = bench("run", *words, "--out", "out", cwd=tmp_path, report=True, recording=True)
    assert len(measured) == 2 * COUNT
    assert "finished earlier: 2 of 4" in again.stderr
    assert _numbers(tmp_path / "out") == _numbers(tmp_path / "whole")
    pages = [(tmp_path / folder / "report.html").read_text() for folder in ("out", "whole")]
    pages = [page.partition("<title>")[2].partition('id="manifest"')[0] for page in pages]
    assert pages[0] == pages[1]
    assert "0005: alone at" in pages[0]
    assert (tmp_path / "out/recording.rrd").stat().st_size > 20_000

    measured.clear()
    changed = tmp_path / "clips/a/labels/flips/0007.png"
    assert cv2.imwrite(str(changed), np.zeros((H, W), np.uint8))
    bench("run", *words, "--out", "out", cwd=tmp_path)
    assert len(measured) == COUNT

    measured.clear()
    units = {file: json.loads(file.read_text()) for file in (tmp_path / "out/units").glob("*.json")}
    (file,) = (file for file, unit in units.items() if (unit["scene"], unit["model"]) == ("b", "flips"))
    file.write_text("{")
    told = bench("run", *words, "--out", "out", cwd=tmp_path)
    assert "damaged; the unit is computed again" in told.stderr
    assert len(measured) == COUNT
    bench("run", *words, "--out", "out", cwd=tmp_path)
    assert len(measured) == COUNT


def test_a_recording_is_made_again_from_the_folder(tmp_path) -> None:
    folder, file = write(tmp_path / "clip", wrong=(5,)), tmp_path / "again.rrd"
    semstab.run(options(folder), out=tmp_path / "out", report=False)
    assert lacks_pictures(tmp_path / "out", file)
    record_finished(tmp_path / "out", file)
    assert not lacks_pictures(tmp_path / "out", file)
    drawn = {name.partition(":")[0] for name in RrdReader(file).store().schema().column_names()}
    assert {f"/clip/series/lone_percent/{model}" for model in ("right", "flips")} <= drawn
    assert "/clip/camera/color" in drawn
    assert not [name for name in drawn if name.startswith(("/clip/map", "/clip/trajectory", "/clip/depth"))]
