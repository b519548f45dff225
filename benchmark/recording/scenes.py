"""What a recording knows of the scenes of a run: where their maps begin, their cameras, and how all is laid out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.core.types import Int64
from semstab.engine.units import Plan
from semstab.metrics import dominant
from semstab.model.labels import LabelSpace
from semstab.model.voxels import VoxelTable
from semstab.recording import camera, series
from semstab.recording.camera import CameraLog, label_context
from semstab.recording.entities import Legend, path
from semstab.recording.eye import Scenery
from semstab.recording.group import GroupLog
from semstab.recording.layout import Known, blueprint
from semstab.recording.voxel_maps import CHUNKS, chunks_of
from semstab.task import Task

FIRST_CHUNKS = 8
"""Chunks of each map that the first layout knows; it is sent again where a map outgrows them."""

SAMPLE = 20_000
"""Voxels of a scene from which it follows where its maps are seen from."""

ORIGIN_STEP = 1000.0
"""Metres; map origins are multiples of it: a scene near its world's origin keeps its coordinates."""


class Scenes:
    """Those of a plan; their layout is sent again where there is more to it.

    live  whether a viewer follows the run, which keeps the layout that it got first
    """

    def __init__(self, plan: Plan, *, live: bool) -> None:
        targets: dict[str, list[LabelSpace]] = {}
        for task in plan.tasks:
            targets.setdefault(task.scene.name, []).append(task.mapping.target)
        first = CHUNKS if live else FIRST_CHUNKS
        self.plan = plan
        self.known = Known(
            legends={scene: Legend(spaces) for scene, spaces in targets.items()}, chunks=dict.fromkeys(targets, first)
        )
        self.origins: dict[str, Int64] = {}
        """Where the maps of a scene begin, in voxels, once that is settled."""
        self.cameras: dict[str, CameraLog] = {}
        """By scene, from then on."""
        self.waits = False
        """Whether the layout is not to be sent yet: a merged file has layouts in no order, and shows the last one."""
        self._live = live
        self._sent = 0

    def log_static(self, stream: rr.RecordingStream) -> None:
        """What holds in all frames: axes, legends, names and colours."""
        for scene, task in {task.scene.name: task for task in self.plan.tasks}.items():
            if (up := task.scene.up) is not None:  # the axis of the world that is nearest to it
                axis = int(np.abs(up).argmax())
                name = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}"
                stream.log(path(scene), getattr(rr.ViewCoordinates, name), static=True)
            _log_legend(stream, scene, self.known.legends[scene])
            camera.log_legend(stream, path(scene, "drift_legend"), task.mapping.target)
        for task in self.plan.tasks:
            entity = path(task.scene.name, "camera", task.backbone)
            stream.log(f"{entity}/labels", label_context(task.mapping.target), static=True)
            stream.log(f"{entity}/drift", camera.context(task.mapping.target), static=True)
        series.log_styles(stream, self.plan)

    def origin(self, stream: rr.RecordingStream, task: Task, position: npt.NDArray[Any]) -> Int64:
        """The scene's map origin, in voxels: settled near the first position that is known, and said."""
        scene, voxel_size = task.scene.name, self.plan.config.voxel_size
        if scene in self.origins:
            return self.origins[scene]
        steps = np.round(position / ORIGIN_STEP).astype(np.int64)
        self.origins[scene] = origin = steps * round(ORIGIN_STEP / voxel_size)
        self.cameras[scene] = CameraLog(task.scene, origin * voxel_size, len(task.indices))
        if steps.any():
            where = ", ".join(f"{name} = {value:.3f} m" for name, value in zip("xyz", origin * voxel_size, strict=True))
            stream.log(path(scene, "log"), rr.TextLog(f"map coordinates are relative to {where} of the scene's world"))
        return origin

    def send_layout(self, stream: rr.RecordingStream) -> None:
        """As it is by now, unless it waits."""
        if not self.waits:
            layout = blueprint(self.plan, self.known)
            stream.send_blueprint(layout, make_default=True, make_active=self._sent == 0 or not self._live)
            self._sent += 1

    def show_chunks(self, stream: rr.RecordingStream, scene: str, voxels: int, *, anyway: bool = False) -> None:
        """Send the layout again where a scene's map of that size has more chunks than it knows, or anyway."""
        outgrown = chunks_of(voxels) > self.known.chunks[scene]
        if outgrown:
            self.known.chunks[scene] = CHUNKS
        if outgrown or anyway:
            self.send_layout(stream)

    def lay_out(self, stream: rr.RecordingStream, group: GroupLog, table: VoxelTable) -> None:
        """All of a group is fused: send the layout again where there is more to it now. The table is one of its own."""
        known, scene = self.known, group.task.scene.name
        compared = len(group.task.backends) > 1
        if compared:
            known.spans[scene, group.task.backbone] = group.spans
        legend = known.legends[scene]
        used = legend.used
        legend.see(group.task.mapping.target, dominant(table))
        _log_legend(stream, scene, legend)
        first = scene not in known.sceneries and len(table) > 0
        if first:
            some = table.index[:: math.ceil(len(table) / SAMPLE)]
            points = ((some - group.origin + 0.5) * table.voxel_size).astype(np.float64)
            known.sceneries[scene] = Scenery(points, self.cameras[scene].poses, group.task.scene.up)
        self.show_chunks(stream, scene, group.voxels, anyway=first or compared or used != legend.used)


def _log_legend(stream: rr.RecordingStream, scene: str, legend: Legend) -> None:
    legend.log(stream, path(scene, "legend"), path(scene, "all_classes"))
