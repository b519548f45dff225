"""Exports of a finished run are opened with other libraries, and hold its voxels where they lie on Earth."""

from __future__ import annotations

import dataclasses
import json
import sys

import laspy
import numpy as np
import open3d as o3d
import pyarrow.csv
import pyarrow.parquet
import pyproj
import pytest
import rasterio
import tiny_scene
import trimesh
from command_line import bench
from posed_config import configure, dataset_of
from posed_scene import fails
from rasterio.transform import rowcol
from records import voxels as voxels_by_hand
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import semstab
from semstab.data.georeference import Georeference
from semstab.errors import ConfigError, DataError, MissingDependencyError
from semstab.exports import export, maps
from semstab.exports.clouds import codes
from semstab.exports.maps import seen_from_above
from semstab.exports.voxels import ExportedVoxels, VoxelColumn
from semstab.metrics import categories, dominant, vss

CRS, OFFSET = "EPSG:32615", (576714, 5188162, 200)
CLASSES = ["wall", "door", "window"]


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """A run of two models with a georeference, and one without; its folder."""
    folder = tmp_path_factory.mktemp("runs")
    tiny_scene.write(folder / "scene")
    for name, options in (("run", {"crs": CRS, "offset": OFFSET}), ("nowhere", {})):
        config = configure(folder / "scene", dataset=dataset_of(folder / "scene", **options), check=None)
        semstab.run(config, out=folder / name, report=False)
    return folder


@pytest.fixture(scope="module")
def table(fused):
    return semstab.load_result(fused / "run").record(model="a").table()


def written(fused, file, run="run", **options):
    export(fused / run, fused / file, **{"model": "a", **options})
    return fused / file


def test_las_has_the_voxels_to_the_millimetre_with_their_measures_and_projection(fused, table):
    codes = fused / "codes.yaml"
    codes.write_text("door: 64\nWall: 6\n")
    for name in ("map.las", "map.laz"):
        cloud = laspy.read(written(fused, name, asprs=codes))
        np.testing.assert_allclose(cloud.xyz, table.centers + OFFSET, atol=5.1e-4)
        assert cloud.header.parse_crs().to_epsg() == 32615
        assert (cloud["class"] == dominant(table) + 1).all()
        assert (cloud.classification == np.array([6, 64, 1])[dominant(table)]).all()
        colors = trimesh.load(written(fused, "map.ply")).colors[:, :3].astype(int)
        assert (np.stack([cloud.red, cloud.green, cloud.blue], axis=1) == colors * 257).all()  # 255 becomes 65535
        np.testing.assert_allclose(cloud.vss, vss(table), rtol=1e-6)
        assert (cloud.op == table.op).all()
        assert {d.name: d.description for d in cloud.point_format.extra_dimensions}["sbd"] == "SBD, bits"
        legend = next(vlr for vlr in cloud.vlrs if vlr.user_id == "semstab")
        assert json.loads(legend.record_data_bytes())["classes"] == ["unclassified", *CLASSES]


def test_codes_of_a_shipped_taxonomy(fused, table):
    voxels = as_voxels(table, classes=("building", "road", "static car"), taxonomy="uavid7")
    assert codes(voxels).tolist() == [0, 6, 11, 64]


def test_ply_opens_in_two_libraries(fused, table):
    path = written(fused, "map.ply")
    cloud = o3d.t.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(cloud.point.positions.numpy(), table.centers + OFFSET)
    assert (cloud.point["class"].numpy().ravel() == dominant(table) + 1).all()
    assert (cloud.point["category"].numpy().ravel() == categories(table)).all()
    np.testing.assert_allclose(cloud.point["vss"].numpy().ravel(), vss(table), rtol=1e-6)
    other = trimesh.load(path)
    np.testing.assert_array_equal(other.vertices, table.centers + OFFSET)
    assert (other.colors[:, :3] == cloud.point.colors.numpy()).all()
    assert b"comment class 2 door" in path.read_bytes()


