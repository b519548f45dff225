"""What changed between two maps, in the viewer: each voxel by how much, the locations that got worse by number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.core.types import UInt8
from semstab.model.voxels import VoxelTable
from semstab.recording.layout import BACKGROUND, SceneBounds, camera_pose
from semstab.recording.target import Target
from semstab.recording.timeline import path
from semstab.recording.voxel_maps import packed, thinned

WORSE, SAME, BETTER, WHITE = (213, 94, 0), (150, 150, 150), (86, 180, 233), (255, 255, 255)
LEAST = 0.05
"""A change from which on a voxel is drawn as one."""

ASPECT = 1.2

Change = tuple[str, VoxelTable, npt.NDArray[Any], npt.NDArray[Any] | None, Sequence[tuple[str, str, tuple[float, ...]]]]
"""A title, the voxels, the gain of each (n,), -1 to 1, in agreement and where truth tells; and locations: in which of
the two they lost, their names and centres."""


def record_changes(
    file: Path,
    changes: Mapping[tuple[str, str], Change],
    up: Mapping[str, tuple[float, float, float]],
    sentences: Sequence[str],
) -> None:
    """Write a recording with a tab for each scene and run, and the sentences beside it."""
    file.unlink(missing_ok=True)
    stream = Target(file).open()
    stream.log(
        "/results",
        rr.TextDocument("\n".join(f"- {text}" for text in sentences), media_type="text/markdown"),
        static=True,
    )
    tabs = [_logged(stream, *names, change, up.get(names[0])) for names, change in changes.items()]
    results = rrb.TextDocumentView(origin="/results", name="Results")
    layout = rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0], results, column_shares=[3, 1]),
        collapse_panels=True,
    )
    stream.send_blueprint(layout, make_default=True, make_active=True)
    stream.flush()
    stream.disconnect()


def _logged(
    stream: rr.RecordingStream, scene: str, run: str, change: Change, up: tuple[float, float, float] | None
) -> rrb.Container:
    title, table, agreement, right, locations = change
    origin = np.round(table.index.mean(axis=0)).astype(np.int64) if len(table) else np.zeros(3, np.int64)
    index = table.index.astype(np.int64) - origin
    factor, rows = thinned(index)
    views = {"agreement": ("Agreement between frames", agreement)}
    if right is not None:
        views["truth"] = ("Right and wrong", right)
    points = ((index[rows] + 0.5) * table.voxel_size).astype(np.float64)
    where = SceneBounds(points, np.zeros((0, 4, 4)), None if up is None else np.array(up))
    shown = []
    for name, (what, values) in views.items():
        entity = path(scene, "change", run, name)
        changed = np.abs(values[rows]) >= LEAST
        cells = (index[rows][changed] // factor).astype(np.int32)
        colors = packed(_shades(values[rows][changed]))
        stream.log(entity, rr.VoxelGridMap(cells, [table.voxel_size * factor] * 3, colors=colors), static=True)
        rest = rr.Points3D(points[~changed], colors=SAME, radii=rr.Radius.ui_points(1.0))  # they do not hide the others
        stream.log(f"{entity}/same", rest, static=True)
        own = [each for each in locations if each[0] == name]
        if own:
            at = np.array([centre for *_, centre in own]) - origin * table.voxel_size
            labels = rr.Points3D(
                at, labels=[label for _, label, _ in own], colors=WHITE, radii=rr.Radius.ui_points(4.0)
            )
            stream.log(f"{entity}/locations", labels, static=True)
        shown.append(
            rrb.Spatial3DView(
                origin=path(scene),
                contents=[f"{entity}/**"],
                name=f"{what}: orange worse, blue better, grey points as before",
                background=BACKGROUND,
                line_grid=False,
                eye_controls=camera_pose(where, ASPECT),
            )
        )
    return rrb.Vertical(*shown, name=title)


def _shades(values: npt.NDArray[Any]) -> UInt8:
    """From orange by grey to blue (n, 3)."""
    share = np.clip(np.abs(values), 0, 1)[:, None]
    end = np.where((values < 0)[:, None], WORSE, BETTER)
    shades: UInt8 = np.round(share * end + (1 - share) * np.array(SAME)).astype(np.uint8)
    return shades
