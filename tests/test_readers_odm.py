"""Projects of OpenDroneMap and OpenSfM: poses, names, sources of depth, distorted photographs, what is wrong."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import struct
from pathlib import Path

import cv2
import dataset_writers as ds
import looking_down as down
import numpy as np
import pytest
import trimesh
from dataset_writers import save, shot, write_reconstruction
from PIL import Image
from posed_scene import fails
from scipy.spatial.transform import Rotation

from semstab.backends import create
from semstab.config import FrameSelection
from semstab.data.georeference import Georeference, wkt
from semstab.datasets import open_dataset
from semstab.datasets.scene import select_frames
from semstab.errors import ConfigError, DataError

pytest.importorskip("pyproj")

NAMES = ["DJI_0002", "DJI_0010", "DJI_0001"]
"""Neither in natural nor in alphabetical order, as shots may be."""

PINHOLE = {"projection_type": "perspective", "focal": down.K.fx / down.W, "k1": 0.0, "k2": 0.0}
CLASSES = ["a", "b", "c"]
SIZE = (down.W, down.H)


def write_project(folder: Path, camera=PINHOLE, *, undistorted=True, depth: str | None = "mesh", **extra) -> Path:
    """Three shots that look down at the plane, their images, labels, and one source of depth."""
    frames = [down.frame(k) for k in range(3)]
    shots = {f"{name}.JPG": shot(frame, "c") for name, frame in zip(NAMES, frames, strict=True)}
    place = folder / ("opensfm/undistorted" if undistorted else "opensfm")
    write_reconstruction(place, [({"c": camera}, shots)], SIZE)
    for name, frame in zip(NAMES, frames, strict=True):
        image = f"opensfm/undistorted/images/{name}.JPG.tif" if undistorted else f"images/{name}.JPG"
        save(folder / image, frame.color)
        save(folder / f"labels/net/{name}.JPG.png", frame.labels)
    if depth is not None:
        DEPTHS[depth](folder, frames)
    return folder


def write_georeference(folder: Path, shift: float = 0.0) -> None:
    place = folder / "odm_georeferencing"
    place.mkdir()
    positions = [" ".join(f"{value + shift:.6f}" for value in down.pose(k)[:3, 3]) for k in range(3)]
    (place / "coords.txt").write_text("\n".join(["WGS84 UTM 15N", "576714 5188162", *positions]) + "\n")
    (place / "proj.txt").write_text("+proj=utm +zone=15 +datum=WGS84 +units=m +no_defs +type=crs")


def mvei(depth: np.ndarray) -> bytes:
    return b"\x89MVE_IMAGE\n" + struct.pack("<4i", *depth.shape[::-1], 1, 9) + depth.astype("<f4").tobytes()


def dmap(depth: np.ndarray, image: str, halves: bool = False) -> bytes:
    magic, exponent = (b"D2", 3) if halves else (b"DR", 0)
    head = magic + struct.pack("<Bb4I2f", 1, exponent, *SIZE, *depth.shape[::-1], 1, 99)
    head += struct.pack("<f", 1) if halves else b""
    head += struct.pack("<H", len(image)) + image.encode() + struct.pack("<3I", 2, 0, 7) + bytes(21 * 8)
    return head + ((depth / 2**exponent).astype("<f2") if halves else depth.astype("<f4")).tobytes()


def along_rays(frame) -> np.ndarray:
    v, u = np.mgrid[: down.H, : down.W]
    K = frame.intrinsics
    return frame.depth * np.sqrt(((u - K.cx) / K.fx) ** 2 + ((v - K.cy) / K.fy) ** 2 + 1)


def put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def write_mve(folder, frames) -> None:
    for k, frame in enumerate(frames):
        write_view(folder, k, f"{k:04d}", frame)


def write_view(folder, k: int, name: str, frame) -> None:
    view = folder / f"mve/views/view_{k:04d}.mve"
    put(view / "depth-L0.mvei", mvei(along_rays(frame)))
    (view / "meta.ini").write_text(f"# MVE\n[camera]\nname = no view\n\n[view]\nid = {k}\nname = {name}\n")


def write_openmvs(folder, frames, halves=False) -> None:
    """In another order than the shots."""
    for k, (name, frame) in enumerate(reversed([*zip(NAMES, frames, strict=True)])):
        image = f"/code/opensfm/undistorted/images/{name}.JPG.tif"
        put(folder / f"opensfm/undistorted/openmvs/depthmaps/depth{k:04d}.dmap", dmap(frame.depth, image, halves))


def write_opensfm(folder, frames, kind="clean") -> None:
    """Half as large as the images, with the plane of each pixel and a score beside the depth."""
    K, shape = down.K.resized((down.W, down.H), (down.W // 2, down.H // 2)), (down.H // 2, down.W // 2)
    for k, name in enumerate(NAMES):
        path = folder / f"opensfm/undistorted/depthmaps/{name}.JPG.tif.{kind}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        depth = down.plane_depth(frames[k].T_wc, K, shape).astype(np.float32)
        np.savez(path, depth=depth, plane=np.zeros((*shape, 3), np.float32), score=np.ones(shape, np.float32))


def write_files(folder, frames) -> None:
    for name, frame in zip(NAMES, frames, strict=True):
        save(folder / f"depth/{name}.npy", frame.depth)


DEPTHS = {
    "mesh": lambda folder, frames: down.write_mesh(folder / "odm_meshing/odm_25dmesh.ply"),
    "dsm": lambda folder, frames: down.write_raster(folder / "odm_dem/dsm.tif"),
    "mve": write_mve,
    "openmvs": write_openmvs,
    "opensfm": write_opensfm,
    "files": write_files,
}


def opened(folder: Path, name: str | None = None, **options):
    dataset = open_dataset("odm", {"root": folder, "classes": CLASSES, "casts": False} | options)
    return dataset.scene(name or dataset.scenes[0])


def test_poses_names_labels_and_images(tmp_path) -> None:
    scene = opened(write_project(tmp_path / "field"))
    assert [scene.image_name(k) for k in range(3)] == ["DJI_0001", "DJI_0002", "DJI_0010"]
    for at, k in enumerate((2, 0, 1)):
        expected, found = down.frame(k), scene.frame(at, "net")
        np.testing.assert_allclose(found.T_wc, expected.T_wc, atol=1e-12)
        np.testing.assert_array_equal(found.labels, expected.labels)
        np.testing.assert_array_equal(found.color, expected.color)
        assert found.intrinsics == expected.intrinsics
    assert scene.up.tolist() == [0, 0, 1]
    assert scene.georeference is None


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_of_every_source_which_is_said(tmp_path, kind) -> None:
    folder = write_project(tmp_path / "field", depth=kind)
    write_georeference(folder)
    scene = opened(folder)
    assert scene.depth_from.startswith(f"{kind}, ")
    assert scene.settings["depth_from"] == kind
    for at, k in enumerate((2, 0, 1)):
        frame = scene.geometry(at)
        assert frame.shape == ((down.H // 2, down.W // 2) if kind == "opensfm" else (down.H, down.W))
        expected = down.plane_depth(down.pose(k), frame.intrinsics, frame.shape)
        np.testing.assert_allclose(frame.depth, expected, atol=2e-5)
        assert frame.intrinsics.fx == pytest.approx(down.K.fx * frame.shape[1] / down.W)


def test_depth_maps_of_opensfm_in_their_older_place(tmp_path) -> None:
    folder = write_project(tmp_path / "field", depth="opensfm")
    expected = opened(folder).geometry(1).depth
    (folder / "opensfm/undistorted/depthmaps").rename(folder / "opensfm/depthmaps")
    assert opened(folder).depth_from.startswith("opensfm, ")
    np.testing.assert_array_equal(opened(folder).geometry(1).depth, expected)


def test_a_map_of_opensfm_that_was_checked_goes_before_a_raw_one(tmp_path) -> None:
    folder = write_project(tmp_path / "field", depth=None)
    frames = [down.frame(k) for k in range(3)]
    write_opensfm(folder, [dataclasses.replace(frame, T_wc=down.pose(9)) for frame in frames], "raw")
    wrong = opened(folder).geometry(0)
    write_opensfm(folder, frames)
    right = opened(folder).geometry(0)
    expected = down.plane_depth(down.pose(2), right.intrinsics, right.shape)
    np.testing.assert_allclose(right.depth, expected, atol=2e-5)
    assert np.abs(wrong.depth - expected).max() > 0.1
    (folder / f"opensfm/undistorted/depthmaps/{NAMES[2]}.JPG.tif.clean.npz").unlink()
    np.testing.assert_array_equal(opened(folder).geometry(0).depth, wrong.depth)


def test_the_first_source_is_taken_or_the_one_that_is_asked_for(tmp_path) -> None:
    folder = write_project(tmp_path / "field", depth="files")
    frames = [down.frame(k) for k in range(3)]
    for kind in ("openmvs", "mve", "mesh"):
        DEPTHS[kind](folder, frames)
        assert opened(folder).settings["depth_from"] == kind
    assert opened(folder, depth_from="openmvs").depth_from == ("openmvs, opensfm/undistorted/openmvs/depthmaps/*.dmap")
    down.write_mesh(folder / "odm_meshing/odm_mesh.ply", shift=(0, 0, 1))
    assert opened(folder).depth_from.endswith("odm_meshing/odm_mesh.ply")
    fails(DataError, r"field: has no depth: no dsm \(odm_dem/dsm.tif\); set surface", opened, folder, depth_from="dsm")


def test_depth_maps_of_halves_are_those_of_floats(tmp_path) -> None:
    folder = write_project(tmp_path / "field", depth=None)
    write_openmvs(folder, [down.frame(k) for k in range(3)], halves=True)
    np.testing.assert_allclose(opened(folder).depth(0), down.plane_depth(down.pose(2)), rtol=1e-3)


def test_submodels_are_scenes_of_their_own(tmp_path) -> None:
    for k in range(2):
        write_project(tmp_path / f"field/submodels/submodel_000{k}")
    below = open_dataset("odm", {"root": tmp_path / "field"}).scenes
    assert below == ("submodels-submodel_0000", "submodels-submodel_0001")
    write_project(tmp_path / "field")
    dataset = open_dataset("odm", {"root": tmp_path / "field", "classes": CLASSES, "casts": False})
    assert dataset.scenes == ("field", "field-submodels-submodel_0000", "field-submodels-submodel_0001")
    assert dataset.scene("field-submodels-submodel_0001").frame(0, "net").depth.all()


def test_a_project_of_opensfm_alone_and_a_mesh_beside_it(tmp_path) -> None:
    write_project(tmp_path / "all")
    folder = (tmp_path / "all/opensfm").rename(tmp_path / "sfm")
    scene = opened(
        folder,
        surface=tmp_path / "all/odm_meshing/odm_25dmesh.ply",
        labels_root=tmp_path / "all/labels",
        labels="{model}/{name}",
    )
    assert scene.depth_from.startswith("rays cast at")
    assert scene.settings["depth_kind"] == "planar"
    np.testing.assert_allclose(scene.frame(1, "net").depth, down.plane_depth(down.pose(0)), atol=2e-5)


# --- georeference -----------------------------------------------------------------------------------------------------


def test_the_georeference_of_a_project(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    expected = Georeference(wkt(down.UTM, "x"), down.OFFSET)
    assert opened(folder).georeference == expected
    (folder / "odm_georeferencing/proj.txt").unlink()
    assert opened(folder).georeference == expected


def test_a_project_of_opensfm_alone_lies_about_its_reference(tmp_path) -> None:
    from pyproj import CRS, Transformer

    folder = write_project(tmp_path / "field")
    (folder / "opensfm/reference_lla.json").write_text('{"latitude": 46.84, "longitude": -91.99, "altitude": 180.0}')
    scene = opened(folder)
    assert scene.georeference.offset == (0, 0, 180)
    assert scene.placed.endswith("no known position to compare the cameras with")
    crs = "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84"
    topocentric = Transformer.from_pipeline(f"{crs} +lat_0=46.84 +lon_0=-91.99 +h_0=180")
    points = np.array([[0.0, 0, 0], [500, -300, 20], [-900, 900, 45]])
    longitude, latitude = Transformer.from_crs(CRS.from_wkt(scene.georeference.crs), 4326, always_xy=True).transform(
        points[:, 0], points[:, 1]
    )
    back = np.stack(topocentric.transform(longitude, latitude, points[:, 2] + 180), axis=1)
    np.testing.assert_allclose(back, points, atol=0.15)  # of which 0.13 m are the Earth's curvature, up
    np.testing.assert_allclose(back[:, :2], points[:, :2], atol=0.05)


def made_matrix(degrees: float = 0.73, offset=(576734.25, 5188175.5, 180.0)) -> np.ndarray:
    """From a frame that is turned and tilted a little to the projection, 24 m off the offset of coords.txt."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", [degrees, 0.01 if degrees % 90 else 0], degrees=True).as_matrix()
    T[:3, 3] = offset
    return T


