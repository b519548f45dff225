"""The answer about several models: a ranking by alpha of the observations that all of them made, with ties."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from semstab.core.types import THESE_FRAMES, THIS_SCENE, Scope
from semstab.data.labels import sharing_classes
from semstab.data.measures import SBD, VSS
from semstab.data.records import Record, Result
from semstab.data.statistics import Estimate, Interval, short
from semstab.datasets import GROUND_TRUTH
from semstab.metrics import macro_mean
from semstab.report.filter_study import filter_studies
from semstab.report.means import ENOUGH, by_model, pooled
from semstab.statistics.agreement import ALPHA
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import difference, mean_of, scope_of
from semstab.statistics.observations import CellObservations
from semstab.statistics.paired_differences import compared_observations, holm

Value = TypeVar("Value")


@dataclass(frozen=True)
class Difference:
    """Alpha of a model less that of another on common observations, the mean over scenes, with its interval.

    Attributes:
        p_holm: p-value, corrected for all pairs of models.
        scope: What varies in the interval.
        undecided: Why nothing may be claimed; '' where something may.
        shown: Whether the difference is shown: Holm's p-value is below 0.05, the interval excludes 0, and it is not
            `silent`.
        silent: Whether the first two hold, but the more stable model owes that to what it leaves out: its alpha is the
            lower one if what has no label counts as disagreeing (`Ignored.alpha`).
    """

    model: str
    other: str
    value: float
    low: float
    high: float
    scenes: int
    p_holm: float
    scope: Scope
    undecided: str
    shown: bool
    silent: bool = False


@dataclass(frozen=True)
class Ranking:
    """Models by alpha of their common observations.

    Attributes:
        ranks: Each rank and its models, the most stable first. A rank is 1 plus the number of models that are shown to
            be more stable, so that models without a shown difference can share it.
        differences: Of all pairs, each in the order of the models in the run.
        unranked: Models whose map is nearly one class, about which alpha tells nothing.
        apart: Models with other classes than most, which cannot be compared with those.
    """

    ranks: tuple[tuple[int, tuple[str, ...]], ...]
    differences: tuple[Difference, ...]
    unranked: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()


def ranking(result: Result) -> Ranking:
    """Return the ranking of a run's models by the observations that all of them made; empty for one model.

    Scenes in which not all models have observations do not count. Filters are not ranked: frames that share a memory
    agree by it.
    """
    if filter_studies(result):
        return Ranking((), ())
    records = [record for record in result.select() if record.unit.model != GROUND_TRUTH]
    models = by_model(records)
    unranked = tuple(name for name, of_scenes in models.items() if all(map(_is_uninformative, of_scenes)))
    names = tuple(name for name in models if name not in unranked)
    scenes = (_files([record for record in records if record.unit.scene == scene]) for scene in result.scenes)
    return replace(_ranking(tuple(filter(None, scenes)), names), unranked=unranked if len(models) > 1 else ())


Files = tuple[tuple[str, Path, int], ...]
"""The models of a scene, their files of observations, and when these were written."""


def _files(records: list[Record]) -> Files:
    """Return the files of a scene; none where a model has none."""
    files = [(record.unit.model, record.observations_file) for record in records]
    present = tuple(
        (name, file, file.stat().st_mtime_ns) for name, file in files if file is not None and file.is_file()
    )
    return present if len(present) == len(files) > 1 else ()


@functools.lru_cache(maxsize=8)
def _ranking(scenes: tuple[Files, ...], names: tuple[str, ...]) -> Ranking:
    """Return the ranking of some models, which terminal and report ask for one after the other."""
    common = [_common(files) for files in scenes] if len(names) > 1 else []
    apart = tuple(name for name in names if common and name not in common[0][0])
    names = tuple(name for name in names if name not in apart)
    known = [each for each in common if {*names} <= each[0].keys()]
    of_all = {name: macro_mean([alpha[name] for _, alpha in known]) for name in names} if known else {}
    return replace(ranked([sums for sums, _ in known], names, of_all=of_all), apart=apart)


def ranked(
    scenes: Sequence[Mapping[str, ClusterSums]],
    names: Sequence[str],
    places: Sequence[str] | None = None,
    of_all: Mapping[str, float] | None = None,
) -> Ranking:
    """Return the ranking of models by their sums in each scene; each place counts once, however often it was flown.

    of_all is alpha of each model if what it leaves out counts as disagreeing: a model is not shown to be more stable
    than another where that is lower.
    """
    places = [str(k) for k in range(len(scenes))] if places is None else places
    pairs = list(itertools.combinations(names, 2)) if scenes else []
    changes = [over_places([_difference(by_model[b], by_model[a]) for by_model in scenes], places) for a, b in pairs]
    p_values = holm([change.p_value for change in changes])
    differences = []
    for (a, b), change, p in zip(pairs, changes, p_values, strict=True):
        differs = change.decided and p < 1 - change.level and not change.low <= 0 <= change.high
        silent = bool(differs and of_all) and change.value * ((of_all or {})[b] - (of_all or {})[a]) < 0
        interval = change.value, change.low, change.high
        shown = differs and not silent
        differences.append(Difference(b, a, *interval, len(scenes), p, change.scope, change.undecided, shown, silent))
    alpha = {name: _mean_alpha(name, scenes, places) for name in names} if scenes else {}
    better = dict.fromkeys(alpha, 0)
    for each in differences:
        if each.shown:
            better[each.other if each.value > 0 else each.model] += 1
    order = sorted(alpha, key=lambda name: (better[name], -alpha[name]))
    ranks = tuple((1 + n, tuple(tied)) for n, tied in itertools.groupby(order, key=better.__getitem__))
    return Ranking(ranks, tuple(differences))


def over_places(values: Sequence[Interval], places: Sequence[str]) -> Interval:
    """Return the mean over places of the mean over the scenes of each place, with its interval."""
    return mean_of([mean_of(of_place) for of_place in _by_place(values, places)])


def _by_place(values: Sequence[Value], places: Sequence[str]) -> list[list[Value]]:
    return [[own for own, of in zip(values, places, strict=True) if of == place] for place in dict.fromkeys(places)]


def _mean_alpha(name: str, scenes: Sequence[Mapping[str, ClusterSums]], places: Sequence[str]) -> float:
    alpha = [value(by_model[name], ALPHA.key) for by_model in scenes]
    return macro_mean([macro_mean(of_place) for of_place in _by_place(alpha, places)])


def _difference(new: ClusterSums, other: ClusterSums) -> Interval:
    """Return alpha of a model less that of another on common observations, for another flight if frames allow that."""
    scopes = {scope_of(sums) for sums in (new, other)}
    return difference(new, other, ALPHA.key, scope=THESE_FRAMES if THESE_FRAMES in scopes else THIS_SCENE)


def answers(result: Result) -> Iterator[str]:
    """Yield the answer: the difference of two models, or the ranks of more."""
    ranked = ranking(result)
    known = [each for each in ranked.differences if not math.isnan(each.low)]
    if len(ranked.differences) == 1 and known:
        (one,) = known
        relation = "does not differ significantly from"
        if one.undecided:
            relation = "is not compared with"
        elif one.shown:
            relation = "is more stable than" if one.value > 0 else "is less stable than"
        elif one.silent:
            relation = "is not shown to differ from"
        change = Estimate(one.value, one.low, one.high).text("+")
        scenes = f", {one.scenes} of {len(result.scenes)} scenes" if one.scenes < len(result.scenes) else ""
        why = f"; {one.undecided}" if one.undecided else ""
        yield f"{one.model} {relation} {one.other}: alpha {change}{scenes}{why}"
    elif known:
        ranks = "; ".join(f"{rank}. {', '.join(names)}" for rank, names in ranked.ranks)
        yield f"most stable first: {ranks}"
        yield (
            "ranks are by alpha of the observations that all models made; a rank is 1 plus the number of models shown"
            f" to be more stable (Holm over {len(ranked.differences)} pairs)"
        )
    for each in (each for each in ranked.differences if each.silent):
        better, worse = (each.model, each.other) if each.value > 0 else (each.other, each.model)
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


CLEAR: Mapping[str, tuple[float, float]] = {"VSS (OP>=3)": (0.02, 0.0), "SBD": (0.002, 0.2), "mIoU": (0.02, 0.0)}
"""How far two models have to lie apart for a measure to tell their order: at least so far, and by at least such a share
of the larger value. VSS and mIoU are from 0 to 1, SBD is in bits."""


def contradictions(result: Result, ranked: Ranking) -> Iterator[str]:
    """Yield one sentence where other measures clearly say the opposite of an order that alpha shows.

    It has the numbers of the first such pair, that with the largest difference of alpha, and names the others.
    """
    models = by_model(result.select())
    opposed = []
    for each in sorted((each for each in ranked.differences if each.shown), key=lambda each: -abs(each.value)):
        better, worse = (each.model, each.other) if each.value > 0 else (each.other, each.model)
        if against := _against(models[better], models[worse]):
            opposed.append((better, worse, against))
    if not opposed:
        return
    better, worse, against = opposed[0]
    *others, last = against
    listed = f"{', '.join(others)} and {last}" if others else last
    more = "; ".join(f"{first} above {second}" for first, second, _ in opposed[1:4])
    rest = f"; so it is for {more}{', ...' if len(opposed) > 4 else ''}" if more else ""
    yield (
        f"the measures do not agree on this order: alpha is higher for {better}, but {listed}"
        f" {'are' if others else 'is'} better for {worse}{rest}; look at the classes before you choose"
    )


def _against(better: Sequence[Record], worse: Sequence[Record]) -> list[str]:
    """Return the measures that are clearly better for the second model: 'VSS (OP>=3) (.942 against .863)'."""
    found = []
    of_both = (_measured(worse), _measured(better))
    for name, (least, share) in CLEAR.items():
        higher, lower = (values[name] for values in of_both)
        gain = lower - higher if name == "SBD" else higher - lower  # less drift is better
        if gain >= max(least, share * max(abs(higher), abs(lower))):
            found.append(f"{name} ({short(higher, digits=3)} against {short(lower, digits=3)})")
    return found


def _measured(records: Sequence[Record]) -> dict[str, float]:
    """Return the measures of a model beside alpha, over its scenes; NaN where unknown."""
    recurrent = pooled(records).recurrent
    enough = recurrent.voxels >= ENOUGH
    known = [record.statistics.correctness for record in records if record.statistics is not None]
    miou = macro_mean([right.miou.value for right in known if right is not None]) if any(known) else math.nan
    vss, sbd = (recurrent[measure] if enough else math.nan for measure in (VSS, SBD))
    return {"VSS (OP>=3)": vss, "SBD": sbd, "mIoU": miou}


def _is_uninformative(record: Record) -> bool:
    return record.statistics is not None and record.statistics.verdict.level == "uninformative"


def _common(files: Files) -> tuple[Mapping[str, ClusterSums], Mapping[str, float]]:
    """Return the sums of the observations that all models of a scene with the same classes made.

    Beside them is alpha of each model if what it leaves out counts as disagreeing.
    """
    loaded = {name: CellObservations.load(file) for name, file, _ in files}
    names = sharing_classes({name: each.classes for name, each in loaded.items()})
    if not names:
        return {}, {}
    both = compared_observations({name: loaded[name] for name in names})
    return both.sums, {row.model: row.alpha for row in both.compared.ignored}
