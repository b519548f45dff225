"""Cameras of Metashape, Pix4D and RealityCapture: their lenses and coordinates against the formulas of the programs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import dataset_writers as ds
import looking_down as down
import numpy as np
import pytest
from posed_scene import fails
from scipy.spatial.transform import Rotation

from semstab import Intrinsics
from semstab.backends import create
from semstab.datasets import open_dataset
from semstab.datasets.geometry.lenses import undistorted
from semstab.errors import DataError, MissingDependencyError

pyproj = pytest.importorskip("pyproj")

SIZE, CAMERA = (64, 48), [50.0, 50.0, 31.9, 23.2]
BROWN = {"k1": -0.11, "k2": 0.05, "k3": -0.01, "p1": 0.004, "p2": -0.003}
POSITION = 1 / 50
"""Pixels: OpenCV looks images up at 32 positions between two pixels."""

POSES = {f"DJI_{k:04d}.JPG": down.pose(k) for k in range(3)}


def opened(name, root, **options):
    dataset = open_dataset(name, {"root": root, "classes": ds.CLASSES, "casts": False} | options)
    return dataset.scene(dataset.scenes[0])


def seen_at(scene, folder, size=SIZE):
    """Pixels (H, W, 2), from the corner of the first one, at which the photograph shows what the pinhole sees; K."""
    (frame, *_) = open_frames(scene, folder)
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32))
    K = frame.camera.intrinsics_at(size[::-1])
    found = undistorted(np.stack([u, v], axis=-1), frame.color_lens, K, size[::-1], "there")
    inside = (found[..., 0] > 1) & (found[..., 0] < size[0] - 2) & (found[..., 1] > 1) & (found[..., 1] < size[1] - 2)
    assert inside.mean() > 0.5
    return found + 0.5, K, inside


def open_frames(name, root, **options):
    dataset = open_dataset(name, {"root": root} | options)
    return dataset.frames(dataset.folders[0])


def rays(K, size=SIZE):
    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return (u - K.cx) / K.fx, (v - K.cy) / K.fy


# --- Lenses -----------------------------------------------------------------------------------------------------------


def test_a_lens_of_metashape_is_that_of_its_manual(tmp_path) -> None:
    """Appendix D: P1 and P2 stand in the other order than in OpenCV; cx, cy count from the middle of the image."""
    ds.write_metashape_xml(tmp_path / "cameras.xml", POSES, [50.4, 50.0, 31.9, 23.2], SIZE, **BROWN)
    found, K, inside = seen_at("metashape", tmp_path)
    x, y = rays(K)
    r2 = x**2 + y**2
    radial = 1 + BROWN["k1"] * r2 + BROWN["k2"] * r2**2 + BROWN["k3"] * r2**3
    x1 = x * radial + BROWN["p1"] * (r2 + 2 * x**2) + 2 * BROWN["p2"] * x * y
    y1 = y * radial + BROWN["p2"] * (r2 + 2 * y**2) + 2 * BROWN["p1"] * x * y
    cx, cy = 31.9 - 31.5, 23.2 - 23.5
    u, v = SIZE[0] / 2 + cx + x1 * 50.0 + x1 * 0.4, SIZE[1] / 2 + cy + y1 * 50.0
    assert np.abs(found - np.stack([u, v], axis=-1))[inside].max() < POSITION
    assert np.abs(x1 - x).max() > 0.01


def test_a_fisheye_of_metashape_bends_the_angle(tmp_path) -> None:
    path = tmp_path / "cameras.xml"
    ds.write_metashape_xml(path, POSES, CAMERA, SIZE, k1=0.02, k2=-0.01, k4=0.001)
    path.write_text(path.read_text().replace('calibration type="frame"', 'calibration type="fisheye"'))
    found, K, inside = seen_at("metashape", tmp_path)
    x, y = rays(K)
    r = np.hypot(x, y)
    angle = np.arctan(r)
    bent = angle * (1 + 0.02 * angle**2 - 0.01 * angle**4 + 0.001 * angle**8) / np.maximum(r, 1e-12)
    u, v = 31.9 + 0.5 + 50 * x * bent, 23.2 + 0.5 + 50 * y * bent
    assert np.abs(found - np.stack([u, v], axis=-1))[inside].max() < POSITION


def test_a_lens_of_pix4d_is_that_of_its_support_page(tmp_path) -> None:
    radial, tangential = (-0.12, 0.06, -0.01), (0.003, -0.002)
    ds.write_pix4d_parameters(tmp_path, POSES, CAMERA, SIZE, radial, tangential)
    found, K, inside = seen_at("pix4d", tmp_path)
    x, y = rays(K)
    r2 = x**2 + y**2
    bent = 1 + radial[0] * r2 + radial[1] * r2**2 + radial[2] * r2**3
    u = 50 * (x * bent + 2 * tangential[0] * x * y + tangential[1] * (r2 + 2 * x**2)) + CAMERA[2] + 0.5
    v = 50 * (y * bent + 2 * tangential[1] * x * y + tangential[0] * (r2 + 2 * y**2)) + CAMERA[3] + 0.5
    assert np.abs(found - np.stack([u, v], axis=-1))[inside].max() < POSITION


@pytest.mark.parametrize("name", ["p3", "b2", "k4"])
def test_a_coefficient_that_no_lens_here_has_is_refused(tmp_path, name) -> None:
    ds.write_metashape_xml(tmp_path / "cameras.xml", POSES, CAMERA, SIZE, **{name: 5.0})
    said = r"cameras.xml: sensor 0: has a coefficient that is not read here .*; export undistorted photographs"
    fails(DataError, said, open_frames, "metashape", tmp_path)


def test_distorted_images_of_realitycapture_are_refused(tmp_path) -> None:
    ds.write_realitycapture_csv(tmp_path / "all.csv", POSES, CAMERA, SIZE, k1=0.1)
    said = r"all.csv, line 2: 'DJI_0000.JPG' is distorted; export undistorted images, and their cameras"
    fails(DataError, said, open_frames, "realitycapture", tmp_path, image_size=SIZE)


# --- Coordinates ------------------------------------------------------------------------------------------------------


def geocentric(T, latitude=47.0, longitude=-91.9, height=200.0, crs="EPSG:4326"):
    """A pose east, north and up of a place, in metres from the Earth's centre."""
    to = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +lat_0={latitude} +lon_0={longitude} +h_0={height} +ellps=WGS84"
    )
    result = np.eye(4)
    origin = np.array(to.transform(*T[:3, 3]))
    result[:3, 3] = origin
    result[:3, :3] = np.stack([np.array(to.transform(*(T[:3, 3] + axis))) - origin for axis in T[:3, :3].T], axis=1)
    return result


