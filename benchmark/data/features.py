"""Features of an image: a vector of unit length at each cell of a grid, coarser than the image or as fine."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Int64
from semstab.data.labels import LabelSpace
from semstab.errors import DataError

OF_FEATURES = LabelSpace("features", ("surface", "no surface"))
"""The label space of a model that gives features and no labels: its map has one class, whatever is seen."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of an image or a scan; vectors are brought to unit length where they are given.

    Attributes:
        vectors: (h, w, D) float16 or float32 of unit length; of a scan (1, N, D), one for each point. float64 becomes
            float32.
        first: Column and row, in pixels of the depth image, of the first cell's centre.
        step: Columns and rows of the depth image from one cell's centre to the next.

    Raises:
        DataError: If their shape or type is wrong, or a vector has no length or is not finite.

    Examples:
        >>> patches = semstab.Features(np.ones((4, 6, 8), np.float32), first=(6.5, 6.5), step=(14.0, 14.0))
        >>> patches.cells(np.array([0.0, 20.4]), np.array([0.0, 0.0])).tolist()
        [0, 1]
    """

    vectors: npt.NDArray[np.floating[Any]]
    first: tuple[float, float]
    step: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "vectors", _unit(np.asarray(self.vectors)))
        numbers = (*self.first, *self.step)
        if not all(map(math.isfinite, numbers)) or min(self.step) <= 0:
            raise DataError(f"features: centres {self.first} with steps {self.step}; steps are above 0, all are finite")

    @classmethod
    def over(cls, vectors: npt.ArrayLike, shape: tuple[int, int]) -> Features:
        """Return features whose grid covers an image (H, W) evenly, from border to border."""
        vectors = np.asarray(vectors)
        if vectors.ndim != 3 or 0 in vectors.shape:
            raise DataError(f"features must be (h, w, D), got {vectors.dtype} of shape {vectors.shape}")
        (h, w), (H, W) = vectors.shape[:2], shape
        if h > H or w > W:
            swapped = " are they (D, h, w)? Turn them by np.moveaxis(features, 0, -1)" if vectors.shape[2] <= W else ""
            raise DataError(f"features have {w}x{h} cells for {W}x{H} pixels;{swapped or ' give a coarser grid'}")
        across, down = W / w, H / h
        return cls(vectors, ((across - 1) / 2, (down - 1) / 2), (across, down))

    @property
    def D(self) -> int:
        """The number of components."""
        return int(self.vectors.shape[2])

    @property
    def nbytes(self) -> int:
        """Bytes of the vectors."""
        return self.vectors.nbytes

    def cells(self, u: npt.NDArray[Any], v: npt.NDArray[Any]) -> Int64:
        """Return the cell (n,) that each pixel, column u and row v (n,), falls into; -1 outside of the grid."""
        h, w, _ = self.vectors.shape
        column = np.floor((u - self.first[0]) / self.step[0] + 0.5)
        row = np.floor((v - self.first[1]) / self.step[1] + 0.5)
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        return np.where(inside, row * w + column, -1).astype(np.int64)

    def at(self, cell: Int64) -> npt.NDArray[np.floating[Any]]:
        """Return the vectors (n, D) of cells (n,)."""
        return self.vectors.reshape(-1, self.D)[cell]

    def every(self, stride: int) -> Features:
        """Return the same cells by the pixels of an image with every stride-th pixel of each axis."""
        (u, v), (across, down) = self.first, self.step
        return dataclasses.replace(self, first=(u / stride, v / stride), step=(across / stride, down / stride))

    def image(self, values: npt.NDArray[Any], shape: tuple[int, int], outside: Any) -> npt.NDArray[Any]:
        """Return values (h, w, ...) of the cells at the pixels (H, W) of the depth image, `outside` beyond the grid."""
        (h, w), (H, W) = self.vectors.shape[:2], shape
        column = np.floor((np.arange(W) - self.first[0]) / self.step[0] + 0.5).astype(np.int64)
        row = np.floor((np.arange(H) - self.first[1]) / self.step[1] + 0.5).astype(np.int64)
        pixels: npt.NDArray[Any] = values[row.clip(0, h - 1)[:, None], column.clip(0, w - 1)[None, :]]
        beyond = ((row < 0) | (row >= h))[:, None] | ((column < 0) | (column >= w))[None, :]
        if beyond.any():
            pixels[beyond] = outside
        return pixels


@dataclass(frozen=True, eq=False)
class FeatureColours:
    """Features as colours: their first three principal components, as they are in one frame, are red, green and blue.

    Attributes:
        mean: (D,) mean vector.
        axes: (D, 3) principal components, the third 0 of features with two.
        low, high: (3,) their 1st and 99th percentiles, which are black and full colour.
    """

    mean: npt.NDArray[np.float32]
    axes: npt.NDArray[np.float32]
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]

    @classmethod
    def from_features(cls, features: Features) -> FeatureColours:
        """Return the colours by which a frame's features differ most."""
        vectors = features.vectors.reshape(-1, features.D).astype(np.float32)
        mean = vectors.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov(vectors - mean, rowvar=False))
        axes = np.column_stack([axes[:, ::-1][:, :3], np.zeros((features.D, 3))])[:, :3].astype(np.float32)
        low, high = np.percentile((vectors - mean) @ axes, [1, 99], axis=0).astype(np.float32)
        return cls(mean, axes, low, np.maximum(high, low + np.float32(1e-6)))

    def fit(self, features: Features) -> bool:
        """Return whether features have the number of components that these colours are of."""
        return len(self.mean) == features.D

    def __call__(self, features: Features) -> npt.NDArray[np.uint8]:
        """Return colours (h, w, 3) of the cells."""
        parts = (features.vectors.astype(np.float32) - self.mean) @ self.axes
        return np.asarray(255 * np.clip((parts - self.low) / (self.high - self.low), 0, 1), np.uint8)


_UNIT = 2e-3
"""Largest difference of a length from 1 in half precision for vectors that are taken as they are."""


def _unit(vectors: npt.NDArray[Any]) -> npt.NDArray[np.floating[Any]]:
    """Return vectors (h, w, D) of unit length, read-only, in half or single precision."""
    if vectors.ndim != 3 or not np.issubdtype(vectors.dtype, np.floating) or 0 in vectors.shape:
        raise DataError(f"features must be float (h, w, D), got {vectors.dtype} of shape {vectors.shape}")
    if vectors.shape[2] < 2:
        raise DataError("features have 1 component; at least 2 are needed, as the angle between vectors counts")
    single = vectors.astype(np.float32, copy=False)
    if not np.isfinite(single).all():
        row, column = np.argwhere(~np.isfinite(single).all(axis=2))[0]
        raise DataError(f"features: the vector of cell ({column}, {row}) is not finite")
    length = np.sqrt(np.einsum("ijk,ijk->ij", single, single, dtype=np.float64))
    if not (length > 0).all():
        row, column = np.argwhere(~(length > 0))[0]
        raise DataError(f"features: the vector of cell ({column}, {row}) has no length")
    half = vectors.dtype == np.float16
    if np.abs(length - 1).max() > (_UNIT if half else 1e-6):
        single = single / length[..., None].astype(np.float32)
    unit: npt.NDArray[np.floating[Any]] = single.astype(np.float16) if half else single.view()
    unit.setflags(write=False)
    return unit
