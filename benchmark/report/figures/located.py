"""Where a picture of a map lies in the coordinates of the exports: ticks of its axes, its scale bar, and north."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.data.georeference import IDENTITY, Georeference
from semstab.data.topdown import level_axes
from semstab.report.figures.topdown import FromAbove

ALONG = 0.9
"""An edge of the picture has ticks of the coordinate that changes by this much or more in a metre along it."""

MOST_TICKS = 5

NORTH = np.array([0.0, 1.0, 0.0])
"""Grid north, in the axes of a projection."""


@dataclass(frozen=True)
class Edge:
    """An edge of a picture: the name of its coordinate, '' without a coordinate, and where its ticks are.

    Attributes:
        ticks: Share of the edge from its lower or left end, 0 to 1, and the coordinate there in metres.
    """

    name: str
    ticks: tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class Located:
    """A picture of a map in the coordinates of the exports: global with a georeference, else the scene's.

    Attributes:
        matrix: (3, 3): coordinates are `matrix` times (metres to the right, metres up in the picture, 1), on the mean
            height of what is seen.
        size: Width and height in metres.
        to_picture: (3, 3) rows right, up in the picture and towards the viewer, in the scene's axes.
        corner: Metres to the right and up at which the lower left corner lies from the scene's origin.
        georeference: None if the scene has none.
    """

    matrix: Float64
    size: tuple[float, float]
    to_picture: Float64
    corner: tuple[float, float]
    georeference: Georeference | None

    @classmethod
    def from_view(cls, above: FromAbove, georeference: Georeference | None = None) -> Located:
        """Locate the picture of the voxels that are seen."""
        H, W = above.rows.shape
        centers = above.table.centers
        return cls.seen_along(above.axis, above.corner, (W * above.cell, H * above.cell), centers, georeference)

    @classmethod
    def seen_along(
        cls,
        axis: npt.ArrayLike,
        corner: tuple[float, float],
        size: tuple[float, float],
        points: Float64,
        georeference: Georeference | None,
    ) -> Located:
        """Locate a picture from the axis towards its viewer, its corner and size, and points (n, 3) that it shows."""
        axes = np.stack(level_axes(axis))
        away = float((points @ axes[2]).mean()) if len(points) else 0.0
        lower_left = axes.T @ np.array([*corner, away])
        linear = np.array(IDENTITY if georeference is None else georeference.linear)
        offset = np.zeros(3) if georeference is None else np.array(georeference.offset)
        matrix = np.column_stack([linear @ axes[0], linear @ axes[1], linear @ lower_left + offset])
        return cls(matrix, size, axes, corner, georeference)

    def coordinates(self, point: npt.ArrayLike) -> list[float]:
        """Return a point (3,) of the scene in the coordinates of the exports, metres."""
        points = np.asarray(point, np.float64).reshape(1, 3)
        projected: list[float] = (points if self.georeference is None else self.georeference.projected(points))[
            0
        ].tolist()
        return projected

    @property
    def names(self) -> tuple[str, str, str]:
        """Names of the three coordinates."""
        return ("x", "y", "z") if self.georeference is None else ("east", "north", "height")

    @property
    def edges(self) -> tuple[Edge, Edge]:
        """The lower and the left edge; without ticks if no coordinate runs along it."""
        lower, left = (self._edge(k) for k in range(2))
        return lower, left

    def _edge(self, k: int) -> Edge:
        number = int(np.abs(self.matrix[:, k]).argmax())
        step, start = self.matrix[number, k], self.matrix[number, 2]
        if abs(step) < ALONG:
            return Edge("", ())
        values = ticks(*sorted((start, start + step * self.size[k])))
        return Edge(self.names[number], tuple(((value - start) / step / self.size[k], value) for value in values))

    @property
    def system(self) -> str:
        """The name of the coordinate system."""
        return "coordinates of the scene" if self.georeference is None else self.georeference.name

    @property
    def north(self) -> float | None:
        """Degrees clockwise from the top of the picture to grid north; None if north is unknown, or in a side view."""
        if self.georeference is None:
            return None
        right, up, towards = self.to_picture @ np.linalg.solve(np.array(self.georeference.linear), NORTH)
        return None if abs(towards) > 0.5 else math.degrees(math.atan2(right, up))

    def share(self, point: npt.ArrayLike) -> tuple[float, float]:
        """Return where a point (3,) of the scene lies: shares of width and height from the upper left corner."""
        right, up, _ = self.to_picture @ np.asarray(point, np.float64)
        return (right - self.corner[0]) / self.size[0], 1 - (up - self.corner[1]) / self.size[1]


def ticks(low: float, high: float, most: int = MOST_TICKS) -> list[float]:
    """Return round numbers between two ends, at most `most` + 1 of them: multiples of 1, 2 or 5 times 10^n."""
    least = (high - low) / most
    power = 10.0 ** math.floor(math.log10(least))
    step = next(s * power for s in (1, 2, 5, 10) if s * power >= least * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def metres(value: float) -> str:
    """Return a coordinate without needless digits: '576720', '-0.5'."""
    return f"{round(value, 3) + 0.0:.10g}"
