"""What the order of backbones owes to the looks that some of them left out."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

from semstab.model.contrast import CommonLooks, Ignored
from semstab.model.events import Events
from semstab.model.measures import Quantity, mean
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, alpha_between, psa
from semstab.statistics.looks.common import common, decided, psa_bounds
from semstab.statistics.looks.entries import CellObservations


@dataclass(frozen=True, eq=False)
class Shared:
    """The logs of backbones on common looks, the same before any was reduced, what is compared first, what is said."""

    logs: Mapping[str, Events]
    whole: Mapping[str, Events]
    primary: Quantity
    found: CommonLooks


def common_looks(looks: Mapping[str, CellObservations]) -> Shared:
    """The looks that all backbones made; where labels are compared with scores, each as its largest class.

    Two frames that both give a class 0.6 agree by 0.52 in expectation, and entirely by alpha between frames; labels
    know no such looks. So that neither gains, both are compared by what they decide.
    """
    names = list(looks)
    both = common([looks[name] for name in names])
    mixed = len({own.soft for own in looks.values()}) > 1
    reduce = decided if mixed else (lambda log: log)
    logs = dict(zip(names, map(reduce, both.logs), strict=True))
    ignoring = dict(zip(names, map(reduce, both.ignoring), strict=True))
    value = {name: alpha_between(log.table()) for name, log in logs.items()}
    ignored = tuple(
        Ignored(name, missing, *psa_bounds(ignoring[name]), alpha_between(ignoring[name].table()))
        for name, missing in zip(names, both.missing, strict=True)
    )
    order = tuple(sorted(names, key=lambda name: -value[name]))
    first = next(iter(logs.values()))
    bounds = {row.backbone: (row.psa_low, row.psa_high) for row in ignored}
    by_psa = sorted(names, key=lambda name: -mean(psa(logs[name].table())))
    return Shared(
        logs,
        dict(zip(names, both.logs, strict=True)),
        ALPHA if mixed else ALPHA_BETWEEN,
        CommonLooks(
            voxels=len(first.ix),
            observations=len(first),
            decided=mixed,
            ignored=ignored,
            order=order,
            order_ignored=tuple(row.backbone for row in sorted(ignored, key=lambda row: -row.alpha)),
            bounded=all(bounds[better][0] >= bounds[worse][1] for better, worse in itertools.pairwise(by_psa)),
        ),
    )
