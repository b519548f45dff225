"""The rigid motion that brings a second visit into the frame of reference of the first one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.core.types import Float64
from semstab.data.georeference import Georeference
from semstab.errors import ConfigError, DataError

LEAST_POINTS = 3

FLAT = 1e-3
"""Extent of the points across a line, as a share of that along it, below which they do not tell how to turn."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rotation and a translation by points that both visits know.

    Attributes:
        matrix: (4, 4) from the second visit to the first one.
        residual: Root mean square of the distances that are left, metres.
        points: Number of points.
    """

    matrix: Float64
    residual: float
    points: int

    @classmethod
    def read(cls, file: Path) -> Alignment:
        """Read rows 'x y z x y z', of the first and of the second visit; commas and lines with # are allowed.

        Raises:
            DataError: If it cannot be read, or holds too few points, or points in a line.
        """
        try:
            text = file.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{file}: cannot be read ({type(error).__name__}); give a text file of points") from error
        rows = []
        for number, line in enumerate(text.splitlines(), 1):
            words = line.partition("#")[0].replace(",", " ").split()
            if not words:
                continue
            try:
                row = [float(word) for word in words]
            except ValueError:
                row = []
            if len(row) != 6 or not np.isfinite(row).all():
                raise DataError(f"{file}: line {number}: write x y z of the first visit, then x y z of the second one")
            rows.append(row)
        if len(rows) < LEAST_POINTS:
            raise DataError(f"{file}: {len(rows)} points; give {LEAST_POINTS} or more that both visits know")
        return cls.between(np.array(rows)[:, :3], np.array(rows)[:, 3:], str(file))

    @classmethod
    def between(cls, first: Float64, second: Float64, where: str = "points") -> Alignment:
        """Fit points (n, 3) of the second visit to those of the first one, by least squares (Kabsch 1976).

        Raises:
            DataError: If all points lie in a line.
        """
        from scipy.spatial.transform import Rotation

        centres = first.mean(axis=0), second.mean(axis=0)
        extent = np.linalg.svd(second - centres[1], compute_uv=False)
        if not extent[1] > FLAT * extent[0]:
            raise DataError(f"{where}: the points lie in a line, which does not tell how to turn; add one beside it")
        rotation, distance = Rotation.align_vectors(first - centres[0], second - centres[1])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.as_matrix()
        matrix[:3, 3] = centres[0] - matrix[:3, :3] @ centres[1]
        return cls(matrix, float(distance) / float(np.sqrt(len(first))), len(first))


def between(
    first: Georeference | None, second: Georeference | None, alignment: Alignment | None, where: str
) -> Float64:
    """Return the matrix (4, 4) from the scene of the second visit to that of the first one.

    By points if there are some, else by the georeferences, which may have other offsets, else the identity.

    Raises:
        ConfigError: If only one visit has a georeference, or their projections differ.
    """
    if alignment is not None:
        return alignment.matrix
    if first is None and second is None:
        return np.eye(4)
    if first is None or second is None or first.crs != second.crs:
        names = " and ".join("none" if georeference is None else georeference.name for georeference in (first, second))
        raise ConfigError(
            f"{where}: the georeferences of the visits differ ({names}); give points that both know: --align"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.solve(np.array(first.linear), np.array(second.linear))
    matrix[:3, 3] = first.in_scene(np.array([second.offset]))[0]
    return matrix
