"""Depth that is cast at a surface: of every kind of file, for any dataset, kept in files, and what is wrong said."""

from __future__ import annotations

import io
import re
import shutil
from concurrent.futures import ThreadPoolExecutor

import cv2
import looking_down as down
import numpy as np
import pytest
from dataset_writers import (
    write_replica,
    write_scannet,
    write_semantic_nerf,
    write_seven_scenes,
    write_tartanair,
    write_tum,
)
from posed_config import configure, dataset_of
from posed_scene import fails
from posed_writer import write_posed
from rich.console import Console

import semstab
from semstab import Intrinsics
from semstab.check import check, quick_check
from semstab.check.display import print_check
from semstab.data.georeference import Georeference, wkt
from semstab.datasets import open_dataset
from semstab.datasets.files import surfaces
from semstab.datasets.files.surfaces import CameraView, Surface
from semstab.errors import ConfigError, DataError, MissingDependencyError

pytest.importorskip("laspy")

PLACED = {"crs": down.UTM, "offset": down.OFFSET}


def view(k: int = 0) -> CameraView:
    return CameraView(down.K, down.pose(k), (down.H, down.W))


def placed() -> Georeference:
    return Georeference(wkt(down.UTM, "crs"), down.OFFSET)


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    return down.write_mesh(tmp_path_factory.mktemp("mesh") / "plane.ply")


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A posed_folder of three frames that look down at the plane."""
    frames = [down.frame(k) for k in range(3)]
    names = [f"{k:04d}" for k in range(3)]
    folder = tmp_path_factory.mktemp("flight") / "field"
    return write_posed(folder, names, {"net": frames}, scale=None, classes=["a", "b", "c"], up_axis="z")


@pytest.mark.parametrize("name", ["plane.ply", "plane.obj", "plane.stl", "points.ply", "points.laz", "dsm.tif"])
def test_a_mesh_a_cloud_and_a_raster_of_one_surface_give_its_depth(tmp_path, name) -> None:
    write = {"points.ply": down.write_points, "points.laz": down.write_laz, "dsm.tif": down.write_raster}
    path = write.get(name, down.write_mesh)(tmp_path / name)
    georeference = placed() if name in ("points.laz", "dsm.tif") else None
    cloud = "points" in name
    surface = Surface(path, cell=0.5 if cloud else None, georeference=georeference)
    for k in range(3):  # a cell's height is that of one of its points
        np.testing.assert_allclose(surface.depth(view(k)), down.plane_depth(down.pose(k)), atol=0.15 if cloud else 2e-5)


def test_holes_of_a_raster_have_no_depth_and_cells_can_be_larger(tmp_path) -> None:
    whole = Surface(down.write_raster(tmp_path / "dsm.tif"), cell=1.5, georeference=placed()).depth(view())
    np.testing.assert_allclose(whole, down.plane_depth(down.pose(0)), atol=0.05)
    holed = Surface(down.write_raster(tmp_path / "holed.tif", hole=True), georeference=placed()).depth(view())
    assert 0.1 < (holed == 0).mean() < 0.7
    np.testing.assert_allclose(holed[holed > 0], down.plane_depth(down.pose(0))[holed > 0], atol=2e-5)


def test_far_from_the_origin_depth_is_as_exact(tmp_path) -> None:
    far = np.array([4e5, 5e6, 0])
    surface = Surface(down.write_mesh(tmp_path / "far.obj", shift=far))
    T = down.pose(1)
    T[:3, 3] += far
    found = surface.depth(CameraView(down.K, T, (down.H, down.W)))
    np.testing.assert_allclose(found, down.plane_depth(down.pose(1)), atol=1e-4)


def test_casts_are_kept_and_read_again_and_damaged_ones_are_cast_anew(mesh, tmp_path, monkeypatch) -> None:
    casts = tmp_path / "casts"
    first = [Surface(mesh, casts=casts).depth(view(k)) for k in range(2)]
    files = sorted(casts.rglob("*.cast"))
    assert len(files) == 2
    assert sum(file.stat().st_size for file in files) < sum(depth.nbytes for depth in first)
    with monkeypatch.context() as patch:
        patch.setattr(surfaces, "read_triangles", None)
        for k in range(2):
            np.testing.assert_array_equal(Surface(mesh, casts=casts).depth(view(k)), first[k])
        with pytest.raises(TypeError):
            Surface(mesh, casts=casts).depth(view(2))
    for file in files:
        content = bytearray(file.read_bytes())
        content[-3] ^= 1
        file.write_bytes(content)
    np.testing.assert_array_equal(Surface(mesh, casts=casts).depth(view(0)), first[0])
    moved = Surface(down.write_mesh(tmp_path / "moved.ply", shift=(0, 0, 1)), casts=casts).depth(view(0))
    assert np.abs(moved - first[0]).min() > 0.5
    assert len(list(casts.rglob("*.cast"))) == 3


def test_where_casts_cannot_be_kept_it_is_said_once(mesh, tmp_path, caplog) -> None:
    (tmp_path / "file").write_text("")
    surface = Surface(mesh, casts=tmp_path / "file")
    for k in range(2):
        np.testing.assert_allclose(surface.depth(view(k)), down.plane_depth(down.pose(k)), atol=2e-5)
    assert len(caplog.records) == 1
    assert "cannot be stored" in caplog.text


def test_threads_may_cast_at_once(mesh) -> None:
    surface = Surface(mesh)
    with ThreadPoolExecutor(4) as pool:
        depths = list(pool.map(lambda k: surface.depth(view(k % 3)), range(12)))
    for k, depth in enumerate(depths):
        np.testing.assert_allclose(depth, down.plane_depth(down.pose(k % 3)), atol=2e-5)


def test_a_posed_folder_gives_the_voxels_of_its_depth_files(flight, mesh, tmp_path) -> None:
    bare = shutil.copytree(flight, tmp_path / "field")
    shutil.rmtree(bare / "depth")
    dataset = dataset_of(bare, surface=str(mesh), casts=str(tmp_path / "casts"))
    result = semstab.run(configure(bare, dataset=dataset), out=tmp_path / "run", report=False)
    stored = semstab.run(configure(flight), out=tmp_path / "stored", report=False)
    ours, theirs = (one.records[0].table() for one in (result, stored))
    assert (len(ours), ours.pixels.sum()) == (len(theirs), theirs.pixels.sum())
    assert result.manifest["depth_from"] == {"field": f"rays cast at {mesh}"}
    assert stored.manifest["depth_from"] == {}


def test_intrinsics_are_those_of_the_depth_files_that_a_surface_stands_for(flight, mesh, tmp_path) -> None:
    other = shutil.copytree(flight, tmp_path / "field")
    for path in (other / "color").iterdir():
        cv2.imwrite(str(path), np.zeros((7, 9, 3), np.uint8))
    scene = open_dataset("posed_folder", {"root": other, "surface": mesh, "casts": False}).scene("field")
    np.testing.assert_allclose(scene.depth(1), down.plane_depth(down.pose(1)), atol=2e-5)


def test_a_run_is_kept_while_its_surface_is_the_same(flight, mesh, tmp_path) -> None:
    def units(surface):
        dataset = dataset_of(flight, surface=str(surface), casts=False)
        result = semstab.run(configure(flight, dataset=dataset), out=tmp_path / "run", report=False, overwrite=True)
        return result.manifest["units"]

    assert units(mesh)["computed"] == 1
    assert units(shutil.copy(mesh, tmp_path / "same.ply"))["computed"] == 0
    assert units(down.write_mesh(tmp_path / "other.ply", shift=(0, 0, 0.5)))["computed"] == 1


@pytest.mark.parametrize(
    "form",
    [
        ("scannet", write_scannet, "depth"), ("seven_scenes", write_seven_scenes, "*.depth.png"),
        ("replica", write_replica, "results/depth*"), ("replica", write_semantic_nerf, "depth"),
        ("tartanair", write_tartanair, "depth_left"), ("tum", write_tum, "depth*"),
    ],
    ids=lambda form: form[1].__name__,
)  # fmt: skip
def test_frames_are_listed_without_depth_files(form, mesh, tmp_path) -> None:
    name, write, depth = form
    frames = [down.frame(k) for k in range(3)]
    names = write(tmp_path / "scene", frames)
    for path in (tmp_path / "scene").glob(depth):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    fx, fy, cx, cy = down.K.fx, down.K.fy, down.K.cx, down.K.cy
    camera = {} if name == "scannet" else {"intrinsics": [fx, fy, cx, cy]}
    options = {
        "root": tmp_path / "scene", "surface": mesh, "casts": False, "intrinsics_size": (down.W, down.H),
    } | camera  # fmt: skip
    if name == "tum":
        options["max_difference"] = 0.06
    scene = open_dataset(name, options).scene("scene")
    assert (len(scene), scene.missing(1)) == (len(names), [])
    np.testing.assert_allclose(scene.depth(1), frames[1].depth, atol=2e-5)
    with pytest.raises(DataError):
        open_dataset(name, {"root": tmp_path / "scene"}).scene("scene")


# --- what the images say ----------------------------------------------------------------------------------------------

LARGE = Intrinsics(160, 160, 95.5, 63.5)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Six larger images of the plane, without depth and labels."""
    frames = [down.frame(k, LARGE, (128, 192), detail=5) for k in range(6)]
    folder = write_posed(
        tmp_path_factory.mktemp("large") / "field", [f"{k}" for k in range(6)], {"": frames}, scale=None
    )
    shutil.rmtree(folder / "depth")
    return folder


