"""Where a scene lies on Earth: the projection of its coordinates, and the offset by which they were made small."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.errors import ConfigError, MissingDependencyError, summarize_error

INSTALL = "pip install 'semstab[geo]'"
"""What a message says where a package of the extra `geo` is not installed."""


@dataclass(frozen=True)
class Georeference:
    """Coordinates in the projection are those of the scene plus the offset: x to the east, y to the north, z up.

    crs     the coordinate reference system as WKT (2:2019), in metres
    offset  (east, north, up), metres
    """

    crs: str
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, crs: str, offset: tuple[float, float, float], where: str) -> Georeference:
        """From a reference system in any words that pyproj reads: EPSG:32615, '+proj=utm +zone=15', WKT.

        Raises ConfigError with `where` (the file or option) for one that is not known, or not in metres,
        MissingDependencyError without pyproj.
        """
        return cls(wkt(crs, where), offset)


def wkt(crs: str, where: str) -> str:
    """The WKT of a projected reference system in metres, with its number where there is one; errors as `of`."""
    try:
        from pyproj import CRS
        from pyproj.exceptions import CRSError
    except ImportError as error:
        raise MissingDependencyError(f"{where}: a georeference needs pyproj; {INSTALL}") from error
    try:
        known = CRS.from_user_input(crs)
    except (CRSError, RecursionError) as error:  # a text of braces is read as JSON
        hint = "write it as EPSG:32615, a PROJ string or WKT"
        raise ConfigError(
            f"{where}: {crs[:80]!r} is no reference system ({summarize_error(error)[:80]}); {hint}"
        ) from error
    units = {axis.unit_name for axis in known.axis_info[:2]}
    if not known.is_projected or units != {"metre"}:
        raise ConfigError(
            f"{where}: {known.name} has axes in {', '.join(sorted(units))}; project it, to UTM for example"
        )
    number = known.to_epsg()
    return str((known if number is None else CRS.from_epsg(number)).to_wkt())
