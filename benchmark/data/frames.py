"""One posed image with depth, or scan of points, and labels: what datasets yield and backends integrate."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32, Float64, Mask, UInt8, UInt16
from semstab.data.features import Features
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, flat, ignore_id
from semstab.errors import DataError

RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole intrinsics in pixels; integer (u, v) are pixel centres.

    Attributes:
        fx, fy: Focal lengths.
        cx, cy: Principal point.

    Examples:
        >>> semstab.Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5).matrix[0]
        array([60. ,  0. , 31.5])
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy"):
            value = float(getattr(self, name))
            object.__setattr__(self, name, value)
            if not math.isfinite(value) or (name.startswith("f") and value <= 0):
                raise DataError(f"intrinsics: {name} = {value:g}; focal lengths must be positive and all values finite")

    @classmethod
    def from_matrix(cls, K: npt.ArrayLike) -> Intrinsics:
        """Make it of a 3x3 (or 4x4) camera matrix.

        Raises:
            DataError: If it has skew or another shape.
        """
        K = np.asarray(K, dtype=np.float64)
        if K.shape not in ((3, 3), (4, 4)):
            raise DataError(f"intrinsics: expected a 3x3 matrix, got shape {K.shape}")
        if np.abs(K[2] - [0, 0, 1, 0][: len(K)]).max() > 1e-9:
            raise DataError(f"intrinsics: the third row is {K[2].tolist()}, not 0 0 1; is the matrix transposed?")
        if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
            raise DataError(f"intrinsics: skew {K[0, 1]:g} is not supported; undistort the images")
        return cls(fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2])

    @property
    def matrix(self) -> Float64:
        """The 3x3 camera matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def every(self, stride: int) -> Intrinsics:
        """Return the intrinsics of the image with pixels 0, stride, 2 stride, ... of each axis."""
        return Intrinsics(self.fx / stride, self.fy / stride, self.cx / stride, self.cy / stride)

    def resized(self, size: tuple[int, int], to: tuple[int, int]) -> Intrinsics:
        """Return intrinsics after the image is resized from `size` (width, height) to `to`; pixel areas align."""
        sx, sy = to[0] / size[0], to[1] / size[1]
        return Intrinsics(self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5)


Pinhole = tuple[float, float, float, float]


def pinhole(camera: Intrinsics) -> Pinhole:
    """Return fx, fy, cx, cy, pixels, as compiled loops take them."""
    return camera.fx, camera.fy, camera.cx, camera.cy


@dataclass(frozen=True)
class LeftOut:
    """The share of a pixel's scores that `top_k` left out: the mean over pixels, and the most of any.

    No voxel's belief (in total variation) or VSS changes by more than the most: see `semstab.pixels.preparation`.
    """

    mean: float
    most: float


IMAGES = ("depth", "points", "labels", "scores", "color", "mask", "left_out", "unlabelled")

OF_VECTORS = ("points", "scores", "color")
"""The images that have a vector in each pixel."""

NOT_GIVEN: Any = None

