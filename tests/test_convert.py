"""Any dataset as posed folders: the same voxels, kept files, formats of depth, and what cannot be held."""

from __future__ import annotations

import dataclasses
import json

import dataset_writers
import numpy as np
import pytest
import tiny_scene
from dataset_writers import CLASSES as FORMAT_CLASSES
from dataset_writers import FORMATS, source, write_labels
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image
from posed_config import configure
from room_scene import CAMERA, Room, opened, walk, write
from typer.testing import CliRunner

from semstab import Intrinsics, LabelSpace
from semstab.backends import create
from semstab.cli import app
from semstab.config import Config
from semstab.configure import load_config, resolve
from semstab.convert import convert, convert_scene, depth_format, matrix_text, quantised
from semstab.datasets import GROUND_TRUTH, open_dataset
from semstab.errors import ConfigError, DataError
from semstab.testing import assert_same_map

CITY = {
    "width": 48,
    "height": 27,
    "frames": 4,
    "origin": [4e5, 5e6, 30],
    "models": {"hard": {"flicker": 0.1}, "soft": {"softness": 0.3}},
}


def of_city(name="city", options=CITY, **content) -> Config:
    """Of the city, or of another dataset."""
    base = {"dataset": {"name": name, "options": options}, "models": None, "taxonomy": None}
    return resolve(load_config(None, base | content))


def fused(scene, model, voxel_size=0.5):
    K = len(scene.label_space(model))
    backend = create("numpy", voxel_size=voxel_size, num_classes=K)
    space = scene.label_space(model)
    mapping = space.mapping_to(space)
    for index in range(len(scene)):
        frame = scene.frame(index, model)
        if frame.labels is not None:
            frame = dataclasses.replace(frame, labels=mapping.labels(frame.labels, ""))
        backend.integrate(frame)
    return backend.table()


def of_memory(room, tmp_path, **content):
    return convert_scene(room, of_city(**content), tmp_path / "out", 0.0, lambda *_: None)


def snapshot(folder):
    return {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in folder.rglob("*.*")}


def test_the_city_gives_the_same_voxels(tmp_path):
    """Depth of float32, hard labels, soft scores and ground truth, at UTM coordinates."""
    config = of_city(scenes=["scene0"])
    (converted,) = convert(config, tmp_path)
    assert (converted.frames, converted.written, converted.depth) == (4, 4, "float32 .npy")
    assert converted.renamed == {"soft": "soft-scores"}
    assert converted.lost == ("time stamps",)
    source, scene = open_dataset("city", config.dataset.options).scene("scene0"), opened(tmp_path)
    assert (scene.name, scene.models, scene.ground_truth) == ("scene0", ("hard", "soft-scores"), True)
    assert scene.up.tolist() == source.up.tolist()
    for there, here in (("hard", "hard"), ("soft", "soft-scores"), (GROUND_TRUTH, GROUND_TRUTH)):
        assert scene.label_space(here) == source.label_space(there)
        table = fused(scene, here)
        assert len(table) > 100
        assert_same_map(table, fused(source, there), 0.0)
    one, other = scene.frame(2, "hard"), source.frame(2, "hard")
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.T_wc, other.T_wc)
    np.testing.assert_array_equal(one.color, other.color)
    assert one.intrinsics == other.intrinsics


def test_a_folder_of_millimetres_stays_one(tmp_path):
    """World-to-camera poses in OpenGL axes and depth in tenths of millimetres come out in the plain convention."""
    root = tiny_scene.write(tmp_path / "wall")
    with (root / "scene.yaml").open("a") as file:
        file.write("depth_scale: 10000\npose_convention: world_to_camera\ncamera_axes: opengl\n")
    (converted,) = convert(configure(root), tmp_path / "out")
    assert converted.depth == "16-bit PNG, 1000 units per metre"
    source, scene = opened(root), opened(tmp_path / "out/wall")
    assert (scene.options.pose_convention, scene.options.camera_axes) == ("camera_to_world", "opencv")
    for model in ("a", "b", "gt"):
        assert_same_map(fused(scene, model, 0.025), fused(source, model, 0.025), 0.0)


def test_frames_keep_their_number(tmp_path):
    (converted,) = convert(of_city(scenes=["scene1"], frames={"start": 1, "stride": 2}), tmp_path)
    assert converted.frames == 2
    names = sorted(path.stem for path in (tmp_path / "scene1/depth").iterdir())
    assert names == ["000001", "000003"]


