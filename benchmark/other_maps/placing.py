"""Place another program's points in the voxels of a run, and find axes, units and offsets under which they fit it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import nearest
from semstab.core.types import Float64, Int32, Int64
from semstab.data.georeference import Georeference
from semstab.data.voxel_keys import voxel_keys
from semstab.errors import ConfigError, DataError
from semstab.other_maps.classes import NONE
from semstab.other_maps.clouds import System

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in a unit of the coordinates."""

AXES = ("x", "y", "z")

FARTHEST = 2**30
"""The largest index of a voxel along an axis."""


@dataclass(frozen=True)
class MapPlacement:
    """How coordinates of a file become those of the run's scene: times the unit, by its axes, plus the shift.

    Attributes:
        unit: A key of UNITS.
        axes: The axes of the file that become x, y and z, as ('x', '-z', 'y').
        shift: (3,) metres that are added.
        system: The system of the result: of the scene, or of its projection.
    """

    unit: str = "m"
    axes: tuple[str, str, str] = AXES
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    system: System = "scene"

    @classmethod
    def parse(cls, unit: str, axes: str | None, shift: str | None, system: System) -> MapPlacement:
        """Read the options.

        Raises:
            ConfigError: For one that cannot be read.
        """
        if unit not in UNITS:
            raise ConfigError(f"--unit {unit}: not known; {nearest(unit, [*UNITS])}")
        file_axes = tuple((axes or "x,y,z").replace(" ", "").split(","))
        if sorted(name.lstrip("-") for name in file_axes) != [*AXES] or any(name[:2] == "--" for name in file_axes):
            raise ConfigError(f"--axes {axes}: write the axes of the file that become x, y and z, as x,-z,y")
        try:
            metres = [float(number) for number in (shift or "0,0,0").split(",")]
        except ValueError:
            metres = []
        if len(metres) != 3 or not np.isfinite(metres).all():
            raise ConfigError(f"--shift {shift}: write three numbers in metres, as 0.05,0.05,0.05")
        a, b, c = file_axes
        x, y, z = metres
        return cls(unit, (a, b, c), (x, y, z), system)

    @cached_property
    def matrix(self) -> Float64:
        """(3, 3) from the file's axes to the result's, times the unit."""
        rows = [np.eye(3)[AXES.index(name[-1])] * (-1 if name[0] == "-" else 1) for name in self.axes]
        return UNITS[self.unit] * np.array(rows)

    def __call__(self, points: Float64, georeference: Georeference | None) -> Float64:
        """Return points (n, 3) of the file in coordinates of the scene, metres."""
        placed: Float64 = points if self.unit == "m" and self.axes == AXES else points @ self.matrix.T
        if any(self.shift):
            placed = placed + np.array(self.shift)
        if self.system == "projection" and georeference is not None:
            return georeference.in_scene(placed)
        return placed

    def options(self, before: MapPlacement) -> str:
        """Return the options that lead here from another placement."""
        words = [] if self.system == before.system else [f"--frame {self.system}"]
        words += [] if self.unit == before.unit else [f"--unit {self.unit}"]
        words += [] if self.axes == before.axes else [f"--axes={','.join(self.axes)}"]
        shift = ",".join(f"{round(metres, 9) + 0.0:g}" for metres in self.shift)
        return " ".join(words if self.shift == before.shift else [*words, f"--shift={shift}"])


@dataclass(frozen=True, eq=False)
class Grid:
    """The voxels of a map, sorted by ix, iy, iz, with a class each.

    Attributes:
        index: (n, 3).
        label: (n,) rows of the run's classes, NONE without one.
        size: Edge of a voxel, metres.
    """

    index: Int32
    label: Int64
    size: float

    def __len__(self) -> int:
        return len(self.index)

    @property
    def centers(self) -> Float64:
        """(n, 3) centres in the scene, metres."""
        return centers(self.index, self.size)

    @cached_property
    def _low(self) -> Int64:
        low: Int64 = self.index.min(axis=0).astype(np.int64)
        return low

    @cached_property
    def _high(self) -> Int64:
        high: Int64 = self.index.max(axis=0).astype(np.int64)
        return high

    @cached_property
    def _keys(self) -> Int64:
        (keys,) = voxel_keys(self.index)
        return keys

    def rows(self, index: npt.NDArray[np.integer[Any]]) -> Int64:
        """Return (m,) the row of each voxel (m, 3), NONE where the map does not hold it."""
        inside = np.flatnonzero(((index >= self._low) & (index <= self._high)).all(axis=1))
        size = self._high - self._low + 1
        x, y, z = (index[inside].astype(np.int64) - self._low).T
        keys = (x * size[1] + y) * size[2] + z
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        rows = np.full(len(index), NONE, np.int64)
        held = self._keys[at] == keys
        rows[inside[held]] = at[held]
        return rows


