"""Record the maps of other programs next to a run's: their classes, and where they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from semstab.core.types import Int32, Int64, UInt8
from semstab.recording.layout import WHITE, SceneBounds, view_3d
from semstab.recording.target import Target, flush
from semstab.recording.timeline import path
from semstab.recording.voxel_maps import packed, thinned

WIDE, HALF = 2.2, 1.6
"""Width by height of the view of differences, and of the two maps below it."""


@dataclass(frozen=True, eq=False)
class Colored:
    """Voxels (n, 3) in colours (n, 3): the name of their entity, and the title of their view."""

    name: str
    title: str
    index: Int32
    colors: UInt8


Named = tuple[str, tuple[float, float, float]]


def record_maps(
    file: Path,
    scene: str,
    maps: Mapping[str, Sequence[Colored]],
    places: Mapping[str, Sequence[Named]],
    size: float,
    up: tuple[float, float, float] | None,
) -> None:
    """Write a recording with a tab for each map: differences above, with named places, and its and the run's classes.

    Args:
        file: The recording.
        scene: Name of the scene.
        maps: The differences, then the two maps, by the name of each other map.
        places: Names and centres of the places at which the maps differ.
        size: Edge of a voxel, metres.
        up: The scene's up axis, if it is known.
    """
    file.unlink(missing_ok=True)
    stream = Target(file).open()
    tabs = [_log(stream, scene, name, views, places[name], size, up) for name, views in maps.items()]
    content = rrb.Tabs(*tabs) if len(tabs) > 1 else tabs[0]
    stream.send_blueprint(rrb.Blueprint(content, collapse_panels=True), make_default=True, make_active=True)
    flush(stream, file)
    stream.disconnect()


def _log(
    stream: rr.RecordingStream,
    scene: str,
    name: str,
    views: Sequence[Colored],
    places: Sequence[Named],
    size: float,
    up: tuple[float, float, float] | None,
) -> rrb.Container:
    all_voxels = views[0].index.astype(np.int64)
    origin: Int64 = np.round(all_voxels.mean(axis=0)).astype(np.int64)
    points = ((all_voxels - origin + 0.5) * size).astype(np.float64)
    bounds = SceneBounds(points, np.zeros((0, 4, 4)), None if up is None else np.array(up))
    made = []
    for k, view in enumerate(views):
        entity, index = path(scene, "maps", name, view.name), view.index.astype(np.int64) - origin
        factor, rows = thinned(index)
        cells = (index[rows] // factor).astype(np.int32)
        grid = rr.VoxelGridMap(cells, [size * factor] * 3, colors=packed(view.colors[rows]))
        stream.log(entity, grid, static=True)
        if places and not k:
            labels, centres = zip(*places, strict=True)
            positions = np.array(centres) - origin * size
            numbers = rr.Points3D(positions, labels=labels, colors=WHITE, radii=rr.Radius.ui_points(4.0))
            stream.log(f"{entity}/places", numbers, static=True)
        made.append(view_3d(scene, [f"{entity}/**"], view.title, bounds, HALF if k else WIDE))
    return rrb.Vertical(made[0], rrb.Horizontal(*made[1:]), name=name)