SOME_POINTS = 1 << 13
"""Points of a scan, about, that tell how far apart its rays are."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One observation of the scene, validated when it is made; its arrays are read-only views.

    It is an image with depth and intrinsics, or a scan of points. A scan of N points is one row: H = 1, W = N, and its
    arrays may be given without that row, as (N, 3), (N,) and (N, K).

    Attributes:
        index: Number in the sequence, from 0.
        depth: (H, W) float32, metres along the optical axis (planar z); 0, negative, NaN and inf are invalid. Of a
            scan it is each point's distance from the sensor, computed by default.
        intrinsics: Intrinsics of the depth image; or its 3x3 camera matrix. A scan has none.
        T_wc: (4, 4) or (3, 4) float64 camera-to-world (sensor-to-world), metres; camera axes x right, y down,
            z forward (OpenCV), a sensor's those of its points.
        labels: (H, W) uint8 or uint16 class ids, ignore id 255 or 65535; other integers become the smaller one.
        scores: (H, W, K) float, instead of labels, non-negative; normalised per pixel where they are used.
        color: (H, W, 3) uint8 RGB, optional.
        mask: (H, W) bool, True where a thing moves that is not to be fused, optional; `semstab.pixels.preparation`.
        left_out: (H, W) bool, the pixels that were left out of fusion because of their class or a mask, optional.
        unlabelled: (H, W) bool, the pixels with depth to which a model gave no label, optional.
        scores_left_out: Part of the scores that was left out, where only the largest are used.
        timestamp: Seconds, optional.
        files: File that each field came from ('depth', 'pose', 'labels', ...); error messages name it.
        points: (H, W, 3) or (N, 3) float32 sensor coordinates, metres, instead of depth and intrinsics; those that are
            not finite, or at the sensor itself, are invalid.
        features: `Features`, or (h, w, D) float of a grid that covers the image evenly, coarser than the depth or as
            fine; of a scan (N, D). Without labels and scores all pixels are of one class, 0.

    Raises:
        DataError: If shapes disagree, the pose is not rigid or not finite, or a type is wrong.

    Examples:
        >>> depth, labels = np.full((48, 64), 5.0, np.float32), np.zeros((48, 64), np.uint8)
        >>> camera = semstab.Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5)
        >>> frame = semstab.Frame(0, depth, camera, np.eye(4), labels=labels)
        >>> frame.shape
        (48, 64)
        >>> points = np.random.default_rng(0).uniform(1, 20, (1000, 3)).astype(np.float32)
        >>> scan = semstab.Frame(0, points=points, labels=np.zeros(1000, np.uint8), T_wc=np.eye(4))
        >>> scan.shape
        (1, 1000)
    """

    index: int
    depth: Float32 = NOT_GIVEN
    intrinsics: Intrinsics = NOT_GIVEN
    T_wc: Float64 = NOT_GIVEN
    labels: UInt8 | UInt16 | None = None
    scores: npt.NDArray[np.floating[Any]] | None = None
    color: UInt8 | None = None
    mask: Mask | None = None
    left_out: Mask | None = None
    unlabelled: Mask | None = None
    scores_left_out: LeftOut | None = None
    timestamp: float | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    points: Float32 | None = None
    features: Features | None = None

    def __post_init__(self) -> None:
        if self.index < 0:
            raise DataError(f"frame {self.index}: its index is below 0; number frames from 0")
        if self.points is not None:
            self._set_scan(np.asarray(self.points))
        self._set("depth", self._checked_depth())
        if self.points is None:
            object.__setattr__(self, "intrinsics", _intrinsics(self.intrinsics, self.where("intrinsics")))
        self._set("T_wc", self._checked_pose())
        if self.features is not None:
            object.__setattr__(self, "features", self._checked_features(self.features))
            if self.labels is None and self.scores is None:
                object.__setattr__(self, "labels", np.zeros(self.shape, np.uint8))
        if (self.labels is None) == (self.scores is None):
            raise DataError(f"{self.where('labels')}: give labels or scores, one of the two, or features")
        if self.labels is not None:
            self._set("labels", self._checked_labels(np.asarray(self.labels)))
        if self.scores is not None:
            self._set("scores", self._checked_scores(np.asarray(self.scores)))
        if self.color is not None:
            self._set("color", self._checked_color(np.asarray(self.color)))
        for name in ("mask", "left_out", "unlabelled"):
            if (marked := getattr(self, name)) is not None:
                self._set(name, self._checked_mask(name, np.asarray(marked)))

    @property
    def is_scan(self) -> bool:
        """True for a scan of points, False for an image."""
        return self.points is not None

    @cached_property
    def rays(self) -> tuple[Float64, Float64]:
        """(u - cx) / fx of each column (W,), (v - cy) / fy of each row (H,); of a scan, which has none, 0."""
        H, W = self.shape
        if self.is_scan:
            return np.zeros(W), np.zeros(H)
        K = self.intrinsics
        u, v = np.arange(W, dtype=np.float64), np.arange(H, dtype=np.float64)
        return (u - K.cx) / K.fx, (v - K.cy) / K.fy

    @cached_property
    def ray_angle(self) -> float:
        """Radians between neighbouring rays: of pixels in the middle of an image; of a scan on average."""
        if self.points is None:
            return 1.0 / math.sqrt(self.intrinsics.fx * self.intrinsics.fy)
        there = np.flatnonzero((self.depth > 0) & (self.depth < np.inf))
        if not len(there):
            return math.nan
        x, y, z = self.points.reshape(-1, 3)[there[:: max(1, len(there) // SOME_POINTS)]].T.astype(np.float64)
        degree = np.degrees([np.arctan2(y, x), np.arcsin(np.clip(z / np.sqrt(x * x + y * y + z * z), -1, 1))])
        cells = np.unique(np.floor(degree / 2).astype(np.int64), axis=1)  # cells of 2 degrees that have points
        solid = np.cos(np.radians(2 * cells[1] + 1)).sum() * math.radians(2) ** 2
        return math.sqrt(solid / len(there))

    @cached_property
    def valid(self) -> Mask:
        """(H, W): depth is valid, and the label is not ignored or the scores are finite and sum to more than 0."""
        if self.labels is not None:
            from semstab.data.kernels import mark_valid

            valid = np.empty(self.shape, dtype=np.bool_)
            mark_valid(flat(self.depth), flat(self.labels), self.ignore_id, valid.reshape(-1))
        else:
            valid = (self.depth > 0) & (self.depth < np.inf) & _usable_scores(self.scores)
        valid.setflags(write=False)
        return valid

    @cached_property
    def predicted(self) -> UInt8 | UInt16:
        """(H, W) class ids: the labels, or the class of the largest score (ignored where scores are unusable)."""
        if self.labels is not None:
            return self.labels
        assert self.scores is not None
        dtype = np.uint8 if self.scores.shape[2] <= IGNORE_8BIT else np.uint16
        ids: npt.NDArray[Any] = self.scores.argmax(axis=2).astype(dtype)
        ids[~_usable_scores(self.scores)] = self.ignore_id
        ids.setflags(write=False)
        return ids

    @property
    def ignore_id(self) -> int:
        """The id of a pixel without a label: 255, or 65535 in 16-bit maps."""
        if self.labels is not None:
            return ignore_id(self.labels)
        assert self.scores is not None
        return IGNORE_8BIT if self.scores.shape[2] <= IGNORE_8BIT else IGNORE_16BIT

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.depth.shape[0], self.depth.shape[1]

    @property
    def left_out_pixels(self) -> int:
        """Return how many pixels were left out of fusion because of their class or a mask."""
        return 0 if self.left_out is None else int(np.count_nonzero(self.left_out))

    @property
    def nbytes(self) -> int:
        """Bytes of its images, the mask of valid pixels included."""
        images = self.depth.size + sum(image.nbytes for image in self._images.values())
        return images + (0 if self.features is None else self.features.nbytes)

    @property
    def _images(self) -> dict[str, npt.NDArray[Any]]:
        """The images that the frame has, by field."""
        images = {name: getattr(self, name) for name in IMAGES}
        return {name: image for name, image in images.items() if image is not None}

    def every(self, stride: int) -> Frame:
        """Return the frame with every stride-th pixel of each axis, from pixel (0, 0), with its intrinsics.

        Of a scan it is every stride-th point.
        """
        if stride == 1:
            return self
        pick = (slice(None, None, stride), slice(None, None, stride))
        images: dict[str, Any] = {name: image[pick] for name, image in self._images.items()}
        if self.points is not None:
            if self.features is not None:
                images["features"] = self.features.vectors[pick]
            return dataclasses.replace(self, **images)
        features = None if self.features is None else self.features.every(stride)
        return dataclasses.replace(self, intrinsics=self.intrinsics.every(stride), **images, features=features)

    def within(self, side: int) -> Frame:
        """Return the frame by the least stride that leaves at most `side` pixels along each axis.

        A scan keeps at most as many points as a square image of that side has pixels.
        """
        H, W = self.shape
        return self.every(max(1, -(-H * W // side**2) if self.is_scan else -(-max(H, W) // side)))

    def where(self, what: str) -> str:
        """Return the name of a field in an error message: its file, if any, else the frame and the field."""
        return self.files.get(what, f"frame {self.index}, {what}")

    def _set(self, name: str, value: npt.NDArray[Any]) -> None:
        value = value.view()
        value.setflags(write=False)
        object.__setattr__(self, name, value)

    def _set_scan(self, points: npt.NDArray[Any]) -> None:
        """Set the points, and what belongs to them, as images of one row where they have none."""
        where = self.where("points")
        if self.intrinsics is not None:
            raise DataError(f"{where}: give depth and intrinsics, or points; a scan has no intrinsics")
        if points.ndim not in (2, 3) or points.shape[-1] != 3 or points.size == 0:
            raise DataError(f"{where}: points must be (N, 3), got shape {points.shape}")
        if not np.issubdtype(points.dtype, np.floating):
            raise DataError(f"{where}: points are {points.dtype}; convert them to metres (float32)")
        points = np.ascontiguousarray(points[None] if points.ndim == 2 else points, dtype=np.float32)
        if len(points) == 1:
            for name in IMAGES:
                if (value := getattr(self, name)) is not None and np.ndim(value) == 1 + (name in OF_VECTORS):
                    object.__setattr__(self, name, np.asarray(value)[None])
        if self.depth is None:
            x, y, z = np.moveaxis(points.astype(np.float64), -1, 0)
            object.__setattr__(self, "depth", np.sqrt(x * x + y * y + z * z).astype(np.float32))
        self._set("points", points)
        if self.depth.shape != points.shape[:2]:
            raise DataError(f"{where}: {points.shape[0] * points.shape[1]} points, but depth of {self.depth.shape}")

    def _checked_depth(self) -> Float32:
        if self.depth is None:
            raise DataError(f"{self.where('depth')}: give depth and intrinsics, or points")
        depth = np.asarray(self.depth)
        if depth.ndim != 2 or depth.size == 0:
            raise DataError(f"{self.where('depth')}: depth must be (H, W), got shape {depth.shape}")
        if not np.issubdtype(depth.dtype, np.floating):
            raise DataError(
                f"{self.where('depth')}: depth is {depth.dtype}; convert it to metres (float32) with its depth scale"
            )
        return depth.astype(np.float32, copy=False)

    def _checked_pose(self) -> Float64:
        where = self.where("pose")
        if self.T_wc is None:
            raise DataError(f"{where}: there is no pose; give T_wc, camera-to-world")
        T = np.array(self.T_wc, dtype=np.float64)
        if T.shape == (3, 4):
            T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
        if T.shape != (4, 4):
            raise DataError(f"{where}: the pose must be a 4x4 or 3x4 matrix, got shape {T.shape}")
        if not np.isfinite(T).all():
            raise DataError(f"{where}: the pose is not finite (lost tracking?); leave this frame out")
        if np.abs(T[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
            raise DataError(
                f"{where}: the last row of the pose is {T[3].tolist()}, not 0 0 0 1; is the matrix transposed?"
            )
        R = T[:3, :3]
        if np.abs(R).max() > 2 or np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE:
            raise DataError(f"{where}: the rotation is not orthonormal, {_in_line(R)}; does it hold a scale?")
        if np.linalg.det(R) < 0:
            raise DataError(
                f"{where}: the rotation mirrors (determinant -1), {_in_line(R)}; no setting mends that: an axis has the"
                " wrong sign, as where left-handed coordinates (Unity, Unreal, CARLA) are taken as they are; convert it"
            )
        return T

    def _checked_features(self, features: Any) -> Features:
        """Return features whose grid has a place in the image."""
        try:
            if isinstance(features, Features):
                return features
            vectors = np.asarray(features)
            return Features.over(vectors[None] if self.is_scan and vectors.ndim == 2 else vectors, self.shape)
        except DataError as error:
            raise DataError(f"{self.where('features')}: {error}") from error

    def _checked_mask(self, name: str, mask: npt.NDArray[Any]) -> Mask:
        if mask.dtype != np.bool_:
            raise DataError(f"{self.where(name)}: the {name} is {mask.dtype}; use bool, True where pixels are left out")
        self._same_size(name, mask.shape)
        return mask

    def _checked_labels(self, labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if labels.dtype not in (np.uint8, np.uint16):
            labels = self._narrowed(labels)
        self._same_size("labels", labels.shape)
        return labels

    def _narrowed(self, labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return integers of another type as uint8, or as uint16 with a label above 255."""
        where = self.where("labels")
        if not (np.issubdtype(labels.dtype, np.integer) or labels.dtype == np.bool_):
            raise DataError(f"{where}: labels are {labels.dtype}; use uint8 or uint16 (ignore 255 or 65535)")
        low, high = int(labels.min(initial=0)), int(labels.max(initial=0))
        if low < 0 or high > IGNORE_16BIT:
            raise DataError(f"{where}: labels go from {low} to {high}; write 255 (65535 of uint16) for no label")
        return labels.astype(np.uint8 if high <= IGNORE_8BIT else np.uint16)

    def _checked_scores(self, scores: npt.NDArray[Any]) -> npt.NDArray[Any]:
        where = self.where("scores")
        if scores.ndim != 3 or not np.issubdtype(scores.dtype, np.floating):
            raise DataError(f"{where}: scores must be float (H, W, K), got {scores.dtype} of shape {scores.shape}")
        if scores.shape[:2] != self.shape and scores.shape[1:] == self.shape:
            raise DataError(f"{where}: scores are (K, H, W) = {scores.shape}; turn them by np.moveaxis(scores, 0, -1)")
        self._same_size("scores", scores.shape[:2])
        if scores.shape[2] < 2:
            raise DataError(f"{where}: scores hold {scores.shape[2]} class; at least 2 are needed")
        if scores.min(initial=0.0, where=np.isfinite(scores)) < 0:
            raise DataError(f"{where}: scores are negative (logits?); apply a softmax first")
        return scores

    def _checked_color(self, color: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
            raise DataError(
                f"{self.where('color')}: colour must be uint8 (H, W, 3), got {color.dtype} of shape {color.shape}"
            )
        return color

    def _same_size(self, name: str, shape: tuple[int, ...]) -> None:
        H, W = self.shape
        if shape != (H, W) and self.is_scan:
            number, points = math.prod(shape), f"{H * W} points" if H == 1 else f"{W}x{H} points"
            what = name if name.endswith("s") else f"values of the {name}"
            raise DataError(f"{self.where(name)}: {number} {what} but {points}; give one for each point")
        if shape != (H, W):
            size = "x".join(str(n) for n in shape[::-1])
            raise DataError(f"{self.where(name)}: {name} are {size} but depth is {W}x{H}; bring them to one size")


def _intrinsics(intrinsics: Any, where: str) -> Intrinsics:
    """Return intrinsics, or a camera matrix as such."""
    if isinstance(intrinsics, Intrinsics):
        return intrinsics
    try:
        return Intrinsics.from_matrix(intrinsics)
    except (TypeError, ValueError) as error:
        reason = error if isinstance(error, DataError) else "not a 3x3 matrix"
        raise DataError(f"{where}: {reason}; give Intrinsics(fx, fy, cx, cy) or a camera matrix") from error


def _in_line(matrix: Float64) -> str:
    """Return a matrix in one line, as an error message shows it."""
    return "[" + "; ".join(" ".join(f"{value:.4g}" for value in row) for row in matrix) + "]"


def _usable_scores(scores: npt.NDArray[Any] | None) -> Mask:
    assert scores is not None
    total = scores.sum(axis=2, dtype=np.float64)
    usable: Mask = np.isfinite(total) & (total > 0)
    return usable