def test_tables_have_names_and_empty_fields_where_something_is_undefined(fused, table):
    for path, rows in (
        (written(fused, "map.parquet"), pyarrow.parquet.read_table(fused / "map.parquet")),
        (written(fused, "map.csv"), pyarrow.csv.read_csv(fused / "map.csv")),
    ):
        assert rows.column("class").to_pylist() == [CLASSES[k] for k in dominant(table)], path
        assert rows.column("sbd").null_count == np.count_nonzero(table.op < 2) > 0
        np.testing.assert_array_equal(rows.column("y").to_numpy(), table.centers[:, 1] + OFFSET[1])
        assert set(rows.column("category").to_pylist()) <= set(semstab.metrics.CATEGORIES)


def test_the_mesh_has_the_sides_that_no_other_voxel_hides(fused, table):
    scene = trimesh.load(written(fused, "map.glb"))
    (mesh,) = scene.geometry.values()
    hidden = sum(
        len(np.intersect1d(*(pack(index) for index in (table.index, table.index + step))))
        for step in np.eye(3, dtype=int)
    )
    assert len(mesh.faces) == 2 * (6 * len(table) - 2 * hidden)
    low, high = table.index.min(axis=0) * 0.25, (table.index.max(axis=0) + 1) * 0.25
    np.testing.assert_allclose(scene.metadata["origin"], low + OFFSET)
    x, y, z = high - low
    np.testing.assert_allclose(mesh.bounds, [[0, 0, -y], [x, z, 0]], atol=1e-6)  # y is up in glTF, north is -z


def pack(index):
    return index @ np.array([10**6, 10**3, 1])


def test_the_raster_lies_where_the_voxels_do(fused, table):
    written(fused, "map.tif")
    with rasterio.open(fused / "map.tif") as raster, rasterio.open(fused / "map.class.tif") as classes:
        assert raster.crs.to_epsg() == 32615
        assert raster.descriptions == ("class", "vss", "entropy", "op", "stable", "height")
        x, y, z = (table.centers + OFFSET).T
        edge, _, west, _, _, north = raster.transform[:6]
        bands = raster.read()[:, ((north - y) // edge).astype(int), ((x - west) // edge).astype(int)]
        topmost = bands[5] == z.astype(np.float32)  # the topmost of its column
        assert topmost.any()
        assert (bands[0][topmost] == dominant(table)[topmost] + 1).all()
        np.testing.assert_allclose(bands[1][topmost], vss(table)[topmost], rtol=1e-6)
        assert (classes.read(1) == np.nan_to_num(raster.read(1))).all()
        assert classes.nodata == 0
        assert classes.colormap(1)[1][:3] == tuple(
            trimesh.load(written(fused, "map.ply")).colors[dominant(table) == 0][0][:3]
        )


def as_voxels(table, columns=(), classes=CLASSES, taxonomy="t", up=(0.0, 0.0, 1.0)):
    colors = np.zeros((table.K, 3), np.uint8)
    return ExportedVoxels(table, dict(columns), tuple(classes), colors, taxonomy, up, None)


def test_a_cell_of_several_voxels_sums_the_beliefs_of_the_topmost():
    """Two columns of two voxels: the lower ones only count for the share of stable voxels."""
    made = voxels_by_hand((1, 3, [3, 0, 0]), (1, 3, [1, 2, 0]), (1, 5, [5, 0, 0]), (1, 5, [1, 0, 4]), r=1.0)
    table = dataclasses.replace(made, ix=np.array([0, 0, 1, 1]), iz=np.array([0, 1, 0, 3]))
    stable = categories(table) == 3
    bands, west, north = seen_from_above(as_voxels(table, {"op": VoxelColumn(table.op)}), cell=2)
    value = {name: band.values.item() for name, band in bands.items()}
    assert value["class"] == 3  # 1/3 + 1/5, 2/3, 4/5
    assert value["op"] == 4
    assert value["stable"] == stable.mean() == 0.75
    assert value["height"] == 3.5
    assert (west, north) == (0.0, 2.0)


def test_without_a_georeference_coordinates_are_the_scenes_which_is_said(fused, table):
    (done,) = export(fused / "nowhere", fused / "plain.laz", model="a")
    assert "no georeference" in done.content
    cloud = laspy.read(fused / "plain.laz")
    np.testing.assert_allclose(cloud.xyz, table.centers, atol=5.1e-4)
    assert cloud.header.parse_crs() is None
    assert b"voxels of 0.25 m, coordinates of the scene\n" in written(fused, "plain.ply", "nowhere").read_bytes()
    assert b"voxels of 0.25 m, WGS 84 / UTM zone 15N (EPSG:32615)\n" in written(fused, "placed.ply").read_bytes()


def test_what_is_exported_can_be_chosen(fused, table):
    rows = pyarrow.csv.read_csv(written(fused, "few.csv", measures=["psa", "pixels"], min_op=2, classes=["Door"]))
    assert rows.column_names == ["x", "y", "z", "class", "psa", "pixels"]
    assert len(rows) == np.count_nonzero((table.op >= 2) & (dominant(table) == 1)) > 0


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("no column 'drift_p'; did you mean 'drift", {"measures": ["drift_p"]}),
        ("no class 'dor'; did you mean 'door'", {"classes": ["dor"]}),
        (r"no voxel with OP >= 9; OP goes up to 3", {"min_op": 9}),
        ("2 units fit .scene of a, scene of b.; choose", {"model": None}),
        ("no model 'c'", {"model": "c"}),
        ("no class 'dor' in the run", {"asprs": "wrong.yaml"}),
        ("300 is no ASPRS code", {"asprs": "large.yaml"}),
    ],
)
def test_bad_choices_are_told_in_one_line(fused, message, options, monkeypatch):
    monkeypatch.chdir(fused)
    (fused / "wrong.yaml").write_text("dor: 6")
    (fused / "large.yaml").write_text("door: 300")
    fails(ConfigError, message, written, fused, "never.las", **options)
    assert not (fused / "never.las").exists()


