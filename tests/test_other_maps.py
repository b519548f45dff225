"""Maps of other programs beside a run's: what they hold, which labels agree, and how a wrong frame is found."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny_scene
from command_line import bench, error_of
from labelled_maps import cloud, kimera_mesh
from posed_config import configure, dataset_of
from posed_scene import fails

import semstab
from semstab.errors import ConfigError, DataError
from semstab.exports import export
from semstab.metrics import dominant
from semstab.other_maps import MapAgreement
from semstab.other_maps.placing import Grid, fused, on_surface

CRS, OFFSET = "EPSG:32615", (576714, 5188162, 200)
COLORS = {"wall": (128, 64, 128), "door": (70, 70, 70), "window": (0, 130, 180)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two models with a georeference and with ground truth, and one without either."""
    folder = tmp_path_factory.mktemp("maps")
    tiny_scene.write(folder / "scene", frames=8)
    for name, options, more in (
        ("run", {"crs": CRS, "offset": OFFSET}, {"statistics": True}),
        ("nowhere", {}, {"statistics": False}),
    ):
        config = configure(folder / "scene", dataset=dataset_of(folder / "scene", **options), check=None, **more)
        semstab.run(config, out=folder / name, report=False)
    return folder


@pytest.fixture(scope="module")
def table(folder):
    return semstab.load_result(folder / "nowhere").record(model="a").table()


def only(folder, other, run="nowhere", **options) -> MapAgreement:
    (agreement,) = semstab.compare_maps(folder / run, folder / other, model="a", **options).agreements
    return agreement


@pytest.mark.parametrize("run", ["run", "nowhere"])
@pytest.mark.parametrize("suffix", ["ply", "las", "laz", "parquet"])
def test_what_the_run_exported_agrees_fully(folder, run, suffix) -> None:
    export(folder / run, folder / f"{run}.{suffix}", model="a")
    agreement = only(folder, f"{run}.{suffix}", run)
    assert (agreement.covers, agreement.covered, agreement.same, agreement.outside, agreement.unlabelled) == (
        1,
        1,
        1,
        0,
        0,
    )
    assert agreement.places == ()
    assert agreement.better == ""


def test_the_tables_that_a_run_stores_are_maps_in_the_scene(folder) -> None:
    """A run with a georeference stores voxels of the scene, and no coordinates of its projection."""
    files = sorted((folder / "run/voxels").glob("*__a__*.parquet"))
    assert only(folder, files[0], "run").same == 1


def test_numbers_by_hand(folder, table) -> None:
    """Of the voxels one in five is missing, and of the others the first ten have another class."""
    ours, true = dominant(table), dominant(truth(folder, table))
    keep = np.arange(len(table)) % 5 > 0
    other = ours[keep].copy()
    other[:10] = (other[:10] + 1) % 3
    far = np.array([[50.0, 50.0, 50.0]])
    cloud(folder / "some.ply", np.concatenate([table.centers[keep], far]), np.append(other, 0))
    agreement = only(folder, "some.ply", "run", frame="scene")
    n = np.count_nonzero(keep)
    assert agreement.points == agreement.voxels == n + 1
    assert agreement.covers == pytest.approx(n / len(table))
    assert agreement.covered == pytest.approx(n / (n + 1))
    assert agreement.outside == pytest.approx(1 / (n + 1))
    assert (agreement.compared, agreement.same) == (n, pytest.approx(1 - 10 / n))
    assert agreement.known == n
    assert agreement.accuracy == pytest.approx((np.mean(ours[keep] == true[keep]), np.mean(other == true[keep])))
    for row in agreement.classes:
        k = ["wall", "door", "window"].index(row.name)
        assert row.voxels == np.count_nonzero(ours[keep] == k)
        assert row.same == pytest.approx(np.mean(other[ours[keep] == k] == k))
        of_class = true[keep] == k
        assert row.recall == pytest.approx((np.mean(ours[keep][of_class] == k), np.mean(other[of_class] == k)))
    assert sum(row.voxels for row in agreement.strata) == len(table)
    twice = next(row for row in agreement.strata if row.name == "OP=2")
    twice_seen = table.op == 2
    assert (twice.voxels, twice.covered) == (np.count_nonzero(twice_seen), pytest.approx(np.mean(keep[twice_seen])))