def centers(index: npt.NDArray[np.integer[Any]], size: float) -> Float64:
    """Return the centres (n, 3) of voxels, metres."""
    return (index.astype(np.float64) + 0.5) * size


def index_of(points: Float64, size: float) -> Int64:
    """Return the voxel (n, 3) of each point, floor(x / r); those out of reach are in the farthest voxel."""
    return np.clip(np.floor(points / size), -FARTHEST, FARTHEST).astype(np.int64)


def fused(points: Float64, row: Int64, size: float, K: int) -> Grid:
    """Return the voxels that hold points, each with the class that most of its labelled points (n,) have.

    Of classes with as many points the first one counts.

    Raises:
        DataError: If the points span too many voxels.
    """
    index, of = np.unique(index_of(points, size), axis=0, return_inverse=True)
    if (np.abs(index) >= FARTHEST).any():
        raise DataError(f"points lie more than {FARTHEST * size:.3g} m from the origin; check their unit (--unit)")
    labelled = row != NONE
    pairs, votes = np.unique(of.reshape(-1)[labelled] * K + row[labelled], return_counts=True)
    voxel, label = pairs // K, pairs % K
    order = np.lexsort((label, -votes, voxel))
    first = np.append(True, np.diff(voxel[order]) != 0) if len(order) else np.zeros(0, np.bool_)
    majority = np.full(len(index), NONE, np.int64)
    majority[voxel[order][first]] = label[order][first]
    return Grid(index.astype(np.int32), majority, size)


MOST_STEPS = 64
"""The most points along an edge of a triangle."""


def on_surface(points: Float64, row: Int64, faces: npt.NDArray[np.integer[Any]], step: float) -> tuple[Float64, Int64]:
    """Return points on triangles, a step apart or less, each with the class of the nearest corner, after the corners.

    Args:
        points: (n, 3) corners.
        row: (n,) their classes.
        faces: (m, 3) corners of each triangle.
        step: In the unit of the points.
    """
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(longest / step), 1, MOST_STEPS).astype(np.int64)
    placed, rows = [points], [row]
    for n in np.unique(steps[steps > 1]).tolist():
        split_faces = faces[steps == n]
        i, j = np.divmod(np.arange((n + 1) ** 2), n + 1)
        weights = np.stack([i, j, n - i - j], axis=1)[i + j <= n] / n
        weights = weights[weights.max(axis=1) < 1]
        placed.append(np.einsum("wc,fcd->fwd", weights, points[split_faces]).reshape(-1, 3))
        rows.append(row[split_faces][:, weights.argmax(axis=1)].reshape(-1))
    return np.concatenate(placed), np.concatenate(rows)


# --- Hypotheses -------------------------------------------------------------------------------------------------------

SAMPLE = 20_000
"""The points that hypotheses are tried on."""

MUCH = 0.05
"""A hypothesis is told if its score is larger by this much or more, and the gap to 1 shrinks by LESS or more."""

LESS = 0.2

TIE = 0.005
"""Difference of scores up to which the first hypothesis counts."""

SMALL = 0.1
"""A unit is not tried that makes a cloud smaller than this share of the map."""


@dataclass(frozen=True)
class Found:
    """A placement that fits the map much better than the given one; the share of voxels that meet the map's in each."""

    placement: MapPlacement
    options: str
    share: float
    share_before: float
    same: float
    same_before: float

    def line(self) -> str:
        """Return the finding in a line, with the option that applies it."""
        return (
            f"fits better with {self.options}: {self.share:.0%} of its voxels lie in the map and {self.same:.0%} have"
            f" its class, instead of {self.share_before:.0%} and {self.same_before:.0%}"
        )


