"""The data that a run fused: frames, classes, size of voxels, geometry, and for which data intervals are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from semstab.core.console import wrapped
from semstab.core.types import THESE_FRAMES
from semstab.data.features import OF_FEATURES
from semstab.data.records import Record, Result
from semstab.report.narrative import noted
from semstab.statistics.intervals import LEAST_FRAMES


def head_lines(name: str, result: Result, runs: Sequence[Record], width: int) -> Iterator[str]:
    """Yield the data that was fused: '40 frames, 7 classes, 0.2 m voxels', whether depth and poses agree, and notes."""
    first = runs[0]
    frames = sorted({run.frames for run in runs})
    counts = f"{frames[0]} to {frames[-1]}" if len(frames) > 1 else f"{frames[0]}"
    spots = [run.statistics.spots for run in runs if run.statistics is not None]
    views = min((of_run.views for of_run in spots if of_run is not None and of_run.views < of_run.frames), default=None)
    distinct = "" if views is None else f" of {views} distinct views"
    chosen = " (auto)" if any(advice.chosen for advice in result.advice.values()) else ""
    numbers = {run.map_summary.K for run in runs if run.taxonomy != OF_FEATURES.name}
    classes = f"{' and '.join(map(str, sorted(numbers)))} classes" if numbers else "features"
    what = f"{counts} frames{distinct}, {classes}, {_metres(first.map_summary.voxel_size)} voxels{chosen}"
    remarks = "    ".join(filter(None, (_geometry(result), _scope(runs))))
    if result.manifest.get("seed") is not None:
        name = f"simulated: {name}"
    line = f"{name}    {what}    {remarks}".rstrip()
    yield line if len(line) <= width else f"{name}    {what}\n  {remarks}".rstrip()
    for text in noted(result):
        yield from wrapped(f"note: {text}")
    yield ""


def _geometry(result: Result) -> str:
    scenes = result.manifest.get("geometry")
    states = [state for state in scenes.values() if isinstance(state, Mapping)] if isinstance(scenes, Mapping) else []
    if not states:
        return ""
    sound = all(state.get("state") == "sound" for state in states)
    return "geometry ok" if sound else "geometry unclear: run semstab-bench check"


def _scope(runs: Sequence[Record]) -> str:
    """Return a note where intervals and verdicts are for the frames of a run alone, as they are too few for more."""
    alphas = [run.statistics.headline.alpha for run in runs if run.statistics is not None]
    few = [alpha for alpha in alphas if alpha.scope == THESE_FRAMES and alpha.frames]
    in_rows = "" if len(few) == len(alphas) else f" in {len(few)} of {len(alphas)} rows"
    return f"intervals for these frames alone{in_rows}: fewer than {LEAST_FRAMES} views" if few else ""


def _metres(size: float) -> str:
    return f"{1000 * size:g} mm" if size < 0.01 else f"{size:g} m"