def bring_into(folder: Path, T: np.ndarray) -> np.ndarray:
    """Bring a project's poses and mesh from the projection less its offset into the frame that T maps from."""
    to = np.linalg.inv(T)
    to[:3, 3] += to[:3, :3] @ down.OFFSET
    path = folder / "opensfm/undistorted/reconstruction.json"
    content = json.loads(path.read_text())
    for values in content[0]["shots"].values():
        R = Rotation.from_rotvec(values["rotation"]).as_matrix()
        t = np.array(values["translation"])
        centre = to[:3, :3] @ (-R.T @ t) + to[:3, 3]
        R = R @ to[:3, :3].T
        values |= {"rotation": Rotation.from_matrix(R).as_rotvec().tolist(), "translation": (-R @ centre).tolist()}
    path.unlink()
    path.write_text(json.dumps(content))
    for mesh in folder.glob("odm_meshing/*.ply"):
        loaded = trimesh.load(mesh, process=False)
        vertices = loaded.vertices @ to[:3, :3].T + to[:3, 3]
        mesh.unlink()
        float64_ply(mesh, vertices, loaded.faces)
    return to


def float64_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.empty(len(faces), [("n", "u1"), ("corners", "<i4", 3)])
    rows["n"], rows["corners"] = 3, faces
    path.write_bytes(head.encode() + vertices.astype("<f8").tobytes() + rows.tobytes())


