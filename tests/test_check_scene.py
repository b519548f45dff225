"""The whole check of a scene: overlap, persistence, noise, labels, advice, its tables, and the refusal of a run."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import tiny_scene
import yaml
from PIL import Image
from posed_config import configure, dataset_of
from room_scene import AXES, CAMERA, CLASSES, RAY_LENGTH, Room, opened, rigid, walk, write
from typer.testing import CliRunner

import semstab
from semstab import Frame, LabelSpace
from semstab.check import check, check_scene, quick_check
from semstab.check.coverage import SIZES, plane_residuals
from semstab.check.histogram import LabelTally
from semstab.check.reprojection import View
from semstab.cli import app
from semstab.configure import load_config, resolve
from semstab.errors import ConfigError, DataError

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))


def of_memory(room: Room, **content):
    return check_scene(room, resolve(load_config(None, {"models": None, "taxonomy": None} | content)))


def bench(*arguments, width=80):
    result = CliRunner().invoke(app, [str(word) for word in arguments], env={"COLUMNS": str(width), "NO_COLOR": "1"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write(tmp_path_factory.mktemp("data") / "room")


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """The scene's first five frames."""
    return write(tmp_path_factory.mktemp("data") / "room", Room(walk(5)))


@pytest.fixture(scope="module")
def sound(folder):
    (checked,) = check(configure(folder, voxel_size=0.1))
    return checked


# --- what is found out


def test_a_sound_scene_has_no_problem(sound):
    assert (sound.problems, sound.verdict.state) == ((), "sound")
    assert (sound.scene, sound.frames, sound.selected, sound.size) == ("room", 12, 12, (96, 72))
    assert sound.depth.valid == 1
    assert 0.5 < sound.depth.p5 < sound.depth.p50 < sound.depth.p95 < 6


def test_motion_is_that_of_the_poses(sound):
    """Of neighbours 15 cm, of the furthest compared ones (8 frames apart) about a metre; depth is about 3 m."""
    poses = walk()
    shifts = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a in poses for b in poses if a is not b]
    least, most = (shift * sound.depth.p50 for shift in sound.motion.shift)
    assert min(shifts) * 0.9 < least < 0.25
    assert 0.5 < most < max(shifts)
    assert 1 < sound.motion.turn[0] < sound.motion.turn[1] < 40


def test_persistence_is_that_of_the_run(folder, sound):
    """All 12 frames are fused, so that OP is the run's own."""
    config = configure(folder, voxel_size=0.1, models=["gt"], check=None, check_geometry=True)
    (run,) = semstab.run(config, report=False).runs
    row = next(row for row in sound.persistence if row.voxel_size == 0.1)
    assert sound.fused_frames == 12
    assert (row.voxels, row.mean_op) == (run.map_summary.voxels, pytest.approx(run.map_summary.mean_op))
    assert row.shares == pytest.approx([stratum.share for stratum in run.map_summary.strata])
    assert [row.voxel_size for row in sound.persistence] == [0.05, 0.1, 0.2]


def test_larger_voxels_keep_more_points(sound):
    stays = [row.stays for row in sound.persistence]
    assert stays == sorted(stays)
    assert 0.1 < stays[0] < stays[-1] < 1


def test_overlap_falls_with_distance_and_labels_agree_as_often_as_planted(sound):
    assert [row.apart for row in sound.overlaps] == [(1, 1), (2, 2), (3, 8)]
    shares = [row.in_view for row in sound.overlaps]
    assert shares == sorted(shares, reverse=True)
    # each label is wrong in a tenth of the pixels: two agree in 0.9^2 + 0.1^2 of them, less at borders
    for row in sound.overlaps:
        assert row.agreement == pytest.approx(0.82, abs=0.04)
        assert row.covisible == row.in_view  # depth is everywhere


