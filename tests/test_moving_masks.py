"""Masks of what moves, which a dataset leaves out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import semstab
from semstab.convert import convert
from semstab.data.measures import SBD, VSS
from semstab.errors import ConfigError
from semstab.recording import Recording
from semstab.recording.voxel_maps import packed
from semstab.statistics.moving import MOVED, STATE_COLORS, STAYED, states_of

CITY = {
    "dataset": {"name": "city", "options": {"width": 160, "height": 90, "frames": 40}}, "scenes": ["scene0"],
    "models": ["gt"], "check": None, "check_geometry": False, "voxel_size": 1.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("moving")
    semstab.run(CITY, out=folder / "run", observers=[Recording(folder / "run" / "recording.rrd")])
    return folder / "run"


def test_masks_have_the_moving_things_and_little_else(run) -> None:  # type: ignore[no-untyped-def]
    (written,) = semstab.export(run, run.parent / "moving")
    files = sorted(written.path.glob("*.png"))
    assert len(files) == 40
    assert "40 masks" in written.content
    config = semstab.load_config(CITY)
    scene = semstab.task.open_scenes(config)["scene0"]
    names = scene.label_space("gt").classes
    moving = [scene.label_space("gt").ids[names.index(name)] for name in ("moving car", "human")]
    masked = right = cars = found = 0
    for file in files[5:-5]:  # the first and the last frames share their places with few others
        truth = np.isin(scene.frame(int(file.stem), "gt").labels, moving)
        mask = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == 0
        beside = cv2.dilate(truth.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        masked, right = masked + mask.sum(), right + (mask & beside).sum()
        cars, found = cars + truth.sum(), found + (mask & truth).sum()
    assert right > 0.9 * masked
    assert found > 0.5 * cars


def test_the_run_tells_what_moved_and_its_series_has_it(run) -> None:  # type: ignore[no-untyped-def]
    (record,) = semstab.load_result(run).select()
    moved = record.statistics.moved
    assert moved.are_found
    assert {row.name for row in moved.classes[:2]} == {"moving car", "human"}
    assert all(row.moved < 0.02 for row in moved.classes[2:])
    assert not moved.misplaced
    header, *rows = (run / "frames").glob("*.csv").__next__().read_text().splitlines()
    at = header.split(",").index("moving_percent")
    assert max(float(row.split(",")[at]) for row in rows) > 0.5


def test_kept_movers_are_told_nowhere(tmp_path) -> None:  # type: ignore[no-untyped-def]
    result = semstab.run(CITY | {"moving": "keep", "frames": {"stop": 10}}, out=tmp_path / "run", report=False)
    (record,) = result.select()
    assert record.statistics.moved is None
    assert record.statistics.static is None


def test_of_depth_cast_at_a_mesh_no_masks_are_written(tmp_path) -> None:  # type: ignore[no-untyped-def]
    from pathlib import Path
    from unittest import mock

    from semstab.exports.moving import write_masks

    task = mock.Mock()
    task.scene.of_scans, task.scene.name, task.scene.surface = False, "field", Path("odm_mesh.ply")
    with pytest.raises(ConfigError, match=r"depth is cast at odm_mesh\.ply"):
        write_masks(task, tmp_path / "moving")
    assert not (tmp_path / "moving").exists()


def test_exported_masks_take_the_movers_out_of_the_map(run, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """The folder that a run reads gets the masks that were exported of it: VSS and SBD are without movers then."""
    (converted,) = convert(semstab.load_config(CITY), tmp_path / "data")
    config = CITY | {"dataset": {"name": "posed_folder", "options": {"root": str(converted.folder)}}, "scenes": None}
    (before,) = semstab.run(config, out=tmp_path / "before", report=False).select()
    semstab.export(tmp_path / "before", tmp_path / "moving")
    (tmp_path / "moving").rename(converted.folder / "mask")
    config |= {"statistics": False}
    (after,) = semstab.run(config, out=tmp_path / "after", report=False).select()
    (unmasked,) = semstab.run(config | {"exclude": {"masks": False}}, out=tmp_path / "kept", report=False).select()

    def cars(record) -> int:  # type: ignore[no-untyped-def]
        table = record.table()
        return int(np.isin(semstab.metrics.dominant(table), [table.classes.index("moving car")]).sum())

    means = [record.map_summary.recurrent for record in (before, after)]
    assert means[1][VSS] > means[0][VSS]
    assert means[1][SBD] < means[0][SBD]
    assert cars(after) < 0.5 * cars(before)
    np.testing.assert_array_equal(unmasked.table().index, before.table().index)
    assert unmasked.map_summary.recurrent[VSS] == before.map_summary.recurrent[VSS]


def test_the_map_and_the_recording_have_a_layer_of_what_moved(run) -> None:  # type: ignore[no-untyped-def]
    from test_recording import read, read_blueprints

    (record,) = semstab.load_result(run).select()
    table = record.table()
    states = states_of(record, table.centers)
    cars = semstab.metrics.dominant(table) == table.classes.index("moving car")
    assert (states[cars] == MOVED).mean() > 10 * (states[~cars] == MOVED).mean()
    assert (states == STAYED).mean() > 0.3
    rows = read(run / "recording.rrd")
    drawn = [row["moved:colors"] for at in rows if "/map/" in at for row in rows[at] if row.get("moved:colors")]
    counts = np.unique(np.concatenate(drawn), return_counts=True)
    expected = packed(STATE_COLORS)[states]
    np.testing.assert_array_equal(counts, np.unique(expected, return_counts=True))
    views = [row for rows in read_blueprints(run / "recording.rrd") for row in rows]
    assert ["gt: orange moved, blue stayed"] in [row.get("ViewBlueprint:display_name") for row in views]
    assert 'data-layer="moved"' in (run / "report.html").read_text()
