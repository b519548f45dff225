"""What a run of somebody's own data says: all of it counted, advised from the data, nothing passed over in silence."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import tiny_scene
from posed_config import configure, dataset_of
from posed_writer import write_posed
from rich.console import Console
from simulated_events import log_of

import semstab
from semstab import Frame, Intrinsics
from semstab.backends.numba_hash import NumbaHash
from semstab.check import check
from semstab.config import read_yaml
from semstab.configure import load_config, predicted_config, resolve
from semstab.errors import DataError
from semstab.metrics import split_last, summarise
from semstab.predict.predictor import parse_predictor
from semstab.report.narrative import notes
from semstab.report.tables import tables
from semstab.report.terminal import print_summary


def printed(result, **options) -> str:
    """What the terminal says of it, with single spaces."""
    text = io.StringIO()
    print_summary(result, Console(file=text, width=80), **options)
    return " ".join(text.getvalue().split())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("data") / "scene")


def test_frames_in_which_nothing_is_seen_are_counted(tmp_path) -> None:
    folder = tiny_scene.write(tmp_path / "scene", models=("a",))
    (folder / "depth/0001.png").unlink()
    np.save(folder / "depth/0001.npy", np.full((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.nan, np.float32))
    result = semstab.run(configure(folder, check_geometry=True))
    assert result.select()[0].frames_empty == 1
    assert "a: 1 of 3 frames have no pixel with both depth and a label" in printed(result)


def test_own_data_is_checked_on_a_sample_of_the_voxels(tmp_path) -> None:
    folder = tiny_scene.write(tmp_path / "scene", frames=12)
    config = configure(folder, backends=["numba"], check="sample", voxel_size=0.05, check_geometry=True)
    result = semstab.run(config, out=tmp_path / "run", report=False)
    assert [record.unit.backend for record in result.records] == ["numba", "numba"]
    for row in result.agreement:
        assert row.agrees
        assert (row.backends, row.one_in) == (("numba", "numpy"), 16)
        assert 0 < row.voxels[0] == row.voxels[1] < result.select()[0].map_summary.voxels / 4
    assert "fusion by numba equals numpy in" in printed(result)
    longest = {"seconds": {"reference": 3.6, "statistics": 5.1, "keep": 0.4, "all": 9.0}}
    timed = dataclasses.replace(result, manifest=result.manifest | longest)
    assert "9 s (longest: statistics 5 s, check of the fusion 4 s)" in printed(timed, seconds=9.2)
    elsewhere = {"units": {"executor": "2 local processes"}}
    timed = dataclasses.replace(timed, manifest=timed.manifest | elsewhere)
    assert "9 s (longest, sums of all workers: statistics 5 s, check of the fusion 4 s)" in printed(timed, seconds=9.2)
    assert semstab.run(config, out=tmp_path / "run", report=False).manifest["units"]["kept"] == 2


def test_the_sample_finds_a_backend_that_is_wrong(tmp_path, monkeypatch) -> None:
    """One that takes one class for another in every tenth voxel."""
    right = NumbaHash.table

    def wrong(self):
        table = right(self)
        evidence = np.where(table.ix[:, None] % 10 == 0, np.roll(table.evidence, 1, axis=1), table.evidence)
        return dataclasses.replace(table, evidence=evidence)

    monkeypatch.setattr(NumbaHash, "table", wrong)
    folder = tiny_scene.write(tmp_path / "scene", models=("a",), frames=40)
    result = semstab.run(configure(folder, backends=["numba"], check="sample", voxel_size=0.05, check_geometry=True))
    assert not result.agrees
    assert "DISAGREE" in printed(result)


def test_compared_backends_have_a_line(scene, tmp_path) -> None:
    config = configure(scene, backends=["numba", "open3d-projective"], check=None, models=["a"], voxel_size=0.25)
    result = semstab.run(config, out=tmp_path / "run", report=False)
    (row,) = result.compared
    assert row.backends == ("numba", "open3d-projective")
    assert result.agreement == ()
    assert result.agrees
    assert semstab.load_result(tmp_path / "run").compared == result.compared
    told = printed(result)
    assert "open3d-projective differs from numba by design" in told
    assert {table.name for table in tables(result)} >= {"fusion", "fusion_compared"}
    assert "agreement" not in {table.name for table in tables(result)}
    assert any(
        sentence.startswith("open3d-projective associates pixels and voxels in another way")
        for sentence in notes(result)
    )


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """Frames of 64x48 pixels that overlap, of a wall with relief; nearly all of it is background."""
    rng, frames = np.random.default_rng(0), {"net": []}
    relief = rng.uniform(1.9, 2.1, (48, 64 + 20)).round(3).astype(np.float32)
    for k in range(8):
        T = np.eye(4)
        T[:3, 3] = [2 / 60 * k, 0.013, 0.017]
        labels = np.zeros((48, 64), np.uint8)
        labels[:8] = rng.integers(0, 3, (8, 64))
        camera = Intrinsics(60, 60, 31.5, 23.5)
        frames["net"].append(Frame(k, relief[:, k : k + 64], camera, T, labels=labels))
    folder = tmp_path_factory.mktemp("data") / "wide"
    return write_posed(folder, [f"{k}" for k in range(8)], frames, classes=["background", "door", "window"])


def test_without_a_voxel_size_own_data_gets_what_check_suggests(wide, tmp_path) -> None:
    config = resolve(load_config({"dataset": dataset_of(wide), "check": None}))
    (checked,) = check(config)
    result = semstab.run(config, out=tmp_path / "run", report=False)
    size = result.advice["wide"].voxel_size
    assert size == checked.suggestion.voxel_size == result.select()[0].map_summary.voxel_size
    assert read_yaml(tmp_path / "run" / "config.yaml")["voxel_size"] == size
    assert checked.persistence[1].voxel_size == size


def test_a_model_on_the_built_in_city_has_the_voxels_of_the_citys_own_models() -> None:
    city = {"name": "city", "options": {"width": 64, "height": 48, "frames": 8}}
    given = {"dataset": city, "check": None, "scenes": ["scene0"]}
    of_city = resolve(load_config(given))
    predicted = resolve(predicted_config([parse_predictor("colour-clusters")], None, given))
    assert semstab.run(predicted, report=False).select()[0].map_summary.voxel_size == of_city.voxel_size


def test_a_given_voxel_size_is_told_where_it_lies(wide) -> None:
    result = semstab.run(configure(wide, backends=["numba"], check=None, voxel_size=1.0, check_geometry=True))
    assert not result.advice["wide"].chosen
    assert "noise of depth" not in printed(result)
    advice = dataclasses.replace(result.advice["wide"], voxel_size=0.5 * result.advice["wide"].suggested)
    assert "noise of depth and poses" in printed(dataclasses.replace(result, advice={"wide": advice}))
    assert "'background' covers" in printed(result)


def test_a_crowded_last_stratum_is_split_by_its_op() -> None:
    rng = np.random.default_rng(0)

    def summary(op):
        labels = rng.integers(0, 3, (len(op), max(op)))
        return summarise(log_of(np.where(np.arange(max(op)) < op[:, None], labels, -1)).table())

    table = summary(np.concatenate([np.ones(10, int), rng.integers(6, 120, 990)]))
    parts = split_last([table])
    assert [row.name for row in table.strata] == ["OP=1", "OP=2", "3<=OP<=5", "OP>5"]
    assert 2 <= len(parts) <= 3
    assert sum(part.voxels for part in parts) == table.strata[-1].voxels
    assert parts[0].name.startswith("6<=OP<=")
    assert all(part.voxels > 150 for part in parts)
    assert [part.voxels for part in split_last([table, table])] == [2 * part.voxels for part in parts]
    assert split_last([summary(np.repeat([1, 2, 7], [50, 30, 20]))]) == []


@pytest.mark.parametrize("name", ["numpy", "numba", "open3d", "open3d-projective", "torch"])
def test_depth_that_cannot_be_metres_is_refused(name) -> None:
    def fuse(depth):
        camera, labels = Intrinsics(60, 60, 32, 32), np.zeros(depth.shape, np.uint8)
        fused = semstab.backends.create(name, voxel_size=0.5, num_classes=2)
        fused.integrate(Frame(3, depth, camera, np.eye(4), labels=labels))
        return fused.table()

    with pytest.raises(DataError, match="frame 3, depth: depth is finite nowhere"):
        fuse(np.full((64, 64), np.nan))
    with pytest.raises(DataError, match="frame 3, depth: depth looks like millimetres, whole numbers up to 4595"):
        fuse(np.arange(500.0, 4596.0).reshape(64, 64))
    assert len(fuse(np.full((64, 64), 400.0)))  # one whole number of metres is a depth
