"""Show the areas that got worse in the frames behind them: the image, and the labels of both runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.types import Float64
from semstab.data.contrast import Area, Compared
from semstab.data.frames import Frame
from semstab.engine.folder import load_result
from semstab.engine.place_pictures import PICTURED, READ, cut_out
from semstab.errors import SemstabError
from semstab.exports.relabel import task_of
from semstab.report.html import jpeg, label_picture
from semstab.task import read


@dataclass(frozen=True, eq=False)
class FramesOf:
    """Frames of a run by their index, and the palette (K, 3) of its classes."""

    frames: Mapping[int, Frame]
    palette: Sequence[tuple[int, int, int]]


def frames_of(run: Compared, scene: str, indices: Sequence[int]) -> FramesOf | None:
    """Return frames as a run had them, or None without its folder, its data or its code."""
    if run.source is None or not Path(run.source).is_dir():
        return None
    try:
        result = load_result(run.source)
        record = result.record(scene=scene, model=run.model)
        with task_of(Path(run.source), record, result.manifest["inputs"]) as (task, pixel_stride):
            if task.scene.of_scans:
                return None
            frames = {index: read(task, index, pixel_stride, color=True) for index in indices}
            return FramesOf(frames, task.mapping.target.colors)
    except (SemstabError, OSError, KeyError):
        return None


def area_pictures(
    areas: Sequence[Area], points: Mapping[int, Float64], runs: Sequence[Compared], scene: str
) -> dict[int, dict[str, Any]]:
    """Return the first areas with a picture of the frame behind each, by their place in the list.

    Args:
        areas: Areas of a run, with the frames that contribute most.
        points: Centres (n, 3) of the voxels of an area in the scene, by its place in the list.
        runs: The base and the run.
        scene: Name of the scene.
    """
    top_frames = {k: area.frames[0].frame for k, area in enumerate(areas) if area.frames and k in points}
    first = dict(list(top_frames.items())[:PICTURED])
    indices = [*dict.fromkeys(first.values())][:READ]
    if not indices:
        return {}
    run_frames = [(run.name, frames_of(run, scene, indices)) for run in runs]
    made = {}
    for k, index in first.items():
        cuts = [
            (name, of_run, cut)
            for name, of_run in run_frames
            if of_run is not None
            and index in of_run.frames
            and (cut := cut_out(of_run.frames[index], points[k])) is not None
        ]
        if cuts:
            image = cuts[0][2][1]
            images = [] if image is None else [("image", jpeg(image))]
            images += [
                (f"labels of {name}", label_picture(cut[0], np.array(of_run.palette))) for name, of_run, cut in cuts
            ]
            x, y, radius = cuts[0][2][2]
            name = areas[k].frames[0].name or str(index)
            made[k] = {"title": name, "shown": images, "ring": [100 * x, 100 * y, 200 * radius]}
    return made
