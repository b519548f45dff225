"""What the statistics say of a finished map, as the viewer shows it beside the map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.model.statistics import LagBin, MapStatistics

AXES = (
    ("angle", "degrees between the views"),
    ("time", "frames apart"),
    ("baseline", "metres between the cameras"),
    ("range", "ratio of the ranges"),
)


def looks_report(found: MapStatistics) -> str:
    """The verdict, and agreement by how far apart two looks at a place are, in Markdown."""
    return "\n".join([found.verdict.line, "", *_correlogram(found)])


def _correlogram(found: MapStatistics) -> Iterator[str]:
    if found.correlogram is None:
        return
    yield "Alpha between frames, by how far apart two looks at a place are:"
    for axis, unit in AXES:
        bins: Sequence[LagBin] = getattr(found.correlogram, axis)
        if bins:
            yield from ("", f"| {unit} | alpha | 95% | for | ceiling |", "|---|---|---|---|---|")
            for row in bins:
                alpha = row.alpha
                band = f"{alpha.low:.2f} to {alpha.high:.2f} | {alpha.question}{'' if alpha.decided else ', undecided'}"
                yield f"| {row.mean:.3g} | {alpha.value:.2f} | {band} | {row.ceiling:.2f} |"