def truth(folder, table):
    """The ground truth's map, fused by the engine as another model is."""
    config = configure(folder / "scene", check=None, models=["gt"])
    made = semstab.run(config, out=folder / "gt", report=False)
    found = made.record(model="gt").table()
    assert (found.index == table.index).all()
    return found


def test_places_are_neighbours_with_the_same_two_classes(folder, table) -> None:
    """A patch of a wall in which the other map has another class is one place, at its middle."""
    ours = dominant(table)
    names, commonest = ["wall", "door", "window"], int(np.bincount(ours).argmax())
    patch, other = (table.centers[:, 0] > 0.5) & (ours == commonest), (commonest + 1) % 3
    assert np.count_nonzero(patch) >= 4
    agreement = only(folder, cloud(folder / "patch.ply", table.centers, np.where(patch, other, ours)).name)
    assert sum(place.voxels for place in agreement.places) <= np.count_nonzero(patch)
    largest = agreement.places[0]
    assert (largest.ours, largest.theirs) == (names[commonest], names[other])
    assert patch[np.linalg.norm(table.centers - largest.centre, axis=1).argmin()]
    comparison = semstab.compare_maps(folder / "nowhere", folder / "patch.ply", model="a")
    in_place = comparison.maps[0].area == 1
    assert np.count_nonzero(in_place) == largest.voxels
    np.testing.assert_allclose(table.centers[in_place].mean(axis=0), largest.centre)


WRONG = {
    "--shift": lambda points, r: points + r / 2,
    "--shift=": lambda points, r: points - r / 2,
    "--axes": lambda points, r: points[:, [0, 2, 1]] * [1, 1, -1],
    "--axes=": lambda points, r: points * [-1, 1, 1],
    "--unit mm": lambda points, r: 1000 * points,
    "--unit cm": lambda points, r: 100 * points[:, [2, 0, 1]],
}


@pytest.mark.parametrize("option", WRONG)
def test_a_wrong_frame_is_found_said_and_mended_by_its_option(folder, table, option, tmp_path) -> None:
    """The option that the line names makes the map agree; without it nothing is moved."""
    rng = np.random.default_rng(3)
    r = table.voxel_size
    points = np.repeat(table.centers, 4, axis=0) + rng.uniform(-0.1, 0.1, (4 * len(table), 3)) * r
    moved = WRONG[option](points, r)
    path = cloud(tmp_path / "moved.ply", moved, np.repeat(dominant(table), 4))
    words = ("maps", folder / "nowhere:a", path)
    done = bench(*words, cwd=tmp_path, code=None)
    said = " ".join((done.stdout + done.stderr).split())
    assert "fits better with --" in said
    assert option.rstrip("=") in said
    if done.returncode == 0:
        assert only(folder, path).same < 1 or only(folder, path).covers < 1
    options = said.partition("fits better with ")[2].partition(":")[0].split()
    bench(*words, *options, "--out", "beside", cwd=tmp_path)
    (row,) = json.loads((tmp_path / "beside/tables/tables.json").read_text())["maps"]["rows"]
    assert (row["covers"], row["covered"], row["same"]) == (100, 100, 100)


def test_voxels_named_by_their_corner_are_half_a_voxel_off(folder, table, tmp_path) -> None:
    path = cloud(tmp_path / "corners.ply", table.index * table.voxel_size - 1e-6, dominant(table))
    fails(DataError, "fits better with --shift=0.125,0.125,0.125", only, folder, path)
    assert only(folder, path, shift="0.125,0.125,0.125").same == 1


def test_coordinates_of_the_scene_in_a_georeferenced_run_are_found(folder, table) -> None:
    path = cloud(folder / "in_scene.ply", table.centers, dominant(table))
    fails(DataError, "fits better with --frame scene", semstab.compare_maps, folder / "run", path, model="a")
    assert only(folder, path, "run", frame="scene").same == 1