@pytest.mark.parametrize(("reference", "crs"), [("EPSG:4326", None), ("EPSG:4326", "EPSG:32616"), ("EPSG:32615", None)])
def test_geocentric_cameras_see_a_place_of_the_projection_where_they_saw_it(tmp_path, reference, crs) -> None:
    wkt = pyproj.CRS(reference).to_wkt("WKT1_GDAL")
    poses = {name: geocentric(T) for name, T in POSES.items()}
    ds.write_metashape_xml(tmp_path / "cameras.xml", poses, CAMERA, SIZE, reference=wkt, scale=1.0)
    options = {} if crs is None else {"crs": crs}
    scene = opened("metashape", tmp_path, surface=tmp_path / "cameras.xml", **options)
    assert pyproj.CRS(scene.georeference.crs) == pyproj.CRS(crs or "EPSG:32615")
    onto = pyproj.Transformer.from_crs("EPSG:4978", scene.georeference.crs, always_xy=True)
    for frame, (name, T) in zip(open_frames("metashape", tmp_path, **options), poses.items(), strict=True):
        assert frame.name == name.removesuffix(".JPG")
        for at in ([0.0, 0.0, 12.0], [3.0, -2.0, 11.0]):
            point = np.array(onto.transform(*(T[:3, :3] @ at + T[:3, 3]))) - scene.georeference.offset
            in_camera = frame.pose[:3, :3].T @ (point - frame.pose[:3, 3])
            assert (
                np.abs(in_camera[:2] / in_camera[2] - np.array(at[:2]) / at[2]).max() < 6e-4
            )  # the projection scales lengths by 0.9997, heights not
            assert in_camera[2] == pytest.approx(at[2], rel=2e-3)
        assert Rotation.from_matrix(frame.pose[:3, :3]).as_matrix() == pytest.approx(frame.pose[:3, :3], abs=1e-8)