def looked_at(photographs, surface):
    scene = open_dataset("posed_folder", {"root": photographs, "surface": surface, "casts": False}).scene("field")
    return quick_check(scene, list(range(6)))


def test_images_confirm_a_surface_in_its_place(photographs, mesh) -> None:
    verdict = looked_at(photographs, mesh)
    assert verdict.state == "sound", verdict.text
    assert "match by surface and poses (correlation" in verdict.text


@pytest.mark.parametrize(("up", "side"), [(1.5, "further from the cameras"), (-2.0, "nearer to the cameras")])
def test_images_find_how_far_off_a_surface_lies(photographs, tmp_path, up, side) -> None:
    verdict = looked_at(photographs, down.write_mesh(tmp_path / "moved.ply", shift=(0, 0, up)))
    assert verdict.state == "unsound", verdict.text
    found = re.search(rf"if the surface lies ([\d.]+) m {side} ", verdict.text)
    assert found, verdict.text
    assert float(found[1]) == pytest.approx(abs(up), rel=0.1)


def test_without_images_nothing_is_claimed_of_a_surface(photographs, mesh, tmp_path) -> None:
    bare = shutil.copytree(photographs, tmp_path / "field")
    shutil.rmtree(bare / "color")
    options = {"root": bare, "surface": mesh, "casts": False, "intrinsics_size": (192, 128)}
    verdict = quick_check(open_dataset("posed_folder", options).scene("field"), list(range(6)))
    assert verdict.state == "unclear"
    assert "without images of overlapping frames nothing tells whether they fit" in verdict.text