def test_another_map_that_is_merely_worse_is_not_moved(folder, table) -> None:
    """Labels at random, and voxels at random: no placement fits much better, and none is said to."""
    rng = np.random.default_rng(0)
    keep = rng.random(len(table)) < 0.6
    label = np.where(rng.random(len(table)) < 0.4, rng.integers(0, 3, len(table)), dominant(table))
    agreement = only(folder, cloud(folder / "worse.ply", table.centers[keep], label[keep]).name)
    assert agreement.better == ""
    assert 0 < agreement.same < 1


def test_a_mesh_whose_colours_are_classes_as_kimera_writes_it(folder, table, tmp_path) -> None:
    """Its colours are named by a file, YAML or the table that Kimera-Semantics reads; large triangles are filled."""
    mesh = kimera_mesh(tmp_path / "mesh.ply", table, COLORS)
    (tmp_path / "colours.yaml").write_text("".join(f"{name}: {list(rgb)}\n" for name, rgb in COLORS.items()))
    lines = [f"{name}, {r}, {g}, {b}, 255, {k}" for k, (name, (r, g, b)) in enumerate(COLORS.items())]
    (tmp_path / "colours.csv").write_text("\n".join(["name, red, green, blue, alpha, id", *lines]))
    for name in ("colours.yaml", "colours.csv"):
        agreement = only(folder, mesh, colours=tmp_path / name)
        assert (agreement.covers, agreement.covered, agreement.same, agreement.unlabelled) == (1, 1, 1, 0)
        assert any("mesh" in note for note in agreement.notes)
    fails(DataError, "--colours", only, folder, mesh)
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    points, row = on_surface(corners, np.array([0, 1, 2]), np.array([[0, 1, 2]]), 0.1)
    below = points[(points[:, 0] + points[:, 1]) <= 4 + 1e-9]
    assert len(below) == len(points)
    assert len(fused(points, row, 0.25, 3)) == sum(range(17)) + 2
    assert set(row[np.linalg.norm(points - corners[1], axis=1) < 1]) == {1}


def test_classes_by_name_id_and_file(folder, table, tmp_path) -> None:
    ours = dominant(table)
    names = np.array(["Wall", "door", "pane"])[ours]
    pq.write_table(pa.table({**dict(zip("xyz", table.centers.T, strict=True)), "label": names}), tmp_path / "n.parquet")
    agreement = only(folder, tmp_path / "n.parquet")
    assert agreement.unlabelled == pytest.approx(np.mean(ours == 2))
    assert any("pane" in note for note in agreement.notes)
    assert agreement.same == 1
    np.savez(tmp_path / "v.npz", index=table.index, label=ours * 10 + 5, voxel_size=table.voxel_size)
    fails(DataError, "id 15", only, folder, tmp_path / "v.npz")
    (tmp_path / "ids.yaml").write_text("5: wall\n15: door\n25: window\n")
    assert only(folder, tmp_path / "v.npz", classes=tmp_path / "ids.yaml").same == 1
    np.savez(tmp_path / "w.npz", points=table.centers, semantic=(2 - ours), classes=["window", "door", "wall"])
    assert only(folder, tmp_path / "w.npz").same == 1


def test_a_voxel_has_the_class_of_most_of_its_points() -> None:
    points = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0], [1.1, 0, 0], [1.2, 0, 0], [2.5, 0, 0], [-0.1, 0, 0]])
    grid = fused(points, np.array([2, 1, 1, 2, 0, -1, 1]), 1.0, 3)
    assert grid.index[:, 0].tolist() == [-1, 0, 1, 2]
    assert grid.label.tolist() == [1, 1, 0, -1]
    assert grid.rows(np.array([[2, 0, 0], [3, 0, 0], [-1, 0, 0], [0, 1, 0]])).tolist() == [3, -1, 0, -1]


def test_a_voxel_outside_the_box_of_a_map_is_in_no_row() -> None:
    """Each has the key of a voxel in another row of the box; of its own corners the last one is not in the map."""
    box = np.array([(x, y, z) for x in (5, 6) for y in (-3, -2, -1) for z in (7, 8, 9, 10)][:-1], dtype=np.int32)
    grid = Grid(box, np.zeros(len(box), np.int64), 1.0)
    around = np.array([(x, y, z) for x in range(4, 8) for y in range(-4, 1) for z in range(6, 12)])
    within = {tuple(index): row for row, index in enumerate(box.tolist())}
    assert grid.rows(around).tolist() == [within.get(tuple(index), -1) for index in around.tolist()]


