"""Report videos without depth and poses: the screen, the tables, the page."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from semstab.core.files import atomic_path, write_text
from semstab.core.json_form import to_json
from semstab.data.frames import Frame
from semstab.data.videos import VideoRecord, VideoResult, VideoRow
from semstab.engine.videos import VideoObserver
from semstab.metrics.image_space import mean_over_scenes
from semstab.report.charts import Line, line_chart, sample
from semstab.report.html import filled, lone_pictures, table_block
from semstab.report.narrative import nearly_all, outlying_line
from semstab.report.tables.flicker import flicker_of_videos
from semstab.report.tables.table import Column, Group, Table, relations
from semstab.report.tables.video_measures import video_measure_tables
from semstab.report.terminal import ProgressBar
from semstab.statistics.verdict import LEAST_CLASSES
from semstab.task import Task

NEEDS = (
    "agreement of places (alpha, VSS), drift (SBD), how often a place was seen (OP) and a verdict need depth and poses:"
    " docs/datasets.md has what is read"
)
"""The line on what a video does not tell."""


class VideoProgress(VideoObserver):
    """A progress bar for a run over videos."""

    def __init__(self, console: Console) -> None:
        self._bar = ProgressBar(console)

    def run_started(self, frames: int) -> None:
        """Show the bar."""
        self._bar.begin(frames)

    def measured_earlier(self, records: Sequence[VideoRecord], of: int) -> None:
        """Say how much there is."""
        if records:
            self._bar.bar.console.print(f"finished earlier: {len(records)} of {of} label sources", style="dim")

    def frame_measured(self, task: Task, frame: Frame, numbers: Mapping[str, float]) -> None:
        """Advance the bar."""
        self._bar.advanced(1, f"{task.scene.name} · {task.model}")

    def close(self) -> None:
        """Remove the bar."""
        self._bar.close()


def flicker_of(records: Sequence[VideoRecord]) -> float:
    """Return the flicker of a model with the motion removed, percent: the mean over videos."""
    return mean_over_scenes(record.image_space for record in records).compensated_flicker_percent


def ranked(result: VideoResult) -> list[str]:
    """Return the models, that with the least flicker first, those that are not ranked last."""
    flicker = {model: flicker_of(result.of(model)) for model in result.models}
    silent = {model for model in result.models if silence(result, model)}
    return sorted(flicker, key=lambda model: (model in silent, math.isnan(flicker[model]), flicker[model]))


def silence(result: VideoResult, model: str) -> str:
    """Return why the flicker of a model says nothing: nearly all of it is one class in each video; '' where it says."""
    records = result.of(model)
    if not all(record.effective_classes < LEAST_CLASSES for record in records):
        return ""
    least = min(records, key=lambda record: record.largest_share)
    return f"uninformative: {nearly_all(least.largest_share)} of the labels of {model} are {least.largest_class}"


def ranking(result: VideoResult) -> str:
    """Return the models in order: '1. a, 2. b'; '' where there are not two to compare."""
    names = [name for name in ranked(result) if not silence(result, name)]
    return ", ".join(f"{k}. {name}" for k, name in enumerate(names, start=1)) if len(names) > 1 else ""


def screen(result: VideoResult) -> Iterator[str]:
    """Yield the lines of a run for a terminal."""
    first = result.records[0]
    frames = sorted({record.frames for record in result.records})
    counts = f"{frames[0]} to {frames[-1]}" if len(frames) > 1 else f"{frames[0]}"
    named = first.scene if len(result.scenes) == 1 else f"{len(result.scenes)} videos"
    size = f"{first.size[0]}x{first.size[1]}"
    yield f"{named}    {counts} frames of {size}, {len(first.classes)} classes    no depth, no poses"
    yield ""
    names = ranked(result)
    if order := ranking(result):
        yield f"  least flicker first: {order}"
    lines = [["", "flicker %", "pixel flicker %", "co-visible %", "VC8", "VC16"]]
    for name in names:
        mean = mean_over_scenes(record.image_space for record in result.of(name))
        shown = (
            mean.compensated_flicker_percent, mean.flicker_percent, 100 * mean.compensated_share, mean.self_vc8,
            mean.self_vc16,
        )  # fmt: skip
        cells = [_text(value, 2 if k < 2 else 0 if k == 2 else 3) for k, value in enumerate(shown)]
        lines.append([name, *cells])
    sizes = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for label, *cells in lines:
        aligned = "  ".join(f"{cell:>{size}}" for cell, size in zip(cells, sizes[1:], strict=True))
        yield f"    {label:<{sizes[0]}}  {aligned}"
    yield "  flicker: pixels whose label differs from the frame before, motion removed by optical flow"
    yield from (f"  {text}" for name in names if (text := silence(result, name)))
    for record in result.records:
        of = [record.model] if len(result.models) > 1 else []
        of += [record.scene] if len(result.scenes) > 1 else []
        yield f"  {outlying_line(record.outlying, ', '.join(of))}"
    yield ""


def _text(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def tables(result: VideoResult) -> list[Table]:
    """Return flicker by model and video, the frames that stand out, and VC and TC where they were asked for."""
    methods = {name: {record.scene: record.image_space for record in result.of(name)} for name in result.models}
    measures = {
        name: {record.scene: record.video_measures for record in result.of(name) if record.video_measures is not None}
        for name in result.models
    }
    measures = {name: values for name, values in measures.items() if values}
    return [*flicker_of_videos(methods), *video_measure_tables(measures), *_frames(result)]


def _frames(result: VideoResult) -> list[Table]:
    groups = [
        Group(
            f"{record.model}, {record.scene}",
            tuple((each.name, 100 * each.share, 100 * record.outlying.usual) for each in record.outlying.frames),
        )
        for record in result.records
        if record.outlying.frames
    ]
    if not groups:
        return []
    columns = (
        Column("frame", "Frame"),
        Column("lone_percent", "Alone (%)", 2),
        Column("usual_percent", "Usual excess (%)", 2),
    )
    caption = (
        "Frames that stand out: the share of the pixels at which the frames before and after a frame agree on another"
        " label than the frame's, with the motion removed, lies above that of the other frames."
    )
    return [Table("frames", "Frames that stand out", caption, columns, tuple(groups))]


def save_series(record: VideoRecord, folder: Path) -> Path:
    """Write FOLDER/frames/SCENE_MODEL.csv; return its path. An undefined number is an empty field."""
    path = folder / "frames" / f"{record.slug}.csv"
    columns = [field.name for field in dataclasses.fields(VideoRow)]
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in record.rows:
            values = [getattr(row, name) for name in columns]
            writer.writerow(
                [int(v) if isinstance(v, bool) else "" if isinstance(v, float) and math.isnan(v) else v for v in values]
            )
    return path


def summary(result: VideoResult) -> dict[str, Any]:
    """Return the content of summary.json: all numbers but those of single frames, which frames/ has."""
    fields = [field.name for field in dataclasses.fields(VideoRecord) if field.repr]
    return {
        "schema": "semstab video 1",
        "records": [{name: to_json(getattr(record, name)) for name in fields} for record in result.records],
    }


def write_page(result: VideoResult, folder: Path) -> Path:
    """Write FOLDER/report.html; return its path."""
    path = folder / "report.html"
    write_text(path, page(result))
    return path


def page(result: VideoResult) -> str:
    """Return the page of a result."""
    first, names = result.records[0], ranked(result)
    colors = {name: k for k, name in enumerate(result.models)}
    frames = sorted({record.frames for record in result.records})
    subtitle = [
        f"{len(result.scenes)} video{'' if len(result.scenes) == 1 else 's'}",
        f"{len(names)} model{'' if len(names) == 1 else 's'}",
    ]
    subtitle += [f"{frames[0]} frames" if len(frames) == 1 else f"{frames[0]} to {frames[-1]} frames"]
    subtitle += [f"{first.size[0]}x{first.size[1]} pixels", f"{len(first.classes)} classes", "no depth, no poses"]
    return filled(
        "videos.html.j2",
        title=", ".join(result.scenes) if len(result.scenes) < 4 else f"{len(result.scenes)} videos",
        subtitle=" · ".join(subtitle),
        needs=f"{NEEDS[0].upper()}{NEEDS[1:]}.",
        models=[(name, sample(colors[name])) for name in result.models] if len(names) > 1 else [],
        cards=[_card(result, name) for name in names],
        ranking=ranking(result),
        silent=[text for name in names if (text := silence(result, name))],
        scenes=[_scene(result, name, colors) for name in result.scenes],
        tables=[table_block(table) for table in tables(result)],
        manifest=json.dumps(result.manifest, indent=2, default=str),
    )


def _card(result: VideoResult, model: str) -> dict[str, Any]:
    mean = mean_over_scenes(record.image_space for record in result.of(model))
    numbers = (
        ("flicker", mean.compensated_flicker_percent, "{:.2f} %", "of the pixels per frame, motion removed"),
        ("pixel flicker", mean.flicker_percent, "{:.2f} %", "of the pixels per frame, motion included"),
        ("co-visible", 100 * mean.compensated_share, "{:.0f} %", "of the pixels, in the frame before"),
        ("VC8", mean.self_vc8, "{:.3f}", "of the pixels keep their label for 8 frames"),
        ("VC16", mean.self_vc16, "{:.3f}", "for 16 frames"),
        ("VC8, truth", mean.vc8, "{:.3f}", "where the truth stays the same"),
    )
    return {
        "model": model,
        "numbers": [(name, form.format(v), note) for name, v, form, note in numbers if not math.isnan(v)],
    }


def _scene(result: VideoResult, scene: str, colors: dict[str, int]) -> dict[str, Any]:
    records = [record for record in result.records if record.scene == scene]
    charts = []
    for column, title, unit in (
        ("compensated_flicker_percent", "Flicker", "flicker, % of the pixels"),
        ("lone_percent", "Frames that stand alone", "% of the pixels"),
    ):
        lines = [
            Line(
                record.model,
                [row.frame for row in record.rows],
                [getattr(row, column) for row in record.rows],
                color=colors[record.model],
            )
            for record in records
        ]
        if any(math.isfinite(value) for line in lines for value in line.y):
            charts.append({"title": title, "chart": line_chart(lines, "frame", unit)})
    alone = len(records) == 1
    outlying = [
        outlying_line(record.outlying, "" if alone else record.model, most=len(record.outlying.frames))
        for record in records
    ]
    lone = [shown for record in records for shown in _lone(record)]
    return {"name": scene, "charts": charts, "outlying": [relations(text) for text in outlying], "lone": lone}


def _lone(record: VideoRecord) -> Iterator[dict[str, Any]]:
    """Yield frames that stand out as images: the image, its labels, and the pixels where it stands alone."""
    named = {each.frame: each for each in record.outlying.frames}
    for picture in record.pictures:
        outlier = named[picture.frame]
        title = f"{record.model}, {outlier.name}: alone at {100 * outlier.share:.0f} % of its pixels"
        yield {"title": title, "pictures": lone_pictures(picture.color, picture.labels, picture.alone, record.colors)}
