"""One line a backbone that a drone team can act on, from thresholds that stand here and in docs/metrics.md."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend
from semstab.backends.shared.association import back_project, voxel_index
from semstab.core.types import Float64, Int64
from semstab.errors import DataError
from semstab.metrics import dominant
from semstab.metrics.agreement import shared_rows, voxel_keys
from semstab.model.frames import Frame
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.model.statistics import (
    NEXT_FLIGHT,
    CeilingShare,
    ClassCeilingShare,
    Estimate,
    Flipping,
    HeadlineStatistics,
    Interval,
    Level,
    Losses,
    StabilityVerdict,
)
from semstab.model.voxels import VoxelTable
from semstab.statistics.accumulate import Cubes, CubeSums, cluster_sums_of
from semstab.statistics.agreement import psa, ratio_of
from semstab.statistics.cluster_sums import ClusterSums, value
from semstab.statistics.intervals import LEAST_FRAMES, EstimateSpec, confidence_intervals, question_of, spec_of
from semstab.statistics.observations import ObservationSample

RELIABLE = 0.8
"""Krippendorff's alpha from which data may be relied on (Krippendorff 2018, Content Analysis, ch. 12)."""

TENTATIVE = 2 / 3
"""Alpha from which tentative conclusions are allowed; below, none (same source)."""

LEAST_CEILING = 0.5
"""A ceiling below which the share of it that is reached says little."""

DANGEROUS = 0.05
"""Largest share of the stable places that may be wrong."""

LEAST_VOXELS, LEAST_BLOCKS = 100, 16
"""Voxels seen twice or more, and blocks of them, below which there is no verdict."""

ADVICE: dict[Level, str] = {
    "stable": "its labels agree from frame to frame; act on them",
    "partly stable": "act on its labels but for those of the class named",
    "usable": "act on a label only where several frames agree",
    "unstable": "do not act on its labels",
    "undecided": "the data do not decide; fly with more overlap, or more of the scene",
    "too coarse": "voxels are too large for what the labels show; use smaller ones",
    "misleading": "do not take agreement for truth",
    "no verdict": "too few places were seen twice; fly with more overlap",
}
"""What to do at each level."""

ACTED_ON, LEAST_FLIPS = ("stable", "partly stable", "usable"), 0.001
"""Levels at which labels are acted on, and the share of places that flip from which on it is said beside them."""

ONE_CLASS = "hardly more than one class was predicted, so that agreement says nothing"


def verdict(
    backbone: str,
    *,
    headline: HeadlineStatistics,
    ceiling: CeilingShare | None,
    flips: Flipping | None = None,
    voxels: int,
    share: float,
    blocks: int,
) -> StabilityVerdict:
    """Judge by the intervals, never by values alone, from voxels with OP >= 2 only.

    headline       numbers of these voxels
    ceiling        alpha between frames and its ceiling; where that is not known, alpha is judged as it is
    flips          the locations about which frames do not agree: few of them hide in any mean
    voxels, share  how many they are, and of all voxels
    blocks         in how many cubes of space they lie
    """
    enough = voxels >= LEAST_VOXELS and blocks >= LEAST_BLOCKS
    level = _level(headline, ceiling) if enough else "no verdict"
    support = f"{voxels} places seen twice or more, {share:.0%} of the map"
    if level == "no verdict":
        return StabilityVerdict(level, f"{backbone}: no verdict, {ONE_CLASS if enough else ADVICE[level]}; {support}")
    psa, wrong = headline.psa, headline.wrong_of_stable
    found = [f"two frames agree on {psa.value:.0%} of the places ({psa.low:.0%} to {psa.high:.0%})"]
    found += [_alpha(headline.alpha_between)] if ceiling is None else _reached(ceiling)
    if not math.isnan(wrong.low):
        found.append(f"{wrong.value:.0%} of the stable places are wrong ({wrong.low:.0%} to {wrong.high:.0%})")
    if flips is not None and level in ACTED_ON:
        found += _flips(flips)
    basis = _basis(headline, ceiling)
    reason = basis.undecided if level == "undecided" and basis.undecided else ADVICE[level]
    return StabilityVerdict(level, f"{backbone}: {level}, {reason}: {', '.join(found)}; {support}; {_holds(basis)}")


def _basis(headline: HeadlineStatistics, ceiling: CeilingShare | None) -> Interval:
    """The interval that decides."""
    return headline.alpha_between if ceiling is None else ceiling.share


def _holds(basis: Interval) -> str:
    """For what the intervals hold."""
    if basis.question == NEXT_FLIGHT:
        return f"intervals are for the next flight, from {basis.frames} frames"
    frames = f"these {basis.frames} frames: fly {LEAST_FRAMES} or more" if basis.frames else "these frames: keep a log"
    return f"intervals are for {frames} to tell of the next flight"