def test_other_bad_input(fused):
    fails(ConfigError, "format '.lax' is not known; did you mean '.la", written, fused, "map.lax")
    fails(DataError, "empty: there is no such folder", export, fused / "empty", fused / "map.ply")
    lonely = dataclasses.replace(as_voxels(voxels_by_hand((1, 1, [1, 0, 0]))), up=None)
    fails(ConfigError, "set up_axis", seen_from_above, lonely)


def test_packages_that_are_missing_are_named_with_their_extra(fused, monkeypatch):
    for package, file in (("laspy", "never.laz"), ("lazrs", "never.las"), ("rasterio", "never.tif")):
        monkeypatch.setitem(sys.modules, package, None)
        fails(MissingDependencyError, r"pip install .semstab\[geo\].", written, fused, file)


def test_voxels_that_span_too_much_are_refused(tmp_path):
    far = voxels_by_hand((2, 1, [1, 0, 0]))
    far = as_voxels(dataclasses.replace(far, ix=np.array([0, 2**22]), iy=np.array([0, 2**22])))
    fails(ConfigError, "choose larger ones with --cell", seen_from_above, far)
    fails(ConfigError, "too much for a mesh", maps.write_mesh, Alone(far), tmp_path / "far.glb")


class Alone:
    """Voxels that are all that was chosen."""

    size = None

    def __init__(self, voxels):
        self.first = voxels

    def tiles(self):
        return iter([(0, 0)])

    def __getitem__(self, place):
        return self.first


# --- A given cloud ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def points(table):
    """In a voxel, a little outside the map, far away."""
    above = table.centers[-1:] + np.array([0, 0, 0.26])
    return np.concatenate([table.centers + 0.05, above, above + 50]) + OFFSET


def las_cloud(path, points, point_format=7, crs=CRS):
    header = laspy.LasHeader(point_format=point_format, version="1.4" if point_format > 5 else "1.2")
    header.scales, header.offsets = [0.001] * 3, OFFSET
    header.add_crs(pyproj.CRS(crs))
    header.add_extra_dims([laspy.ExtraBytesParams("views", np.uint8)])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.intensity, cloud.views = np.arange(len(points)), np.arange(len(points)) % 7
    cloud.classification = np.full(len(points), 2)
    if point_format > 5:
        cloud.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("surveyor", 7, "", b"mine"), laspy.VLR("copc", 1000)])
    cloud.write(path)
    return path


