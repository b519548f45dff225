"""Videos, without depth and poses: which model flickers least, and a row of numbers for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.core.console import wrapped
from semstab.data.records import Record, Result
from semstab.metrics.image_space import mean_over_scenes
from semstab.report.means import by_model
from semstab.report.ranking import least_flicker_first, order_of_models
from semstab.report.terminal.disagreement import outlying_lines
from semstab.report.terminal.layout import laid_out, number

HEADS = ("", "flicker %", "pixel flicker %", "co-visible %", "VC8", "VC16")

LEGEND = (
    "flicker: pixels whose label differs from the frame before, motion removed by optical flow; pixel flicker: with"
    " motion; co-visible: pixels that the flow finds in the frame before",
    "VC8, VC16: share of the pixels whose label stays the same for 8 or 16 frames, with motion",
)
"""The meaning of the columns."""

NEEDS = (
    "agreement of places (alpha, VSS), drift (SBD), how often a place was seen (OP) and a verdict need depth and poses:"
    " docs/datasets.md has what is read"
)
"""The line on what a video does not tell."""


def videos(result: Result, records: Sequence[Record], width: int) -> Iterator[str]:
    """Yield the videos, the answer, a row for each model over all videos, and the frames that stand out."""
    frames = sorted({record.frames for record in records})
    counts = f"{frames[0]} to {frames[-1]}" if len(frames) > 1 else f"{frames[0]}"
    sizes = " and ".join(
        dict.fromkeys(f"{w}x{h}" for w, h in (record.pixels.size for record in records if record.pixels))
    )
    classes = " and ".join(map(str, sorted({record.map_summary.K for record in records})))
    listed = result.scenes[0] if len(result.scenes) == 1 else f"{len(result.scenes)} videos"
    yield f"{listed}    {counts} frames of {sizes}, {classes} classes    no depth, no poses"
    yield ""
    for text in order_of_models(result):
        yield from wrapped(text)
    models, rows = by_model(records), [HEADS]
    for name in least_flicker_first(models):
        mean = mean_over_scenes(record.image_space for record in models[name])
        flicker = number(mean.compensated_flicker_percent, 2), number(mean.flicker_percent, 2)
        share = number(100 * mean.compensated_share, 0)
        rows.append((name, *flicker, share, number(mean.self_vc8, 3), number(mean.self_vc16, 3)))
    yield from laid_out(rows, width, texts=0)
    for text in LEGEND:
        yield from wrapped(text)
    yield from outlying_lines(records)
    yield from wrapped(f"note: {NEEDS}")
    yield ""