def _alpha(alpha: Estimate) -> str:
    return f"alpha between frames {alpha.value:.2f} ({alpha.low:.2f} to {alpha.high:.2f}), its ceiling not known"


def _flips(flips: Flipping) -> list[str]:
    if flips.seen < 0.5:
        return ["most places were seen too seldom to tell which of them flip"]
    if not flips.share.value >= LEAST_FLIPS:
        return []
    share, part = flips.share, f", {flips.part:.0%} of that between {flips.a} and {flips.b}" if flips.a else ""
    far = f"{share.value:.1%} of the places of this map flip ({share.low:.1%} to {share.high:.1%})"
    return [f"not to act on: {far}{part}"]


def _reached(ceiling: CeilingShare) -> list[str]:
    share = ceiling.share
    far = f"({share.low:.0%} to {share.high:.0%}) of its ceiling, {ceiling.ceiling.value:.2f} by {ceiling.by}"
    chance = ", no better than chance," if share.value < 0 else ""
    said = [f"alpha between frames {ceiling.alpha.value:.2f}{chance} is {share.value:.0%} {far}"]
    if (worst := ceiling.worst) is not None:
        said.append(f"worst class {worst.name} {_class_share(worst)}")
    return said


def _class_share(row: ClassCeilingShare) -> str:
    if math.isnan(row.share.value):
        return "not known"
    chance = "no better than chance, " if row.share.value < 0 else ""
    return f"{chance}{row.share.value:.0%} ({row.share.low:.0%} to {row.share.high:.0%})"


def _level(headline: HeadlineStatistics, ceiling: CeilingShare | None) -> Level:
    basis = _basis(headline, ceiling)
    if math.isnan(basis.low):
        return "no verdict"
    if headline.wrong_of_stable.low > DANGEROUS:
        return "misleading"
    if basis.low < TENTATIVE or not basis.decided:
        return "unstable" if basis.decided and basis.high < TENTATIVE else "undecided"
    if ceiling is not None and not ceiling.ceiling.value >= LEAST_CEILING:
        return "too coarse"
    if basis.low < RELIABLE:
        return "usable"
    return "stable" if ceiling is None or _every_class_holds(ceiling) else "partly stable"


def _every_class_holds(ceiling: CeilingShare) -> bool:
    """Whether each class that matters allows at least tentative conclusions."""
    return all(row.share.low >= TENTATIVE for row in ceiling.classes if row.counts_for_verdict)


# Agreement beside its ceiling: what two frames would agree on had their labels not depended on the view.
#
# Voxels hold more than one thing, and frames see different parts of them: that sets a ceiling to agreement, which falls
# as voxels grow. The share of it that a model reaches does not.

SUPPORT = 100.0
"""Places from which on a class matters to the verdict, where no critical classes are named."""


def ceiling_share(
    sample: ObservationSample,
    table: VoxelTable,
    sums: ClusterSums | None = None,
    *,
    critical: Sequence[str] = (),
    least: float = SUPPORT,
) -> CeilingShare:
    """Alpha between frames in the sampled voxels beside that of the sample's limit, of all classes and of each.

    table     the whole map: how many places a class has
    sums      of the map with that sample, where they are there already
    critical  names of the classes that matter; where none is given, those with `least` places or more
    """
    sums = cluster_sums_of(table, sample=sample.shared()) if sums is None else sums
    repeated = table.op >= 2
    places = (table.evidence[repeated] / table.op[repeated, None]).sum(axis=0)
    found = confidence_intervals(ceiling_specs(sums, table.K))
    return ceiling_share_from(sample.by, places, sums, found, critical=critical, least=least)


def ceiling_specs(sums: ClusterSums, K: int) -> Iterator[EstimateSpec]:
    """For `answers`: alpha in the sample, its ceiling, and what share of it is reached, by K classes together and by
    each."""
    assert sums.seen is not None
    assert sums.limit is not None
    question = question_of(sums)
    yield spec_of(sums.seen, "alpha_between", question=question)
    yield spec_of(sums.limit, "alpha_between", question=question)
    for k in (None, *range(K)):
        yield spec_of(sums, "reached", k, question)


