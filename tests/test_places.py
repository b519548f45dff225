"""Where things are: the worst places of a map, their files, and the coordinates around its pictures."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import re

import numpy as np
import pyproj
import pytest
import tiny_scene
from command_line import bench
from posed_config import configure, dataset_of
from posed_scene import fails

import semstab
from semstab import Frame, Intrinsics, VoxelTable
from semstab.data.georeference import IDENTITY, Georeference
from semstab.data.topdown import level_axes
from semstab.engine.place_pictures import EDGE, chosen_frames, cut_out, pictured_views
from semstab.errors import ConfigError
from semstab.exports import export
from semstab.exports.places import LOCAL, holds_places
from semstab.report.figures.located import Located, metres, ticks
from semstab.report.figures.maps import Overview, draw_stability
from semstab.report.figures.topdown import FromAbove
from semstab.report.html import label_picture
from semstab.report.page import render
from semstab.statistics import SpotObservations, Views, places
from semstab.statistics.places import Place, PlaceView, connected, places_of, worst_places

CRS, OFFSET = "EPSG:32615", (576714.0, 5188162.0, 200.0)
CLASSES = ("wall", "door", "window")
WKT = pyproj.CRS.from_epsg(32615).to_wkt()


def a_map(groups, r=0.5):
    """A map from groups of (indices, votes): the votes of each voxel are whole frames of a class."""
    index, evidence = [], []
    for voxels, votes in groups:
        index += voxels
        evidence += [votes] * len(voxels)
    order = np.lexsort(np.array(index).T[::-1])
    index, evidence = np.array(index)[order], np.array(evidence, float)[order]
    op = evidence.sum(axis=1).astype(int)
    zeros = np.zeros(len(op))
    return VoxelTable(
        *index.T, op=op, evidence=evidence, drift_sum=zeros, pixels=op, first_frame=zeros, last_frame=op - 1,
        self_sum=op.astype(float), frame_entropy_sum=zeros, voxel_size=r, classes=CLASSES,
    )  # fmt: skip


def row(y, n=4):
    return [(x, y, 0) for x in range(n)]


def spots_in(places, r=0.5):
    """Spots at points, each with the answers (view, label)."""
    spot, view, label = zip(*((k, v, c) for k, (_, answers) in enumerate(places) for v, c in answers), strict=True)
    views = Views.from_rows([[10 * v, 0, 0, 0, v, 0.01] for v in range(4)])
    zeros = np.zeros(len(spot), np.float32)
    label = np.array(label, np.uint16)
    return SpotObservations(
        np.array(spot, np.int32), np.array(view, np.int32), label, label, label, zeros, zeros,
        np.array([point for point, _ in places], float), np.zeros(len(places), np.uint32), views, 0.25, 3,
    )  # fmt: skip


# --- Places -----------------------------------------------------------------------------------------------------------


def test_a_place_is_touching_voxels_on_which_half_of_the_frames_disagree_worst_first() -> None:
    table = a_map([(row(0, 5), [2, 1, 0]), (row(10, 9), [0, 2, 2]), (row(20, 9), [4, 0, 0]), (row(30, 3), [1, 1, 0])])
    first, second = worst_places((table,), None)
    assert (first.label, first.other, first.voxels, first.op) == (1, 2, 9, 4)
    assert first.agreement == pytest.approx(1 / 3)  # of six pairs of four frames two agree
    assert (second.label, second.other, second.voxels) == (0, 1, 5)
    lost = 9 * 2 / 3, 5 * 2 / 3
    whole = sum(lost) + 3  # three voxels are too few for a place
    assert [first.share, second.share] == pytest.approx([lost_votes / whole for lost_votes in lost])
    assert first.centre == (2.25, 5.25, 0.25)
    assert first.size == pytest.approx(math.hypot(4.5, 0.5, 0.5))
    assert first.views == ()


def test_places_do_not_depend_on_tiles_and_are_at_most_so_many() -> None:
    groups = [(row(0, 5), [2, 1, 0]), (row(10, 9), [0, 2, 2])]
    whole = worst_places((a_map(groups),), None)
    parts = worst_places([a_map([group]) for group in groups], None)
    whole, parts = (
        [(p.number, p.label, p.voxels, round(p.share, 9), p.centre) for p in found] for found in (whole, parts)
    )
    assert whole == parts
    assert len(worst_places((a_map(groups),), None, 1)) == 1


def test_of_a_large_map_the_voxels_on_which_frames_agree_least_are_looked_at(monkeypatch) -> None:
    groups = [(row(0, 5), [2, 1, 0]), (row(10, 9), [2, 2, 2]), (row(20, 3), [1, 0, 1])]
    monkeypatch.setattr(places, "VOXELS", 9)
    for tables in ((a_map(groups),), [a_map([group]) for group in groups]):
        (place,) = worst_places(tables, None)
        assert place.voxels == 6
    assert place.share == pytest.approx(6 * 0.8 / (5 * 2 / 3 + 9 * 0.8 + 3))


def test_a_map_without_disagreement_has_no_places() -> None:
    assert worst_places((a_map([(row(0), [4, 1, 0])]),), None) == []  # six of ten pairs agree


def test_voxels_of_other_pairs_of_classes_or_without_a_common_corner_are_apart() -> None:
    index = np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2), (4, 2, 2)], np.int32)
    pair = np.array([(0, 1), (0, 1), (0, 2), (0, 2)])
    a, b, c, d = connected(index, pair)
    assert a == b
    assert len({a, c, d}) == 3


def test_the_views_of_a_place_are_those_of_its_spots_with_the_likeliest_class() -> None:
    table = a_map([(row(0, 5), [2, 1, 0])])
    inside = [((0.1, 0.1, 0.1), [(2, 1), (0, 0)]), ((0.6, 0.2, 0.3), [(0, 0), (3, 3)]), ((1.1, 0.2, 0.3), [(0, 1)])]
    outside = [((0.1, 0.9, 0.1), [(1, 2)])]
    (place,) = worst_places((table,), spots_in([*inside, *outside]))
    assert place.views == (PlaceView(0, 0, 3), PlaceView(20, 1, 1), PlaceView(30, -1, 1))


# --- Pictures ---------------------------------------------------------------------------------------------------------


def a_place(number, label, other, views, points=((0.0, 0.0, 2.0),)):
    return Place(number, label, other, 4, 0.3, 0.1, 3.0, 1.0, points[0], np.array(points), tuple(views))


def test_few_frames_show_the_places_one_of_each_class_of_a_place() -> None:
    one = a_place(1, 0, 1, [PlaceView(3, 0, 2), PlaceView(5, 0, 9), PlaceView(6, 1, 1), PlaceView(7, 2, 4)])
    two = a_place(2, 1, 0, [PlaceView(6, 1, 3), PlaceView(8, 0, 1)])
    assert chosen_frames([one, two]) == {5, 6, 8}
    assert [view.frame for view in pictured_views(one, {5, 6, 8})] == [5, 6]
    more = [a_place(k, 0, 1, [PlaceView(10 * k, 0, 1), PlaceView(10 * k + 1, 1, 1)]) for k in range(9)]
    assert chosen_frames(more) == {0, 1, 10, 11}


def test_a_picture_is_cut_around_the_place_in_labels_and_in_a_larger_image() -> None:
    labels = np.zeros((60, 80), np.uint8)
    labels[30:, 40:] = 1
    color = np.zeros((120, 160, 3), np.uint8)
    color[60:, 80:] = 255
    camera, pose = Intrinsics(40.0, 40.0, 39.5, 29.5), np.eye(4)
    frame = Frame(0, np.full((60, 80), 2, np.float32), camera, pose, labels=labels)
    points = np.array([(x, y, 2.0) for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    around, image, (x, y, radius) = cut_out(frame, points)
    assert around.shape == (EDGE, EDGE)
    assert image is None
    assert (x, y) == pytest.approx((0.5, 0.5), abs=0.02)
    assert 0.05 < radius < 0.5
    assert around[-1, -1] == 1
    assert around[0, 0] == around[0, -1] == around[-1, 0] == 0
    with_color = dataclasses.replace(frame, color=color[::2, ::2])
    assert cut_out(with_color, points)[1][-1, -1].tolist() == [255, 255, 255]
    assert cut_out(frame, np.subtract(points, (0, 0, 4))) is None
    assert cut_out(frame, np.add(points, (9, 0, 0))) is None


def test_labels_without_a_class_are_grey() -> None:
    assert label_picture(np.array([[0, 255]], np.uint8), np.array([[1, 2, 3]])).startswith("data:image/png")


# --- Coordinates of a picture -----------------------------------------------------------------------------------------


def test_ticks_are_round_and_few() -> None:
    assert ticks(576676.2, 576761.0) == [576680, 576700, 576720, 576740, 576760]
    assert ticks(-0.3, 0.4) == pytest.approx([-0.2, 0, 0.2, 0.4])
    assert [metres(value) for value in (576680.0, -0.2, 0.1 + 0.2, -1e-9)] == ["576680", "-0.2", "0.3", "0"]


def plate(up=(0, 0, 1)):
    index = [(x, y + 4, 0) for x in range(40) for y in range(20)]
    return FromAbove.from_table(a_map([(index, [3, 0, 0])]), up)


def test_a_picture_lies_in_the_coordinates_of_the_scene() -> None:
    located = Located.from_view(plate())
    lower, left = located.edges
    assert (lower.name, left.name, located.north) == ("x", "y", None)
    expected = {0: 0, 5: 0.25, 10: 0.5, 15: 0.75, 20: 1}
    assert {value: share for share, value in lower.ticks} == pytest.approx(expected)
    assert {value: share for share, value in left.ticks} == pytest.approx({2 * k: 0.2 * (k - 1) for k in range(1, 7)})
    assert located.share((5, 4.5, 0)) == pytest.approx((0.25, 0.75))
    assert located.coordinates((5, 4.5, 0)) == [5, 4.5, 0]


def test_a_picture_lies_in_the_projection_and_north_is_up() -> None:
    located = Located.from_view(plate(), Georeference(WKT, OFFSET))
    lower, left = located.edges
    assert (lower.name, left.name, located.north) == ("east", "north", 0)
    assert [value for _, value in lower.ticks] == [576715, 576720, 576725, 576730]
    assert [share for share, _ in lower.ticks] == pytest.approx([0.05, 0.3, 0.55, 0.8])
    assert located.coordinates((1, 2, 3)) == [576715, 5188164, 203]
    assert located.system == "WGS 84 / UTM zone 15N (EPSG:32615)"


@pytest.mark.parametrize("degrees", [3.0, 30.0, -90.0])
def test_north_of_a_scene_that_is_turned_against_the_projection(degrees) -> None:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turned = ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))  # the scene's x axis lies `degrees` north of east
    georeference = Georeference(WKT, OFFSET, turned)
    located = Located.from_view(plate(), georeference)
    assert located.north == pytest.approx(degrees)
    lower, _ = located.edges
    assert lower.name == {3.0: "east", 30.0: "", -90.0: "north"}[degrees]
    for share, value in lower.ticks:
        point = located.coordinates((share * 20, 2, 0.25))
        assert value == pytest.approx(point[0 if lower.name == "east" else 1])


def test_a_map_from_the_side_has_heights_and_no_north() -> None:
    wall = FromAbove.from_table(a_map([([(x, 0, z) for x in range(20) for z in range(10)], [3, 0, 0])]), (0, 0, 1))
    located = Located.from_view(wall, Georeference(WKT, OFFSET))
    assert wall.view == "from the side"
    assert [edge.name for edge in located.edges] == ["east", "height"]
    assert located.north is None


@pytest.mark.parametrize("along", [0, 1])
def test_a_wall_is_seen_upright_from_either_side(along) -> None:
    index = [(k, 0, z) if along == 0 else (0, k, z) for k in range(20) for z in range(10)]
    located = Located.from_view(FromAbove.from_table(a_map([(index, [3, 0, 0])]), (0, 0, 1)))
    lower, left = located.edges
    assert (lower.name, left.name) == ("xy"[along], "z")
    assert [value for _, value in sorted(left.ticks)] == [0, 1, 2, 3, 4, 5]


def test_a_figure_has_the_coordinates_of_the_exports_and_an_arrow_to_north() -> None:
    axes = draw_stability(plate(), Georeference(WKT, OFFSET)).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["576715", "576720", "576725", "576730"]
    assert axes.get_xlabel() == "east, m (WGS 84 / UTM zone 15N (EPSG:32615))"
    assert axes.get_ylim()[0] == axes.get_yticks()[0] > axes.get_yticks()[-1]  # rows count from the top
    assert next(label.get_text() for label in axes.get_yticklabels()) == "5188164"
    texts = [text.get_text() for text in axes.texts]
    assert texts == ["5 m", "N"]
    without = draw_stability(plate()).axes[0]
    assert [text.get_text() for text in without.texts] == ["5 m"]
    assert without.get_xlabel() == "x, m (coordinates of the scene)"


def test_the_matrix_of_a_picture_is_that_of_its_axes() -> None:
    up = np.array([0.1, -0.2, 1.0])
    located = Located.seen_along(up, (1.0, 2.0), (4.0, 3.0), np.zeros((1, 3)), None)
    right, ahead, _ = level_axes(up)
    np.testing.assert_allclose(located.matrix @ [0, 0, 1], right + 2 * ahead)
    np.testing.assert_allclose(located.matrix @ [3, 1, 1], 4 * right + 3 * ahead)
    assert located.georeference is None
    assert np.array(IDENTITY).shape == (3, 3)


# --- Runs, their report and their files -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with a noisy run that has a georeference, and with one that has none."""
    folder = tmp_path_factory.mktemp("places")
    tiny_scene.write(folder / "scene", frames=6, noise=0.6)
    for name, options in (("run", {"crs": CRS, "offset": OFFSET}), ("nowhere", {})):
        config = configure(folder / "scene", dataset=dataset_of(folder / "scene", **options), check=None)
        semstab.run(config, out=folder / name, report=False)
    return folder