@pytest.mark.parametrize("point_format", [3, 7])
def test_a_las_cloud_is_classified_and_keeps_its_fields(fused, table, points, point_format):
    cloud = las_cloud(fused / f"cloud{point_format}.laz", points, point_format)
    (done,) = export(fused / "run", fused / "onto.laz", model="a", classify=cloud, radius=0.3)
    before, after = laspy.read(cloud), laspy.read(fused / "onto.laz")
    for name in (*before.point_format.dimension_names,):
        assert (after["classification_before" if name == "classification" else name] == before[name]).all(), name
    expected = dominant(table) + 1
    assert after["class"].tolist() == [*expected, expected[-1], 0]
    assert np.array(after.classification).tolist() == [*[1] * (len(table) + 1), 0]
    assert after.op.tolist() == [*table.op, table.op[-1], 0]
    np.testing.assert_allclose(after.vss, [*vss(table), vss(table)[-1], 0], rtol=1e-6)
    assert [vlr.user_id for vlr in after.evlrs or ()] == ["surveyor"] * (point_format > 5)
    assert done.content == f"{len(points)} points, {(len(points) - 1) / len(points):.1%} of them classified"
    export(fused / "run", fused / "none.laz", model="a", classify=fused / "onto.laz", radius=0)
    again = laspy.read(fused / "none.laz")
    assert again["class"].tolist() == [*expected, 0, 0]
    assert (again["classification_before"] == 2).all()


def ply_cloud(path, points, order="<"):
    dtype = np.dtype([(name, f"{order}f8") for name in "xyz"] + [("gray", f"{order}i4")])
    rows = np.zeros(len(points), dtype)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    rows["gray"] = np.arange(len(points))
    form = "little" if order == "<" else "big"
    properties = "".join(f"property double {name}\n" for name in "xyz") + "property int gray\n"
    head = (
        f"ply\nformat binary_{form}_endian 1.0\ncomment of mine\nelement vertex {len(points)}\n{properties}end_header\n"
    )
    path.write_bytes(head.encode() + rows.tobytes())
    return path


def test_a_ply_cloud_is_classified_in_chunks(fused, table, points, monkeypatch):
    from semstab.exports import join

    monkeypatch.setattr(join, "CHUNK", 7)
    for order in "<>":
        cloud = ply_cloud(fused / "cloud.ply", points, order)
        export(fused / "run", fused / "onto.ply", model="a", classify=cloud, measures=["vss"], radius=0.3)
        after = o3d.t.io.read_point_cloud(str(fused / "onto.ply"))
        np.testing.assert_array_equal(after.point.positions.numpy(), points)
        assert (after.point["gray"].numpy().ravel() == np.arange(len(points))).all()
        expected = dominant(table) + 1
        assert after.point["class"].numpy().ravel().tolist() == [*expected, expected[-1], 0]
        assert b"comment of mine" in (fused / "onto.ply").read_bytes()


def test_clouds_that_cannot_be_classified(fused, points):
    def classify(cloud, to="never.laz"):
        export(fused / "run", fused / to, model="a", classify=cloud)

    there = las_cloud(fused / "there.laz", points[-1:] + 1000)
    fails(DataError, "no point lies in the map: the cloud spans .* m, the map .*; correct the cloud", classify, there)
    beside = fused / "nowhere", fused / "never.laz"
    fails(DataError, "give the run's dataset a georeference", export, *beside, model="a", classify=there)
    elsewhere = las_cloud(fused / "elsewhere.laz", points, crs="EPSG:32616")
    fails(DataError, "is in EPSG:32616, the run in EPSG:32615; reproject", classify, elsewhere)
    fails(
        ConfigError,
        "the output has the format of .*; write .*never.las",
        classify,
        las_cloud(fused / "c.las", points),
        "never.ply",
    )
    fails(ConfigError, "this is the cloud itself", classify, fused / "c.las", "c.las")
    fails(ConfigError, "a cloud is a .las", classify, fused / "cloud.e57")
    damaged = fused / "damaged.laz"
    for size in (100, 300, -200):
        damaged.write_bytes(las_cloud(fused / "z.laz", points).read_bytes()[:size])
        fails(DataError, "damaged.laz: cannot be read", classify, damaged)
    las = las_cloud(fused / "c.las", points, point_format=3)
    header = laspy.read(las).header
    las.write_bytes(las.read_bytes()[: header.offset_to_point_data + 10 * header.point_format.size])
    fails(DataError, rf"c\.las: .*ends after 10 of {len(points)} points", classify, las)
    short = ply_cloud(fused / "short.ply", points)
    short.write_bytes(short.read_bytes()[:-30])
    fails(DataError, "it is cut short", classify, short, "never.ply")
    for text, message in (
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "save it as binary"),
        (b"solid\n", "not a PLY file"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n", "does not end"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n", "no y, z"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nelement face 2\nend_header\n", "more than points"),
    ):
        short.write_bytes(text)
        fails(DataError, message, classify, short, "never.ply")
    assert not list(fused.glob("never*"))