def test_the_projection_of_pix4d_stands_beside_its_cameras(tmp_path) -> None:
    params = tmp_path / "1_initial/params"
    ds.write_pix4d_parameters(params, POSES, CAMERA, SIZE)
    (params / "flight_wkt.prj").write_text(pyproj.CRS(down.UTM).to_wkt("WKT1_GDAL"))
    (params / "flight_offset.xyz").write_text("576714.000 5188162.000 0.000\n")
    mesh = down.write_mesh(tmp_path / "mesh.ply")
    scene = opened("pix4d", tmp_path, surface=mesh)
    assert scene.georeference.offset == down.OFFSET
    (tmp_path / "images").mkdir()
    for k in range(3):
        T = down.pose(k)
        frame = scene.geometry(k)
        np.testing.assert_allclose(frame.T_wc, T, atol=1e-12)
        K = Intrinsics(*CAMERA)
        expected = down.plane_depth(T, K, SIZE[::-1])
        assert frame.depth == pytest.approx(expected, abs=2e-4)
    (params / "flight_offset.xyz").write_text("576714.000\n")
    fails(DataError, "flight_offset.xyz: expected three numbers, got 1", opened, "pix4d", tmp_path, surface=mesh)


@pytest.mark.parametrize("mesh", ["in the projection", "shifted"])
def test_a_mesh_of_realitycapture_lies_where_its_cameras_are(tmp_path, mesh) -> None:
    shifted = {name: T.copy() for name, T in POSES.items()}
    for T in shifted.values():
        T[:3, 3] += down.OFFSET
    ds.write_realitycapture_csv(tmp_path / "all.csv", shifted, CAMERA, SIZE)
    origin = np.zeros(3) if mesh == "in the projection" else np.array([576000.0, 5188000.0, 0.0])
    surface = down.write_mesh(tmp_path / "mesh.obj", np.array(down.OFFSET) - origin)
    options = {} if mesh == "in the projection" else {"mesh_origin": origin.tolist()}
    scene = opened("realitycapture", tmp_path, surface=surface, crs=down.UTM, image_size=SIZE, **options)
    for k in range(3):
        frame = scene.geometry(k)
        place = scene.georeference.projected(frame.T_wc[None, :3, 3])[0]
        np.testing.assert_allclose(place, shifted[f"DJI_{k:04d}.JPG"][:3, 3], atol=1e-9)
        np.testing.assert_allclose(frame.T_wc[:3, :3], down.pose(k)[:3, :3], atol=1e-12)
        expected = down.plane_depth(down.pose(k), Intrinsics(*CAMERA), SIZE[::-1])
        assert np.median(np.abs(frame.depth - expected)) < 0.02  # of the mesh's 32-bit vertices, 5000 km away


def test_geocentric_cameras_without_pyproj_say_what_to_install(tmp_path, monkeypatch) -> None:
    poses = {name: geocentric(T) for name, T in POSES.items()}
    ds.write_metashape_xml(
        tmp_path / "cameras.xml", poses, CAMERA, SIZE, reference=pyproj.CRS(4326).to_wkt(), scale=1.0
    )
    monkeypatch.setitem(sys.modules, "pyproj", None)
    fails(MissingDependencyError, r"needs pyproj; pip install 'semstab\[geo\]'", open_frames, "metashape", tmp_path)