def test_noise_of_depth_is_measured():
    """Median of |a - b| is 0.674 sqrt(2) sigma of z; of the second difference of three, 0.674 sqrt(1.5) sigma."""
    noise = 0.02
    checked = of_memory(Room(noise=noise))
    z = checked.depth.p50
    assert checked.noise.between == pytest.approx(0.674 * 2**0.5 * noise * z, rel=0.25)
    assert checked.noise.within == pytest.approx(0.674 * 1.5**0.5 * noise * z, rel=0.25)
    assert checked.noise.footprint == pytest.approx(z / CAMERA.fx, rel=0.05)


def test_a_plane_has_no_residual():
    v, u = np.indices((20, 30))
    depth = (1 / (0.2 + 0.001 * u + 0.002 * v)).astype(np.float32)
    frame = Frame(0, depth, CAMERA, np.eye(4), labels=np.zeros((20, 30), np.uint8))
    residuals = plane_residuals(View.from_frame(frame, 1000))
    assert len(residuals) == 20 * 28
    assert residuals.max() < 1e-5


def test_suggestions_follow_from_the_data(sound):
    def thick(frames):
        return of_memory(Room([walk(12)[k // 5] for k in range(frames)])).suggestion

    fine, noisy = sound.suggestion, of_memory(Room(noise=0.03)).suggestion
    assert fine.voxel_size in SIZES
    assert fine.voxel_size < noisy.voxel_size
    assert noisy.pixel_stride >= fine.pixel_stride >= 1
    assert (fine.frame_stride, thick(60).frame_stride, thick(59).frame_stride) == (1, 3, 2)  # 20 frames are left
    slow = of_memory(Room([rigid(np.eye(3), (0.8 * i - 1, 0, 0.2 * i - 1)) for i in range(4)]))
    assert slow.suggestion.frame_stride == 1
    assert "share" in slow.suggestion.frame_stride_reason


def test_voxels_too_small_to_count_are_left_out(short):
    (checked,) = check(configure(short, voxel_size=1e-9))
    assert (checked.verdict.state, checked.persistence) == ("sound", ())
    result = bench("check", "--data", short, "--voxel-size", 1e-9)
    assert "SOUND" in result.stdout
    assert "observation persistence" not in result.stdout


def test_without_depth_nothing_is_said_about_motion(tmp_path):
    folder = write(tmp_path / "room", Room(walk(3), told_depth=lambda z: z * np.nan))
    (checked,) = check(configure(folder))
    assert (checked.motion, checked.noise, checked.suggestion) == (None, None, None)
    assert "nan" not in bench("check", "--data", folder).stdout


def test_frames_are_those_that_are_selected(folder):
    (checked,) = check(configure(folder, frames={"start": 2, "stride": 3}))
    assert (checked.frames, checked.selected, checked.fused_frames) == (12, 4, 4)
    assert checked.suggestion.frame_stride % 3 == 0


# --- labels


def tallied(space, *maps):
    tally = LabelTally("net")
    for labels in maps:
        depth = np.ones(labels.shape[:2], np.float32)
        given = {"scores": labels} if labels.ndim == 3 else {"labels": labels}
        tally.add(Frame(0, depth, CAMERA, np.eye(4), **given))
    return tally.histogram(space)


def test_labels_are_counted_by_class():
    space = LabelSpace("mine", ("a", "b", "c"), ids=(0, 4, 7))
    found = tallied(space, np.array([[0, 0, 4, 255]], np.uint8), np.array([[7, 255, 65535, 0]], np.uint16))
    assert found.classes == {"a": 3 / 8, "b": 1 / 8, "c": 1 / 8}
    assert (found.ignored, found.unknown, found.problem, found.pixels) == (3 / 8, {}, None, 8)


def test_ids_outside_the_taxonomy_are_named():
    space = LabelSpace("mine", ("a", "b"))
    found = tallied(space, np.array([[0, 1, 5, 9]], np.uint8))
    assert found.unknown == {5: 0.25, 9: 0.25}
    assert found.problem == "labels of net: id 5, 9 (50.00% of the pixels) is outside the taxonomy mine (ids 0 to 1)"


def test_scores_count_by_their_largest_class():
    space = LabelSpace("mine", ("a", "b"), ids=(3, 8))
    scores = np.array([[[0.9, 0.1], [0.2, 0.8], [0, 0], [np.nan, 1]]], np.float32)
    found = tallied(space, scores)
    assert (found.classes, found.ignored, found.problem) == ({"a": 0.25, "b": 0.25}, 0.5, None)
    wider = tallied(space, np.ones((1, 2, 3), np.float32))
    assert wider.problem == "scores of net hold 3 classes, but mine has 2"


def test_maps_without_a_label_are_a_problem():
    found = tallied(LabelSpace("mine", ("a", "b")), np.full((2, 2), 255, np.uint8))
    assert found.problem == "labels of net: no pixel has a label"
    assert tallied(None, np.array([[3, 3, 255, 1]], np.uint8)).classes == {"1": 0.25, "3": 0.5}


def test_every_model_is_counted(tmp_path):
    folder = tiny_scene.write(tmp_path / "wall")
    (checked,) = check(configure(folder))
    assert [labels.model for labels in checked.labels] == ["a", "b"]
    (checked,) = check(configure(folder, models=["gt"]))
    assert [labels.model for labels in checked.labels] == ["gt"]
    assert sum(checked.labels[0].classes.values()) == pytest.approx(1)


def test_labels_that_were_begun_only_stop_nobody_else(tmp_path):
    folder = tiny_scene.write(tmp_path / "wall")
    first, *others = sorted((folder / "labels/b").glob("*.png"))
    for file in others:
        file.unlink()
    (checked,) = check(configure(folder))
    assert [labels.model for labels in checked.labels] == ["a"]
    (note,) = [note for note in checked.notes if note.startswith("labels of b: ")]
    assert note.startswith(f"labels of b: 1 of {1 + len(others)} selected frames have a map, so they were not checked")
    with pytest.raises(DataError, match="labels/b"):
        list(check(configure(folder, models=["b"])))
    (folder / "labels/a" / first.name).unlink()
    with pytest.raises(DataError, match="labels/"):
        list(check(configure(folder)))


def test_unknown_classes_are_a_problem_beside_the_geometry(tmp_path):
    folder = write(tmp_path / "room", Room(walk(5)))
    (folder / "scene.yaml").write_text("")
    (checked,) = check(configure(folder))
    assert checked.verdict.state == "sound"
    (problem,) = checked.problems
    assert "the classes of 'net' are not known" in problem


def test_a_scene_without_labels_is_checked_by_its_depth(tmp_path):
    folder = write(tmp_path / "room", Room(walk(6)))
    shutil.rmtree(folder / "labels")
    (checked,) = check(configure(folder))
    assert (checked.verdict.state, checked.labels, checked.problems) == ("sound", (), ())
    assert all(np.isnan(row.agreement) for row in checked.overlaps)
    np.savetxt(folder / "pose/003.txt", np.full((4, 4), np.nan))
    (checked,) = check(configure(folder))
    assert (checked.frames, checked.selected, checked.verdict.state) == (6, 5, "sound")


def test_a_dataset_that_yields_nothing_without_labels_says_so():
    room = Room()
    room.models, room.ground_truth = (), False
    with pytest.raises(DataError, match="without any this dataset yields no depth"):
        of_memory(room)


def test_a_selection_that_does_not_fit_is_refused(folder):
    for content, message in (
        ({"scenes": ["rom"]}, "did you mean 'room'"),
        ({"models": ["nat"]}, "did you mean 'net'"),
        ({"taxonomy": "uavid7"}, "no class takes"),
        ({"frames": {"start": 20}}, "leaves none of its 12"),
    ):
        with pytest.raises(ConfigError, match=message):
            list(check(configure(folder, **content)))


# --- the command


def test_the_tables_fit_80_columns_and_the_numbers_go_to_a_file(folder, short, tmp_path):
    file = tmp_path / "check.json"
    result = bench("check", "--data", folder, "--json", file, "--voxel-size", 0.1, "--verbose")
    assert result.exit_code == 0, result.stderr
    assert max(map(len, result.stdout.splitlines())) <= 80
    for word in ("as configured", "frames apart", "OP=1", "labels, % of the pixels", "--voxel-size", "SOUND"):
        assert word in result.stdout
    plain = bench("check", "--data", short, "--voxel-size", 0.1).stdout
    assert "SOUND" in "".join(plain.splitlines()[:3])
    assert len(plain.splitlines()) <= 24
    content = json.loads(file.read_text(), parse_constant=lambda text: pytest.fail(f"{text} in JSON"))
    (scene,) = content["scenes"]
    assert (content["schema"], scene["sound"], scene["problems"]) == (1, True, [])
    assert {row["name"] for row in scene["verdict"]["fits"]} >= {"as configured", "camera_axes: opengl"}
    assert scene["persistence"][1]["voxel_size"] == 0.1
    assert scene["overlaps"][0]["error"] < 0.01
    assert bench("check", "--data", short, "--quiet").output == ""


def test_unsound_data_are_exit_2_with_one_line_that_says_what_mends_it(tmp_path):
    folder = write(tmp_path / "room", Room(walk(6), told_pose=lambda T: T @ AXES["opengl"]))
    result = bench("check", "--data", folder)
    assert result.exit_code == 2
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: room: depth reprojects with ")
    assert f"under camera_axes: opengl (set it in {folder}/scene.yaml)" in line
    assert "UNSOUND" in result.stdout
    assert "same voxel" not in result.stdout  # nothing is said about voxels of a scene that is wrong
    assert bench("check", "--data", folder, "--set", "dataset.options.camera_axes=opengl").exit_code == 0


def test_every_scene_is_checked_and_every_problem_counted(tmp_path):
    write(tmp_path / "scenes/a", Room(walk(5)))
    write(tmp_path / "scenes/b", Room(walk(5), told_depth=lambda z: z * 0))
    Image.fromarray(np.full((72, 96), 77, np.uint8)).save(tmp_path / "scenes/b/labels/net/002.png")
    result = bench("check", "--data", tmp_path / "scenes")
    assert result.exit_code == 2
    assert "  SOUND" in result.stdout
    assert result.stderr.strip() == (
        "error: b: no pixel of the sampled frames has valid depth; check the files and depth_scale"
        " (and 1 more, see above)"
    )
    assert "id 77: no class" in result.stdout


def damage_image(folder):
    path = folder / "labels/net/001.png"
    path.write_bytes(path.read_bytes()[:50])
    return "labels/net/001.png: not a whole PNG image"


def damage_depth(folder):
    np.save(folder / "depth/001.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return "depth/001.npy: the .npy header is damaged, or the array does not hold plain numbers"


def damage_pose(folder):
    (folder / "pose/001.txt").write_text("1 2 three")
    return "pose/001.txt: expected numbers"


def damage_size(folder):
    np.save(folder / "depth/001.npy", np.ones((10, 10), np.float32))
    return "depth/001.npy: depth is 10x10 where that of the others is 96x72"


def damage_intrinsics(folder):
    (folder / "intrinsics.txt").write_text("nan 0 0 0 1 0 0 0 1")
    return "intrinsics.txt"


def damage_settings(folder):
    (folder / "scene.yaml").write_text("depth_kind: euclidean\n")
    return "scene.yaml: depth_kind: input should be 'planar', 'ray' or 'inverse' (got 'euclidean')"


@pytest.mark.parametrize(
    "damage", [damage_image, damage_depth, damage_pose, damage_size, damage_intrinsics, damage_settings]
)
def test_damaged_files_are_one_line(tmp_path, damage):
    folder = write(tmp_path / "room", Room(walk(3)))
    message = damage(folder)
    result = bench("check", "--data", folder)
    assert result.exit_code == 2
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "/nowhere"), "/nowhere: there is no such folder"),
        (("--dataset", "cty"), "did you mean 'city'?"),
        (("--set", "voxel_size=0"), "voxel_size: input should be greater than"),
        (("--frames", "x"), "write START:STOP:STRIDE"),
    ],
)
def test_wrong_options_are_one_line(arguments, message):
    result = bench("check", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


def test_a_file_that_cannot_be_written_is_one_line(short, tmp_path):
    (tmp_path / "file").write_text("")
    result = bench("check", "--data", short, "--json", tmp_path / "file/check.json", "-q")
    assert result.exit_code == 2
    assert len(result.stderr.strip().splitlines()) == 1


# --- in a run


def test_a_run_refuses_unsound_data_unless_told_otherwise(tmp_path):
    folder = write(tmp_path / "room", Room(walk(5), told_pose=np.linalg.inv))
    config = configure(folder, models=["net"], check=None, check_geometry=True, voxel_size=0.2)
    with pytest.raises(DataError, match=r"room: depth reprojects .* pose_convention: world_to_camera"):
        semstab.run(config, out=tmp_path / "run", report=False)
    assert not list((tmp_path / "run").rglob("*.parquet"))
    trusting = config.model_copy(update={"check_geometry": False})
    (run,) = semstab.run(
        trusting, out=tmp_path / "run", report=False
    ).runs  # the same folder: the numbers do not depend on it
    assert run.map_summary.voxels > 0
    assert "check" not in json.loads((tmp_path / "run/manifest.json").read_text())["seconds"]
    arguments = (
        "--data", folder, "-m", "net", "--voxel-size", 0.2, "--check", "none", "--rerun", "off", "--report", "off",
        "-q", "--out",
    )  # fmt: skip
    refused = bench("run", *arguments, tmp_path / "other")
    assert refused.exit_code == 2
    assert len(refused.stderr.strip().splitlines()) == 1
    assert bench("run", *arguments, tmp_path / "other", "--no-geometry-check").exit_code == 0


def test_a_study_refuses_unsound_data_unless_told_otherwise(tmp_path):
    folder = write(tmp_path / "room", Room(walk(5), told_pose=np.linalg.inv))
    content = {"dataset": dataset_of(folder), "backends": ["numba"], "voxel_size": 0.2}
    file = tmp_path / "room.yaml"
    file.write_text(yaml.safe_dump(content | {"models": ["net"]}))
    refused = bench("study", file, "--out", tmp_path / "study", "-q")
    assert refused.exit_code == 2
    assert "pose_convention: world_to_camera" in refused.stderr
    assert len(refused.stderr.strip().splitlines()) == 1
    assert not list((tmp_path / "study/units").glob("*.json"))
    assert (
        bench("study", file, "--out", tmp_path / "study", "-q", "--no-geometry-check", "--report", "off").exit_code == 0
    )
    assert json.loads((tmp_path / "study/manifest.json").read_text())["geometry"] == {}


def test_the_manifest_says_what_was_found_and_what_it_cost(folder, tmp_path):
    checked = []

    class Watching(semstab.engine.Observer):
        def geometry_checked(self, task, verdict):
            checked.append((task.scene.name, verdict.state))

    config = configure(folder, models=["net", "gt"], check=None, check_geometry=True, voxel_size=0.2)
    semstab.run(config, out=tmp_path / "run", observers=[Watching()], report=False)
    manifest = json.loads((tmp_path / "run/manifest.json").read_text())
    assert manifest["geometry"]["room"]["state"] == "sound"
    assert manifest["geometry"]["room"]["frames"] == 4
    assert manifest["seconds"]["check"] > 0
    assert checked == [("room", "sound")]  # once a scene, not once a model
    semstab.run(config, out=tmp_path / "run", observers=[Watching()], report=False)
    assert len(checked) == 1  # what is kept is not checked again


def test_what_cannot_be_told_does_not_stop_a_run(tmp_path):
    folder = write(tmp_path / "room", Room(walk(1)))
    words = ("--data", folder, "-b", "numpy", "--rerun", "off", "--report", "off", "--out", tmp_path / "run")
    result = bench("run", *words, width=200)
    assert result.exit_code == 0
    assert "room: it takes two frames to tell whether depth and poses agree" in result.stderr
    state = json.loads((tmp_path / "run/manifest.json").read_text())["geometry"]["room"]
    assert (state["state"], state["error"]) == ("unclear", None)


# --- depth along the ray


def test_depth_along_the_ray_gives_the_same_frames(tmp_path):
    rays = write(tmp_path / "rays", Room(walk(2), told_depth=lambda z: z * RAY_LENGTH), depth_kind="ray")
    planar = write(tmp_path / "planar", Room(walk(2)))
    a, b = opened(rays), opened(planar)
    np.testing.assert_allclose(a.frame(1, "net").depth, b.frame(1, "net").depth, rtol=1e-6)
    assert a.frame(1, "net").depth.dtype == np.float32
    assert a.digest([0], "net") != opened(rays, depth_kind="planar").digest([0], "net")
    np.save(rays / "depth/000.npy", np.array([[0, -1, np.nan, np.inf]], np.float32).repeat(72, 0).repeat(24, 1))
    assert not a.frame(0, "net").valid.any()


# --- real data


def real(name) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"no {DATA / name}; set SEMSTAB_DATA to the folder that holds {name}/")
    return DATA / name


@pytest.mark.parametrize(("name", "error"), [("apc_shelf", 0.007), ("hololens", 0.003)])
def test_real_scenes_are_sound_with_the_errors_of_their_notes(name, error):
    (checked,) = check(configure(real(name)))
    assert checked.problems == ()
    assert checked.notes == ()  # labels are registered, and no value of depth means 'no depth'
    assert checked.overlaps[0].error == pytest.approx(error, abs=0.002)
    assert checked.verdict.undetermined == ()


@pytest.mark.parametrize(
    ("name", "setting", "wrong", "right"),
    [
        ("apc_shelf", "pose_convention", "world_to_camera", "camera_to_world"),
        ("apc_shelf", "camera_axes", "opengl", "opencv"),
        ("hololens", "camera_axes", "ned", "opencv"),
        ("apc_shelf", "depth_scale", 100, "1000"),
        ("hololens", "depth_scale", 10_000, "1000"),
        ("apc_shelf", "depth_scale", 1, "1000"),
        ("hololens", "depth_kind", "ray", "planar"),
    ],
)
def test_a_mistake_in_a_real_scene_is_named(name, setting, wrong, right):
    options = {setting: wrong}
    scene = opened(real(name), **options)
    verdict = quick_check(scene, range(len(scene)), options)
    assert verdict.mend == (f"dataset.options.{setting}: {right}",)


def test_the_dictionary_is_plain_json(sound):
    content = sound.to_dict()
    assert json.loads(json.dumps(content, allow_nan=True, default=str))["verdict"]["state"] == "sound"
    assert set(dataclasses.asdict(sound)) <= set(content)
    assert re.fullmatch(r"depth reprojects with [\d.]+% median error, \d+% co-visible", content["verdict"]["text"])
    assert [row["model"] for row in content["labels"]] == ["net"]
    assert set(content["labels"][0]["classes"]) == set(CLASSES)


def test_intrinsics_of_the_colour_image_are_recognised(tmp_path):
    """Colour is 1.3 times as large as depth, and the intrinsics are those of colour."""
    size = (125, 94)
    folder = write(tmp_path / "room", Room(walk(9), camera=CAMERA.resized((96, 72), size)))
    (folder / "color").mkdir()
    for i in range(9):
        Image.fromarray(np.zeros((*size[::-1], 3), np.uint8)).save(folder / f"color/{i:03d}.png")
    (checked,) = check(configure(folder))
    assert checked.verdict.mend == ("intrinsics_size: [125, 94]",)


def test_frames_whose_poses_do_not_fit_the_others_are_named():
    """Of 12 frames the poses of two are wrong by 40 cm along their view: what they show is farther, or nearer."""
    wrong = [pose[2, 3] for pose in walk()[5:7]]

    def told(pose):
        return pose @ rigid(np.eye(3), (0, 0, -0.4)) if pose[2, 3] in wrong else pose

    checked = of_memory(Room(told_pose=told))
    (note,) = [text for text in checked.notes if "do not fit" in text]
    assert note.startswith("poses of frames 5 to 6 do not fit: ")
    assert not [text for text in of_memory(Room()).notes if "fit" in text]
