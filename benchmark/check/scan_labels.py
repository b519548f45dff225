"""Labels of scans that belong to other points: another scan's, or in another order of the points."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from semstab.check.chain import LEAST_SEEN
from semstab.check.scan_order import InOrder
from semstab.check.trials import FitContrast
from semstab.core.types import Int64, Mask

FEWER = 0.95
"""The part of the disagreement that remains with the right labels, at most."""

Labels = Mapping[int, Int64]


@dataclass(frozen=True)
class Order:
    """Another order of labels: what it is called, and the labels of a scan, or None if there are none for it."""

    name: str
    of: Callable[[Labels, int], Int64 | None]
    mend: str


def _of_scan(by: int, labels: Labels, position: int) -> Int64 | None:
    other = labels.get(position + by)
    return other if other is not None and len(other) == len(labels[position]) else None


def _reversed(labels: Labels, position: int) -> Int64 | None:
    return labels[position][::-1]


ORDERS = (
    Order("are one scan late", functools.partial(_of_scan, 1), "give each scan the labels of its own points"),
    Order("are one scan early", functools.partial(_of_scan, -1), "give each scan the labels of its own points"),
    Order("are in reversed order of the points", _reversed, "reverse them"),
)


def wrong_order(ordered: InOrder) -> str | None:
    """Return the line on labels that fit the points clearly better another way; completes 'labels of X ...'.

    They fit if points next to each other have the same label, in a scan and from scan to scan.
    """
    for order in ORDERS:
        fits = contrast(ordered, order)
        if fits.is_clear and 1 - fits.other <= FEWER * (1 - fits.given):
            return (
                f"{order.name} ({fits.other:.1%} of the points agree with points next to them so, in the scan and in"
                f" others, {fits.given:.1%} now): {order.mend}"
            )
    return None


def contrast(ordered: InOrder, order: Order) -> FitContrast:
    """Return the agreement of labels as given and in another order, over scans: within each, and with later ones."""
    given, ignore = ordered.labels, ordered.ignore
    other = {p: reordered for p in given if (reordered := order.of(given, p)) is not None}

    def agreement_at(labels: Labels, position: int) -> float:
        scan_labels = labels[position]
        row, nearest = ordered.own[position]
        within = agreement(scan_labels[row], scan_labels[nearest], ignore)
        between = [
            agreement(scan_labels[rows[0]], labels[b][rows[1]], ignore)
            for (a, b), rows in ordered.rows.items()
            if a == position and b in other
        ]
        return (within + float(np.mean(between))) / 2 if between else math.nan

    return FitContrast.between([agreement_at(given, p) for p in other], [agreement_at(other, p) for p in other])


def agreement(first: Int64, second: Int64, ignore: int) -> float:
    """Return the share of equal labels (n,), of points that have one; NaN for too few."""
    labelled: Mask = (first != ignore) & (second != ignore)
    return float(np.mean((first == second)[labelled])) if labelled.sum() >= LEAST_SEEN else math.nan