@pytest.mark.parametrize(
    ("name", "places"),
    [
        ("a.geojson", True),
        ("places.csv", True),
        ("run-places.CSV", True),
        ("map.csv", False),
        ("workplaces.csv", False),
    ],
)
def test_which_files_get_places(tmp_path, name, places) -> None:
    assert holds_places(tmp_path / name) is places


def test_geojson_has_longitude_and_latitude_and_the_coordinates_of_the_exports(runs) -> None:
    (written,) = export(runs / "run", runs / "out.geojson", model="a")
    assert "WGS 84 / UTM zone 15N (EPSG:32615)" in written.content
    content = json.loads((runs / "out.geojson").read_text())
    assert (content["type"], "crs" in content) == ("FeatureCollection", False)
    places = places_of(semstab.load_result(runs / "run").record(model="a"))
    assert len(places) == len(content["features"]) > 0
    back = pyproj.Transformer.from_crs("EPSG:4326", CRS, always_xy=True)
    for place, feature in zip(places, content["features"], strict=True):
        properties, (lon, lat) = feature["properties"], feature["geometry"]["coordinates"]
        x, y, z = np.array(place.centre) + OFFSET
        assert (properties["x"], properties["y"], properties["z"]) == pytest.approx((x, y, z), abs=1e-3)
        assert back.transform(lon, lat) == pytest.approx((x, y), abs=0.01)
        assert properties["class"] in CLASSES
        assert properties["confused_with"] in set(CLASSES) - {properties["class"]}
        assert properties["crs"] == "WGS 84 / UTM zone 15N (EPSG:32615)"
        assert len(properties["frames"]) == len(properties["given"]) == len(place.views)
        assert set(properties["frames"]) <= {f"{k:04d}" for k in range(6)}
    assert any(feature["properties"]["frames"] for feature in content["features"])