def write_matrix(folder: Path, T: np.ndarray) -> None:
    rows = "\n".join(" ".join(map(repr, row)) for row in T.tolist())
    (folder / "opensfm/geocoords_transformation.txt").write_text(rows + "\n")


def write_shots(folder: Path, shift: float = 0.0) -> None:
    """ODM's report of the cameras, all of them shifted to the east."""
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(32615, 4326, always_xy=True)
    features = []
    for k, name in enumerate(NAMES):
        east, north, up = down.pose(k)[:3, 3] + down.OFFSET
        at = to_degrees.transform(east + shift, north)
        geometry = {"type": "Point", "coordinates": [*at, up]}
        features.append({"type": "Feature", "properties": {"filename": f"{name}.JPG"}, "geometry": geometry})
    (folder / "odm_report").mkdir()
    (folder / "odm_report/shots.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))


def where_cameras_lie(scene) -> np.ndarray:
    """(n, 3) in the projection."""
    return scene.georeference.projected(np.array([scene.T_wc(k)[:3, 3] for k in range(len(scene))]))


@pytest.mark.parametrize("absolute", [True, False])
def test_topocentric_poses_are_brought_into_the_projection_by_the_matrix(tmp_path, absolute, caplog) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    before = opened(folder)
    expected, depth = where_cameras_lie(before), before.depth(1)
    T = made_matrix()
    bring_into(folder, T)
    write_matrix(folder, T if absolute else T - np.array([[0, 0, 0, x] for x in (*down.OFFSET, 0)]))
    scene = opened(folder)
    assert scene.georeference.turned
    np.testing.assert_allclose(where_cameras_lie(scene), expected, atol=1e-6)
    np.testing.assert_allclose(scene.depth(1), depth, atol=1e-4)
    assert "by opensfm/geocoords_transformation.txt; cameras " in scene.placed
    assert not caplog.records
    write_shots(folder)
    found = re.search(r"cameras (\S+) m \(median, horizontal\) from odm_report/shots", opened(folder).placed)
    assert float(found[1]) < 1e-3


@pytest.mark.parametrize("with_matrix", [True, False])
def test_the_matrix_is_not_applied_to_poses_that_are_in_the_projection(tmp_path, with_matrix, caplog) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    write_matrix(folder, made_matrix())  # of an earlier run
    if with_matrix:
        shutil.copy(
            folder / "opensfm/undistorted/reconstruction.json", folder / "opensfm/reconstruction.topocentric.json"
        )
    scene = opened(folder)
    assert scene.georeference == Georeference(wkt(down.UTM, "x"), down.OFFSET)
    assert "less the offset of odm_georeferencing/coords.txt; cameras 0.00 m" in scene.placed
    assert ("is a file left from another version of ODM?" in caplog.text) is not with_matrix


def test_without_the_matrix_the_reference_of_opensfm_gives_it(tmp_path, caplog) -> None:
    """The expected matrix is OpenSfM's: differences of a metre, carried through ECEF to the projection."""
    from pyproj import Transformer

    lat, lon, alt = 46.8421, -91.9941, 12.0
    so, co, sa, ca = (f(np.radians(x)) for x in (lon, lat) for f in (np.sin, np.cos))
    axes = np.array([[-so, -sa * co, ca * co], [co, -sa * so, ca * so], [0, ca, sa]])
    origin = np.array(Transformer.from_crs(4979, 4978, always_xy=True).transform(lon, lat, alt))
    degrees = Transformer.from_crs(4978, 4979, always_xy=True).transform(*(origin[:, None] + axes @ np.eye(3, 4)))
    east, north = Transformer.from_crs(4326, 32615, always_xy=True).transform(*degrees[:2])
    q = np.stack([east, north, degrees[2]], axis=1)
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    expected = where_cameras_lie(opened(folder))
    near = make_orthogonal((q[:3] - q[3]).T)
    assert np.degrees(np.arctan2(near[1, 0], near[0, 0])) == pytest.approx(0.73, abs=0.01)  # convergence of meridians
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = near, q[3]
    bring_into(folder, T)
    where = json.dumps({"latitude": lat, "longitude": lon, "altitude": alt})
    (folder / "opensfm/reference_lla.json").write_text(where)
    scene = opened(folder)
    np.testing.assert_allclose(scene.georeference.linear, (q[:3] - q[3]).T, atol=1e-7)
    np.testing.assert_allclose(scene.georeference.offset, q[3], atol=1e-5)
    scale = 4e-4 * np.hypot(*(expected[:, :2] - q[3][:2]).T).max()
    np.testing.assert_allclose(where_cameras_lie(scene)[:, :2], expected[:, :2], atol=scale)
    assert "by opensfm/reference_lla.json; cameras " in scene.placed
    assert not caplog.records


def make_orthogonal(axes: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(axes)
    return u @ vt


@pytest.mark.parametrize("source", ["coords.txt", "shots.geojson", "opensfm/exif", "images"])
def test_cameras_24_m_from_where_they_were_are_warned_of(tmp_path, source, caplog) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder, shift=24 / np.sqrt(2) if source == "coords.txt" else 0)
    if source == "shots.geojson":
        write_shots(folder, shift=24)
    if source in ("opensfm/exif", "images"):
        write_gps(folder, source, shift=24)
    scene = opened(folder)
    assert scene.georeference.offset == down.OFFSET
    assert re.search(r"the cameras lie 24(\.\d)? m \(median, horizontal\) from ", caplog.text)
    assert "restore opensfm/geocoords_transformation.txt and reference_lla.json of this run, or give crs" in caplog.text
    assert f"from {KNOWN[source]}" in scene.placed


def test_what_gps_explains_is_said_and_not_warned_of(tmp_path, caplog) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    write_gps(folder, "images", shift=3)
    assert opened(folder).placed.endswith("cameras 3.00 m (median, horizontal) from the GPS of the images")
    assert not caplog.records


@pytest.mark.parametrize(
    ("line", "damaged", "words"),
    [
        (-1, "1e300 0 0", "cameras 0.00 m (median"),
        (-1, "nan 0 0", "cameras 0.00 m (median"),
        (1, "1e300 5188162", "no known position to compare the cameras with"),
    ],
)
def test_positions_beyond_the_earth_are_left_out(tmp_path, line, damaged, words, caplog) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    coords = folder / "odm_georeferencing/coords.txt"
    lines = coords.read_text().splitlines()
    lines[line] = damaged
    coords.write_text("\n".join(lines))
    assert words in opened(folder).placed
    assert not caplog.records


KNOWN = {
    "coords.txt": "the positions in odm_georeferencing/coords.txt",
    "shots.geojson": "odm_report/shots.geojson",
    "opensfm/exif": "the GPS of the images (opensfm/exif)",
    "images": "the GPS of the images",
}


def write_gps(folder: Path, where: str, shift: float) -> None:
    """GPS of all images but the last, as OpenSfM keeps it or as EXIF of the photographs."""
    from pyproj import Transformer

    to_degrees = Transformer.from_crs(32615, 4326, always_xy=True)
    for k, name in enumerate(NAMES[:2]):
        east, north, _ = down.pose(k)[:3, 3] + down.OFFSET
        lon, lat = to_degrees.transform(east + shift, north)
        if where == "opensfm/exif":
            put(
                folder / f"opensfm/exif/{name}.JPG.exif",
                json.dumps({"gps": {"latitude": lat, "longitude": lon}}).encode(),
            )
            continue
        exif = Image.Exif()
        parts = ((int(x), int(x * 60 % 60), x * 3600 % 60) for x in (lat, -lon))
        exif[0x8825] = dict(zip((1, 2, 3, 4), ("N", next(parts), "W", next(parts)), strict=True))
        (folder / "images").mkdir(exist_ok=True)
        Image.new("RGB", SIZE).save(folder / f"images/{name}.JPG", exif=exif)


def test_a_textured_mesh_of_topocentric_poses_is_brought_back(tmp_path) -> None:
    """ODM writes it turned into the projection, less the matrix's east and north."""
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    depth, T = opened(folder).depth(0), made_matrix()
    bring_into(folder, T)
    write_matrix(folder, T)
    (folder / "odm_meshing/odm_25dmesh.ply").unlink()
    down.write_mesh(folder / "odm_texturing/odm_textured_model_geo.obj", shift=np.array(down.OFFSET) - [*T[:2, 3], 0])
    scene = opened(folder)
    assert scene.depth_from.endswith("odm_textured_model_geo.obj")
    np.testing.assert_allclose(scene.depth(0), depth, atol=1e-4)
    write_raster = down.write_raster(folder / "odm_dem/dsm.tif")
    assert opened(folder, depth_from="dsm").depth_from.endswith(write_raster.name)
    np.testing.assert_allclose(opened(folder, depth_from="dsm").depth(0), depth, atol=1e-4)


def test_an_alignment_to_another_cloud_is_followed(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    moved = np.eye(4)
    moved[:3, 3] = [2, -3, 7]
    (folder / "odm_georeferencing/alignment_matrix.json").write_text(json.dumps(moved.tolist()))
    scene = opened(folder)
    assert scene.georeference.offset == (576716, 5188159, 7)
    assert "moved by odm_georeferencing/alignment_matrix.json" in scene.placed


def test_options_say_more_than_files(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder, shift=700)
    turn = ((0, -1, 0), (1, 0, 0), (0, 0, 1))
    scene = opened(folder, crs="EPSG:32616", offset=(1, 2, 3), linear=turn)
    assert scene.georeference == Georeference(wkt("EPSG:32616", "x"), (1, 2, 3), turn)
    assert scene.placed is None
    fails(ConfigError, "cannot be inverted", opened, folder, crs="EPSG:32616", linear=((1, 0, 0),) * 3)


# --- lenses -----------------------------------------------------------------------------------------------------------

LENSES = {
    "perspective": {"projection_type": "perspective", "focal": 0.8, "k1": -0.12, "k2": 0.03},
    "brown": {
        "projection_type": "brown", "focal_x": 0.82, "focal_y": 0.78, "c_x": 0.02, "c_y": -0.01, "k1": -0.1, "k2": 0.05,
        "p1": 0.004, "p2": -0.003, "k3": -0.01,
    },
    "fisheye": {"projection_type": "fisheye", "focal": 0.8, "k1": 0.05, "k2": -0.02},
}  # fmt: skip
BIG = (96, 64)


def distort(camera, x, y):
    """Where OpenSfM's models see the ray (x, y, 1), in pixels of an image of `BIG`."""
    get = lambda key: camera.get(key, 0.0)  # noqa: E731
    r2 = x**2 + y**2
    if camera["projection_type"] == "fisheye":
        r = np.sqrt(r2)
        angle = np.arctan(r)
        scale = np.where(r > 0, angle * (1 + get("k1") * angle**2 + get("k2") * angle**4) / np.maximum(r, 1e-12), 1)
        x, y = x * scale, y * scale
    else:
        radial = 1 + get("k1") * r2 + get("k2") * r2**2 + get("k3") * r2**3
        x, y = (
            x * radial + 2 * get("p1") * x * y + get("p2") * (r2 + 2 * x**2),
            y * radial + 2 * get("p2") * x * y + get("p1") * (r2 + 2 * y**2),
        )
    fx, fy = (camera.get(key, camera.get("focal")) for key in ("focal_x", "focal_y"))
    W, H = BIG
    return W * (fx * x + get("c_x")) + (W - 1) / 2, W * (fy * y + get("c_y")) + (H - 1) / 2


def write_distorted(folder: Path, camera, undistorted: bool) -> Path:
    """A project with photographs of a lens, the ids of whose labels are random."""
    frames = [down.frame(k) for k in range(3)]
    shots = {f"{name}.JPG": shot(frame, "c") for name, frame in zip(NAMES, frames, strict=True)}
    write_reconstruction(folder / "opensfm", [({"c": camera}, shots)], BIG)
    if undistorted:
        write_reconstruction(folder / "opensfm/undistorted", [({"c": PINHOLE | {"focal": 0.8}}, shots)], BIG)
    rng = np.random.default_rng(0)
    for name in NAMES:
        ids = rng.integers(0, 3, BIG[::-1]).astype(np.uint8)
        save(folder / f"labels/net/{name}.png", ids)
        save(folder / f"images/{name}.JPG.png", np.stack([ids * 100] * 3, axis=-1))
    down.write_mesh(folder / "odm_meshing/odm_mesh.ply")
    return folder


def seen_by_pinhole(folder: Path, camera, K, shape) -> tuple[np.ndarray, np.ndarray]:
    """The nearest label of the distorted map at each pixel, and which pixels are far enough from a tie."""
    ids = cv2.imread(str(folder / f"labels/net/{NAMES[2]}.png"), cv2.IMREAD_UNCHANGED)
    v, u = np.mgrid[: shape[0], : shape[1]]
    x, y = distort(camera, (u - K.cx) / K.fx, (v - K.cy) / K.fy)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    inside = (column >= 0) & (column < BIG[0]) & (row >= 0) & (row < BIG[1])
    clear = (np.abs(x - column) < 0.47) & (np.abs(y - row) < 0.47)
    return np.where(inside, ids[row.clip(0, BIG[1] - 1), column.clip(0, BIG[0] - 1)], 255), clear


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("undistorted", [False, True])
def test_labels_of_distorted_photographs_land_where_they_belong(tmp_path, kind, undistorted) -> None:
    camera = LENSES[kind]
    folder = write_distorted(tmp_path / "field", camera, undistorted)
    scene = opened(folder, **({"labels_on": "original"} if undistorted else {}))
    frame = scene.frame(0, "net", color=False)
    assert frame.shape == BIG[::-1]
    assert frame.intrinsics.fx == pytest.approx(BIG[0] * 0.8)
    expected, clear = seen_by_pinhole(folder, camera, frame.intrinsics, frame.shape)
    assert clear.mean() > 0.8
    np.testing.assert_array_equal(frame.labels[clear], expected[clear])
    assert (frame.labels != cv2.imread(str(folder / f"labels/net/{NAMES[2]}.png"), -1)).mean() > 0.2


def test_models_predict_on_the_photograph_and_its_colour_is_shown_undistorted(tmp_path) -> None:
    folder = write_distorted(tmp_path / "field", LENSES["brown"], undistorted=False)
    scene = opened(folder)
    photograph = cv2.imread(str(folder / f"images/{NAMES[2]}.JPG.png"))
    np.testing.assert_array_equal(scene.image(0), photograph)
    frame = scene.frame(0, "net")
    inner = (slice(20, 40), slice(30, 60))
    assert np.abs(frame.color[inner].astype(int) - photograph[inner]).mean() > 20
    ids = cv2.imread(str(folder / f"labels/net/{NAMES[2]}.png"), -1)
    live = scene.predicted(0, labels=ids)
    np.testing.assert_array_equal(live.labels, frame.labels)
    assert "color" not in frame.files
    flat = opened(folder, labels_on="undistorted")
    np.testing.assert_array_equal(flat.image(0), frame.color)
    np.testing.assert_array_equal(flat.frame(0, "net").labels, ids)


def test_scores_of_distorted_photographs_are_mixed_with_any_number_of_classes(tmp_path) -> None:
    folder = write_distorted(tmp_path / "field", LENSES["fisheye"], undistorted=False)
    scores = np.random.default_rng(1).dirichlet(np.ones(9), BIG[::-1]).astype(np.float16)
    for name in NAMES:
        path = folder / f"scores/soft/{name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, scores.transpose(2, 0, 1))
    scene = opened(folder, classes=[f"c{k}" for k in range(9)])
    mixed = scene.frame(0, "soft-scores").scores
    assert mixed.shape == (*BIG[::-1], 9)
    np.testing.assert_allclose(mixed.astype(float).sum(axis=2)[20:40, 30:60], 1, atol=5e-3)


def test_what_a_lens_folds_over_has_no_label(tmp_path) -> None:
    camera = {"projection_type": "perspective", "focal": 0.5, "k1": -0.4, "k2": 0.0}
    labels = opened(write_distorted(tmp_path / "field", camera, undistorted=False)).frame(0, "net").labels
    assert labels[0, 0] == labels[-1, -1] == 255
    assert (labels[20:40, 30:60] < 3).all()


# --- what is wrong ----------------------------------------------------------------------------------------------------


def test_a_project_without_reconstruction_says_so(tmp_path) -> None:
    (tmp_path / "field/opensfm").mkdir(parents=True)
    match = "field: no scene here, nor 3 folders deep; one holds opensfm/undistorted/reconstruction.json or opensfm/rec"
    fails(DataError, match, opened, tmp_path / "field")


def test_several_reconstructions_are_named_and_one_can_be_chosen(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    path = folder / "opensfm/undistorted/reconstruction.json"
    (whole,) = json.loads(path.read_text())
    small = whole | {"shots": {"DJI_0010.JPG": whole["shots"]["DJI_0010.JPG"]}}
    path.write_text(json.dumps([whole, small]))
    match = (
        r"2 reconstructions, .*\(0: 3 shots from DJI_0002.JPG; 1: 1 shots from DJI_0010.JPG\); choose one with recon"
    )
    fails(DataError, match, opened, folder)
    assert len(opened(folder, reconstruction=1)) == 1
    fails(DataError, "there is no reconstruction 2; it has 2, counted from 0", opened, folder, reconstruction=2)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            {"projection_type": "spherical"},
            "camera 'c': the camera model 'spherical' is not known; there is perspective",
        ),
        ({"projection_type": []}, r"camera 'c': the camera model '\[\]' is not known"),
        ({"width": 0}, "camera 'c': 'width' is 0; expected a number of pixels"),
        ({"focal": None}, "camera 'c': 'focal' is missing"),
        ({"focal": 0.0}, "camera 'c': intrinsics: fx = 0; focal lengths must be positive"),
    ],
)
def test_a_camera_that_cannot_be_used_is_named(tmp_path, change, match) -> None:
    fails(DataError, match, opened, write_project(tmp_path / "field", camera=PINHOLE | change))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"camera": "other"}, "shot 'DJI_0002.JPG': its camera 'other' is not in the file"),
        ({"rotation": [0, 1]}, "'rotation' must be three numbers"),
        ({"translation": [0, 1, "x"]}, "'translation' is 'x'; expected a number"),
    ],
)
def test_a_shot_that_cannot_be_used_is_named(tmp_path, change, match) -> None:
    folder = write_project(tmp_path / "field")
    path = folder / "opensfm/undistorted/reconstruction.json"
    content = json.loads(path.read_text())
    content[0]["shots"]["DJI_0002.JPG"] |= change
    path.write_text(json.dumps(content))
    fails(DataError, match, opened, folder)


