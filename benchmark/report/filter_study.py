"""Find the filter that makes a model more stable at an acceptable price."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from semstab.data.records import Record, Result
from semstab.metrics import macro_mean

MOST_LAG = 1.0
"""The most frames by which a recommended filter may follow a change late, in the mean."""

LEAST_COVERAGE = 0.95
"""The least share of the model's labels that a recommended filter must leave."""

LEAST_CHANGED = 0.001
"""The least share of the model's labels that a recommended filter must change: else it does nothing."""

LEAST_SEEN = 0.01
"""The least share of the model's labelled pixels that two frames must see: else flicker is known of next to nothing."""

ALIKE = 0.005
"""Shares that differ by no more count as equal."""

ALIKE_WORTH = 0.002
"""Filters whose quality differs by no more count as equal: then the one with less flicker is better."""


MEANS = (
    "flicker", "next_frame", "accuracy", "miou", "consistent_wrong", "lag", "coverage", "milliseconds", "changed",
    "seen",
)  # fmt: skip
"""The fields of a `FilterResult` that are means over scenes of those of `FrameQuality`."""


@dataclass(frozen=True)
class FilterResult:
    """A filter over a model: macro means over the scenes, shares 0 to 1, NaN if undefined; see `FrameQuality`.

    Attributes:
        filters: The names of the filters; '' for the model itself.
        flicker: The share of points seen in two frames in a row whose label changes: motion-compensated; seen: such
            points for one that the model labels.
        changed: The share of the model's labels that it changes.
        plain: The same share at the same pixel, whatever it shows.
        alpha: The alpha on which verdicts rest.
        better: The number of frames whose accuracy, or next-frame consistency without truth, is above the model's, and
            the number of all frames.
    """

    filters: str
    flicker: float
    plain: float
    alpha: float
    next_frame: float
    accuracy: float
    miou: float
    consistent_wrong: float
    lag: float
    coverage: float
    milliseconds: float
    changed: float
    seen: float
    better: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class FilterStudy:
    """A model and the filters over it."""

    model: str
    unfiltered: FilterResult
    filtered: tuple[FilterResult, ...]

    @property
    def has_truth(self) -> bool:
        """Return whether there is ground truth."""
        return not math.isnan(self.unfiltered.accuracy)

    def worth(self, row: FilterResult) -> float:
        """Return the quality that a filter must not lower: accuracy, or next-frame consistency without ground truth."""
        return row.accuracy if self.has_truth else row.next_frame

    def harmless(self, row: FilterResult) -> bool:
        """Return whether a filter lowers neither quality nor coverage too far, whatever it does for stability."""
        base = self.unfiltered
        if row.coverage < LEAST_COVERAGE:
            return False
        if not self.has_truth:
            return row.next_frame >= base.next_frame - ALIKE
        return row.accuracy >= base.accuracy and row.miou >= base.miou and not row.lag > MOST_LAG

    @property
    def best(self) -> FilterResult | None:
        """Return the filter to use: harmless, with less flicker than the model, and the highest quality.

        Of filters with equal quality the one with the least flicker is returned. Stability alone is no reason: a label
        that never changes has no flicker.
        """
        if not self.unfiltered.seen >= LEAST_SEEN:
            return None
        acting = [row for row in self.filtered if row not in self.idle]
        able = [row for row in acting if row.flicker < self.unfiltered.flicker and self.harmless(row)]
        most = max(map(self.worth, able), default=math.nan)
        return min(
            (row for row in able if self.worth(row) >= most - ALIKE_WORTH), key=lambda row: row.flicker, default=None
        )

    @property
    def idle(self) -> list[FilterResult]:
        """Return the filters that change next to no label."""
        return [row for row in self.filtered if row.changed < LEAST_CHANGED]

    @property
    def misleading(self) -> list[FilterResult]:
        """Return the filters that lower flicker, plain or compensated, and make labels worse; the worst first."""
        base = self.unfiltered
        worse = [row for row in self.filtered if self.worth(row) < self.worth(base) - ALIKE]
        return sorted((r for r in worse if r.flicker < base.flicker or r.plain < base.plain), key=self.worth)


def filter_studies(result: Result) -> list[FilterStudy]:
    """Return a study of each model whose filtered labels were assessed together with its own; none in other results."""
    groups: dict[str, dict[str, list[Record]]] = {}
    for record in result.select():
        if record.quality is not None:
            groups.setdefault(record.quality.model, {}).setdefault(record.quality.filters, []).append(record)
    return [
        FilterStudy(
            model,
            _row(rows[""], rows[""]),
            tuple(_row(records, rows[""]) for filters, records in rows.items() if filters),
        )
        for model, rows in groups.items()
        if "" in rows and len(rows) > 1
    ]


def of_interest(result: Result) -> Result:
    """Return the result for tables and figures of maps: a filter study is reduced to models and the filters to use."""
    filters_by_model = {study.model: {"", study.best.filters if study.best else ""} for study in filter_studies(result)}
    if not filters_by_model:
        return result

    def is_listed(record: Record) -> bool:
        quality = record.quality
        return quality is None or quality.filters in filters_by_model.get(quality.model, {quality.filters})

    names = {record.unit.model for record in result.select() if is_listed(record)}
    records = tuple(record for record in result.records if record.unit.model in names)
    return dataclasses.replace(result, records=records)


