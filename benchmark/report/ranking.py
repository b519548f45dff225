"""The answer about several models in sentences: their order by alpha, and measures that contradict it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from semstab.comparison.ranking import Ranking, rank_models
from semstab.data.measures import SBD, VSS
from semstab.data.records import Record, Result
from semstab.data.statistics import Estimate, short
from semstab.metrics import macro_mean
from semstab.report.filter_study import filter_studies
from semstab.report.means import ENOUGH, by_model, pooled
from semstab.report.narrative import nearly_all
from semstab.statistics.verdict import LEAST_CLASSES


def ranking(result: Result) -> Ranking:
    """Return the ranking of a run's models. Filters are not ranked: frames that share a memory agree by it."""
    return Ranking((), ()) if filter_studies(result) else rank_models(result)


def order_of_models(result: Result) -> Iterator[str]:
    """Yield the answer: the difference of two models, or the ranks of more; of videos the order by flicker."""
    if not result.maps.records:
        yield from _by_flicker(result)
        return
    ranked = ranking(result)
    defined = [pair for pair in ranked.differences if not math.isnan(pair.low)]
    if len(ranked.differences) == 1 and defined:
        (difference,) = defined
        relation = "does not differ significantly from"
        if difference.undecided:
            relation = "is not compared with"
        elif difference.shown:
            relation = "is more stable than" if difference.value > 0 else "is less stable than"
        elif difference.silent:
            relation = "is not shown to differ from"
        change = Estimate(difference.value, difference.low, difference.high)
        way = "higher"
        if difference.value < 0:
            change, way = Estimate(-difference.value, -difference.high, -difference.low), "lower"
        scenes = (
            f", {difference.scenes} of {len(result.scenes)} scenes" if difference.scenes < len(result.scenes) else ""
        )
        why = f"; {difference.undecided}" if difference.undecided else ""
        yield f"{difference.model} {relation} {difference.other}: alpha {way} by {change.text()}{scenes}{why}"
    elif defined:
        ranks = "; ".join(f"{rank}. {', '.join(names)}" for rank, names in ranked.ranks)
        yield f"most stable first: {ranks}"
        yield (
            "rank: 1 plus the number of models with a significantly higher alpha (Holm over"
            f" {len(ranked.differences)} pairs), where all models have a label"
        )
    for pair in (pair for pair in ranked.differences if pair.silent):
        better, worse = (pair.model, pair.other) if pair.value > 0 else (pair.other, pair.model)
        yield (
            f"{better} has a higher alpha than {worse} on what both label, but a lower one if what it leaves out counts"
            " as disagreeing"
        )
    yield from contradictions(result, ranked)
    if ranked.unranked:
        yield f"not ranked, as nearly the whole map is one class: {', '.join(ranked.unranked)}"
    if ranked.apart and not ranked.ranks:
        yield f"not compared, as their classes differ: {', '.join(ranked.apart)}"
    elif ranked.apart:
        yield f"not compared, as the classes of the others differ: {', '.join(ranked.apart)}"


def _by_flicker(result: Result) -> Iterator[str]:
    """Yield the models of videos, the one with the least flicker first, and why the flicker of others says nothing."""
    models = by_model(result.select())
    silent = {name: text for name, records in models.items() if (text := _silence(records))}
    ranked = [name for name in least_flicker_first(models) if name not in silent]
    if len(ranked) > 1:
        yield f"least flicker first: {', '.join(f'{k}. {name}' for k, name in enumerate(ranked, start=1))}"
    yield from silent.values()


def least_flicker_first(models: Mapping[str, Sequence[Record]]) -> list[str]:
    """Return the models by their mean flicker over scenes; those without a number last."""
    flicker = {
        name: macro_mean([record.image_space.compensated_flicker_percent for record in records])
        for name, records in models.items()
    }
    return sorted(flicker, key=lambda name: (math.isnan(flicker[name]), flicker[name]))


def _silence(records: Sequence[Record]) -> str:
    """Return why flicker of videos says nothing: nearly all of each is one class; '' if flicker is informative."""
    pixels = [record.pixels for record in records if record.pixels is not None]
    if not pixels or not all(video.effective_classes < LEAST_CLASSES for video in pixels):
        return ""
    least = min(pixels, key=lambda video: video.largest_share)
    share, model = nearly_all(least.largest_share), records[0].unit.model
    return f"uninformative: {share} of the labels of {model} are {least.largest_class}"


CLEAR: Mapping[str, tuple[float, float]] = {"VSS (OP>=3)": (0.02, 0.0), "SBD": (0.002, 0.2), "mIoU": (0.02, 0.0)}
"""How far two models have to lie apart for a measure to tell their order: at least so far, and by at least such a share
of the larger value. VSS and mIoU are from 0 to 1, SBD is in bits."""


def contradictions(result: Result, ranked: Ranking) -> Iterator[str]:
    """Yield one sentence where other measures clearly say the opposite of an order that alpha shows.

    It has the numbers of the first such pair, that with the largest difference of alpha, and names the others.
    """
    models = by_model(result.select())
    opposed = []
    for pair in sorted((pair for pair in ranked.differences if pair.shown), key=lambda pair: -abs(pair.value)):
        better, worse = (pair.model, pair.other) if pair.value > 0 else (pair.other, pair.model)
        if against := _against(models[better], models[worse]):
            opposed.append((better, worse, against))
    if not opposed:
        return
    better, worse, against = opposed[0]
    *earlier, last = against
    listed = f"{', '.join(earlier)} and {last}" if earlier else last
    more = "; ".join(f"{first} above {second}" for first, second, _ in opposed[1:4])
    rest = f"; so it is for {more}{', ...' if len(opposed) > 4 else ''}" if more else ""
    yield (
        f"measures disagree: alpha is better for {better}, but {listed}"
        f" {'are' if earlier else 'is'} better for {worse}{rest}; compare the classes before you choose"
    )


def _against(better: Sequence[Record], worse: Sequence[Record]) -> list[str]:
    """Return the measures that are clearly better for the second model: 'VSS (OP>=3) (.942 against .863)'."""
    clearly_better = []
    of_both = (_measured(worse), _measured(better))
    for name, (least, share) in CLEAR.items():
        higher, lower = (values[name] for values in of_both)
        gain = lower - higher if name == "SBD" else higher - lower  # less drift is better
        if gain >= max(least, share * max(abs(higher), abs(lower))):
            clearly_better.append(f"{name} ({short(higher, digits=3)} against {short(lower, digits=3)})")
    return clearly_better


def _measured(records: Sequence[Record]) -> dict[str, float]:
    """Return the measures of a model other than alpha, over its scenes; NaN if unknown."""
    recurrent = pooled(records).recurrent
    enough = recurrent.voxels >= ENOUGH
    correctness = [record.statistics.correctness for record in records if record.statistics is not None]
    miou = (
        macro_mean([right.miou_op2.value for right in correctness if right is not None])
        if any(correctness)
        else math.nan
    )
    vss, sbd = (recurrent[measure] if enough else math.nan for measure in (VSS, SBD))
    return {"VSS (OP>=3)": vss, "SBD": sbd, "mIoU": miou}