@pytest.mark.parametrize("kind", ["mve", "openmvs"])
def test_a_truncated_depth_map_is_named(tmp_path, kind) -> None:
    folder = write_project(tmp_path / "field", depth=kind)
    for path in [*folder.rglob("*.mvei"), *folder.rglob("*.dmap")]:
        path.write_bytes(path.read_bytes()[:-4])
    match = r"\.(mvei|dmap): truncated: 24x16 pixels need \d+ bytes, it has \d+"
    fails(DataError, match, opened(folder).depth, 0)
    for path in [*folder.rglob("*.mvei"), *folder.rglob("*.dmap")]:
        path.write_bytes(path.read_bytes()[:20])
    fails(DataError, r"\.(mvei|dmap): (not an MVE image|not an OpenMVS)", lambda: opened(folder).depth(0))


@pytest.mark.parametrize(
    ("file", "text", "kind", "match"),
    [
        ("proj.txt", "+proj=nowhere", ConfigError, r"proj.txt: '\+proj=nowhere' is no reference system"),
        ("coords.txt", "WGS84 UTM 15N\n576714\n", DataError, "coords.txt: expected a projection, 'EAST NORTH'"),
        ("coords.txt", "WGS84 UTM 15N\n", DataError, "coords.txt: expected a projection, 'EAST NORTH'"),
        ("alignment_matrix.json", "[1, 2]", DataError, "alignment_matrix.json: expected four rows of four numbers"),
        ("../opensfm/geocoords_transformation.txt", "1 0 0\n", DataError, "transformation.txt: expected four rows"),
        (
            "../opensfm/reference_lla.json",
            '{"latitude": 95, "longitude": 0, "altitude": 0}',
            DataError,
            "is no latitude",
        ),
        (
            "../odm_report/shots.geojson",
            '{"features": [1]}',
            DataError,
            "shots.geojson: expected points with a filename",
        ),
    ],
)
def test_a_damaged_georeference_is_named(tmp_path, file, text, kind, match) -> None:
    folder = write_project(tmp_path / "field")
    write_georeference(folder)
    put((folder / "odm_georeferencing" / file).resolve(), text.encode())
    fails(kind, match, opened, folder)


