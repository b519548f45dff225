"""What a check points out though it may be right: values that mean 'no depth', and labels off the edges of depth."""

from __future__ import annotations

import dataclasses
import functools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_writers import four, write_labels, write_seven_scenes
from posed_config import configure, dataset_of
from posed_writer import write_posed
from room_scene import CLASSES, Room, walk, write
from typer.testing import CliRunner

import semstab
from semstab.check import check, registration
from semstab.check.no_depth import find_sentinel
from semstab.check.registration import find_offset, grey_levels
from semstab.check.reprojection import View
from semstab.cli import app
from semstab.datasets import open_dataset
from semstab.pixels.edges import depth_edges, image_edges

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))


def notes(root, **options):
    (checked,) = check(configure(root, dataset=dataset_of(root, **options), check_geometry=False))
    return checked.notes


# --- no depth


def with_gaps(z, value=65.535):
    z = np.round(z, 3)
    z[10:20, 30:50] = value
    return z


@pytest.fixture(scope="module")
def gaps(tmp_path_factory):
    """Folders by what 'no depth' is stored as: 65535 in millimetres, a far plane in millimetres, and 0 for both."""
    folders = {}
    for name, value in (("65535", 65.535), ("40000", 40.0), ("0", 0.0)):
        room = Room(walk(6), told_depth=functools.partial(with_gaps, value=value))
        sources = {name: [room.frame(i, name) for i in range(6)] for name in ("net", "gt")}
        folder = tmp_path_factory.mktemp(f"gaps{name}") / "room"
        folders[name] = write_posed(folder, [f"{i:03d}" for i in range(6)], sources, classes=list(CLASSES))
    return folders


@pytest.mark.parametrize("value", ["65535", "40000"])
def test_a_value_that_means_no_depth_is_left_out_and_said(gaps, value):
    (note,) = notes(gaps[value])
    assert f"2.9% of the pixels with depth have the value {value} " in note
    assert note.endswith(f"it means 'no depth'; it is left out (invalid_depth: [{value}])")
    assert notes(gaps[value], invalid_depth=[float(value)]) == ()


def test_check_prints_it(gaps):
    value = "40000"
    result = CliRunner().invoke(app, ["check", "--data", str(gaps[value])], env={"COLUMNS": "80", "NO_COLOR": "1"})
    assert f"note: 2.9% of the pixels with depth have the value {value}" in result.stdout


def test_a_run_leaves_it_out_as_check_does_and_says_so(gaps, tmp_path):
    value = "65535"

    def run(name, **settings):
        usual = {"models": ["net"], "check": None, "check_geometry": True, "voxel_size": 0.2}
        config = configure(gaps[name], **usual | settings)
        result = semstab.run(config, out=tmp_path / f"{name}{len(settings)}", report=False)
        return result.runs[0].map_summary.voxels, [note for of_scene in result.notes.values() for note in of_scene]

    (left_out, said), (without, silent), (trusting, _) = run(value), run("0"), run(value, check_geometry=False)
    assert left_out == without < trusting
    assert [note.endswith(f"it is left out (invalid_depth: [{value}])") for note in said] == [True]
    assert silent == []


def test_far_walls_and_noise_are_depth(tmp_path):
    assert notes(write(tmp_path / "room", Room(walk(6)))) == ()
    rng = np.random.default_rng(0)
    assert find_sentinel([rng.uniform(1, 9, (50, 60)).astype(np.float32)], 1.0) is None
    assert find_sentinel([np.full((5, 6), 2, np.float32)], 1000.0) is None
    assert find_sentinel([np.zeros((5, 6), np.float32)], 1000.0) is None
    assert find_sentinel([], 1000.0) is None


# --- registration


