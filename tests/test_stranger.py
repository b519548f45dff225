"""What a run of somebody's own data says: all of it counted, advised from the data, nothing passed over in silence."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import tiny_scene
from posed_config import configure
from rich.console import Console

import semstab
from semstab.backends.numba_hash import NumbaHash
from semstab.backends.numpy_reference import NumpyReference, NumpySample, in_sample
from semstab.metrics.matching import rows_of
from semstab.outputs.terminal import print_summary
from semstab.testing.builders import assert_same_map, random_frames


def printed(result) -> str:
    """What the terminal says of it, with single spaces."""
    text = io.StringIO()
    print_summary(result, Console(file=text, width=80))
    return " ".join(text.getvalue().split())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("data") / "scene")


def test_frames_in_which_nothing_is_seen_are_counted(tmp_path) -> None:
    folder = tiny_scene.write(tmp_path / "scene", backbones=("a",))
    (folder / "depth/0001.png").unlink()
    np.save(folder / "depth/0001.npy", np.full((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.nan, np.float32))
    result = semstab.run(configure(folder))
    assert result.select()[0].summary.frames_empty == 1
    assert "scene, a: 1 of 3 frames hold no pixel with both depth and a label" in printed(result)


# --- The check against the reference ----------------------------------------------------------------------------------


def test_own_data_is_checked_on_a_sample_of_the_voxels(tmp_path) -> None:
    folder = tiny_scene.write(tmp_path / "scene", frames=12)
    config = configure(folder, backends=["numba"], check="sample", voxel_size=0.05)
    result = semstab.run(config, out=tmp_path / "run", report=False)
    assert [record.unit.backend for record in result.records] == ["numba", "numba"]
    for row in result.agreement:
        assert row.agrees
        assert (row.backends, row.one_in) == (("numba", "numpy"), 16)
        assert 0 < row.voxels[0] == row.voxels[1] < result.select()[0].summary.table.voxels / 4
    assert "numba against the numpy reference on" in printed(result)
    assert semstab.run(config, out=tmp_path / "run", report=False).manifest["units"]["kept"] == 2


def test_the_sample_finds_a_backend_that_is_wrong(tmp_path, monkeypatch) -> None:
    """One that counts a pixel too much in every tenth voxel."""
    right = NumbaHash.table

    def wrong(self):
        table = right(self)
        return dataclasses.replace(table, evidence=table.evidence + (table.ix[:, None] % 10 == 0) * [1.0, 0, 0])

    monkeypatch.setattr(NumbaHash, "table", wrong)
    folder = tiny_scene.write(tmp_path / "scene", backbones=("a",), frames=40)
    result = semstab.run(configure(folder, backends=["numba"], check="sample", voxel_size=0.05))
    assert not result.agrees
    assert "DISAGREE" in printed(result)


def test_the_sample_is_part_of_the_reference() -> None:
    frames, K = random_frames(1), 4
    whole, sample = NumpyReference(0.2, K), NumpySample(0.2, K)
    for frame in frames:
        whole.integrate(frame)
        sample.integrate(frame)
    drawn = rows_of(whole.table(), in_sample(whole.table().index.T.astype(np.int64)))
    assert 0 < len(drawn) < len(whole.table()) / 4
    assert_same_map(sample.table(), drawn, 0)