def advice(study: FilterStudy) -> Iterator[str]:
    """Yield sentences: the filter to use and why, filters that only seem to help, and what is not known."""
    best, base = study.best, study.unfiltered
    if not base.seen >= LEAST_SEEN:
        yield (
            f"No filter over {study.model} is recommended: two frames in a row see the same surface at"
            f" {100 * max(0.0, base.seen):.2g} % of the labelled pixels, and flicker is measured on"
            f" {100 * LEAST_SEEN:g} % or more."
        )
    elif best is None:
        least = "accuracy, IoU, coverage or time to follow" if study.has_truth else "next-frame consistency or coverage"
        yield f"Use none of these filters over {study.model}: none lowers its flicker without a loss of {least}."
    else:
        yield f"Use --filter {typed(best)} over {study.model}: {_why(study, best)}."
    if study.idle:
        names = ", ".join(row.filters for row in study.idle[:4])
        more = f" and {len(study.idle) - 4} more" if len(study.idle) > 4 else ""
        yield f"These filters change fewer than {100 * LEAST_CHANGED:g} % of the labels: {names}{more}."
    if study.misleading:
        worst = study.misleading[0]
        names = ", ".join(row.filters for row in study.misleading[:4])
        more = f" and {len(study.misleading) - 4} more" if len(study.misleading) > 4 else ""
        harm = _harm(study, worst)
        yield f"These filters lower flicker and make labels worse: {names}{more}. {worst.filters} {harm}."
    if not study.has_truth:
        yield (
            "There is no ground truth: the accuracy of labels and their delay after a true change are not known. The"
            " choice rests on next-frame consistency: how often a label is the one that"
            f" {study.model} predicts there in the next frame, which no filter has seen. A label that is wrong in every"
            " frame stays wrong."
        )
    elif not math.isfinite(base.lag):
        yield "No true label changes in these frames: the delay of labels after a change is not known."


def typed(result: FilterResult) -> str:
    """Return the filters as they are typed after the first --filter."""
    return result.filters.replace("+", " --filter ")


def _why(study: FilterStudy, best: FilterResult) -> str:
    base, (better, frames) = study.unfiltered, best.better
    parts = [
        f"flicker falls from {100 * base.flicker:.1f} to {100 * best.flicker:.1f} %",
        f"{100 * best.changed:.2g} % of the labels change",
    ]
    if study.has_truth:
        parts.append(
            f"accuracy goes from {100 * base.accuracy:.1f} to {100 * best.accuracy:.1f} % (better in {better} of"
            f" {frames} frames), mean IoU from {100 * base.miou:.1f} to {100 * best.miou:.1f} %"
        )
    else:
        parts.append(
            f"next-frame consistency goes from {100 * base.next_frame:.1f} to {100 * best.next_frame:.1f} % (better in"
            f" {better} of {frames} frames)"
        )
    if study.has_truth and math.isfinite(best.lag):
        parts.append(f"labels follow a change {best.lag:.1f} frames late")
    if best.coverage < 1 - ALIKE:
        parts.append(f"{100 * best.coverage:.0f} % of the labels are left")
    return f"{', '.join(parts)}, for {best.milliseconds:.0f} ms per frame"


def _harm(study: FilterStudy, row: FilterResult) -> str:
    base = study.unfiltered
    steady = f"has {100 * row.flicker:.1f} % flicker ({100 * base.flicker:.1f} % without)"
    if row.flicker >= base.flicker:
        steady = f"has {100 * row.plain:.1f} % flicker at the same pixel ({100 * base.plain:.1f} % without)"
    if not study.has_truth:
        return f"{steady}, but predicts {100 * row.next_frame:.1f} % of the next labels ({100 * base.next_frame:.1f} %)"
    late = f", and it follows changes {row.lag:.1f} frames late" if math.isfinite(row.lag) else ""
    return (
        f"{steady}, but {100 * row.consistent_wrong:.0f} % of its labels are consistent but wrong"
        f" ({100 * base.consistent_wrong:.0f} %){late}"
    )


def _row(records: Sequence[Record], unfiltered: Sequence[Record]) -> FilterResult:
    qualities = [record.quality for record in records if record.quality is not None]
    headlines = [record.statistics.headline for record in records if record.statistics is not None]

    def mean(name: str) -> float:
        return macro_mean([getattr(quality, name) for quality in qualities])

    return FilterResult(
        filters=qualities[0].filters,
        plain=macro_mean([record.image_space.flicker_percent for record in records]) / 100,
        alpha=macro_mean([row.alpha.value for row in headlines]),
        **{name: mean(name) for name in MEANS},
        better=_better(records, unfiltered),
    )


def _better(records: Sequence[Record], unfiltered: Sequence[Record]) -> tuple[int, int]:
    """Return the number of frames whose filtered labels have a higher quality, and the number of all frames."""
    before = {record.unit.scene: record.quality for record in unfiltered}
    pairs: list[tuple[float, float]] = []
    for record in records:
        a, b = record.quality, before.get(record.unit.scene)
        if a is not None and b is not None:
            kind = "accuracy_by_frame" if any(math.isfinite(v) for v in b.accuracy_by_frame) else "next_frame_by_frame"
            pairs += zip(getattr(a, kind), getattr(b, kind), strict=False)
    return sum(a > b for a, b in pairs), len(pairs)