def test_the_check_says_what_depth_is_cast_at(photographs, mesh) -> None:
    config = configure(photographs, dataset=dataset_of(photographs, surface=str(mesh), casts=False))
    (checked,) = check(config)
    console = Console(record=True, width=80, file=io.StringIO())
    print_check(checked, console)
    said = " ".join(console.export_text().split())
    assert f"from rays cast at {mesh}".replace(" ", "") in said.replace(" ", "")
    assert "SOUND neighbouring images match" in said
    assert "reprojected into each other" not in said


# --- what is wrong ----------------------------------------------------------------------------------------------------


def test_a_surface_in_other_coordinates_than_the_poses_says_how_far_off(flight, tmp_path) -> None:
    path = down.write_mesh(tmp_path / "utm.obj", shift=down.OFFSET)
    match = (
        r"utm.obj: no frame sees it: the nearest camera is 5,220,1\d\d m away \(east -576,7\d\d, north -5,188,1\d\d,"
        r" up \d+ m\); surface and poses have different coordinates"
    )
    dataset = open_dataset("posed_folder", {"root": flight, "surface": path, "casts": False})
    fails(DataError, match, dataset.scene("field").geometry, 1)
    config = configure(flight, dataset=dataset_of(flight, surface=str(path), casts=False))
    fails(DataError, match, semstab.run, config)
    fails(DataError, match, list, check(config))