@pytest.mark.parametrize("lens", [PINHOLE, LENSES["brown"]])
def test_label_maps_of_another_view_are_named(tmp_path, lens) -> None:
    folder = write_project(tmp_path / "field", lens, undistorted=lens is PINHOLE)
    save(folder / "labels/net/DJI_0001.JPG.png", np.zeros((16, 16), np.uint8))
    fails(DataError, "DJI_0001.JPG.png: labels are 16x16 but .* 24x16, another view", opened(folder).frame, 0, "net")


def test_an_image_that_is_not_there_is_named_by_where_it_would_be(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    shutil.rmtree(folder / "opensfm/undistorted/images")
    assert opened(folder).missing(0, color=True) == [f"{folder}/opensfm/undistorted/images/DJI_0001.JPG"]
    with pytest.raises(DataError, match=r"3 missing: .*add them, or name their folder \(--option images=FOLDER\)$"):
        select_frames(opened(folder), FrameSelection(), color=True)


def test_original_labels_need_the_cameras_of_the_photographs(tmp_path) -> None:
    folder = write_project(tmp_path / "field")
    match = "opensfm/reconstruction.json: does not give the distortion of the photograph DJI_0002, which labels_on"
    fails(DataError, match, opened, folder, labels_on="original")
    write_distorted(folder, LENSES["brown"], undistorted=True)
    for path in (folder / "images").iterdir():
        path.unlink()
    scene = opened(folder, labels_on="original")
    fails(DataError, "the photograph of DJI_0001 is not there, .* set labels_on: undistorted", scene.image, 0)
    assert scene.missing(0, color=True) != []


# --- the real flight --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def brighton() -> Path:
    data = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))
    if not (data / "brighton").is_dir():
        pytest.skip(f"no {data / 'brighton'}; set SEMSTAB_DATA to the folder that holds brighton/")
    return data / "brighton"