@dataclass(frozen=True)
class _Fit:
    share: float
    same: float

    @property
    def score(self) -> float:
        return (self.share + self.same) / 2


def better_placement(
    points: Float64, row: Int64, grid: Grid, given: MapPlacement, georeference: Georeference | None
) -> Found | None:
    """Return a placement under which much more of a cloud lies in the map with its class, or None without one.

    The search tries frames of reference, units and exchanged or mirrored axes, then shifts by half a voxel along each
    axis.

    Args:
        points: (n, 3) in the file's coordinates.
        row: (n,) their classes.
        grid: The map.
        given: The configured placement.
        georeference: Georeference of the scene, or None.
    """
    sample = np.linspace(0, len(points) - 1, min(SAMPLE, len(points))).astype(np.int64)
    points, row = points[sample], row[sample]
    extent = float(np.linalg.norm(np.ptp(grid.index, axis=0) + 1.0)) * grid.size

    def fit(placement: MapPlacement) -> _Fit:
        placed = placement(points, georeference)
        if placement.unit != given.unit and float(np.linalg.norm(np.ptp(placed, axis=0))) < SMALL * extent:
            return _Fit(0.0, 0.0)
        cloud_grid = fused(placed, row, grid.size, int(max(row.max(), 0)) + 1) if _near(placed, grid) else None
        if cloud_grid is None:
            return _Fit(0.0, 0.0)
        at = grid.rows(cloud_grid.index)
        same = (at != NONE) & (cloud_grid.label != NONE) & (cloud_grid.label == grid.label[at])
        return _Fit(float(np.mean(at != NONE)), float(same.mean()))

    before = fit(given)
    best, of_best = given, before
    for hypotheses in (_turned(given, georeference), None):
        tried = [*(hypotheses or _shifted(best, grid.size))]
        fits = [fit(placement) for placement in tried]
        top = max(of_this.score for of_this in fits)
        k = next(k for k, of_this in enumerate(fits) if of_this.score >= top - TIE)
        if top - of_best.score > MUCH and 1 - top < (1 - LESS) * (1 - of_best.score):
            best, of_best = tried[k], fits[k]
    if best == given:
        return None
    return Found(best, best.options(given), of_best.share, before.share, of_best.same, before.same)


def _near(placed: Float64, grid: Grid) -> bool:
    """Return whether the boxes around points and map meet."""
    low, high = placed.min(axis=0), placed.max(axis=0)
    return bool(
        (high >= grid.index.min(axis=0) * grid.size).all()
        and (low <= (grid.index.max(axis=0) + 1) * grid.size).all()
        and (np.abs(placed) < FARTHEST * grid.size).all()
    )


def _turned(configured: MapPlacement, georeference: Georeference | None) -> Iterator[MapPlacement]:
    """Yield placements with other frames, units and axes, those that change least first."""
    systems: Sequence[System] = ("scene",) if georeference is None else ("scene", "projection")
    tried = [
        replace(configured, system=system, unit=unit, axes=(a, b, c))
        for system in systems
        for unit in UNITS
        for order in itertools.permutations(AXES)
        for a, b, c in itertools.product(*((name, f"-{name}") for name in order))
    ]
    yield from sorted(tried, key=lambda placement: _changes(placement, configured))


def _changes(placement: MapPlacement, configured: MapPlacement) -> int:
    axes = sum(axis != before for axis, before in zip(placement.axes, configured.axes, strict=True))
    return 4 * (placement.system != configured.system) + 4 * (placement.unit != configured.unit) + axes


def _shifted(placement: MapPlacement, size: float) -> Iterator[MapPlacement]:
    """Yield placements that are shifted by half a voxel, along all axes first."""
    halves = sorted(itertools.product((-0.5, 0.0, 0.5), repeat=3), key=lambda step: -sum(map(abs, step)))
    for steps in halves:
        x, y, z = (old + step * size for old, step in zip(placement.shift, steps, strict=True))
        if any(steps):
            yield replace(placement, shift=(x, y, z))
