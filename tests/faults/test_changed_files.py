"""Files of a finished run that changed on the disk: each is reported before it is read, by all that reads it."""

from __future__ import annotations

import random
import shutil

import pytest
import tiny_scene
from command_line import bench, error_of
from posed_config import configure

import semstab
from semstab import Events, VoxelTable
from semstab.core.files import write_sealed
from semstab.data.digests import DIGESTS, require_unchanged
from semstab.engine import load_result
from semstab.errors import DataError
from semstab.report.figures.maps import Overview
from semstab.report.saved_run import read_series
from semstab.statistics import SpotObservations
from semstab.statistics.cluster_sums import ClusterSums

LOADERS = {
    "voxels": VoxelTable.load, "truth": VoxelTable.load, "events": Events.load, "observations": SpotObservations.load,
    "sums": ClusterSums.load, "frames": read_series, "overview": Overview.load,
}  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    root = tiny_scene.write(folder / "wall", models=("a",), frames=8)
    settings = {"models": ["a"], "backends": ["numpy"], "check": None, "events": True, "statistics": True}
    semstab.run(configure(root, **settings), out=folder / "run", report=False)
    return folder / "run"


@pytest.fixture
def run(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "run")


@pytest.mark.parametrize("kind", LOADERS)
def test_any_flipped_bit_of_a_table_is_found_when_it_is_read(run, kind) -> None:
    (file,) = (run / kind).iterdir()
    LOADERS[kind](file)
    whole, rng = file.read_bytes(), random.Random(kind)
    for _ in range(60):
        damaged, bit = bytearray(whole), rng.randrange(8 * len(whole))
        damaged[bit // 8] ^= 1 << bit % 8
        file.write_bytes(damaged)
        with pytest.raises(DataError, match=f"^{file}: has changed since the run wrote it; run the same command again"):
            LOADERS[kind](file)
    file.write_bytes(whole)
    LOADERS[kind](file)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("sums", ["compare", "run", "other"]), ("observations", ["compare", "run", "other"]),
        ("frames", ["compare", "run", "other"]), ("sums", ["gate", "run", "--save-baseline", "base.summary"]),
        ("sums", ["gate", "run", "--against", "other", "--rule", "alpha drop < 1"]),
        ("voxels", ["export", "run", "--to", "m.csv"]), ("voxels", ["show", "run", "--figures", "png"]),
        ("truth", ["calibrate", "run", "--out", "thresholds.yaml"]),
    ],
)  # fmt: skip
def test_commands_name_the_changed_file_and_end_with_2(run, tmp_path, kind, words) -> None:
    shutil.copytree(run, tmp_path / "other")
    (file,) = (run / kind).iterdir()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    said = error_of(*words, cwd=tmp_path)
    assert f"run/{kind}/{file.name}: has changed since the run wrote it; run the same command again" in said


def test_tiles_have_digests_too_and_a_start_that_was_killed_has_none(tmp_path) -> None:
    root, out = tiny_scene.write(tmp_path / "wall", models=("a",), frames=8), tmp_path / "out"
    words = ["--data", root, "--backend", "numpy", "--voxel-size", "0.1", "--tile-size", "8", "--out", out]
    bench(*words, cwd=tmp_path)
    tile = sorted((out / "voxels/wall__a__numpy").iterdir())[0]
    content = bytearray(tile.read_bytes())
    content[20] ^= 1
    tile.write_bytes(content)
    with pytest.raises(DataError, match="run the same command again"):
        load_result(out).record().table()
    bench(*words, cwd=tmp_path)
    load_result(out).record().table()
    (out / DIGESTS).unlink()
    tile.write_bytes(content)
    require_unchanged(tile)


def test_digests_that_are_damaged_are_reported(run) -> None:
    write_sealed(run / DIGESTS, {"schema": 0})
    with pytest.raises(DataError, match=r"digests\.json: holds no digests of this version; run the same command again"):
        require_unchanged(run / "sums/wall__a__numpy.parquet")