@pytest.fixture(scope="module")
def project(brighton):
    return open_dataset("odm", {"root": brighton / "odm", "casts": False, "images": brighton / "color"}).scene("odm")


@pytest.fixture(scope="module")
def project_map(project):
    return map_of(project)


def map_of(scene):
    backend = create("numba", voxel_size=1.0, num_classes=2)
    for k in (0, 3, 5, 11):
        backend.integrate(scene.geometry(k).every(3))
    return backend.table()


def test_the_project_of_a_real_flight_is_its_posed_folder(brighton, project) -> None:
    folder = open_dataset("posed_folder", {"root": brighton}).scene("brighton")
    assert project.georeference.offset == down.OFFSET
    assert [project.image_name(k) for k in range(18)] == [folder.image_name(k) for k in range(18)]
    for index in (0, 11):
        ours, theirs = project.geometry(index, color=True), folder.geometry(index, color=True)
        np.testing.assert_allclose(ours.T_wc, theirs.T_wc, atol=1e-12)
        assert ours.intrinsics == theirs.intrinsics
        np.testing.assert_array_equal(ours.color, theirs.color)
        both = (ours.depth > 0) & (theirs.depth > 0)
        assert np.abs(ours.depth - theirs.depth)[both].max() < 0.002
        assert np.mean((ours.depth > 0) != (theirs.depth > 0)) < 3e-4  # rays along the surface's own border


