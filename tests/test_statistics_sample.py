"""Statistics rest on a sample of a large map's voxels; the parts of a map give the sample of the whole."""

from __future__ import annotations

import numpy as np
import pytest
from compare_summaries import differences
from simulated_events import grid, log_of, log_of_evidence, soft

from semstab import Events, VoxelTable
from semstab.core.json_form import to_json
from semstab.errors import DataError
from semstab.metrics import summarise
from semstab.statistics import MapSample, analyse, describe

SIDE, F, MOST = 40, 8, 400


@pytest.fixture(scope="module")
def log() -> Events:
    rng = np.random.default_rng(0)
    visible = rng.random((SIDE**2, F)) < 0.7
    visible[:, 0] = True
    return log_of_evidence(soft(rng, SIDE**2, F), visible, index=grid(SIDE))


@pytest.fixture(scope="module")
def truth() -> VoxelTable:
    return log_of(np.random.default_rng(1).integers(0, 3, (SIDE**2, 1)), index=grid(SIDE)).table()


def parts_of(log: Events, truth: VoxelTable) -> list[MapSample]:
    """Samples of four strips of the map."""
    table = log.table()
    strips = [np.flatnonzero(table.ix // 10 == strip) for strip in range(4)]
    return [MapSample.draw(table.rows(rows), log.rows(rows), truth, most=MOST) for rows in strips]


def test_the_sample_of_the_parts_is_the_sample_of_the_whole(log, truth, tmp_path) -> None:
    table = log.table()
    whole = MapSample.draw(table, log, truth, most=MOST)
    assert len(whole.table) == len(whole.truth) == len(whole.events.ix) == MOST
    parts = parts_of(log, truth)
    for k, part in enumerate(parts):
        part.save(tmp_path / f"{k}.npz")
    merged = MapSample.merged([MapSample.load(tmp_path / f"{k}.npz") for k in range(4)], most=MOST)
    np.testing.assert_array_equal(merged.table.index, whole.table.index)
    one, other = analyse(whole), analyse(merged)
    assert differences(to_json(one.summary), to_json(other.summary), tolerance=1e-12) == []
    for name, values in one.columns(table, truth).items():
        np.testing.assert_allclose(other.columns(table, truth)[name], values, rtol=1e-12, err_msg=name)


def test_means_are_of_all_voxels_and_columns_that_need_the_log_of_the_drawn_ones(log, truth) -> None:
    table = log.table()
    found = analyse(MapSample.draw(table, log, truth, most=MOST))
    assert found.table == summarise(table)
    assert found.summary.voxels == len(table)
    columns = found.columns(table, truth)
    assert np.count_nonzero(~np.isnan(columns["flip_rate"])) <= MOST
    assert not np.isnan(columns["psa"][table.op >= 2]).any()
    assert (columns["true_label"] >= 0).all()
    few = found.columns(table)
    assert np.count_nonzero(few["true_label"] >= 0) == MOST


def test_a_small_map_is_its_own_sample_and_a_damaged_file_is_refused(log, tmp_path) -> None:
    sample = MapSample.draw(log.table(), log)
    assert len(sample.table) == SIDE**2
    assert to_json(analyse(sample).summary) == to_json(describe(log.table(), log))
    (tmp_path / "part.npz").write_bytes(b"no arrays")
    with pytest.raises(DataError, match=r"part\.npz: it is missing, damaged or not a sample of a map"):
        MapSample.load(tmp_path / "part.npz")