def test_geojson_without_a_georeference_has_metres_and_says_so(runs) -> None:
    (written,) = export(runs / "nowhere", runs / "local.geojson", model="a", most=2)
    assert written.notes == ("local metres, no degrees: lay no map under it",)
    content = json.loads((runs / "local.geojson").read_text())
    assert (content["crs"], content["note"]) == (None, LOCAL)
    for feature in content["features"]:
        properties = feature["properties"]
        assert feature["geometry"]["coordinates"] == [properties["x"], properties["y"]]
        assert properties["crs"] == ""


def test_the_table_has_the_same_places(runs) -> None:
    export(runs / "run", [runs / "places.csv", runs / "same.geojson"], model="a", most=3)
    with (runs / "places.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    features = json.loads((runs / "same.geojson").read_text())["features"]
    for line, feature in zip(rows, features, strict=True):
        properties = feature["properties"]
        assert [float(line[name]) for name in "xyz"] == [properties[name] for name in "xyz"]
        assert line["frames"].split("; ") == properties["frames"]
        assert float(line["latitude"]) == feature["geometry"]["coordinates"][1]


def test_voxels_are_chosen_as_in_other_exports(runs) -> None:
    fails(ConfigError, "no voxel with OP >= 99", export, runs / "run", runs / "none.geojson", model="a", min_op=99)
    export(runs / "run", runs / "doors.geojson", model="a", classes=["door"])
    content = json.loads((runs / "doors.geojson").read_text())
    assert {feature["properties"]["class"] for feature in content["features"]} <= {"door"}


def test_a_run_whose_frames_agree_has_no_places(tmp_path) -> None:
    tiny_scene.write(tmp_path / "scene", noise=0.0)
    semstab.run(configure(tmp_path / "scene", check=None), out=tmp_path / "run", report=False)
    match = "no place where at most half of the pairs of frames agree"
    fails(ConfigError, match, export, tmp_path / "run", tmp_path / "places.csv", model="a")


def test_the_command_writes_both_files(runs) -> None:
    done = bench("export", runs / "run", "--to", "c.geojson", "--to", "places.csv", "-m", "a", "-n", "2", cwd=runs)
    assert "c.geojson: 2 places where frames disagree, WGS 84 / UTM zone 15N (EPSG:32615)" in done.stdout
    assert "longitude and latitude" in done.stdout


def test_the_page_has_coordinates_north_and_the_places_with_their_frames(runs) -> None:
    result = semstab.load_result(runs / "run")
    page = render(result, runs / "run")
    record = result.record(model="a")
    first = places_of(record)[0]
    x, y, z = np.array(first.centre) + OFFSET
    assert "WGS 84 / UTM zone 15N (EPSG:32615)" in page
    assert f"east {metres(round(x, 2))}, north {metres(round(y, 2))}, height {metres(round(z, 2))}" in page
    assert 'href="#place-0-0-1"' in page
    assert 'id="place-0-0-1"' in page
    assert '<div class="bar"' in page
    pictures = Overview.load(runs / "run" / "overview" / "scene__a.npz").places
    assert pictures is not None
    assert set(pictures.of) <= {place.number for place in places_of(record)}
    assert 'class="ringed"' in page
    nowhere = render(semstab.load_result(runs / "nowhere"), runs / "nowhere")
    assert "coordinates of the scene" in nowhere
    assert '<div class="north"' not in nowhere


def test_areas_of_compare_are_in_the_coordinates_of_the_exports(runs) -> None:
    there, nowhere = (semstab.compare(runs / name, out=runs / f"versus-{name}") for name in ("run", "nowhere"))
    (scene,), (local,) = there.scenes, nowhere.scenes
    assert (scene.crs, local.crs) == ("WGS 84 / UTM zone 15N (EPSG:32615)", "")
    pairs = list(zip(scene.against[0].areas, local.against[0].areas, strict=True))
    assert pairs
    for area, unplaced in pairs:
        np.testing.assert_allclose(area.centre, np.array(unplaced.centre) + OFFSET)
    text = (runs / "versus-run" / "comparison.md").read_text()
    assert "Centres are in WGS 84 / UTM zone 15N (EPSG:32615)." in text
    assert "m of WGS 84 / UTM zone 15N (EPSG:32615)" in text
    page = (runs / "versus-run" / "report.html").read_text()
    first = scene.against[0].areas[0]
    assert f'id="area-scene__{scene.against[0].other}-{first.what}-1"' in page
    assert f"east {metres(round(first.centre[0], 2))}" in page
    pins = re.findall(r'class="pin" href="#(area-[^"]+)" style="left:([\d.]+)%;top:([\d.]+)%"', page)
    assert f"area-scene__{scene.against[0].other}-{first.what}-1" in {link for link, *_ in pins}
    for link, left, top in pins:  # each opens an area that the page tells of, and lies in the picture
        assert f'<details class="place" id="{link}">' in page
        assert 0 < float(left) < 100
        assert 0 < float(top) < 100
    assert "Centres are in the coordinates of the scene." in (runs / "versus-nowhere" / "comparison.md").read_text()


def test_areas_are_shown_in_the_frames_behind_them_where_the_data_is_at_hand(tmp_path) -> None:
    tiny_scene.write(tmp_path / "scene", frames=6, noise=0.6)
    semstab.run(configure(tmp_path / "scene", check=None), out=tmp_path / "run", report=False)
    compared = semstab.compare(tmp_path / "run", out=tmp_path / "with")
    assert any(area.frames for area in compared.scenes[0].against[0].areas)
    page = (tmp_path / "with" / "report.html").read_text()
    assert 'alt="labels of a"' in page
    assert 'alt="labels of b"' in page
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    semstab.compare(tmp_path / "run", out=tmp_path / "without")
    page = (tmp_path / "without" / "report.html").read_text()
    assert "Top contributing frames" in page
    assert "labels of a" not in page