def test_asprs_codes_of_a_cloud_of_another_program(folder, table, tmp_path) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = table.centers.T
    las.classification = np.array([6, 11, 64])[dominant(table)]
    las.write(tmp_path / "c.las")
    fails(ConfigError, "ASPRS", only, folder, tmp_path / "c.las")
    (tmp_path / "codes.yaml").write_text("6: wall\n11: door\n64: window\n")
    assert only(folder, tmp_path / "c.las", classes=tmp_path / "codes.yaml").same == 1


def test_several_maps_are_rows_of_a_table_with_pictures_places_and_a_recording(folder, table, tmp_path) -> None:
    ours = dominant(table)
    cloud(tmp_path / "same.ply", table.centers, ours)
    cloud(tmp_path / "other.ply", table.centers, np.where(table.centers[:, 0] < 0.5, (ours + 1) % 3, ours))
    done = bench(
        "maps",
        folder / "run:a",
        "same.ply",
        "other.ply",
        "--frame",
        "scene",
        "--out",
        "beside",
        cwd=tmp_path,
        columns=80,
    )
    assert max(map(len, done.stdout.splitlines())) <= 80
    rows = json.loads((tmp_path / "beside/tables/tables.json").read_text())["maps"]["rows"]
    assert [row["map"] for row in rows] == ["same.ply", "other.ply"]
    assert rows[0]["same"] == 100 > rows[1]["same"]
    places = json.loads((tmp_path / "beside/places.geojson").read_text())
    assert {feature["properties"]["map"] for feature in places["features"]} == {"other.ply"}
    lon, lat = places["features"][0]["geometry"]["coordinates"]
    assert (round(lon), round(lat)) == (-92, 47)
    lines = (tmp_path / "beside/places.csv").read_text().splitlines()
    assert len(lines) == 1 + len(places["features"])
    assert len(list((tmp_path / "beside/figures").glob("*.png"))) == 2
    assert (tmp_path / "beside/recording.rrd").stat().st_size > 1000


BAD = [
    ("missing.ply", (), "there is no such file"),
    ("some.obj", (), "format '.obj' is not known"),
    ("bad.ply", (), "cannot be read"),
    ("bad.npz", (), "cannot be read"),
    ("bare.ply", (), "no field holds a class"),
    ("good.ply", ("--field", "kind"), "no field 'kind'"),
    ("good.ply", ("--unit", "ft"), "--unit ft"),
    ("good.ply", ("--axes", "x,y"), "--axes x,y"),
    ("good.ply", ("--axes", "x,--y,z"), "--axes"),
    ("good.ply", ("--shift", "1,2"), "--shift 1,2"),
    ("good.ply", ("--frame", "world"), "--frame world"),
    ("good.ply", ("--colours", "none.yaml"), "no colour"),
    ("good.ply", ("--classes", "nothing"), "nothing"),
]


@pytest.mark.parametrize(("name", "words", "text"), BAD)
def test_bad_input_is_one_line(folder, table, tmp_path, name, words, text) -> None:
    cloud(tmp_path / "good.ply", table.centers, dominant(table))
    (tmp_path / "some.obj").write_text("v 0 0 0\n")
    (tmp_path / "bad.ply").write_text((tmp_path / "good.ply").read_text()[:300])
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 no archive")
    cloud(tmp_path / "bare.ply", table.centers, dominant(table), name="quality")
    line = error_of("maps", folder / "nowhere:a", name, *words, "--out", "beside", cwd=tmp_path)
    assert text in line
    assert not (tmp_path / "beside").exists()


def test_another_projection_is_refused(folder, table, tmp_path) -> None:
    columns = {**dict(zip("xyz", (table.centers + OFFSET).T, strict=True)), "label": dominant(table)}
    about = {"crs": "EPSG:32616", "classes": ["wall", "door", "window"]}
    made = pa.table(columns).replace_schema_metadata({"semstab": json.dumps(about)})
    pq.write_table(made, tmp_path / "other.parquet")
    fails(DataError, "EPSG:32616", only, folder, tmp_path / "other.parquet", "run")
    fails(DataError, "no georeference", only, folder, tmp_path / "other.parquet")
