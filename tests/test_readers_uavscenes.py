"""UAVScenes: flights by their names, the map of their place, ground truth in a folder apart, distorted photographs."""

from __future__ import annotations

import json
import re
from pathlib import Path

import dataset_writers as ds
import looking_down as down
import numpy as np
import pytest
from dataset_writers import save
from posed_scene import fails

from semstab import LabelSpace
from semstab.datasets import open_dataset, recognise
from semstab.errors import DataError

LENS = (-0.11, 0.05, 0.004, -0.003, -0.01)
NAMES = [f"165813705{k}.641204937" for k in range(3)]


def write_flight(root: Path, name="AMtown01", step=5, *, lens=LENS, nested=True) -> Path:
    """Write a flight that looks down at the plane of its place's map, with ground truth, as the archives unpack."""

    def inner(folder: str) -> Path:
        return root / folder / folder if nested else root / folder

    flight = inner(f"interval{step}_CAM_LIDAR") / f"interval{step}_{name}"
    cameras = []
    for k, stamp in enumerate(NAMES):
        frame = down.frame(k)
        save(flight / f"interval{step}_CAM/{stamp}.jpg", frame.color)
        truth = inner(f"interval{step}_CAM_label") / flight.name / f"interval{step}_CAM_label_id/{stamp}.png"
        save(truth, np.array([1, 3, 24], np.uint8)[frame.labels])
        save(flight / f"labels/net/{stamp}.png", np.array([1, 3, 24], np.uint8)[frame.labels])
        cameras += [ds.uavscenes_camera(f"{stamp}.jpg", frame, lens), ds.uavscenes_camera(f"{stamp}9.jpg", frame, lens)]
    (flight / "sampleinfos_interpolated.json").write_text(json.dumps(cameras))
    place = inner("terra_3dmap_pointcloud_mesh") / re.sub(r"\d+$", "", name)
    place.mkdir(parents=True, exist_ok=True)
    down.write_mesh(place / "Mesh.ply")
    return flight


def opened(root, scene="AMtown01", **options):
    space = {"taxonomies": {"gt": "uavscenes", "net": "uavscenes"}, "casts": False}
    return open_dataset("uavscenes", {"root": root} | space | options).scene(scene)


@pytest.mark.parametrize("nested", [True, False])
def test_a_flight_is_read_with_the_map_of_its_place_and_its_ground_truth(tmp_path, nested) -> None:
    write_flight(tmp_path, nested=nested, lens=(0.0,) * 5)
    assert recognise(tmp_path)[0] == "uavscenes"
    scene = opened(tmp_path)
    assert (scene.name, len(scene), scene.models, scene.ground_truth) == ("AMtown01", 3, ("net",), True)
    assert [scene.frame_name(k) for k in range(3)] == NAMES
    np.testing.assert_allclose(scene.timestamps, [float(name) for name in NAMES])
    assert scene.surface is not None
    assert scene.surface.parts[-2:] == ("AMtown", "Mesh.ply")
    for k in range(3):
        frame, expected = scene.frame(k, "gt"), down.frame(k)
        np.testing.assert_allclose(frame.T_wc, expected.T_wc, atol=1e-12)
        np.testing.assert_allclose(frame.depth, expected.depth, rtol=1e-5)
        np.testing.assert_array_equal(frame.labels, scene.frame(k, "net").labels)


def test_the_folder_of_one_flight_finds_what_lies_above(tmp_path) -> None:
    flight = write_flight(tmp_path, "HKairport_GNSS_Evening", lens=(0.0,) * 5)
    scene = opened(flight, "HKairport_GNSS_Evening")
    assert scene.ground_truth
    assert scene.surface is not None
    assert scene.surface.parts[-2] == "HKairport_GNSS_Evening"


def test_flights_over_one_place_share_its_map_and_two_intervals_are_refused(tmp_path) -> None:
    write_flight(tmp_path)
    write_flight(tmp_path, "AMtown02")
    dataset = open_dataset("uavscenes", {"root": tmp_path, "casts": False})
    assert dataset.scenes == ("AMtown01", "AMtown02")
    assert dataset.scene("AMtown01").surface == dataset.scene("AMtown02").surface
    write_flight(tmp_path, step=1)
    fails(DataError, "holds AMtown01 in two intervals; set root to one", open_dataset, "uavscenes", {"root": tmp_path})


def test_photographs_are_distorted_as_opencv_has_it(tmp_path) -> None:
    flight = write_flight(tmp_path)
    (frame, *_) = open_dataset("uavscenes", {"root": tmp_path, "casts": False}).frames(flight)
    assert frame.color_lens is not None
    assert frame.color_lens.coefficients == LENS
    assert frame.label_lens is frame.color_lens  # label maps are of the photographs


def test_without_the_map_a_surface_is_asked_for(tmp_path) -> None:
    flight = write_flight(tmp_path / "data")
    (tmp_path / "alone").mkdir()
    flight.rename(tmp_path / "alone/interval5_AMtown01")
    fails(DataError, "has no depth images; set surface to the mesh", opened, tmp_path / "alone")


@pytest.mark.parametrize(("change", "line"), [
    (lambda c: c[0].pop("T4x4"), "camera 0: T4x4 is no 4x4 matrix"),
    (lambda c: c[0]["T4x4"][0].__setitem__(0, 10**400), "camera 0: T4x4 is no 4x4 matrix"),
    (lambda c: c[1].update(P3x3=[[1, 2], [3, 4]]), "camera 1: P3x3 is no 3x3 matrix"),
    (lambda c: c[0]["P3x3"][0].__setitem__(1, 4.0), "camera 0: P3x3 is no matrix of a camera without skew"),
    (lambda c: c[0].update(K1="x"), "camera 0: K1 is no number"),
    (lambda c: c[0].update(Width=10.5), "camera 0: a photograph of 10.5x"),
    (lambda c: c[0].pop("OriginalImageName"), "camera 0: OriginalImageName is missing"),
    (lambda c: c.insert(0, 7), "camera 0: is no camera"),
])  # fmt: skip
def test_a_damaged_file_of_cameras_is_one_line(tmp_path, change, line) -> None:
    path = write_flight(tmp_path) / "sampleinfos_interpolated.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    fails(DataError, re.escape(line), opened, tmp_path)
    path.write_text("{}")
    fails(DataError, "expected a list of cameras, got a dict", opened, tmp_path)


def test_the_taxonomy_has_the_ids_of_the_label_maps() -> None:
    space = LabelSpace.load("uavscenes")
    assert space.ids == (0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 13, 14, 15, 16, 17, 18, 19, 20, 24)