def test_label_sources_and_scenes_are_selected(tmp_path):
    done = list(convert(of_city(scenes=["scene0", "scene2"], models=["hard"]), tmp_path))
    assert [converted.scene for converted in done] == ["scene0", "scene2"]
    scene = open_dataset("posed_folder", {"root": tmp_path}).scene("scene2")
    assert (scene.models, scene.ground_truth) == (("hard",), False)
    with pytest.raises(ConfigError, match="no scene 'scene9'"):
        list(convert(of_city(scenes=["scene9"]), tmp_path))
    with pytest.raises(ConfigError, match="no model 'hart'; did you mean 'hard'"):
        list(convert(of_city(models=["hart"]), tmp_path))


# --- going on


def test_what_is_there_is_kept(tmp_path):
    config = of_city(scenes=["scene0"])
    list(convert(config, tmp_path))
    images = {path: at for path, at in snapshot(tmp_path).items() if path.suffix in (".png", ".npy", ".npz", ".txt")}
    (tmp_path / "scene0/labels/hard/000002.png").unlink()
    (again,) = convert(config, tmp_path)
    assert again.written == 1
    now = snapshot(tmp_path)
    assert {path for path, at in images.items() if now[path] != at} == {tmp_path / "scene0/labels/hard/000002.png"}
    (more,) = convert(config.model_copy(update={"models": ["hard"]}), tmp_path)
    assert more.written == 0


def test_an_interrupted_conversion_goes_on(tmp_path):
    config = of_city(scenes=["scene0"])
    steps = []

    def interrupting(what, done, total):
        steps.append((what, done, total))
        if len(steps) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(convert(config, tmp_path / "out", progress=interrupting))
    assert steps[0] == ("scene0 · hard", 1, 4)
    assert steps[-1] == ("scene0 · soft", 2, 4)
    assert not list((tmp_path / "out").rglob(".*"))  # nothing half-written
    (converted,) = convert(config, tmp_path / "out")
    assert converted.written == 4  # of each the ground truth was missing
    list(convert(config, tmp_path / "whole"))
    for model in ("hard", "soft-scores", "gt"):
        assert_same_map(
            fused(opened(tmp_path / "out/scene0"), model), fused(opened(tmp_path / "whole/scene0"), model), 0.0
        )


def test_more_frames_can_follow_but_not_fewer(tmp_path):
    for stop, written in ((2, 2), (4, 2)):
        (converted,) = convert(of_city(scenes=["scene0"], frames={"stop": stop}), tmp_path)
        assert (converted.frames, converted.written) == (stop, written)
    with pytest.raises(ConfigError, match="holds frame 000003, which is not selected now"):
        list(convert(of_city(scenes=["scene0"], frames={"stop": 3}), tmp_path))


def test_a_folder_of_something_else_is_not_touched(tmp_path):
    (tmp_path / "scene0").mkdir()
    (tmp_path / "scene0/mine.txt").write_text("mine")
    config = of_city(scenes=["scene0"])
    with pytest.raises(ConfigError, match="the folder exists and holds no conversion"):
        list(convert(config, tmp_path))
    list(convert(config, tmp_path / "out"))
    changed = of_city(options=CITY | {"seed": 1}, scenes=["scene0"])
    with pytest.raises(ConfigError, match="was converted from other data or with other settings"):
        list(convert(changed, tmp_path / "out"))
    (tmp_path / "out/scene0/conversion.json").write_text('{"key": 1, "depth_scale": "x"}')
    with pytest.raises(DataError, match=r"conversion\.json: damaged; delete"):
        list(convert(config, tmp_path / "out"))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="the folder exists"):
        convert_scene(Room(walk(2)), of_city(), tmp_path / "file", 0.0, lambda *_: None)


def test_a_scene_is_not_converted_onto_itself(tmp_path):
    root = write(tmp_path / "room", Room(walk(2)))
    before = snapshot(root)
    with pytest.raises(ConfigError, match="the folder exists"):
        list(convert(configure(root), tmp_path))
    assert snapshot(root) == before


# --- depth


def test_depth_that_does_not_fit_later_is_stored_as_floats(tmp_path):
    """The first and last frames are whole millimetres, one between them is not."""

    class Late(Room):
        def frame(self, index, model, *, color=True):
            frame = super().frame(index, model, color=color)
            depth = np.round(frame.depth, 3) + np.float32(1e-4 * (index == 4))
            return dataclasses.replace(frame, depth=depth.astype(np.float32))

    room = Late(walk(6))
    converted = of_memory(room, tmp_path)
    assert converted.depth == "float32 .npy"
    assert {path.suffix for path in (tmp_path / "out/depth").iterdir()} == {".npy"}
    scene = opened(tmp_path / "out")
    for index in range(6):
        np.testing.assert_array_equal(scene.depth(index), room.frame(index, "net").depth)
    assert of_memory(room, tmp_path).written == 0