def test_a_cloud_whose_fields_cannot_be_kept_is_named_not_the_disk(fused):
    """Points of 332 bytes of which no field is told: laspy writes such a header, and cannot read it."""
    las = laspy.LasData(laspy.LasHeader(point_format=0, version="1.4"))
    las.x, las.y, las.z = np.zeros((3, 1))
    las.write(fused / "wide.las")
    content = bytearray((fused / "wide.las").read_bytes())
    content[105:107] = (20 + 312).to_bytes(2, "little")
    (fused / "wide.las").write_bytes(content + bytes(312))
    fails(
        DataError, r"wide\.las: cannot be read", export, fused / "run", fused / "never.las", model="a",
        classify=fused / "wide.las",
    )  # fmt: skip
    assert not (fused / "never.las").exists()


def test_the_command(fused):
    done = bench("export", fused / "run", "--to", "a.ply", "--to", "a.las", "-m", "a", "--class", "door", cwd=fused)
    assert "a.ply: " in done.stdout
    assert "WGS 84 / UTM zone 15N (EPSG:32615)" in done.stdout
    assert "without ASPRS code (--asprs): door; their" in done.stdout
    assert (fused / "a.las").exists()


# --- a scene whose axes are not those of the projection ---------------------------------------------------------------

QUARTER = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
SLIGHT = tuple(map(tuple, Rotation.from_euler("zx", [0.73, 0.02], degrees=True).as_matrix().tolist()))


@pytest.fixture(scope="module", params=[QUARTER, SLIGHT], ids=["a quarter", "0.73 degrees"])
def turned(request, fused):
    """The run once more, of the same scene in a frame that is turned to the projection; its name and matrix."""
    name = f"turned-{len(list(fused.glob('turned-*')))}"
    options = {"crs": CRS, "offset": OFFSET, "linear": request.param}
    config = configure(fused / "scene", dataset=dataset_of(fused / "scene", **options), check=None)
    semstab.run(config, out=fused / name, report=False)
    return name, np.array(request.param)


def test_every_format_has_the_coordinates_of_the_projection(fused, table, turned):
    run, linear = turned
    expected = table.centers @ linear.T + OFFSET
    (georeference,) = semstab.load_result(fused / run).georeference.values()
    assert (np.array(georeference.linear) == linear).all()
    cloud = laspy.read(written(fused, "t.las", run))
    np.testing.assert_allclose(cloud.xyz, expected, atol=5.1e-4)
    ply = o3d.t.io.read_point_cloud(str(written(fused, "t.ply", run)))
    np.testing.assert_allclose(ply.point.positions.numpy(), expected, atol=1e-6)
    rows = pyarrow.parquet.read_table(written(fused, "t.parquet", run))
    np.testing.assert_allclose(np.stack([rows[axis] for axis in "xyz"], axis=1), expected, atol=1e-6)
    mesh = trimesh.load_scene(written(fused, "t.glb", run))
    origin = np.array(mesh.metadata["origin"])
    x, z, y = (mesh.to_geometry().vertices @ np.diag([1, 1, -1])).T  # glTF's y is up, its z towards the viewer
    corners = table.index[:, None] + np.array([*np.ndindex(2, 2, 2)])
    corners = corners.reshape(-1, 3) * table.voxel_size @ linear.T + OFFSET
    found = np.stack([x, y, z], axis=1) + origin
    assert cKDTree(corners).query(found)[0].max() < 1e-4