def test_cameras_that_look_elsewhere_are_told_so(flight, mesh) -> None:
    options = {"root": flight, "surface": mesh, "casts": False, "camera_axes": "opengl"}
    scene = open_dataset("posed_folder", options).scene("field")
    fails(DataError, "no frame sees it: .* m above it and looks elsewhere; are pose_convention", scene.depth, 0)


def test_one_frame_that_sees_nothing_is_no_error(flight, mesh, tmp_path) -> None:
    away = shutil.copytree(flight, tmp_path / "away")
    T = down.pose(0)
    T[:3, 3] += 1000
    np.savetxt(away / "pose/0000.txt", T)
    scene = open_dataset("posed_folder", {"root": away, "surface": mesh, "casts": False}).scene("away")
    assert not scene.depth(0).any()
    assert (scene.depth(1) > 0).all()


@pytest.mark.parametrize(
    ("name", "write"), [("m.ply", down.write_mesh), ("c.laz", down.write_laz), ("r.tif", down.write_raster)]
)
def test_a_truncated_surface_is_named(tmp_path, name, write) -> None:
    path = write(tmp_path / name)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    fails(DataError, rf"{name}: .*", Surface(path, georeference=placed()).depth, view())


def test_what_is_no_surface_is_named(tmp_path) -> None:
    path = tmp_path / "two.ply"
    import trimesh

    trimesh.PointCloud(np.zeros((2, 3))).export(path)
    fails(DataError, "two.ply: a cloud of 2 points is no surface", Surface(path).depth, view())
    (tmp_path / "x.obj").write_text("nothing\n")
    fails(DataError, "x.obj: ", Surface(tmp_path / "x.obj").depth, view())
    fails(DataError, "there.ply: cannot be read", Surface, tmp_path / "there.ply")


def test_a_raster_of_another_projection_or_turned_is_told_what_to_do(tmp_path) -> None:
    import rasterio

    other = Surface(down.write_raster(tmp_path / "o.tif", crs="EPSG:32616"), georeference=placed())
    fails(ConfigError, "o.tif: lies in EPSG:32616, the scene in EPSG:32615; reproject it", other.depth, view())
    turned = rasterio.Affine(0.5, 0.1, 0, 0.1, -0.5, 0)
    path = down.write_raster(tmp_path / "t.tif", transform=turned)
    fails(DataError, "t.tif: the raster is rotated", Surface(path, georeference=placed()).depth, view())


def test_heights_need_z_to_be_up(flight, tmp_path) -> None:
    path = down.write_raster(tmp_path / "dsm.tif")
    dataset = open_dataset("posed_folder", {"root": flight, "surface": path, "up_axis": "-y"})
    fails(ConfigError, "dsm.tif: holds heights over x and y, but up_axis is -y; turn it", dataset.scene, "field")


def test_a_grid_that_is_too_fine_is_refused(tmp_path) -> None:
    path = down.write_points(tmp_path / "c.ply")
    fails(DataError, "too many .* set a larger surface_cell", Surface(path, cell=0.001).depth, view())


def test_without_the_extra_it_is_said_what_to_install(tmp_path, monkeypatch) -> None:
    import sys

    path = down.write_raster(tmp_path / "r.tif")
    monkeypatch.setitem(sys.modules, "rasterio", None)
    fails(MissingDependencyError, r"r.tif: .*pip install 'semstab\[geo\]'", Surface(path).depth, view())


def test_without_a_size_it_is_said_what_to_set(flight, mesh, tmp_path) -> None:
    bare = shutil.copytree(flight, tmp_path / "field")
    for folder in ("color", "depth"):
        shutil.rmtree(bare / folder)
    options = {"root": bare, "surface": mesh, "casts": False}
    scene = open_dataset("posed_folder", options).scene("field")
    fails(DataError, "no colour image gives the size of depth; set intrinsics_size", scene.depth, 0)
    told = open_dataset("posed_folder", options | {"intrinsics_size": (down.W, down.H)}).scene("field")
    np.testing.assert_allclose(told.depth(0), down.plane_depth(down.pose(0)), atol=2e-5)
