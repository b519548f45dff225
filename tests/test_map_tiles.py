"""A map fused tile by tile is the map fused at once, to the last bit."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import re
import shutil
from collections.abc import Generator
from unittest import mock

import numpy as np
import pytest
import tiny_scene
from compare_summaries import differences
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from posed_config import configure
from posed_writer import write_posed
from pyarrow import dataset, parquet
from scipy.spatial.transform import Rotation

import semstab
from semstab import Belief, Frame, Intrinsics, VoxelTable, backends, relabel
from semstab.comparison import voxels as common_voxels
from semstab.comparison.differences import differences_of
from semstab.comparison.opening import open_compared
from semstab.core.json_form import to_json
from semstab.data import voxels
from semstab.data.parquet import Tile
from semstab.data.voxels import Extent
from semstab.engine import InProcess, LocalProcesses, Observer
from semstab.engine.sizing import Sizing
from semstab.engine.tiles import tiles_met
from semstab.errors import ConfigError, DataError, OutgrownError
from semstab.exports import export, maps
from semstab.gating.calibration import calibrate_run
from semstab.statistics.cluster_sums import ClusterSums
from semstab.testing import EXACT, SUMS, random_frames, sight_line

K, SIZE = 4, 0.4


def fused(name: str, frames, within: Extent | None = None, **options) -> VoxelTable:
    backend = backends.create(name, voxel_size=SIZE, num_classes=K, within=within, **options)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def assert_same_bits(part: VoxelTable, whole: VoxelTable) -> None:
    for name in ("ix", "iy", "iz", *EXACT, *SUMS):
        assert np.asarray(getattr(part, name)).tobytes() == np.asarray(getattr(whole, name)).tobytes(), name


@pytest.mark.parametrize("name", ["numpy", "numba", "open3d", "torch"])
def test_the_maps_of_tiles_are_the_parts_of_the_whole_map(name) -> None:
    """Whichever frame opens a tile's map; labels and soft scores, to the last bit."""
    frames = random_frames(3, count=4, K=K)
    whole = fused(name, frames)
    tiles = [Extent((x, y), (x + 16, y + 16)) for x in range(-16, 16, 16) for y in range(-16, 16, 16)]
    found = 0
    for tile in tiles:
        part = fused(name, frames, tile)
        assert_same_bits(part, whole.rows(tile.holds(whole.index.T)))
        found += len(part)
    assert found == len(whole) > 500


