"""Scans in order, each against those before it: where poses jump, and scans that do not fit those next to them."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.chain import GAPS, LEAST_SEEN, STRIKING_SHIFT, Chain, Link
from semstab.check.continuity import LEAVE_OUT, MOST_BAD, MOST_NAMED
from semstab.check.reprojection import CONSISTENT, Pair, frames_at, motion, reader
from semstab.check.scan_sample import ScanPoints
from semstab.check.surfaces import LEAST_RANGE, Surfaces
from semstab.check.verdict import Verdict
from semstab.core.arrays import evenly
from semstab.core.types import Float64, Int64
from semstab.data.frames import Frame
from semstab.datasets import Scene

STRETCHES, LENGTH = 4, 10
"""Stretches of successive scans that are read, and scans of each; of a short sequence all are read."""

NEXT_TO, NEAREST = 8000, 3
"""Points of a scan whose labels are held against those of the points next to them in it, and the number of these."""

SOUGHT = 2
"""Every second of the points that are sought is held against surfaces."""

ROUNDS, OUTLYING, STIFF = 5, 3.0, 0.01
"""Rounds of a robust fit; multiple of the median distance from which on a point counts less; weight, as a share of the
points, by which a motion that the surfaces hardly show, such as along a street, remains small."""

LEAST_DISTANCE = 0.001
"""Metres that distances from surfaces vary by at least."""

CONTRADICTS = 0.01
"""Two scans contradict each other from this error on, if it is far from the usual one."""

APART_BY = max(GAPS)


@dataclass(frozen=True, eq=False)
class InOrder:
    """Scans in order.

    Attributes:
        chain: Their agreement.
        rows: (2, n) rows of points of a scan, and of the nearest points of a later one, by their positions.
        own: (2, n) rows of points of a scan, and of the nearest other points of the same scan, by its position.
        labels: (N,) ids of all points of a scan, by its position; empty without labels.
        ignore: The id of points without a label.
    """

    chain: Chain
    rows: dict[Pair, Int64]
    own: dict[int, Int64]
    labels: dict[int, Int64]
    ignore: int


def in_order(scene: Scene, indices: Sequence[int], source: str | None) -> InOrder:
    """Read scans in order and compare them; those that cannot be read are passed over."""
    links, rows, nearest_in_scan = dict[Pair, Link](), dict[Pair, Int64](), dict[int, Int64]()
    labels, ignore, positions = dict[int, Int64](), -1, list[int]()
    last = deque[tuple[int, Float64, ScanPoints]](maxlen=APART_BY)
    for position, scan in _read(scene, indices, source):
        if len((cloud := ScanPoints(scan)).rows) < LEAST_SEEN:
            continue
        positions.append(position)
        if source is not None:
            labels[position], ignore = scan.predicted.reshape(-1).astype(np.int64), scan.ignore_id
            nearest_in_scan[position] = _nearest_in(cloud)
        for other, T, before in last:
            if position - other in GAPS:
                turn, shift = motion(T, scan.T_wc)
                links[other, position], rows[other, position] = _linked(before, cloud, turn, shift)
        last.append((position, scan.T_wc, cloud))
    errors = [links[pair].error for pair in itertools.pairwise(positions) if pair in links]
    usual = float(np.nanmedian(errors)) if np.isfinite(errors).any() else math.nan
    return InOrder(Chain(positions, links, usual, contradicting=CONTRADICTS), rows, nearest_in_scan, labels, ignore)


def _read(scene: Scene, indices: Sequence[int], source: str | None) -> Iterator[tuple[int, Frame]]:
    count, most = len(indices), STRETCHES * LENGTH
    starts = [round(k * (count - LENGTH) / (STRETCHES - 1)) for k in range(STRETCHES)]
    wanted = range(count) if count <= most else sorted({start + k for start in starts for k in range(LENGTH)})
    return frames_at(set(wanted), indices, reader(scene, source), passing_over=True)


def _nearest_in(cloud: ScanPoints) -> Int64:
    """Return (2, n) rows of points of a scan, and of the nearest other points of it."""
    chosen = np.array(evenly(len(cloud.rows), NEXT_TO), dtype=np.int64)
    nearest = cloud.tree.query(cloud.points[chosen], k=1 + NEAREST)[1][:, 1:]
    rows: Int64 = cloud.rows[np.stack([np.repeat(chosen, NEAREST), nearest.ravel()])]
    return rows


def _linked(first: ScanPoints, second: ScanPoints, turn: Float64, shift: Float64) -> tuple[Link, Int64]:
    """Return how far one scan is off the surfaces of another, and the rows (2, n) of points that meet there."""
    around = Surfaces.nearest_to(first.sought[::SOUGHT], second.points, second.tree, turn, shift)
    distance, nearest = second.tree.query(first.sought @ turn.T + shift)
    meet = distance <= CONSISTENT * np.linalg.norm(first.sought, axis=1)
    rows = np.stack([first.rows[first.chosen], second.rows[nearest]])[:, meet]
    return Link(offset(around), float(around.near.mean()), math.nan, False, math.nan), rows


def offset(around: Surfaces) -> float:
    """Return the motion of points that brings them onto the surfaces, as a share of their range; NaN with few points.

    It is one step of a registration of points to planes, by iteratively reweighted least squares: ground, on which
    points stay wherever a scan is moved, does not hide an offset from the walls.
    """
    if np.count_nonzero(around.met) < LEAST_SEEN:
        return math.nan
    points = (around.points @ around.turn.T + around.shift)[around.met]
    normal, range_ = around.normal[around.met], np.linalg.norm(around.points[around.met], axis=1)
    distance = np.einsum("ni,ni->n", points - around.middle[around.met], normal)
    rows, step = np.hstack([np.cross(points, normal), normal]), np.zeros(6)
    limit = OUTLYING * max(float(np.median(np.abs(distance))), LEAST_DISTANCE)
    stiff = STIFF * len(rows) * np.diag([float(np.median(range_)) ** 2] * 3 + [1.0] * 3)
    for _ in range(ROUNDS):
        weighted = rows / np.maximum(1, np.abs(distance + rows @ step) / limit)[:, None]
        step = -np.linalg.solve(weighted.T @ rows + stiff, weighted.T @ distance)
    moved = np.cross(step[:3], points) + step[3:]
    return float(np.median(np.linalg.norm(moved, axis=1) / np.maximum(range_, LEAST_RANGE)))


def with_order(verdict: Verdict, scene: Scene, indices: Sequence[int], ordered: InOrder) -> Verdict:
    """Return the verdict, with scans that do not fit those next to them, and the scan at which poses jump."""
    if verdict.state != "sound":
        return verdict
    chain = ordered.chain

    def scan_name(position: int) -> str:
        return scene.frame_name(indices[position])

    misfits = chain.misfits()
    if len(misfits) <= MOST_BAD * len(chain.positions):
        verdict = verdict.remarking(*_said_of(misfits, chain, scan_name))
    rest = chain.without([position for position, _ in misfits])
    breaks = [(pair, chain.error(*pair), chain.usual) for pair in rest.breaks()]
    if (jump := breaks[0] if breaks else rest.shift()) is None:
        return verdict
    (before, first), error, usual = jump
    text = (
        f"poses jump at scan {scan_name(first)}: points of scans before it are {error:.2%} of their range off the"
        f" surfaces of scans from it on, {usual:.2%} in others as far apart; correct the poses, or fuse the two"
        f" parts one by one (--frames :{indices[before] + 1} and --frames {indices[first]}:)"
    )
    return verdict.refuted(text) if error >= STRIKING_SHIFT * usual else verdict.remarking(text)


def _said_of(misfits: Sequence[tuple[int, Pair]], chain: Chain, name_of: Callable[[int], str]) -> Iterator[str]:
    for position, (before, after) in misfits[:MOST_NAMED]:
        yield (
            f"scan {name_of(position)} does not fit scans {name_of(before)} and {name_of(after)} next to it: its"
            f" points are {chain.error(before, position):.1%} of their range off, theirs"
            f" {chain.error(before, after):.2%}; its pose is wrong: correct it, or leave the scan out ({LEAVE_OUT})"
        )