@pytest.mark.parametrize("scale", [1000.0, 5000.0, 6553.5, 256.0])
def test_the_scale_of_a_dataset_is_found_again(tmp_path, scale):
    """Depth as a reader of 16-bit files makes it, whatever its scale, is stored in 16 bits without loss."""

    def as_read(z):
        return np.divide(np.round(z * scale), scale, dtype=np.float32, casting="same_kind")

    room = Room(walk(2), told_depth=as_read)
    assert of_memory(room, tmp_path).depth == f"16-bit PNG, {scale:g} units per metre"
    np.testing.assert_array_equal(opened(tmp_path / "out").depth(1), room.frame(1, "net").depth)


def test_a_stated_error_is_kept(tmp_path):
    room = Room(walk(3))
    converted = convert_scene(room, of_city(), tmp_path / "out", 1e-3, lambda *_: None)
    assert converted.depth.startswith("16-bit PNG")
    worst = max(np.abs(opened(tmp_path / "out").depth(i) - room.frame(i, "net").depth).max() for i in range(3))
    assert 0 < worst <= 1e-3


def test_invalid_depth_stays_invalid(tmp_path):
    def with_gaps(z):
        z = np.round(z, 3)
        z[0, :5] = (0, -1, np.nan, np.inf, -np.inf)
        return z

    room = Room(walk(2), told_depth=with_gaps)
    assert of_memory(room, tmp_path).depth == "16-bit PNG, 1000 units per metre"
    scene = opened(tmp_path / "out")
    for index in range(2):
        np.testing.assert_array_equal(scene.frame(index, "net").valid, room.frame(index, "net").valid)


DEPTHS = hnp.arrays(
    np.float32,
    (2, 3),
    elements=st.one_of(st.floats(2**-10, 100, width=32), st.sampled_from([0.0, -1.0, np.nan, np.inf])),
)


@given(depth=DEPTHS, scale=st.sampled_from([100.0, 1000.0, 6553.5]))
def test_what_is_quantised_is_off_by_no_more_than_is_said(depth, scale):
    units, error = quantised(depth, scale)
    valid = (depth > 0) & (depth < np.inf)
    if np.isinf(error):
        whole = np.rint(depth[valid].astype(np.float64) * scale)
        assert whole.min() < 1 or whole.max() > 65535
        return
    np.testing.assert_array_equal(units > 0, valid)
    back = (units / scale).astype(np.float32)
    assert np.abs(back.astype(np.float64) - depth)[valid].max(initial=0) == pytest.approx(error)
    assert error <= 0.5 / scale + 1e-5


@given(depth=DEPTHS, tolerance=st.sampled_from([0.0, 1e-3, 0.1]))
def test_a_format_holds_what_it_was_chosen_for(depth, tolerance):
    form = depth_format([depth], tolerance)
    stored = form.stored(depth, tolerance)
    assert stored is not None
    if form.scale is None:
        assert stored is depth
    else:
        assert stored.dtype == np.uint16


@given(hnp.arrays(np.float64, (4, 4), elements=st.floats(-1e7, 1e7)))
def test_matrices_read_back_to_the_same_numbers(matrix):
    numbers = [float(word) for word in matrix_text(matrix).split()]
    np.testing.assert_array_equal(np.array(numbers).reshape(4, 4), matrix)


# --- what a posed folder cannot hold


def test_two_cameras_are_refused(tmp_path):
    class Zooming(Room):
        def frame(self, index, model, *, color=True):
            frame = super().frame(index, model, color=color)
            camera = Intrinsics(CAMERA.fx + (index == 2), CAMERA.fy, CAMERA.cx, CAMERA.cy)
            return dataclasses.replace(frame, intrinsics=camera)

    with pytest.raises(DataError, match=r"intrinsics .* differ from those of the frames before .* has one camera"):
        of_memory(Zooming(walk(4)), tmp_path)


def test_two_sources_of_one_folder_are_refused(tmp_path):
    room = Room(walk(2), soft=True)
    room.models = ("net", "net-scores")
    with pytest.raises(ConfigError, match="net and net-scores would get the same folder; choose with --model"):
        of_memory(room, tmp_path)


def test_sources_keep_their_names_where_a_folder_can_be_called_so(tmp_path):
    room = Room(walk(2), soft=False)
    room.models = ("a b", "a-b", "../x")
    assert list(of_memory(room, tmp_path).renamed) == ["../x"]
    assert {"a b", "a-b"} < {path.name for path in (tmp_path / "out" / "labels").iterdir()}
    assert not (tmp_path / "out" / "x").exists()


