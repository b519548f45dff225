"""What changed between two maps, in the viewer: each voxel by how much, the places that got worse by number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from semstab.model.voxels import VoxelTable
from semstab.outputs.recording.entities import path
from semstab.outputs.recording.layout import BACKGROUND, Scenery, eye
from semstab.outputs.recording.target import Target
from semstab.outputs.recording.voxel_maps import packed, thinned

WORSE, SAME, BETTER = (213, 94, 0), (150, 150, 150), (86, 180, 233)
ASPECT = 1.2

Change = tuple[str, VoxelTable, npt.NDArray[Any], npt.NDArray[Any] | None, Sequence[tuple[str, tuple[float, ...]]]]
"""A title, the voxels, what each gained (n,), -1 to 1, in agreement and where truth tells, and named places."""


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
    shown = []
    for name, (what, values) in views.items():
        entity = path(scene, "change", run, name)
        cells = (index[rows] // factor).astype(np.int32)
        colors = packed(_shades(values[rows]))
        stream.log(entity, rr.VoxelGridMap(cells, [table.voxel_size * factor] * 3, colors=colors), static=True)
        points = ((index[rows] + 0.5) * table.voxel_size).astype(np.float64)
        where = Scenery(points, np.zeros((0, 4, 4)), None if up is None else np.array(up))
        shown.append(
            rrb.Spatial3DView(
                origin=path(scene),
                contents=[entity, path(scene, "places", run)],
                name=f"{what}: orange worse, blue better",
                background=BACKGROUND,
                line_grid=False,
                eye_controls=eye(where, ASPECT),
            )
        )
    if places:
        centres = np.array([centre for _, centre in places]) - origin * table.voxel_size
        labels = [label for label, _ in places]
        stream.log(
            path(scene, "places", run), rr.Points3D(centres, labels=labels, radii=rr.Radius.ui_points(4.0)), static=True
        )
    return rrb.Vertical(*shown, name=title)


def _shades(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """From orange by grey to blue (n, 3)."""
    share = np.clip(np.abs(values), 0, 1)[:, None]
    end = np.where((values < 0)[:, None], WORSE, BETTER)
    shades: npt.NDArray[np.uint8] = np.round(share * end + (1 - share) * np.array(SAME)).astype(np.uint8)
    return shades