@pytest.mark.parametrize("told_by", ["matrix", "poses in the projection"])
def test_the_real_flight_in_a_turned_frame_lies_where_it_lay(brighton, project, tmp_path, told_by, caplog) -> None:
    """Poses and mesh turned by 0.73 degrees and shifted by 24 m: what is exported is the same to a millimetre."""
    folder = tmp_path / "flight"
    shutil.copytree(brighton / "odm", folder)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    T = made_matrix()
    write_matrix(folder, T)
    if told_by == "matrix":
        bring_into(folder, T)
    images = {"casts": False, "images": brighton / "color"}
    there = project
    here = open_dataset("odm", {"root": folder} | images).scene("flight")
    assert here.georeference.turned is (told_by == "matrix")
    assert ("left from another version" in caplog.text) is (told_by != "matrix")
    np.testing.assert_allclose(where_cameras_lie(here), where_cameras_lie(there), atol=1e-4)
    if told_by == "matrix":
        ours, theirs = here.geometry(9), there.geometry(9)
        both = (ours.depth > 0) & (theirs.depth > 0)
        assert np.mean((ours.depth > 0) != (theirs.depth > 0)) < 3e-4
        gap = here.georeference.projected(points_at(ours, both)) - there.georeference.projected(points_at(theirs, both))
        assert np.quantile(np.abs(gap), 0.999) < 0.001