def test_an_oblique_up_direction_and_unknown_classes_are_said_to_be_lost(tmp_path):
    class Odd(Room):
        up = np.array([0.0, 0.6, 0.8])

        def label_space(self, model) -> LabelSpace:
            raise DataError("not known")

    converted = of_memory(Odd(walk(2)), tmp_path)
    assert converted.lost == (
        "the up direction, which is no axis",
        "the classes of net, which are not known; write a label_space.yaml for them",
        "the classes of gt, which are not known; write a label_space.yaml for them",
    )
    assert opened(tmp_path / "out").frame(1, "net").labels is not None


def test_a_scene_without_labels_keeps_depth_poses_colour_and_masks(tmp_path):
    root = write(tmp_path / "room", Room(walk(3)))
    for part in ("net", "gt"):
        (root / "labels" / part).rename(tmp_path / part)
    (root / "color").mkdir()
    for path in (root / "depth").iterdir():
        Image.fromarray(np.full((72, 96, 3), 7, np.uint8)).save(root / f"color/{path.stem}.png")
    (root / "mask").mkdir()
    Image.fromarray(np.eye(72, 96, dtype=np.uint8)).save(root / "mask/001.png")
    (converted,) = convert(configure(root), tmp_path / "out")
    assert converted.frames == 3
    source, scene = opened(root), opened(tmp_path / "out/room")
    np.testing.assert_array_equal(scene.depth(2), source.depth(2))
    np.testing.assert_array_equal(scene.T_wc(2), source.T_wc(2))
    assert scene.color(2).tolist() == source.color(2).tolist()
    assert scene.models == ()
    assert [path.name for path in (tmp_path / "out/room/mask").iterdir()] == ["000001.png"]


# --- the command


def bench(*arguments):
    return CliRunner().invoke(app, [str(word) for word in arguments], env={"COLUMNS": "80", "NO_COLOR": "1"})


def test_the_command_converts_and_says_what_it_did(tmp_path):
    root = tiny_scene.write(tmp_path / "wall")
    arguments = ("convert", "--data", root, "--out", tmp_path / "out")
    result = bench(*arguments)
    assert result.exit_code == 0, result.output
    assert f"wall: 3 frames, depth as 16-bit PNG, 1000 units per metre: {tmp_path}/out/wall" in result.stdout
    again = bench(*arguments)
    assert "3 frames, 3 of them finished earlier" in again.stdout
    manifest = json.loads((tmp_path / "out/wall/conversion.json").read_text())
    assert (manifest["schema"], manifest["depth_scale"]) == (1, 1000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--data", "/nowhere"), "/nowhere: there is no such folder"),
        (("--dataset", "city", "-s", "scene7"), "no scene 'scene7'"),
        (("--dataset", "ciy"), "did you mean 'city'?"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, arguments, message):
    result = bench("convert", "--out", tmp_path / "out", *arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_damaged_source_is_one_line_and_leaves_nothing_half_written(tmp_path):
    root = tiny_scene.write(tmp_path / "wall")
    (root / "labels/b/0001.png").write_bytes(b"no image")
    result = bench("convert", "--data", root, "--out", tmp_path / "out", "-q")
    assert result.exit_code == 2
    (line,) = result.stderr.strip().splitlines()
    assert "labels/b/0001.png: not a PNG image" in line
    assert not list((tmp_path / "out").rglob(".*"))
    assert len(list((tmp_path / "out/wall/labels/a").glob("*.png"))) == 3


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_voxels(tmp_path, name):
    form = FORMATS[name]
    frames = source(form.scale)
    write_labels(tmp_path / "data", form.write(tmp_path / "data", frames), frames)
    needed = {key: value() if callable(value) else value for key, value in form.options.items()}
    config = of_city(form.dataset, {"root": str(tmp_path / "data"), "classes": FORMAT_CLASSES, **needed})
    (converted,) = convert(config, tmp_path / "out")
    reader, scene = dataset_writers.opened(form, tmp_path / "data"), opened(converted.folder)
    assert scene.models == reader.models == ("net",)
    table = fused(scene, "net", 0.1)
    assert len(table) > 500
    assert_same_map(table, fused(reader, "net", 0.1), 0.0)
    if form.scale is not None and form.scale < dataset_writers.BITS_24:
        scale = 1000 if 1000 % form.scale == 0 else form.scale  # millimetres hold centimetres, too
        assert converted.depth == f"16-bit PNG, {scale:g} units per metre"
