"""The georeference of a scene: a projection, and the affine map that brings the scene's coordinates into it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64
from semstab.errors import ConfigError, MissingDependencyError, summarize_error

INSTALL = "pip install 'semstab[geo]'"
"""The advice of a message where a package of the extra `geo` is not installed."""

SINGULAR = 1e-6
"""Determinant of a matrix that flattens the scene; matrices of topocentric scenes have 1 to a thousandth."""


Row = tuple[float, float, float]
Linear = tuple[Row, Row, Row]

IDENTITY: Linear = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Georeference:
    """Coordinates in the projection are `linear` times those of the scene, plus `offset`.

    A scene whose axes are the projection's (x to the east, y to the north, z up) has the identity as `linear`. A
    topocentric scene is turned against the projection by the convergence of meridians, and scaled by some parts in ten
    thousand.

    Attributes:
        crs: The coordinate reference system as WKT (2:2019), in metres.
        offset: (east, north, up), metres.
        linear: Rows of the (3, 3) matrix.
    """

    crs: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    linear: Linear = IDENTITY

    @classmethod
    def from_crs(
        cls, crs: str, offset: tuple[float, float, float], where: str, linear: Linear | None = None
    ) -> Georeference:
        """Make it of a reference system in any words that pyproj reads: EPSG:32615, '+proj=utm +zone=15', WKT.

        Raises:
            ConfigError: For one that is not known, or not in metres, and for a matrix that cannot be inverted, with
                `where` (the file or option).
            MissingDependencyError: Without pyproj.
        """
        if linear is not None and not abs(np.linalg.det(np.array(linear))) > SINGULAR:
            raise ConfigError(f"{where}: the matrix from the scene to the projection cannot be inverted; correct it")
        return cls(wkt(crs, where), offset, IDENTITY if linear is None else linear)

    @property
    def name(self) -> str:
        """Name of the reference system, with its number, if any: 'WGS 84 / UTM zone 15N (EPSG:32615)'."""
        name = re.search(r'"([^"]*)"', self.crs)
        number = re.search(r'ID\["EPSG",\s*(\d+)\]\s*\]\s*$', self.crs)
        return f"{name[1] if name else 'a projection'}{f' (EPSG:{number[1]})' if number else ''}"

    @property
    def turned(self) -> bool:
        """Return whether the scene's axes are not those of the projection."""
        return self.linear != IDENTITY

    def along(self, points: Float64) -> Float64:
        """Return points (n, 3) of the scene along the axes of the projection, without the offset."""
        along: Float64 = points @ np.array(self.linear).T if self.turned else points
        return along

    def projected(self, points: Float64) -> Float64:
        """Return points (n, 3) of the scene in the projection."""
        projected: Float64 = self.along(points) + np.array(self.offset)
        return projected

    def back_along(self, points: Float64) -> Float64:
        """Return in the scene's coordinates points (n, 3) of the projection less the offset."""
        back: Float64 = np.linalg.solve(np.array(self.linear), points.T).T if self.turned else points
        return back

    def in_scene(self, points: Float64) -> Float64:
        """Return points (n, 3) of the projection in the scene's coordinates."""
        return self.back_along(points - np.array(self.offset))


def wkt(crs: str, where: str) -> str:
    """Return the WKT of a projected reference system in metres, with its number, if any; errors as `of`."""
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise MissingDependencyError(f"{where}: a georeference needs pyproj; {INSTALL}") from error
    try:
        system = CRS.from_user_input(crs)
    except (CRSError, RecursionError) as error:  # a text of braces is read as JSON
        hint = "write it as EPSG:32615, a PROJ string or WKT"
        raise ConfigError(
            f"{where}: {crs[:80]!r} is no reference system ({summarize_error(error)[:80]}); {hint}"
        ) from error
    units = {axis.unit_name for axis in system.axis_info[:2]}
    if not system.is_projected or units != {"metre"}:
        raise ConfigError(
            f"{where}: {system.name} has axes in {', '.join(sorted(units))}; project it, to UTM for example"
        )
    number = system.to_epsg()
    return str((system if number is None else CRS.from_epsg(number)).to_wkt())