def ceiling_share_from(
    by: str,
    places: Float64,
    sums: ClusterSums,
    found: Sequence[Interval],
    *,
    critical: Sequence[str] = (),
    least: float = SUPPORT,
) -> CeilingShare:
    """The same from the sums of a map with a sample, whose limit has labels `by` whom; places (K,) of each class.

    found  the answers to `ceiling_specs`
    """
    assert sums.seen is not None
    assert sums.limit is not None
    names = sums.classes or tuple(str(k) for k in range(len(places)))
    named = set(critical) & set(names)
    alpha, ceiling, reached, *of_classes = found
    return CeilingShare(
        by=by,
        voxels=round(float(sums.seen["voxels"].sum())),
        alpha=alpha,
        ceiling=ceiling,
        share=reached,
        classes=tuple(
            ClassCeilingShare(
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


# Geometry or semantics: what agreement would be left if the labels did not depend on the view at all.
#
# View-independent labels are fused under the same poses, depth and noise. What is lost there is geometry's: pixels that
# fall into the wrong voxel, voxels that hold more than one thing. The rest of the loss is the model's.


def ceiling(
    frames: Iterable[Frame],
    make_backend: Callable[[], FusionBackend],
    *,
    world: VoxelTable | None = None,
    views: Iterable[Frame] | None = None,
) -> VoxelTable:
    """The map of view-independent labels: what the fusion of `frames` would be with a model that never errs.

    frames        the frames as they were fused, noise included; one is held at a time
    make_backend  makes a new, empty map of the same voxels: `lambda: create("numba", voxel_size=0.2, num_classes=7)`
    world         a map whose dominant labels are rendered into the frames; where there is none, the frames' own labels
                  count, which are to be the ground truth
    views         the same frames free of the noise that was added to them: labels are seen from there

    With `world` the map itself and no `views` nothing is lost, as each pixel sees the voxel that it falls into. Give
    ground truth, a map of finer voxels, or the frames before noise was added.
    Raises DataError where frames and views do not fit together.
    """
    backend = make_backend()
    for frame in frames if world is None else rendered(frames, world, views):
        backend.integrate(frame)
    return backend.table()


def rendered(frames: Iterable[Frame], world: VoxelTable, views: Iterable[Frame] | None = None) -> Iterator[Frame]:
    """The frames with the labels that the map shows in them: each pixel has the dominant label of the voxel it sees.

    A pixel that sees no voxel of the map is ignored. `views` (the frames themselves where not given) say where a pixel
    sees. Raises DataError where a view is missing or differs in size from its frame.
    """
    labels = _Labels(world)
    for frame, view in ((frame, frame) for frame in frames) if views is None else _paired(frames, views):
        seen = np.full(view.shape, labels.ignore, dtype=labels.dtype)
        seen[view.valid] = labels.at(voxel_index(back_project(view), world.voxel_size, view))
        yield dataclasses.replace(frame, labels=seen, scores=None)


def losses(table: VoxelTable, limit: VoxelTable) -> Losses:
    """Split the disagreement in a model's map by the ceiling's map `limit` of the same voxels.

    Raises DataError where the maps differ in K or voxel size.
    """
    rows, limit_rows = shared_rows(table, limit)
    both = (table.op[rows] >= 2) & (limit.op[limit_rows] >= 2)
    rows, limit_rows = rows[both], limit_rows[both]
    total, geometry = 1 - psa(table)[rows], 1 - psa(limit)[limit_rows]
    cubes = Cubes.of(table.rows(rows), where=np.ones(len(rows), np.bool_))
    means = cubes.means({"total": total, "geometry": geometry, "model": total - geometry})
    means["share"] = np.stack([means["geometry"][:, 0], means["total"][:, 0]], axis=1)
    sums = CubeSums(cubes.cell, cubes.edge, means)
    return Losses(
        voxels=len(rows),
        total=sums.estimate("total", ratio_of).ends,
        geometry=sums.estimate("geometry", ratio_of).ends,
        model=sums.estimate("model", ratio_of, (-1.0, 1.0)).ends,
        share=sums.estimate("share", ratio_of, (0.0, math.inf)).ends,
    )


class _Labels:
    """The dominant label of a map's voxel by its index; `ignore` where the map has no voxel."""

    def __init__(self, world: VoxelTable) -> None:
        if not len(world):
            raise DataError("the map to render has no voxels")
        few = world.K <= IGNORE_8BIT
        self.dtype = np.uint8 if few else np.uint16
        self.ignore = IGNORE_8BIT if few else IGNORE_16BIT
        self._low = world.index.min(axis=0).astype(np.int64)
        self._size = world.index.max(axis=0) - self._low + 1
        (self._keys,) = voxel_keys(world.index)
        self._labels = dominant(world).astype(self.dtype)

    def at(self, index: Int64) -> npt.NDArray[np.integer]:
        """Labels (n,) of voxel indices (3, n)."""
        x, y, z = index - self._low[:, None]
        inside = (
            (np.minimum(np.minimum(x, y), z) >= 0) & (x < self._size[0]) & (y < self._size[1]) & (z < self._size[2])
        )
        key = (x * self._size[1] + y) * self._size[2] + z
        row = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(inside & (self._keys[row] == key), self._labels[row], self.dtype(self.ignore))


def _paired(frames: Iterable[Frame], views: Iterable[Frame]) -> Iterator[tuple[Frame, Frame]]:
    frames, views = iter(frames), iter(views)
    for frame in frames:
        view = next(views, None)
        if view is None or view.shape != frame.shape:
            what = "there is none" if view is None else f"it is {view.shape[1]}x{view.shape[0]}"
            raise DataError(f"frame {frame.index}: needs a view of its size to see labels from; {what}")
        yield frame, view