# --- What is refused --------------------------------------------------------------------------------------------------


def test_damaged_cameras_of_metashape(tmp_path) -> None:
    path = tmp_path / "cameras.xml"
    ds.write_metashape_xml(path, POSES, CAMERA, SIZE)
    whole = path.read_text()
    for old, new, said in (
        ("</document>", "", r"cameras.xml: no XML"),
        (
            'sensor_id="0" component',
            'sensor_id="7" component',
            "camera 'DJI_0000.JPG': its sensor '7' is not in the file",
        ),
        ("<scale>2.5", "<scale>-2.5", "component 0: the scale is -2.5"),
        ("<f>50.0</f>", "<f>wide</f>", r"sensor 0: 'f' must hold 1 number; export"),
        ("<f>50.0</f>", "<f>nan</f>", r"sensor 0: 'f' must hold 1 number; export"),
        ("<transform>", "<lost>", "none of its"),
        ('type="frame" class="adjusted"', 'type="spherical" class="adjusted"', "camera model 'spherical' is not read"),
        ('id="1" sensor_id="0" component_id="0"', 'id="1" sensor_id="0" component_id="1"', "in several components"),
        ("LOCAL_CS[]", "GEOGCS[", r"'GEOGCS\[' is no reference system"),
    ):
        assert old in whole
        changed = whole.replace(old, new)
        path.write_text(changed.replace("</transform>", "</lost>", 99) if new == "<lost>" else changed)
        fails(DataError, said, open_frames, "metashape", tmp_path)
    path.write_text(whole.replace("</chunk>", "</chunk><chunk label='Chunk 2'/>"))
    fails(
        DataError,
        r"2 chunks \(0: Chunk 1, 1: Chunk 2\); choose one: --option chunk=NUMBER",
        open_frames,
        "metashape",
        tmp_path,
    )
    assert len(open_frames("metashape", tmp_path, chunk=0)) == 3
    fails(DataError, "there is no chunk 4; it has 2", open_frames, "metashape", tmp_path, chunk=4)


def test_cameras_that_are_not_aligned_are_counted(tmp_path, caplog) -> None:
    ds.write_metashape_xml(tmp_path / "cameras.xml", POSES, CAMERA, SIZE)
    assert len(open_frames("metashape", tmp_path)) == 3
    assert "1 of 4 cameras are not aligned" in caplog.text


def test_damaged_cameras_of_pix4d(tmp_path) -> None:
    path = tmp_path / "flight_calibrated_camera_parameters.txt"
    ds.write_pix4d_parameters(tmp_path, POSES, CAMERA, SIZE)
    lines = path.read_text().splitlines()
    for changed, said in (
        (lines[:7], "holds no photograph"),
        (lines[:-1], r"line 29: 'DJI_0002.JPG': expected lines of 3, 3, 3, 3, 2, 3, 3, 3, 3 numbers"),
        ([*lines[:17], *lines[18:]], "line 18: 'DJI_0001.JPG' is not a number"),
        ([line.replace("50.0 0.0", "50.0 1.0") for line in lines], "matrix K has skew, which is not supported"),
    ):
        path.write_text("\n".join(changed))
        fails(DataError, said, open_frames, "pix4d", tmp_path)


def test_damaged_cameras_of_realitycapture(tmp_path) -> None:
    path = tmp_path / "all.csv"
    ds.write_realitycapture_csv(path, POSES, CAMERA, SIZE)
    whole = path.read_text()
    for changed, said in (
        (whole.splitlines()[0], "holds no camera"),
        (whole.replace("heading,pitch,roll", "heading,pitch,roll,f2", 1).replace(",f,", ",", 1), "'f' is missing"),
        (whole.replace("DJI_0001.JPG", ""), "'#name' is missing"),
    ):
        path.write_text(changed)
        fails(DataError, said, open_frames, "realitycapture", tmp_path, image_size=SIZE)


