"""Why a model that is more stable may still be worse: its accuracy, and signs of labels that cannot flicker."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from semstab.comparison.entries import Entry
from semstab.data.contrast import Contrast
from semstab.data.records import Record
from semstab.data.statistics import short
from semstab.metrics import macro_mean
from semstab.statistics.agreement import ALPHA
from semstab.statistics.correctness import ACCURACY, MIOU
from semstab.statistics.verdict import LIMITS

LEAST_RECALL = 0.25
"""The share of the edges of depth with a border of labels below which labels may be coarse."""

MUCH_LESS = 0.8
"""A number of one model below this part of the other model's number is reported."""


def suspicions(record: Record) -> Iterator[str]:
    """Yield why frames of one model may agree although its labels are poor; nothing if its verdict is not to act."""
    statistics, recall = record.statistics, record.image_space.edge_recall
    if statistics is None or statistics.verdict.level not in ("stable", "usable"):
        return
    if statistics.spots is not None and statistics.spots.labelled < LIMITS.labelled:
        missing = f"{1 - statistics.spots.labelled:.0%} of the locations have no label in most frames"
        yield f"{missing}; what has no label cannot flicker"
    if recall < LEAST_RECALL:
        yield (
            f"only {recall:.0%} of the edges of depth have a border of labels near them: the labels may be coarse,"
            " blurred, or of few objects"
        )


def cautions(
    names: tuple[str, str],
    scenes: Sequence[tuple[Entry, Entry]],
    contrasts: Sequence[Contrast],
) -> Iterator[str]:
    """Yield what stands against the conclusion that the more stable of two models is the better one.

    Nothing if no difference of alpha is shown. With ground truth the accuracy of both is stated, else that there was
    none; then a smaller number of classes, and labels that follow fewer edges of depth.

    Args:
        names: The base and the other model.
        scenes: The numbers of both in each scene.
        contrasts: The other model against the base, over all scenes.
    """
    by_measure = {row.measure: row for row in contrasts if not row.of}
    alpha = by_measure.get(ALPHA.name)
    if alpha is None or not alpha.change:
        return
    stable = int(alpha.change == "better")  # 0: the base is more stable, 1: the other model
    order = (stable, 1 - stable)
    more, less = (names[k] for k in order)
    yield _of_truth(more, less, by_measure, order)
    classes = _means([[_effective_classes(scene[k]) for scene in scenes] for k in order])
    if classes[0] < MUCH_LESS * classes[1]:
        yield (
            f"{more} uses fewer classes than {less} ({classes[0]:.1f} against {classes[1]:.1f} effective classes):"
            " merged classes cannot be confused"
        )
    edges = _means([[scene[k].record.image_space.edge_recall for scene in scenes] for k in order])
    if edges[0] < MUCH_LESS * edges[1]:
        yield (
            f"labels of {more} follow {edges[0]:.0%} of the edges of depth, labels of {less} {edges[1]:.0%}: coarse or"
            " blurred labels flicker less"
        )
    for text in dict.fromkeys(text for scene in scenes for text in suspicions(scene[stable].record)):
        yield f"{more}: {text}"


def _of_truth(more: str, less: str, by_measure: Mapping[str, Contrast], order: tuple[int, int]) -> str:
    rows = [by_measure[q.name] for q in (ACCURACY, MIOU) if q.name in by_measure]
    if not rows:
        return f"more stable means that frames of {more} agree, not that they are right: no ground truth was compared"
    titles = {q.name: f"{q.word} ({q.population})" for q in (ACCURACY, MIOU)}
    pairs = [(row.base, row.other) for row in rows]
    values = [(pair[order[0]], pair[order[1]]) for pair in pairs]
    numbers = ", ".join(
        f"{titles[row.measure]} {short(a, digits=3)} against {short(b, digits=3)}"
        for row, (a, b) in zip(rows, values, strict=True)
    )
    if any(a < b for a, b in values):
        return f"{more} is more stable and less right than {less} ({numbers}): do not take agreement for truth"
    return f"none from the ground truth, {more} is also more often right than {less} ({numbers})"


def _means(of_both: Sequence[Sequence[float]]) -> tuple[float, float]:
    first, second = (macro_mean(values) for values in of_both)
    return first, second


def _effective_classes(entry: Entry) -> float:
    statistics = entry.record.statistics
    return float("nan") if statistics is None or statistics.spots is None else statistics.spots.effective_classes
