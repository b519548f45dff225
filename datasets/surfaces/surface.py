"""A surface in a file, as the depth of any camera that looks at it."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.disk import file_digest
from semstab.datasets.surfaces.casting import Caster, View
from semstab.datasets.surfaces.casts import Casts
from semstab.datasets.surfaces.triangles import Triangles, read_triangles
from semstab.errors import DataError
from semstab.model.frames import Intrinsics
from semstab.model.georeference import Georeference

PROBE = (9, 16)
"""Rays of a view that tell whether it sees the surface at all: rows and columns."""


class Surface:
    """Opened by its file's digest; its triangles are read when a cast is asked for that is not kept.

    Threads may ask at once. Raises DataError where the file cannot be read.
    """

    def __init__(
        self, path: Path, cell: float | None = None, georeference: Georeference | None = None, casts: Path | None = None
    ) -> None:
        self.path = path
        self._cell = cell
        self._georeference = georeference
        self._casts = Casts(casts, self.digest)
        self._lock = threading.Lock()
        self._caster: Caster | None = None

    @cached_property
    def digest(self) -> bytes:
        """Bytes that are equal where the surface is."""
        offset = None if self._georeference is None else self._georeference.offset
        return file_digest(self.path) + repr((self._cell, offset)).encode()

    @cached_property
    def triangles(self) -> Triangles:
        """The surface in the scene's coordinates. Raises what `read_triangles` raises."""
        return read_triangles(self.path, self._cell, self._georeference)

    def depth(self, view: View) -> npt.NDArray[np.float32]:
        """Depth (H, W) of a view along the optical axis in metres, 0 where it sees no surface."""
        depth = self._casts.get(view)
        if depth is None:
            depth = self._cast(view)
            self._casts.put(view, depth)
        return depth

    def require_seen(self, views: Iterable[View]) -> None:
        """Raise DataError, which says how far away the cameras are, where no view sees the surface."""
        centres = []
        for view in views:
            if self._cast(_thinned(view)).any():
                return
            centres.append(view.T_wc[:3, 3])
        raise DataError(f"{self.path}: no frame sees it: {_apart(self.triangles, np.array(centres))}")

    def _cast(self, view: View) -> npt.NDArray[np.float32]:
        with self._lock:
            if self._caster is None:
                self._caster = Caster(self.triangles)
        return self._caster.depth(view)


def _thinned(view: View) -> View:
    """The same view in few pixels."""
    (H, W), (rows, columns), K = view.shape, PROBE, view.intrinsics
    thin = K.resized((W, H), (columns, rows)) if min(H, W) > max(PROBE) else K
    return View(Intrinsics(thin.fx, thin.fy, thin.cx, thin.cy), view.T_wc, PROBE if thin is not K else view.shape)


def _apart(triangles: Triangles, centres: npt.NDArray[np.float64]) -> str:
    """Where the cameras are relative to a surface that they do not see, and what to do."""
    low, high = triangles.bounds
    nearest = np.clip(centres, low, high)
    closest = np.linalg.norm(centres - nearest, axis=1).argmin()
    x, y, z = centres[closest] - nearest[closest]
    if np.hypot(x, y) == 0 and z >= 0:
        return (
            f"the nearest camera is {z:.4g} m above it and looks elsewhere; are pose_convention and camera_axes right?"
        )
    return (
        f"the nearest camera is {np.linalg.norm((x, y, z)):,.0f} m away (east {x:,.0f}, north {y:,.0f}, up {z:,.0f}"
        " m); surface and poses lie in other coordinates, bring them to the same (an offset?)"
    )
