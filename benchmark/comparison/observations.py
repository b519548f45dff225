"""Models on the observations that all of them made, and how their order depends on those that some left out."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64, Mask
from semstab.data.contrast import ComparedObservations, Ignored
from semstab.data.events import Events
from semstab.data.measures import mean
from semstab.data.statistics import LabelledPairs
from semstab.errors import DataError
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.agreement import ALPHA, ONE_HOT, psa
from semstab.statistics.cluster_sums import ClusterSums, chance_of
from semstab.statistics.cluster_sums import value as value_of
from semstab.statistics.observations import SpotObservations, same_spots
from semstab.statistics.silence import mean_products, pairs_labelled


@dataclass(frozen=True, eq=False)
class CommonObservations:
    """Models of one scene with their common observations.

    Attributes:
        shared: For each model the answers for spots and views to which all models gave a label, at the same pixels.
        ignoring: For each model the answers that any model gave, with one more class, the last, for those that the
            model left without a label.
        missing: Share of these answers that the model left without a label.
    """

    shared: tuple[SpotObservations, ...]
    ignoring: tuple[SpotObservations, ...]
    missing: tuple[float, ...]


def common_observations(models: Sequence[SpotObservations]) -> CommonObservations:
    """Return the common observations of samples.

    Where the pixel beside has no label of one model, its second answer is of another pixel than that of the others, or
    there is none: such observations are not common, since alpha would differ though all labels are the same.

    Raises:
        DataError: If they differ in K.
    """
    if len({sample.K for sample in models}) > 1:
        raise DataError("samples with different classes cannot be compared; fuse both with the same classes")
    models = same_spots(models)
    of, first = _numbered(models)
    labelled, silent, near, far = np.zeros((4, len(models), len(first)))
    for k, (numbers, sample) in enumerate(zip(of, models, strict=True)):
        labelled[k] = np.bincount(numbers[sample.label < sample.K], minlength=len(first))
        silent[k] = np.bincount(numbers[sample.label == sample.K], minlength=len(first))
        near[k], far[k] = (np.bincount(numbers, squares, len(first)) for squares in (sample.near, sample.far))
    elsewhere = (near == near[0]).all(axis=0) & (far != far[0]).any(axis=0)
    common: Mask = (labelled > 0).all(axis=0) & (silent == 0).all(axis=0) & ~elsewhere
    answers = labelled + silent
    most = labelled.max(axis=0)
    # a frame that repeats another one of its view gives no answer of its own: it leaves nothing out
    left_out = np.where(answers > 0, silent, most)
    asked = SpotObservations.stacked(models).only(first)
    shared, ignoring = [], []
    for sample, numbers, ignored in zip(models, of, left_out, strict=True):
        shared.append(sample.only(common[numbers]))
        ignoring.append(_filled(sample.labelled(), asked, ignored))
    shares = np.where(answers > 0, silent / np.maximum(answers, 1), 1.0)
    missing = tuple(float(np.average(share, weights=most)) if most.any() else math.nan for share in shares)
    return CommonObservations(tuple(shared), tuple(ignoring), missing)


def _numbered(models: Sequence[SpotObservations]) -> tuple[list[Int64], Int64]:
    """Return the number of each answer's observation, the same in all models, and one answer of each observation."""
    views = max((len(sample.views) for sample in models), default=1)
    key = np.concatenate([sample.spot.astype(np.int64) * views + sample.view for sample in models])
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    return np.split(of, np.cumsum([len(sample) for sample in models])[:-1]), first


def _filled(sample: SpotObservations, asked: SpotObservations, ignored: Float64) -> SpotObservations:
    """Return a model's answers, with a further class for the answers that it `ignored` (n,) of each observation."""
    further = asked.only(np.repeat(np.arange(len(asked)), ignored.astype(np.int64)))
    none = np.full(len(further), sample.K, np.uint16)
    further = dataclasses.replace(further, label=none, neighbour=none, beyond=none)
    return dataclasses.replace(SpotObservations.stacked([sample, further]), K=sample.K + 1, classes=(), distances=None)


def psa_bounds(log: Events) -> tuple[float, float]:
    """Return the least and the largest mean PSA, whatever the observations of the last class would have been.

    Manski (1990, American Economic Review 80): pairs of observations of which one is missing agree never, or always.
    """
    low, labelled_share = (mean_products(log, shares) for shares in (log.evidence[:, :-1], 1 - log.evidence[:, -1:]))
    missing = 1 - labelled_share
    high = low + np.where(missing > ONE_HOT, missing, 0.0)  # rounding leaves nothing out
    return (float(low.mean()), float(high.mean())) if len(low) else (math.nan, math.nan)


@dataclass(frozen=True, eq=False)
class SharedObservations:
    """Sums of each model's common observations, their logs, and the comparison itself."""

    sums: Mapping[str, ClusterSums]
    logs: Mapping[str, Events]
    compared: ComparedObservations


def compared_observations(samples: Mapping[str, SpotObservations]) -> SharedObservations:
    """Return the observations that all models made, and how their order depends on those that some left out."""
    names = list(samples)
    common = common_observations([samples[name] for name in names])
    shared, ignoring = (dict(zip(names, answers, strict=True)) for answers in (common.shared, common.ignoring))
    logs = {name: sample.observations() for name, sample in shared.items()}
    sums: dict[str, ClusterSums] = {}
    edge: float | None = None
    for name, sample in shared.items():
        sums[name] = sums_of_spots(sample, edge)
        edge = sums[name].answers[0].edge
    ignored = []
    for name, missing in zip(names, common.missing, strict=True):
        log, model_sums = ignoring[name].observations(), sums_of_spots(samples[name])
        pairs = LabelledPairs(pairs_labelled(log), chance_of(model_sums.answers[0]))
        ignored.append(
            Ignored(name, missing, *psa_bounds(log), pairs.of_all(min(value_of(model_sums, ALPHA.key), 1.0)))
        )
    first = next(iter(logs.values()))
    bounds = {row.model: (row.psa_low, row.psa_high) for row in ignored}
    by_psa = sorted(names, key=lambda name: -mean(psa(logs[name].table())))
    compared = ComparedObservations(
        spots=len(first.ix),
        observations=len(first),
        ignored=tuple(ignored),
        order=_falling({name: value_of(sums[name], ALPHA.key) for name in names}),
        order_ignored=_falling({row.model: row.alpha for row in ignored}),
        bounded=all(bounds[better][0] >= bounds[worse][1] for better, worse in itertools.pairwise(by_psa)),
    )
    return SharedObservations(sums, logs, compared)


def _falling(alpha: Mapping[str, float]) -> tuple[str, ...]:
    """Return the models by alpha, the highest first; a model whose alpha is undefined, as it gives one class, last."""
    return tuple(sorted(alpha, key=lambda name: (math.isnan(alpha[name]), -alpha[name])))
