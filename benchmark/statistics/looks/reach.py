"""Agreement beside its ceiling: what two frames would agree on had their labels not depended on the view.

Voxels hold more than one thing, and frames see different parts of them: that sets a ceiling to agreement, which falls
as voxels grow. The share of it that a model reaches does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.core.types import Float64
from semstab.model.statistics import ClassReach, Interval, Reach
from semstab.model.voxels import VoxelTable
from semstab.statistics.looks.entries import ObservationSample
from semstab.statistics.sampling import Asked, InfluenceSums, answers, asked_of, influence_sums, question_of, value

SUPPORT = 100.0
"""Places from which on a class matters to the verdict, where no critical classes are named."""


def reach_of(
    sample: ObservationSample,
    table: VoxelTable,
    sums: InfluenceSums | None = None,
    *,
    critical: Sequence[str] = (),
    least: float = SUPPORT,
) -> Reach:
    """Alpha between frames in the sampled voxels beside that of the sample's limit, of all classes and of each.

    table     the whole map: how many places a class has
    sums      of the map with that sample, where they are there already
    critical  names of the classes that matter; where none is given, those with `least` places or more
    """
    sums = influence_sums(table, sample=sample.shared()) if sums is None else sums
    repeated = table.op >= 2
    places = (table.evidence[repeated] / table.op[repeated, None]).sum(axis=0)
    found = answers(reach_by(sums, table.K))
    return reach_from(sample.by, places, sums, found, critical=critical, least=least)


def reach_by(sums: InfluenceSums, K: int) -> Iterator[Asked]:
    """For `answers`: alpha in the sample, its ceiling, and what share of it is reached, by K classes together and by
    each."""
    assert sums.seen is not None
    assert sums.limit is not None
    question = question_of(sums)
    yield asked_of(sums.seen, "alpha_between", question=question)
    yield asked_of(sums.limit, "alpha_between", question=question)
    for k in (None, *range(K)):
        yield asked_of(sums, "reached", k, question)


def reach_from(
    by: str,
    places: Float64,
    sums: InfluenceSums,
    found: Sequence[Interval],
    *,
    critical: Sequence[str] = (),
    least: float = SUPPORT,
) -> Reach:
    """The same from the sums of a map with a sample, whose limit has labels `by` whom; places (K,) of each class.

    found  the answers to `reach_by`
    """
    assert sums.seen is not None
    assert sums.limit is not None
    names = sums.classes or tuple(str(k) for k in range(len(places)))
    named = set(critical) & set(names)
    alpha, ceiling, reached, *of_classes = found
    return Reach(
        by=by,
        voxels=round(float(sums.seen["voxels"].sum())),
        alpha=alpha,
        ceiling=ceiling,
        reached=reached,
        classes=tuple(
            ClassReach(
                name,
                float(places[k]),
                name in named if named else bool(places[k] >= least),
                value(sums.seen, "alpha_between", k),
                value(sums.limit, "alpha_between", k),
                of_classes[k],
            )
            for k, name in enumerate(names)
        ),
    )
