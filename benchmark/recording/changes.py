"""What changed between two maps, in the viewer: each voxel by how much, the places that got worse by number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.core.types import Int64, UInt8
from semstab.metrics import vss
from semstab.metrics.agreement import shared_rows
from semstab.model.voxels import VoxelTable
from semstab.recording.entities import path
from semstab.recording.eye import BACKGROUND, Scenery, eye
from semstab.recording.target import Target
from semstab.recording.voxel_maps import packed, thinned

WORSE, SAME, BETTER, WHITE = (213, 94, 0), (150, 150, 150), (86, 180, 233), (255, 255, 255)
LEAST = 0.05
"""A change from which on a voxel is drawn as one."""

ASPECT = 1.2

Change = tuple[str, VoxelTable, npt.NDArray[Any], npt.NDArray[Any] | None, Sequence[tuple[str, str, tuple[float, ...]]]]
"""A title, the voxels, what each gained (n,), -1 to 1, in agreement and where truth tells; and places: in which of the
two they lost, their names and centres."""


def record_changes(
    file: Path,
    changes: Mapping[tuple[str, str], Change],
    up: Mapping[str, tuple[float, float, float]],
    sentences: Sequence[str],
) -> None:
    """Write a recording with a tab for each scene and run, and what was found beside it."""
    file.unlink(missing_ok=True)
    stream = Target(file).open()
    stream.log(
        "/found", rr.TextDocument("\n".join(f"- {text}" for text in sentences), media_type="text/markdown"), static=True
    )
    tabs = [_logged(stream, *names, change, up.get(names[0])) for names, change in changes.items()]
    found = rrb.TextDocumentView(origin="/found", name="What was found")
    layout = rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0], found, column_shares=[3, 1]), collapse_panels=True
    )
    stream.send_blueprint(layout, make_default=True, make_active=True)
    stream.flush()
    stream.disconnect()


def _logged(
    stream: rr.RecordingStream, scene: str, run: str, change: Change, up: tuple[float, float, float] | None
) -> rrb.Container:
    title, table, agreement, right, places = change
    origin = np.round(table.index.mean(axis=0)).astype(np.int64) if len(table) else np.zeros(3, np.int64)
    index = table.index.astype(np.int64) - origin
    factor, rows = thinned(index)
    views = {"agreement": ("Agreement between frames", agreement)}
    if right is not None:
        views["truth"] = ("Right and wrong", right)
    points = ((index[rows] + 0.5) * table.voxel_size).astype(np.float64)
    where = Scenery(points, np.zeros((0, 4, 4)), None if up is None else np.array(up))
    shown = []
    for name, (what, values) in views.items():
        entity = path(scene, "change", run, name)
        changed = np.abs(values[rows]) >= LEAST
        cells = (index[rows][changed] // factor).astype(np.int32)
        colors = packed(_shades(values[rows][changed]))
        stream.log(entity, rr.VoxelGridMap(cells, [table.voxel_size * factor] * 3, colors=colors), static=True)
        rest = rr.Points3D(points[~changed], colors=SAME, radii=rr.Radius.ui_points(1.0))  # they do not hide the others
        stream.log(f"{entity}/same", rest, static=True)
        own = [place for place in places if place[0] == name]
        if own:
            at = np.array([centre for *_, centre in own]) - origin * table.voxel_size
            labels = rr.Points3D(
                at, labels=[label for _, label, _ in own], colors=WHITE, radii=rr.Radius.ui_points(4.0)
            )
            stream.log(f"{entity}/places", labels, static=True)
        shown.append(
            rrb.Spatial3DView(
                origin=path(scene),
                contents=[f"{entity}/**"],
                name=f"{what}: orange worse, blue better, grey points as before",
                background=BACKGROUND,
                line_grid=False,
                eye_controls=eye(where, ASPECT),
            )
        )
    return rrb.Vertical(*shown, name=title)


def _shades(values: npt.NDArray[Any]) -> UInt8:
    """From orange by grey to blue (n, 3)."""
    share = np.clip(np.abs(values), 0, 1)[:, None]
    end = np.where((values < 0)[:, None], WORSE, BETTER)
    shades: UInt8 = np.round(share * end + (1 - share) * np.array(SAME)).astype(np.uint8)
    return shades


# Voxels where the maps of two backends differ.

ONLY_FIRST, ONLY_SECOND = (230, 159, 0), (86, 180, 233)
VSS_RANGE = (0.0, 0.5)

DIFFERENCE = {"only_first": "in the first only", "only_second": "in the second only", "changed": "|VSS difference|"}
"""The parts of a difference, and what they are called."""


def log_difference(
    stream: rr.RecordingStream,
    entity: str,
    tables: Mapping[str, VoxelTable],
    origin: Int64,
    tolerance: float,
) -> str:
    """Log the voxels that one of two maps has only, and those whose VSS differs by more than the tolerance.

    tables  the two maps by the names of their backends

    Returns how many there are, in words. They are of the final maps, so they are logged for all times.
    """
    first, second = tables.values()
    in_first, in_second = shared_rows(first, second)
    change = np.abs(vss(first)[in_first] - vss(second)[in_second])
    differs = change > tolerance
    parts = {
        "only_first": np.delete(first.index, in_first, axis=0),
        "only_second": np.delete(second.index, in_second, axis=0),
        "changed": first.index[in_first[differs]],
    }
    looks: dict[str, dict[str, Any]] = {
        "only_first": {"colors": ONLY_FIRST},
        "only_second": {"colors": ONLY_SECOND},
        "changed": {"colormap": rr.components.Colormap.Inferno, "value_range": VSS_RANGE},
    }
    for part in DIFFERENCE:
        index = parts[part] - origin
        factor, rows = thinned(index)
        values: dict[str, Any] = {"values": change[differs][rows].astype(np.float32)} if part == "changed" else {}
        cells = (index[rows] // factor).astype(np.int32)
        size = [first.voxel_size * factor] * 3
        stream.log(f"{entity}/{part}", rr.VoxelGridMap(cells, size, **values, **looks[part]), static=True)
    one, other = tables
    return (
        f"{len(parts['only_first']):,} voxels in {one} only, {len(parts['only_second']):,} in {other} only; of"
        f" {len(in_first):,} in both VSS differs in {int(differs.sum()):,}, by {change.max(initial=0.0):.2g} at most"
    )