def zoomed(image, scale, x=0.0):
    H, W = image.shape
    about = np.array([[scale, 0, (1 - scale) * (W - 1) / 2 + x], [0, scale, (1 - scale) * (H - 1) / 2]])
    return cv2.warpAffine(image, about, (W, H), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


class Unregistered(Room):
    """Labels as a colour camera of another focal length has them, or one beside the depth camera."""

    def __init__(self, scale, x=0.0):
        super().__init__(walk(12))
        self.change = (scale, x)

    def frame(self, index, model, *, color=True):
        frame = super().frame(index, "gt", color=color)
        return dataclasses.replace(frame, labels=zoomed(np.array(frame.labels), *self.change))


@pytest.mark.parametrize(("scale", "x"), [(525 / 585, 0), (1, -7)])
def test_labels_that_are_not_registered_are_pointed_out(tmp_path, scale, x):
    (note,) = notes(write(tmp_path / "room", Unregistered(scale, x)))
    assert note.startswith(
        "labels of net look as if they were not registered to the depth: their edges fit those of depth"
    )
    enlarged = float(note.partition("enlarged ")[2].split()[0])
    assert enlarged == pytest.approx(1 / scale, abs=0.05)


@pytest.mark.parametrize(("stated", "said"), [(False, "[525, 525, 320, 240]"), (True, "[fx, fy, cx, cy]")])
def test_labels_of_7_scenes_are_given_the_camera_of_its_colour_to_paste(tmp_path, stated, said):
    room = Unregistered(525 / 585)
    color = np.zeros((*room.frame(0, "net").shape, 3), np.uint8)
    frames = [dataclasses.replace(room.frame(k, "net"), color=color) for k in range(len(room))]
    write_labels(tmp_path, write_seven_scenes(tmp_path, frames), frames)
    options = {"root": tmp_path, "classes": list(CLASSES), "intrinsics": four(frames[0])}
    if stated:  # wrongly: they are those of depth
        options |= {"color_intrinsics": four(frames[0]), "color_size": frames[0].shape[::-1]}
    scene = open_dataset("seven_scenes", options).scene(tmp_path.name)
    views = [View.from_frame(scene.frame(k, "net"), 500) for k in range(len(scene))]
    (line,) = registration.notes(scene, views, "net")
    assert line.endswith(f"set dataset.options.color_intrinsics: {said}, or register them to the depth")


def test_labels_that_are_registered_are_not(tmp_path):
    assert notes(write(tmp_path / "room", Unregistered(1))) == ()


def test_edges_that_have_nothing_to_do_with_each_other_are_not():
    rng = np.random.default_rng(1)
    depths = [np.kron(rng.uniform(1, 5, (9, 12)), np.ones((8, 8))).astype(np.float32) for _ in range(10)]
    noise = [np.kron(rng.random((18, 24)) < 0.2, np.ones((4, 4))) > 0 for _ in range(10)]
    assert find_offset(list(zip(depths, noise, strict=True))) is None
    assert find_offset([(depth, depth_edges(depth)) for depth in depths]) is None
    assert find_offset([]) is None


def test_an_optimum_on_the_bound_of_the_search_is_none():
    """Of what is enlarged by more than the search tries, its first or last scale fits best."""
    rng = np.random.default_rng(0)
    depths = [np.kron(rng.uniform(1, 5, (6, 8)), np.ones((16, 20))).astype(np.float32) for _ in range(8)]

    def found(scale):
        return find_offset([(depth, depth_edges(zoomed(depth, scale))) for depth in depths])

    assert found(1 / 0.9).scale == pytest.approx(0.9, abs=0.02)
    assert found(1 / 0.84) is None
    assert found(1 / 1.16) is None


def test_sparse_depth_tells_nothing_of_registration():
    """The edges of labels that are off, and dense depth, are enough; with depth in 30 % of the pixels they are not."""
    rng = np.random.default_rng(0)
    depths = [np.kron(rng.uniform(1, 5, (6, 8)), np.ones((16, 20))).astype(np.float32) for _ in range(8)]
    edges = [depth_edges(zoomed(depth, 1.1)) for depth in depths]
    sparse = [np.where(rng.random(depth.shape) < 0.3, depth, 0).astype(np.float32) for depth in depths]
    assert find_offset(list(zip(depths, edges, strict=True))) is not None
    assert find_offset(list(zip(sparse, edges, strict=True))) is None


def test_it_is_said_where_few_pixels_have_depth(tmp_path):
    def scans(z):
        return np.where(np.random.default_rng(0).random(z.shape) < 0.04, np.round(z, 3), 0)

    room = Room(walk(12), told_depth=scans)
    sources = {name: [room.frame(i, name) for i in range(12)] for name in ("net", "gt")}
    folder = write_posed(tmp_path / "room", [f"{i:03d}" for i in range(12)], sources, classes=list(CLASSES))
    (note,) = notes(folder)
    assert " % of the pixels have depth: labels of the others are in no map" in note
    assert 3 < float(note.split()[0]) < 5
    words = ["run", "--data", folder, "-m", "net", "--voxel-size", "0.2", "--out", tmp_path / "out", "--report", "off"]
    words += ["--rerun", "off", "--check", "none"]
    said = CliRunner().invoke(app, [str(word) for word in words]).stdout
    assert "of the pixels have depth" in " ".join(said.split())


def test_real_data_are_registered_and_have_no_such_values():
    """A flight; the indoor scenes are in `test_check_scene.py`."""
    if not (DATA / "brighton").is_dir():
        pytest.skip(f"no {DATA / 'brighton'}; set SEMSTAB_DATA to the folder that holds brighton/")
    assert notes(DATA / "brighton") == ()


def test_real_images_of_another_focal_length_are_pointed_out():
    if not (DATA / "hololens").is_dir():
        pytest.skip(f"no {DATA / 'hololens'}; set SEMSTAB_DATA to the folder that holds hololens/")
    scene = open_dataset("posed_folder", {"root": DATA / "hololens"}).scene("hololens")
    greys = {k: grey_levels(scene.image(k)) for k in range(0, 96, 6)}
    for scale in (525 / 585, 585 / 525):
        pairs = [(scene.depth(k), image_edges(zoomed(grey, scale))) for k, grey in greys.items()]
        assert find_offset(pairs).scale == pytest.approx(1 / scale, abs=0.03)