def test_the_raster_of_a_turned_scene_has_the_voxels_where_they_lie(fused, table, turned):
    run, linear = turned
    points, r = table.centers @ linear.T + OFFSET, table.voxel_size
    with rasterio.open(written(fused, "t.tif", run)) as file:
        bands = dict(zip(file.descriptions, file.read(), strict=True))
        row, column = (np.array(at, int) for at in rowcol(file.transform, points[:, 0], points[:, 1]))
        y, x = np.nonzero(np.isfinite(bands["class"]))
        centres = np.stack(file.xy(y, x), axis=1)
    heights = bands["height"][row, column]
    assert np.isfinite(heights).all()  # no voxel is lost
    assert (heights >= points[:, 2] - 1e-4).all()
    assert cKDTree(points[:, :2]).query(centres)[0].max() <= r * np.sqrt(0.5) + 1e-6  # and no cell is made up


def test_a_turned_plane_has_no_gaps():
    ground = np.stack([*np.indices((40, 40)).reshape(2, -1), np.zeros(1600, int)], axis=1).astype(np.int32)
    made = voxels_by_hand(*[(1, 3, [3, 0, 0])] * len(ground), r=0.25)
    table = dataclasses.replace(made, **dict(zip(("ix", "iy", "iz"), ground.T, strict=True)))
    for degrees in (0.73, 30, 45):
        axes = tuple(map(tuple, Rotation.from_euler("z", degrees, degrees=True).as_matrix().tolist()))
        voxels = dataclasses.replace(as_voxels(table), georeference=Georeference("", (0.0, 0.0, 0.0), axes))
        bands, west, north = seen_from_above(voxels)
        empty = np.argwhere(np.isnan(bands["height"].values))
        x, y = west + (empty[:, 1] + 0.5) * table.voxel_size, north - (empty[:, 0] + 0.5) * table.voxel_size
        back = np.stack([x, y, 0 * x], axis=1) @ np.array(axes)
        inside = ((back[:, :2] > 0) & (back[:, :2] < 40 * table.voxel_size)).all(axis=1)
        assert not inside.any()


def test_a_cloud_in_the_projection_is_classified_by_a_turned_run(fused, table, turned):
    run, linear = turned
    points = table.centers @ linear.T + OFFSET
    cloud = ply_cloud(fused / "tc.ply", points)
    (done,) = export(fused / run, fused / "td.ply", model="a", classify=cloud, radius=0)
    assert "100.0%" in done.content
    after = o3d.t.io.read_point_cloud(str(fused / "td.ply"))
    assert (after.point["class"].numpy().ravel() == dominant(table) + 1).all()


def test_few_points_that_are_met_are_warned_of(fused, table, caplog):
    points = table.centers + OFFSET

    def classify(cloud, **options):
        caplog.clear()
        export(fused / "run", fused / "few.ply", model="a", classify=ply_cloud(fused / "f.ply", cloud), **options)
        return caplog.text

    assert classify(points) == ""
    high = np.concatenate([points[-3:], points[:3], points + np.array([0, 0, 50])])
    assert "f.ply: only " in classify(high)
    assert "the map may be shifted or turned, or the cloud is of another area or height" in caplog.text
    assert classify(high, classes=CLASSES) == ""
    large = np.concatenate([points, points + np.array([500, 0, 0]), points + np.array([0, 500, 0])])
    assert "the cloud is larger than the map; of the points over the map 100.0% do" in classify(large)


def test_a_model_is_chosen_after_a_colon(fused):
    export(f"{fused / 'run'}:b", fused / "colon.csv")
    export(fused / "run", fused / "option.csv", model="b")
    assert (fused / "colon.csv").read_text() == (fused / "option.csv").read_text()
    done = bench("export", f"{fused / 'run'}:a", "--to", str(fused / "colon.ply"), cwd=fused)
    assert done.returncode == 0, done.stderr
    with pytest.raises(ConfigError, match=r"run:a: --model b names another model; use one of the two"):
        export(f"{fused / 'run'}:a", fused / "colon.csv", model="b")
    with pytest.raises(ConfigError, match=r"nothing"):
        export(f"{fused / 'run'}:nothing", fused / "colon.csv")
