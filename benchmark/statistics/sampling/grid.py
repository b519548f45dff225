"""The influences of places and frames on a number, and the variance that they make together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64, Int64
from semstab.model.statistics import THIS_MAP, Question
from semstab.statistics.blocks import gradient_of
from semstab.statistics.sampling.arrangement import Cells, arranged
from semstab.statistics.sampling.influence import Statistic
from semstab.statistics.sampling.reach import Errors, Spread, one_thread, spreads
from semstab.statistics.sampling.where import Where

TINY = 1e-12
"""A variance below is none."""

# --- Influences -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grid:
    """Influences of places and frames on a number.

    places   (G, 3) cubes in which something counts, frames (F,) groups
    block    (G,) influence of each cube; they sum to 0
    cell     (G, F) of each group of frames in each cube
    size     (G, F) how much is in it, all (G,) in each cube
    one_off  what the number falls by where all that counts was not as the first sum has it, but the opposite
    """

    places: Int64
    frames: Int64
    block: Float64
    cell: Float64
    size: Float64
    all: Float64
    edge: float
    step: int
    one_off: float

    def units(self, question: Question) -> int:
        """How many independent looks there can be."""
        return len(self.places) if question == THIS_MAP else min(len(self.places), len(self.frames) * self.step)

    def unseen(self, question: Question, level: float) -> float:
        """What so many looks without a single error may have missed."""
        return self.one_off * float(1 - ((1 - level) / 2) ** (1 / self.units(question)))

    def minus(self, other: Grid) -> Grid:
        """The influences on the difference of two numbers."""
        places, rows = np.unique(np.concatenate([self.places, other.places]), axis=0, return_inverse=True)
        frames, columns = np.unique(np.concatenate([self.frames, other.frames]), return_inverse=True)
        block, everything = np.zeros(len(places)), np.zeros(len(places))
        cell, size = np.zeros((len(places), len(frames))), np.zeros((len(places), len(frames)))
        row, column = np.split(rows.ravel(), [len(self.places)]), np.split(columns, [len(self.frames)])
        for grid, sign, at, to in zip((self, other), (1.0, -1.0), row, column, strict=True):
            block[at] += sign * grid.block
            everything[at] += grid.all
            cell[np.ix_(at, to)] += sign * grid.cell
            size[np.ix_(at, to)] += grid.size
        return Grid(
            places, frames, block, cell, size, everything, self.edge, self.step, max(self.one_off, other.one_off)
        )


def influences(where: Where, columns: Float64, of: Statistic, halves: Float64 | None = None) -> Grid | None:
    """The influences of sums (m, C) by cube and group of frames.

    halves (m, 2): of places that two frames saw, what of the first two sums both are held for, instead of half each.
    """
    total = columns.sum(axis=0)
    gradient = gradient_of(of, total)
    everything = np.abs(where.by_place(columns[:, 1]))
    some = everything > TINY * everything.sum()
    if some.sum() < 2 or everything.sum() < TINY or not np.isfinite(gradient).all():
        return None  # of 150 classes hardly any voxel may count as stable: 1e-112 of all of them
    own: Float64 = columns @ gradient
    shared = own if halves is None else own + gradient[0] * (halves[:, 0] - total[0] / total[1] * halves[:, 1])
    by_frame, size = where.by_both(shared), where.by_both(np.abs(columns[:, 1]))
    seen = size.sum(axis=0) > 0
    return Grid(
        where.places[some],
        where.frames[seen],
        where.by_place(own)[some],
        by_frame[np.ix_(some, seen)],
        size[np.ix_(some, seen)],
        everything[some],
        where.edge,
        where.step,
        one_off=abs(float(gradient[0] * total[1])),
    )


# --- Variance ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwoWay:
    """The variance that comes from places, and what frames add to it.

    most  degrees of freedom that it has at most
    """

    places: Spread
    frames: Spread
    most: float = math.inf

    @property
    def total(self) -> float:
        """Of both."""
        return self.places.variance + self.frames.variance

    @property
    def degrees(self) -> float:
        """Of the sum (Satterthwaite 1946)."""
        parts = (self.places, self.frames)
        spread = sum(part.variance**2 / part.degrees for part in parts if part.variance > 0)
        return min(max(self.total**2 / spread, 1.0) if spread else self.places.degrees, self.most)

    def half(self, level: float) -> float:
        """Half the width of the interval."""
        from scipy import special

        if not self.degrees > 0:
            return math.nan
        return float(special.stdtrit(self.degrees, (1 + level) / 2)) * math.sqrt(self.total)


NO_FRAMES = Spread(0.0, math.inf, 1.0)


def two_way(grids: Sequence[Grid], questions: Sequence[Question]) -> list[TwoWay]:
    """V_frame + V_block - V_cell (Cameron, Gelbach, Miller 2011): pairs that share a frame or a block count once."""
    cells = arranged([grid.places for grid in grids])
    errors = [Errors(at, grid.block, grid.all) for at, grid in zip(cells, grids, strict=True)]
    with one_thread():
        found = [TwoWay(own, NO_FRAMES) for own in spreads(errors)]
        of_flight = [k for k, grid in enumerate(grids) if questions[k] != THIS_MAP and len(grid.frames) > 1]
        beyond = _beyond_places([(grids[k], cells[k], found[k].places) for k in of_flight])
    for k, frames in zip(of_flight, beyond, strict=True):
        found[k] = TwoWay(found[k].places, frames)
    return found


def _beyond_places(grids: Sequence[tuple[Grid, Cells, Spread]]) -> list[Spread]:
    """What frames add: the influences that one frame, and those near it, have in places far from each other."""
    errors = []
    for cells, (grid, _, _) in zip(arranged([grid.frames[:, None] for grid, _, _ in grids]), grids, strict=True):
        influence, size = grid.cell.sum(axis=0), grid.size.sum(axis=0)
        influence = influence - size / size.sum() * influence.sum()  # of a sample they do not sum to 0
        errors.append(Errors(cells, influence, size))
    found = spreads(errors, modelled=True)
    return [
        _less_of_places(own, frames, grid, places, by_place) if frames.variance > 0 else NO_FRAMES
        for own, frames, (grid, places, by_place) in zip(errors, found, grids, strict=True)
    ]


def _less_of_places(errors: Errors, frames: Spread, grid: Grid, places: Cells, by_place: Spread) -> Spread:
    """The variance that comes from frames less what is within places that err alike."""
    order, influence = errors.cells.order, errors.influence[errors.cells.order]
    cell = grid.cell[np.ix_(places.order, order)]
    together = cell.T @ places.kernel(by_place.parts.block, by_place.parts.weight) @ cell
    blocks, of = np.unique(frames.parts.block, return_inverse=True)
    kernels = [errors.cells.of.kernel(block)[: len(order), : len(order)] for block in blocks.tolist()]
    plain = np.array([influence @ kernel @ influence for kernel in kernels])
    inside = np.array([(kernel * together).sum() for kernel in kernels])
    beyond = np.where(plain > 0, np.maximum(1 - inside / np.where(plain > 0, plain, 1.0), 0.0), 0.0)
    return Spread.mean(frames.parts.times(beyond[of]))


def apart(one: Grid, other: Grid, question: Question) -> TwoWay:
    """Of two flights over the same places: each adds the variance of its own frames."""
    both, first, second = two_way([one.minus(other), one, other], [THIS_MAP, question, question])
    if question == THIS_MAP:
        return both
    joined = TwoWay(first.frames, second.frames)
    return TwoWay(both.places, Spread(joined.total, joined.degrees, first.frames.block))