@pytest.mark.parametrize("name", ["numba", "open3d"])
def test_soft_scores_are_rounded_as_in_the_whole_map(name) -> None:
    """Where many voxels share a table that gives way, sums hang on all of them; and keys on where the map begins."""
    rng, frames = np.random.default_rng(0), []
    for index, shift in enumerate((7.3, 0.0, 0.4)):
        T_wc = np.eye(4)
        T_wc[:3, 3] = shift, 0.1, 0.2
        depth = (5 * (0.3 + 0.7 * rng.random((96, 1)) * rng.random(128) ** 2)).astype(np.float32)
        scores = rng.random((96, 128, K), dtype=np.float32)
        frames.append(Frame(index, depth * (index > 0), Intrinsics(128, 128, 64, 48), T_wc, scores=scores))
    backend = backends.create(name, voxel_size=0.05, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    whole = backend.table()
    tile = Extent((-16, -16), (16, 16), (146, 2, 4))
    part = backends.create(name, voxel_size=0.05, num_classes=K, within=tile)
    for frame in frames[1:]:
        part.integrate(frame)
    assert len(part.table()) > 1000
    assert_same_bits(part.table(), whole.rows(tile.holds(whole.index.T)))


def test_a_backend_is_restricted_far_away_and_not_where_it_looks_pixels_up() -> None:
    """Beyond 2^15 voxels from the camera pixels become voxels by another loop."""
    far = [sight_line(t, [(0.5, 1), (20000.5, 2), (20001.5, 0)], along="x") for t in range(2)]
    whole, part = fused("numba", far), fused("numba", far, Extent((50000, 0), (50003, 4)))
    assert 0 < len(part) < len(whole)
    assert_same_bits(part, whole.rows(Extent((50000, 0), (50003, 4)).holds(whole.index.T)))
    with pytest.raises(ConfigError, match="open3d-projective' does not associate pixel by pixel"):
        fused("open3d-projective", [], Extent((0, 0), (1, 1)))
    with pytest.raises(ConfigError, match="'numba' has no option 'within'"):
        fused("numba", [], "all")


class Counting(InProcess):
    """In this process; remembers the tiles that were finished, and is interrupted after some."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.left, self.done, self.errors = stop_after, [], []

    def run(self, next_job, observers) -> Generator:
        for work in super().run(next_job, observers):
            self.done.append(None if work.tile is None else work.tile.name)
            self.errors += [work.error] if work.error is not None else []
            yield work
            self.left -= 1
            if not self.left:
                raise KeyboardInterrupt


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("scene") / "wall", models=("a",), frames=30)


@pytest.fixture(scope="module")
def soft_wall(tmp_path_factory):
    """The same with soft scores, of a camera that comes back."""
    rng = np.random.default_rng(2)
    frames = []
    for i in (*range(8), *range(8)):
        frame = tiny_scene.frame(i, np.zeros((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.uint8))
        scores = rng.random((*frame.shape, 3)).astype(np.float32) ** 4
        frames.append(dataclasses.replace(frame, index=len(frames), labels=None, scores=scores))
    root = tmp_path_factory.mktemp("soft") / "wall"
    return write_posed(root, [f"{i:02d}" for i in range(16)], {"a": frames}, classes=["x", "y", "z"], up_axis="-y")


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def series_of(folder):
    (series,) = (folder / "frames").iterdir()
    with series.open() as file:
        return [{key: row[key] for key in row if not key.endswith("_ms")} for row in csv.DictReader(file)]


SETTINGS = {"check": "sample", "backends": ["numba"], "check_geometry": False}


@pytest.fixture(scope="module")
def both(wall, tmp_path_factory):
    """Folders of a run at once, and of one in tiles."""
    return run_both(wall, tmp_path_factory.mktemp("runs"), **SETTINGS)


def run_both(root, folder, **options):
    executor = Counting()
    semstab.run(configure(root, **options), out=folder / "whole", report=False)
    semstab.run(configure(root, **options, tile_size=8), out=folder / "tiles", executor=executor, report=False)
    assert len(executor.done) > 4
    return folder / "whole", folder / "tiles"


def assert_same_run(whole, tiles) -> None:
    """Every column of every voxel to the last bit, every number of the summary to 1e-12, the series but for times."""
    assert len(list((tiles / "voxels").glob("*/tile=*.parquet"))) > 4
    assert not (tiles / "tiles").exists()
    found = differences(summary_of(whole), summary_of(tiles), tolerance=1e-12)
    assert [line for line in found if "_file" not in line.split(":")[0]] == []
    one, other = (semstab.load(folder).table() for folder in (tiles, whole))
    assert_same_bits(one, other)
    for row, expected in zip(series_of(tiles), series_of(whole), strict=True):
        assert {key: float(value or "nan") for key, value in row.items()} == pytest.approx(
            {key: float(value or "nan") for key, value in expected.items()}, rel=1e-12, abs=1e-12, nan_ok=True
        )


def test_a_run_in_tiles_says_what_a_whole_one_says(both) -> None:
    assert_same_run(*both)


@pytest.mark.parametrize(("scene", "backend"), [("soft_wall", "numba"), ("wall", "numpy")])
def test_so_it_does_with_soft_scores_and_other_backends(scene, backend, tmp_path, request) -> None:
    assert_same_run(*run_both(request.getfixturevalue(scene), tmp_path, **SETTINGS | {"backends": [backend]}))


@pytest.fixture(scope="module")
def judged(wall, tmp_path_factory):
    """The same of a run with all statistics and its log."""
    settings = SETTINGS | {"statistics": True, "events": True, "models": ["a"]}
    return run_both(wall, tmp_path_factory.mktemp("judged"), **settings)


def test_statistics_of_tiles_are_those_of_the_whole_map(judged) -> None:
    """With log and ground truth: flips, quadrants; each column of each voxel."""
    assert_same_run(*judged)
    whole, tiles = judged
    (statistics,) = (run["statistics"] for run in summary_of(tiles)["runs"])
    assert all(statistics[name] is not None for name in ("geometry", "correctness", "flipping"))
    assert statistics["drift"]["flips"]["rate"]["value"] > 0
    one, other = (semstab.load(folder) for folder in (tiles, whole))
    names = parquet.read_schema(other.result.records[0].voxels_file).names
    names = [name for name in names if name != "evidence"]
    columns, expected = (VoxelTable.columns(run.result.records[0].voxels_file, names) for run in (one, other))
    for name in names:
        np.testing.assert_allclose(columns[name], expected[name], rtol=1e-12, err_msg=name)
    assert_same_bits(*(VoxelTable.load(run.result.records[0].truth_file) for run in (one, other)))
    logs = one.events(), other.events()
    for name in ("ix", "iy", "iz", "voxel", "frame", "pixels", "evidence"):
        np.testing.assert_array_equal(*(np.asarray(getattr(log, name)) for log in logs))
    sums = [ClusterSums.load(run.result.records[0].sums_file) for run in (one, other)]
    ordered = [
        part.columns[np.lexsort((part.frame, *part.cell.T))]
        for part in (part.coarsened(part.edge, part.step) for part in sums)
    ]
    np.testing.assert_allclose(*ordered, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".ply", ".laz"])
def test_an_export_of_tiles_holds_the_same_voxels(suffix, both, tmp_path) -> None:
    """In another order."""
    if suffix == ".laz":
        pytest.importorskip("laspy")
    written = []
    for folder in both:
        (exported,) = export(folder, tmp_path / f"{folder.name}{suffix}", min_op=2)
        assert exported.content.startswith("210 voxels")
        written.append(exported.path)
    rows = [sorted(READ[suffix](path)) for path in written]
    assert rows[0] == rows[1]
    with pytest.raises(ConfigError, match="no voxel with OP >= 99; OP goes up to"):
        export(both[1], tmp_path / f"none{suffix}", min_op=99)
    assert len(list(tmp_path.iterdir())) == 2


def rows_of_ply(path):
    head, body = path.read_bytes().split(b"end_header\n")
    assert b"element vertex 210\n" in head
    return [body[start : start + len(body) // 210] for start in range(0, len(body), len(body) // 210)]


READ = {
    ".csv": lambda path: path.read_text().splitlines(),
    ".parquet": lambda path: [str(row) for row in parquet.read_table(path).to_pylist()],
    ".ply": rows_of_ply,
    ".laz": lambda path: [str(point) for point in laspy_points(path)],
}


def laspy_points(path):
    import laspy

    cloud = laspy.read(path)
    names = [name for name in cloud.point_format.dimension_names if name not in ("X", "Y", "Z")]
    return zip(*(cloud[name] for name in ("x", "y", "z", *names)), strict=True)


def test_rasters_and_meshes_of_tiles_are_those_of_the_whole_map(both, tmp_path, monkeypatch) -> None:
    """Each pixel of each band; each triangle with its colour: no side is seen between two tiles."""
    rasterio, trimesh = pytest.importorskip("rasterio"), pytest.importorskip("trimesh")
    rasters, meshes = [], []
    for folder, window in zip(both, (1024, 4), strict=True):
        monkeypatch.setattr(maps, "WINDOW", window)
        files = [tmp_path / f"{folder.name}{suffix}" for suffix in (".tif", ".glb")]
        export(folder, files, min_op=2)
        for file in (files[0], files[0].with_suffix(".class.tif")):
            with rasterio.open(file) as bands:
                rasters.append((bands.read(), bands.transform, bands.descriptions, bands.tags(1)))
        scene = trimesh.load(files[1])
        found = []
        for mesh in scene.geometry.values():
            corners = mesh.triangles.round(5).reshape(len(mesh.faces), -1)
            found += [
                (*row, *mesh.visual.vertex_colors[face[0]]) for row, face in zip(corners, mesh.faces, strict=True)
            ]
        meshes.append(sorted(map(tuple, np.array(found).tolist())))
    for one, other in zip(rasters[:2], rasters[2:], strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:] == other[1:]
    assert len(meshes[0]) > 400
    assert meshes[0] == meshes[1]


def test_a_cloud_takes_from_tiles_what_it_takes_from_the_whole_map(both, tmp_path) -> None:
    """Points in voxels, and beside them, also across the edge of a tile."""
    rng, table = np.random.default_rng(0), VoxelTable.load(both[1] / "voxels" / "wall__a__numba")
    points = table.centers[rng.integers(len(table), size=2000)] + rng.uniform(-0.4, 0.4, (2000, 3))
    cloud = tmp_path / "cloud.ply"
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2000\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    cloud.write_bytes(header.encode() + points.astype("<f8").tobytes())
    written = []
    for folder in both:
        out = tmp_path / f"{folder.name}.ply"
        (exported,) = export(folder, out, classify=cloud, radius=0.3)
        written.append((out.read_bytes(), exported.content))
    assert written[0] == written[1]
    assert "100.0%" not in written[0][1]


@pytest.mark.parametrize("leave_one_out", [False, True])
def test_labels_from_tiles_are_those_from_the_whole_map(leave_one_out, both, tmp_path) -> None:
    found = []
    for folder in both:
        report = relabel(folder, tmp_path / folder.name, belief=Belief(min_op=2, leave_one_out=leave_one_out))
        files = sorted((tmp_path / folder.name / "labels" / "a-fused").glob("*.png"))
        found.append(([file.read_bytes() for file in files], dataclasses.replace(report, folder="")))
    assert found[0] == found[1]
    assert len(found[0][0]) == 30


def test_backends_are_held_against_each_other_tile_by_tile(wall, tmp_path) -> None:
    whole, tiles = run_both(wall, tmp_path, backends=["numba"], check="numpy")
    one, other = (summary_of(folder)["agreement"] for folder in (whole, tiles))
    assert len(one) == 1
    assert differences(one, other, tolerance=1e-12) == []
    assert all(row["agrees"] for row in other)


def test_models_are_compared_tile_by_tile(tmp_path) -> None:
    """With ground truth."""
    root, found = tiny_scene.write(tmp_path / "wall", frames=8), []
    for size in (None, 8):
        settings = {"check": None, "backends": ["numba"], "statistics": True, "events": True, "tile_size": size}
        semstab.run(configure(root, **settings), out=tmp_path / str(size), report=False)
        found.append(to_json(semstab.compare(tmp_path / str(size)).overall))
    assert differences(*found, tolerance=1e-12) == []
    assert_same_comparison(*(tmp_path / size for size in ("None", "8")))


def test_evidence_is_calibrated_on_tiles_as_on_the_whole_map(judged, monkeypatch) -> None:
    """Also on the sample that stands for a large map."""
    for most in (common_voxels.MOST, 100):
        monkeypatch.setattr(common_voxels, "MOST", most)
        one, other = (calibrate_run(folder, precision=0.6) for folder in judged)
        assert one == other
        assert ("1 in 4 of the locations" in one.calibrated_on) == (most == 100)


def assert_same_comparison(whole, tiles) -> None:
    """Of two label sources of a run: numbers, places that got worse, and what changed in each voxel."""
    said, columns = [], []
    for run in (whole, tiles):
        found = differences_of(open_compared([f"{run}:a", f"{run}:b"]))
        said.append(json.loads(json.dumps(to_json(found.result))))
        parts = list(found.changes["wall", "b"].parts())
        together = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        columns.append(sorted(zip(*together.values(), strict=True)))
    (scene,) = said[0]["scenes"]
    assert scene["against"][0]["areas"]
    assert [line for line in differences(*said, tolerance=1e-9) if "source" not in line] == []
    assert columns[0] == columns[1]


def test_tiles_that_were_finished_before_an_interruption_are_taken_over(wall, both, tmp_path) -> None:
    """A damaged one is computed again; and once the unit is whole, it is kept as any other."""
    config, out = configure(wall, **SETTINGS, tile_size=8), tmp_path / "run"
    first, second = Counting(stop_after=3), Counting()
    with pytest.raises(KeyboardInterrupt):
        semstab.run(config, out=out, executor=first, report=False)
    (damaged,) = out.glob(f"tiles/*/{first.done[1]}.npz")
    damaged.write_bytes(damaged.read_bytes()[:-20])
    semstab.run(config, out=out, executor=second, report=False)
    assert set(first.done) & set(second.done) == {first.done[1]}
    assert_same_run(both[0], out)
    assert semstab.run(config, out=out, report=False).manifest["units"]["kept"] == 1


def test_a_run_in_tiles_by_several_processes_leaves_what_one_process_leaves(wall, both, tmp_path) -> None:
    config = configure(wall, **SETTINGS, tile_size=8)
    semstab.run(config, out=tmp_path / "tiles", executor=LocalProcesses(2), report=False)
    assert differences(summary_of(both[1]), summary_of(tmp_path / "tiles"), tolerance=0) == []
    assert_same_run(both[0], tmp_path / "tiles")


class Progress(Observer):
    """The frames that went into maps."""

    frames = 0

    def advanced(self, frames, what) -> None:
        self.frames += frames


def test_a_map_that_will_not_fit_is_fused_in_tiles_and_a_line_says_so(wall, both, tmp_path, caplog) -> None:
    progress, executor = Progress(), Counting()
    config = configure(wall, **SETTINGS, memory_gb=30e-6)
    with mock.patch("semstab.engine.memory_budget.resident_bytes", return_value=0):  # the estimates of maps count alone
        semstab.run(config, out=tmp_path / "tiles", observers=[progress], executor=executor, report=False)
    assert len(executor.done) > 2
    assert re.search(
        r"wall, a: about .* million voxels of 0.25 m would take .* GB, 3e-05 GB are free: it is fused in tiles",
        caplog.text,
    )
    assert progress.frames == 30
    assert_same_bits(semstab.load(tmp_path / "tiles").table(), semstab.load(both[0]).table())


@pytest.mark.parametrize(
    ("settings", "line"),
    [({"tile_size": "off"}, r"use tiles \(--tile-size 256\)"), ({"tile_size": 8}, "use a smaller --tile-size than 8")],
)
def test_a_map_that_outgrows_the_memory_is_given_up_in_one_line(settings, line, wall, tmp_path) -> None:
    config = configure(wall, **SETTINGS, memory_gb=3e-6, **settings)
    with (
        mock.patch("semstab.engine.memory_budget.resident_bytes", return_value=0),
        mock.patch("semstab.engine.execution.planned_sizes", forced_sizes),
        pytest.raises(OutgrownError, match=rf"after \d+ of \d+ frames the map has .* is left of memory_gb; {line}"),
    ):
        semstab.run(config, out=tmp_path / "run", report=False)


def forced_sizes(config, missing, width) -> Sizing:
    """As if every map were expected to fit."""
    sizes = {unit.identity: config.tile_size for unit in missing} if isinstance(config.tile_size, int) else {}
    return Sizing(tile_sizes=sizes)


def test_parts_of_other_tiles_are_not_taken_for_those_of_these(wall, both, tmp_path) -> None:
    """A part is named by its corners in tiles, which are others where tiles are larger."""
    for size, executor in ((8, Counting(stop_after=4)), (16, Counting())):
        config = configure(wall, **SETTINGS, tile_size=size)
        with contextlib.suppress(KeyboardInterrupt):
            semstab.run(config, out=tmp_path / "tiles", executor=executor, report=False)
    assert_same_bits(semstab.load(tmp_path / "tiles").table(), semstab.load(both[0]).table())


def test_a_unit_in_tiles_takes_the_place_of_a_whole_one_and_back(wall, tmp_path) -> None:
    """No file of the other form stays."""
    voxels = tmp_path / "run" / "voxels"
    for size, there in ((None, "wall__a__numba.parquet"), (8, "wall__a__numba"), (None, "wall__a__numba.parquet")):
        (tmp_path / "run" / "units").mkdir(parents=True, exist_ok=True)
        for unit in (tmp_path / "run" / "units").iterdir():
            unit.unlink()
        semstab.run(configure(wall, backends=["numba"], check=None, tile_size=size), out=tmp_path / "run", report=False)
        assert [path.name for path in voxels.iterdir()] == [there]


def test_tiles_of_two_maps_are_no_table(both, tmp_path, monkeypatch) -> None:
    tiles = tmp_path / "tiles"
    shutil.copytree(both[1] / "voxels" / "wall__a__numba", tiles)
    table = VoxelTable.load(tiles)
    assert sum(map(len, VoxelTable.iter_tiles(tiles))) == len(table) == 222
    np.testing.assert_array_equal(VoxelTable.columns(tiles, ["vss", "ix"])["vss"], semstab.metrics.vss(table))
    for free, fits in ((222 * voxels.BYTES_A_VOXEL, True), (222 * voxels.BYTES_A_VOXEL - 1, False)):
        monkeypatch.setattr(voxels, "available_bytes", lambda free=free: free)
        with (
            contextlib.nullcontext()
            if fits
            else pytest.raises(DataError, match=r"0.000222 million voxels in \d+ tiles")
        ):
            VoxelTable.load(tiles)
    some = next(VoxelTable.iter_tiles(tiles))
    some.save(tiles / "tile=9_9.parquet", tile=Tile(9, 9, 8, "another"))
    with pytest.raises(DataError, match=r"tile=9_9.* is a tile of another map than .*; remove it"):
        VoxelTable.load(tiles)
    (tiles / "tile=9_9.parquet").unlink()
    first = next(tiles.iterdir())
    first.rename(tiles / "tile=9_9.parquet")
    with pytest.raises(DataError, match=r"tile=9_9.*: holds tile .*; it was renamed"):
        VoxelTable.load(tiles)
    with pytest.raises(DataError, match="a folder without tiles"):
        VoxelTable.load(tmp_path)


@pytest.mark.parametrize(("settings", "message"), [
    ({"tile_size": 12}, r"tile_size: use a power of 2 from 8, or off"),
    ({"tile_size": 8, "backends": ["open3d-projective"]}, r"tile_size = 8: backend 'open3d-projective' cannot"),
])  # fmt: skip
def test_what_cannot_be_tiled_is_refused_in_one_line(settings, message, wall) -> None:
    with pytest.raises(ConfigError, match=message):
        semstab.run(configure(wall, **{"backends": ["numba"], "check": None, **settings}), report=False)


@hypothesis_settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([8, 32, 128]), st.floats(0.1, 0.7))
def test_no_pixel_falls_into_a_tile_that_its_frustum_does_not_meet(seed, size, voxel_size) -> None:
    """Of cameras that look anywhere, at depth in any range."""
    rng = np.random.default_rng(seed)
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = Rotation.random(rng=seed).as_matrix(), rng.normal(0, 30, 3)
    low, high = np.sort(rng.uniform(0.1, 60, 2))
    depth = rng.uniform(low, high, (12, 16)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    frame = Frame(3, depth, Intrinsics(14, 15, 7.2, 6.1), T_wc, labels=np.zeros(depth.shape, np.uint8))
    met = set(map(tuple, tiles_met(frame, voxel_size, size).tolist()))
    backend = backends.create("numpy", voxel_size=voxel_size, num_classes=2)
    backend.integrate(frame)
    assert {tuple(tile) for tile in (backend.table().index[:, :2] // size).tolist()} <= met


def test_a_frustum_meets_few_tiles_and_too_many_are_told_with_the_file() -> None:
    """Straight down from 60 voxels above, onto ground 40 by 30 voxels wide; not the box around an oblique view."""
    down = np.array([[1.0, 0, 0, 4], [0, -1, 0, 4], [0, 0, -1, 60], [0, 0, 0, 1]])
    depth, labels = np.full((30, 40), 60.0, np.float32), np.zeros((30, 40), np.uint8)
    frame = Frame(0, depth, Intrinsics(60, 60, 20, 15), down, labels=labels)
    assert len(tiles_met(frame, 1.0, 8)) <= 7 * 6
    turned = down.copy()
    turned[:3, :3] = Rotation.from_euler("zx", [45, 60], degrees=True).as_matrix() @ down[:3, :3]
    far = dataclasses.replace(frame, T_wc=turned, depth=depth + np.linspace(0, 400, 30, dtype=np.float32)[:, None])
    met = tiles_met(far, 1.0, 8)
    assert len(met) < 0.6 * np.prod(np.ptp(met, axis=0) + 1)
    depth = np.full((4, 4), 1e6, np.float32)
    frame = Frame(0, depth, Intrinsics(2, 2, 2, 2), np.eye(4), labels=np.zeros((4, 4), np.uint8))
    with pytest.raises(DataError, match=r"frame 0, depth: up to 1e\+06 m deep, it sees .* tiles of 0.8 m"):
        tiles_met(frame, 0.1, 8)


def test_other_programs_read_the_tiles_as_one_table(both) -> None:
    """The queries of docs/large-scenes.md."""
    folder = both[1] / "voxels" / "wall__a__numba"
    table = VoxelTable.load(folder)
    expected = {
        k: float(semstab.metrics.vss(table)[(table.op >= 3) & (semstab.metrics.dominant(table) == k)].mean())
        for k in range(3)
    }
    read = dataset.dataset(folder).to_table(columns=["label", "vss", "op"])
    assert read.num_rows == len(table)
    query = f"SELECT label, avg(vss) FROM '{folder}/*.parquet' WHERE op >= 3 GROUP BY label"
    duckdb = pytest.importorskip("duckdb")
    assert dict(duckdb.sql(query).fetchall()) == pytest.approx(expected)
    pl = pytest.importorskip("polars")
    found = pl.scan_parquet(f"{folder}/*.parquet").filter(pl.col("op") >= 3).group_by("label").agg(pl.col("vss").mean())
    assert dict(found.collect().iter_rows()) == pytest.approx(expected)