def test_the_only_mesh_beside_the_cameras_gives_depth(tmp_path) -> None:
    ds.write_pix4d_parameters(tmp_path, POSES, CAMERA, SIZE)
    said = r"has no depth images; set surface to the mesh, .*: --option surface=FILE$"
    fails(DataError, said, opened, "pix4d", tmp_path)
    down.write_mesh(tmp_path / "model.obj")
    (tmp_path / "orthophoto.tif").touch()
    scene = opened("pix4d", tmp_path)
    assert scene.depth_from.startswith("rays cast at")
    expected = down.plane_depth(down.pose(0), Intrinsics(*CAMERA), SIZE[::-1])
    assert scene.geometry(0).depth == pytest.approx(expected, abs=2e-4)
    down.write_mesh(tmp_path / "low.ply")
    said = r"surface=FILE \(here are low.ply, model.obj, orthophoto.tif\)"
    fails(DataError, said, opened, "pix4d", tmp_path)


def test_two_files_of_cameras_are_told_apart_by_an_option(tmp_path) -> None:
    for name in ("a.xml", "b.xml"):
        ds.write_metashape_xml(tmp_path / name, POSES, CAMERA, SIZE)
    (tmp_path / "other.xml").write_text("<html/>")
    said = r"several files hold cameras \(a.xml, b.xml\); name one: --option cameras=FILE"
    fails(DataError, said, open_dataset, "metashape", {"root": tmp_path})
    assert len(open_frames("metashape", tmp_path, cameras="b.xml")) == 3


# --- The real flight --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def brighton():
    data = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data")) / "brighton"
    if not data.is_dir():
        pytest.skip(f"no {data}; set SEMSTAB_DATA to the folder that holds brighton/")
    options = {"root": data / "odm", "casts": False, "images": data / "color"}
    return data, open_dataset("odm", options).scene("odm"), open_dataset("odm", options)


@pytest.mark.parametrize("name", ["metashape", "pix4d", "realitycapture"])
def test_a_real_flight_has_the_voxels_that_its_odm_project_has(brighton, tmp_path, name) -> None:
    data, project, dataset = brighton
    frames = list(dataset.frames(dataset.folders[0]))[:6]
    poses = {f"{frame.name}.JPG": np.linalg.inv(frame.pose) for frame in frames}
    size = frames[0].camera.size
    K = frames[0].camera.intrinsics_at(size[::-1])
    write = {
        "metashape": lambda: ds.write_metashape_xml(tmp_path / "cameras.xml", poses, K_of(K), size),
        "pix4d": lambda: ds.write_pix4d_parameters(tmp_path / "params", poses, K_of(K), size),
        "realitycapture": lambda: ds.write_realitycapture_csv(tmp_path / "all.csv", poses, K_of(K), size),
    }
    write[name]()
    mesh = data / "odm/odm_meshing/odm_25dmesh.ply"
    scene = opened(name, tmp_path, surface=mesh, images=data / "color")
    found, expected = create("numba", voxel_size=1.0, num_classes=2), create("numba", voxel_size=1.0, num_classes=2)
    for k in (0, 3, 5):
        assert scene.image_name(k) == project.image_name(k)
        for source, backend in ((scene, found), (project, expected)):
            backend.integrate(source.geometry(k).every(3))
    ours, theirs = found.table(), expected.table()
    assert len(ours) == len(theirs) > 1000
    np.testing.assert_array_equal(ours.index, theirs.index)
    np.testing.assert_array_equal(ours.op, theirs.op)
    assert np.abs(ours.pixels - theirs.pixels).sum() < 1e-5 * theirs.pixels.sum()


def K_of(K: Intrinsics) -> list[float]:
    return [K.fx, K.fy, K.cx, K.cy]