@pytest.mark.parametrize("write", [ds.write_nvm, ds.write_bundle])
def test_the_real_flight_exported_by_opensfm_has_the_voxels_of_its_project(
    brighton, project, project_map, tmp_path, write
) -> None:
    casts = {"casts": False, "images": brighton / "color"}
    folder = tmp_path / "flight"
    shutil.copytree(brighton / "odm", folder)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    (folder / "opensfm/undistorted/reconstruction.json").unlink()
    first = project.geometry(0)
    poses = {f"{project.frame_name(k)}.JPG.tif": np.linalg.inv(project.T_wc(k)) for k in range(len(project))}
    write(folder / "opensfm", poses, first.intrinsics.fx)
    exported = open_dataset("odm", {"root": folder} | casts).scene("flight")
    theirs, ours = project_map, map_of(exported)
    assert len(theirs) > 1000
    np.testing.assert_array_equal(ours.index, theirs.index)
    np.testing.assert_array_equal(ours.op, theirs.op)
    assert np.abs(ours.pixels - theirs.pixels).sum() < 1e-5 * theirs.pixels.sum()


def test_an_nvm_of_images_that_distort_is_refused_with_its_line(tmp_path) -> None:
    folder = tmp_path / "field"
    ds.write_exported(folder, [down.frame(k) for k in range(3)], "nvm")
    path = folder / "opensfm/undistorted/reconstruction.nvm"
    lines = path.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if "DJI_0001" in line)
    lines[at] = lines[at].removesuffix(" 0 0") + " -0.1 0"
    path.write_text("\n".join(lines) + "\n")
    fails(DataError, f"reconstruction.nvm: line {at + 1}: the camera distorts; undistort the images", opened, folder)


@pytest.mark.parametrize("radial", [(-0.1, 0.0), (0.0, 0.02)])
def test_a_bundle_of_images_that_distort_is_of_the_photographs(tmp_path, radial) -> None:
    """Labels lie on the photographs, as those of a reconstruction.json with the same lens."""
    camera = PINHOLE | {"k1": radial[0], "k2": radial[1]}
    shots = {f"{name}.JPG": shot(down.frame(k), "c") for k, name in enumerate(NAMES)}
    scenes = []
    for kind in ("json", "bundle"):
        folder = write_project(tmp_path / kind, camera, undistorted=False)
        if kind == "bundle":
            (folder / "opensfm/reconstruction.json").unlink()
            poses = {name: np.linalg.inv(down.frame(k).T_wc) for k, name in enumerate(shots)}
            ds.write_bundle(folder / "opensfm", poses, down.K.fx, radial)
        scenes.append(opened(folder))
    for k in range(3):
        theirs, ours = (scene.geometry(k) for scene in scenes)
        np.testing.assert_allclose(ours.T_wc, theirs.T_wc, atol=1e-6)
        np.testing.assert_allclose(ours.depth, theirs.depth, rtol=1e-4)


def points_at(frame, mask: np.ndarray) -> np.ndarray:
    """(n, 3) the points of the scene at pixels of a frame."""
    K, (v, u) = frame.intrinsics, np.nonzero(mask)
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(len(u))], axis=1)
    return (rays * frame.depth[mask][:, None].astype(float)) @ frame.T_wc[:3, :3].T + frame.T_wc[:3, 3]


@pytest.mark.parametrize("suffix", ["", ".JPG", ".JPG.tif"])
def test_mve_views_belong_to_the_images_that_they_name(tmp_path, suffix):
    folder = write_project(tmp_path / "p", depth=None)
    frames = {name: down.frame(k) for k, name in enumerate(NAMES)}
    for k, name in enumerate(reversed(NAMES)):
        write_view(folder, k, f"{name}{suffix}", frames[name])
    scene = opened(folder)
    for k in range(3):
        np.testing.assert_allclose(scene.depth(k), frames[scene.frame_name(k)].depth, rtol=1e-5)


def test_mve_views_of_other_images_are_refused(tmp_path):
    folder = write_project(tmp_path / "p", depth=None)
    write_view(folder, 0, "IMG_7.JPG", down.frame(0))
    fails(
        DataError,
        r"the views are called IMG_7 in their meta.ini, which no shot of the",
        opened,
        folder,
    )


@pytest.mark.parametrize("camera", [PINHOLE | {"k1": 0.1}, PINHOLE | {"projection_type": "fisheye"}])
def test_undistorted_images_whose_camera_distorts_are_refused(tmp_path, camera):
    folder = write_project(tmp_path / "p", camera)
    fails(DataError, r"undistorted/reconstruction.json: the camera of DJI_0\d+.JPG distorts", opened, folder)
