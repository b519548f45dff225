"""Spots of the surface, and the labels that each view gives them.

A spot is a point of the surface, in a coarse cell that a frame shows, at a place that depth alone decides; as many
cells have one as stand for equal areas. Each later frame answers for all spots that it sees, near or far, with the
label of the pixel that a spot falls into. So spots are even over the surface, and a spot has as many answers as views
see it. All models of a flight are asked at the same spots. Memory is bounded: if there are too many answers, every
second spot is dropped, by a hash of its cell.
"""

from __future__ import annotations

import functools
import hashlib
import math
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.arrays import GrowingRows
from semstab.core.types import Float64, Int32, Int64, Mask, UInt16
from semstab.data.frames import Frame, pinhole
from semstab.data.labels import fixed
from semstab.statistics.feature_spots import FeatureObservations, FeatureStore
from semstab.statistics.kept_depth import DepthMemory, KeptDepth, firm
from semstab.statistics.kept_points import KeptPoints
from semstab.statistics.observations import COLUMNS, TYPES, VIEW, SpotObservations, Views, cells_of
from semstab.statistics.sparse_depth import SparseDepth, of_lidar, step_of_few
from semstab.statistics.votes import SpotVotes

BUDGET = 1 << 19
"""Most answers (spot, view)."""

MOST_SPOTS = 1 << 16
"""Most spots, of which many may have been seen once."""

MOST_NEW = 1 << 15
"""Most coarse cells, with a spot or without, that one frame adds."""

SLOTS = 2
"""Slots, at least, of the table of coarse cells for each of them."""

LOOKED_AT = 6_000
"""Blocks of pixels, about, or points of a scan, in which new spots are looked for."""

PLACES, MOST_LOOKED = 4.0, 1 << 17
"""Places that are looked at in the square of the spacing, so that few cells are left out by chance; and the most
places, about, of a frame."""

APART = 0.7
"""Spacing of spots, by the edge of a square as large as a block of pixels shows on average, or up to twice as much."""

SIDE = 320
"""Most pixels on a side of the labels by which frames that repeat another are found."""

REACH = 1 << 20
"""Coarse cells from the first camera within which there are spots."""

SOME_POINTS = 1_500
"""Points of sparse depth, about, that tell the mean area for which a point stands."""

CHANGE = 8.0
"""Growth or fall of the median footprint from which on the sample begins again, as after a take-off."""

STILL = 1.0
"""Pixels by which no point of an image moves while a camera stands still."""

SIGMAS, LEAST, MOST = 1.0, 0.002, 0.05
"""A pixel shows a spot if their depths differ by at most SIGMAS standard deviations of how they differ in the flight,
which depth noise and errors of poses cause; the least and the most of this tolerance, relative. A third of the answers
is lost by this, whatever the labels; with a wider tolerance more answers come from other surfaces than the spot's. Of a
first frame, which has nothing to differ from, the noise within it counts."""

SURE, SMOOTH = 4.0, 0.0005
"""Standard deviations of the noise within a frame by which pixels of one surface differ at most; and the noise,
relative, from which on depth comes from planes through the pixels around."""

GATE, ENOUGH = 0.05, 50
"""The standard deviation of depth comes from relative differences up to GATE, of frames with ENOUGH such pixels."""


@dataclass(frozen=True, eq=False)
class Anchor:
    """The frame that a view began with: its pose, and the footprint of a pixel in the image's middle."""

    view: int
    T_wc: Float64
    focal: float
    depth: float

    def sees_alike(self, frame: Frame) -> bool:
        """Return whether no point moves by more than STILL pixels from this frame to another."""
        turned = self.T_wc[:3, :3].T @ frame.T_wc[:3, :3]
        angle = math.acos(min(max((float(np.trace(turned)) - 1) / 2, -1.0), 1.0))
        moved = float(np.linalg.norm(frame.T_wc[:3, 3] - self.T_wc[:3, 3])) / self.depth
        return self.focal * (angle + moved) <= STILL


class Sampler:
    """Takes frames one by one, as they are fused; `sample` returns the answers so far.

    The first frame sets the spacing of spots, a power of 2. Frames that a standing camera takes are one view,
    and so are frames with the same pose and the same labels.

    Args:
        num_classes: K, the number of classes.
        budget: Most answers of a sample.
        moving: Whether to keep depth of views, from which follows which spots moved.
    """

    def __init__(self, num_classes: int, budget: int = BUDGET, *, moving: bool = True) -> None:
        self.K, self.budget = num_classes, budget
        self._memory = DepthMemory() if moving else None
        self._spacing = math.nan
        self._low: Int64 = np.zeros(3, np.int64)
        self._columns: dict[str, npt.NDArray[Any]] = {}
        self._views = GrowingRows(VIEW)
        self._frames = 0
        self._anchor: Anchor | None = None
        self._seen: dict[bytes, Anchor] = {}
        self._errors: list[float] = []
        self._noise = 0.0
        self._widths: list[float] = []
        self._known = 0
        self._features = FeatureStore()
        self._pixel: tuple[Int32, Int64] | None = None
        self._clear()

    def _clear(self) -> None:
        self._share, self._answers, self._spots, self._cells = 1 << 32, 0, 0, 0
        self._point, self._hash = np.empty((1 << 12, 3)), np.empty(1 << 12, np.uint32)
        self._found, self._firm = np.empty(1 << 12, np.int32), np.ones(1 << 12, np.bool_)
        self._table = np.full(1 << 14, -1, np.int64)
        self._columns = {name: np.empty(1 << 14, dtype) for name, dtype in TYPES.items()}
        self._features.clear()

    def add(self, frame: Frame) -> None:
        """Add the answers of a frame."""
        self._frames += 1
        if frame.features is not None:
            self._features.start(frame)
        few = frame.depth[:: step_of_few(frame.shape), :: step_of_few(frame.shape)]
        few = few[(few > 0) & (few < np.inf)]
        if not len(few):
            few = frame.depth[(frame.depth > 0) & (frame.depth < np.inf)]
        sparse = SparseDepth.from_frame(frame, self.K)
        view = self._view_of(frame, float(np.median(few)), sparse) if len(few) else None
        if view is None:
            return
        self._known = self._spots
        T, seed = fixed(frame.T_wc), zlib.crc32(np.ascontiguousarray(frame.T_wc).tobytes())
        if sparse is None:
            self._noise = _noise(frame)
            self._find(frame, T, seed)
            self._remember(view, frame, T, None)
            answers = self._answers_of_image(frame, T, seed)
        else:
            self._find_in_points(sparse, T, seed)
            self._remember(view, frame, T, sparse)
            answers = self._answers_of_points(frame, sparse, T, seed)
        if frame.features is not None:
            self._take_features(frame, sparse, view, *answers[:2])
        self._take(view, *answers)

    def _view_of(self, frame: Frame, depth: float, sparse: SparseDepth | None) -> int | None:
        """Return the view of a frame with this median depth, a new one or not; None if the frame repeats another."""
        small = frame.predicted[:: max(1, -(-frame.shape[0] // SIDE)), :: max(1, -(-frame.shape[1] // SIDE))]
        hashed = hashlib.blake2b(np.ascontiguousarray(small).tobytes(), digest_size=16)
        if frame.features is not None:
            hashed.update(np.ascontiguousarray(frame.features.vectors).data)
        digest = hashed.digest()
        same = self._seen.get(digest)
        if same is not None and same.sees_alike(frame):
            return None
        if self._anchor is not None and self._anchor.sees_alike(frame):
            return self._anchor.view
        focal = 1.0 / frame.ray_angle
        self._anchor = self._seen[digest] = Anchor(len(self._views), frame.T_wc.copy(), focal, depth)
        centre, when = frame.T_wc[:3, 3], math.nan if frame.timestamp is None else frame.timestamp
        self._views.append([frame.index, *centre.tolist(), when, depth / focal])
        self._widths.append(_width(frame, sparse, self._allowed()) or depth / focal)
        spacing = 2.0 ** math.ceil(math.log2(APART * float(np.median(self._widths))))
        if not self._spacing / CHANGE < spacing < self._spacing * CHANGE:
            self._spacing = spacing
            self._low = cells_of(centre, spacing) - REACH
            self._clear()
        return self._anchor.view

    # --- New spots ----------------------------------------------------------------------------------------------------

    def _find(self, frame: Frame, T: Float64, seed: int) -> None:
        """Add spots in an image with dense depth."""
        from semstab.statistics.loops.new_spots import new_in_image

        (H, W), stride = frame.shape, _stride(frame.shape)
        blocks = -(-H // stride) * -(-W // stride)
        cells = self._spacing, self._share, self._low
        places = stride, _factor(blocks), self._density(blocks), seed
        of_frame = fixed(frame.depth), pinhole(frame.intrinsics), T, SURE * self._noise
        self._new(lambda *room: new_in_image(*of_frame, *cells, *places, *room))

    def _density(self, blocks: int) -> float:
        """Return how many places are looked at in the square of the spacing."""
        return min(PLACES, MOST_LOOKED / (blocks * (self._widths[-1] / self._spacing) ** 2))

    def _find_in_points(self, sparse: SparseDepth, T: Float64, seed: int) -> None:
        """Add spots among the points of sparse depth."""
        from semstab.statistics.loops.sparse import new_in_points

        looked = min(len(sparse.w), LOOKED_AT)
        place = sparse.camera, sparse.around, sparse.reach, sparse.apart(looked)
        cells = self._spacing, self._share, self._low
        places = _factor(len(sparse.w)), looked, self._density(looked), seed
        self._new(lambda *room: new_in_points(*sparse.arrays, *place, self._allowed(), T, *cells, *places, *room))

    def _new(self, find: Any) -> None:
        """Add the spots that a loop finds, of at most MOST_NEW cells."""
        while SLOTS * (self._cells + MOST_NEW) > len(self._table):
            self._rebuild(2 * len(self._table))
        if self._spots + MOST_NEW > len(self._hash):
            room = max(2 * len(self._hash), self._spots + MOST_NEW)
            self._point, self._hash = _longer(self._point, room), _longer(self._hash, room)
            self._found, self._firm = _longer(self._found, room), _longer(self._firm, room)
        end = self._spots + MOST_NEW
        spots, cells = find(self._table, self._point[self._spots : end], self._hash[self._spots : end])
        self._spots, self._cells = self._spots + spots, self._cells + cells

    def _remember(self, view: int, frame: Frame, T: Float64, sparse: SparseDepth | None) -> None:
        """Keep depth of a view, and of the new spots which view found them and which lie at no edge of depth.

        A point of a LiDAR lies on a surface, at an edge, too; but a spot between points may lie between two surfaces.
        """
        if self._memory is None:
            return
        new = slice(self._known, self._spots)
        self._found[new] = view
        if not of_lidar(sparse):
            self._firm[new] = firm(self._point[new], T, pinhole(frame.intrinsics), fixed(frame.depth), self._noise)
            if self._memory.wants(view):
                self._memory.add(KeptDepth.of_image(view, T.copy(), pinhole(frame.intrinsics), fixed(frame.depth)))
            return
        points, place = (sparse.u, sparse.v, sparse.w), (sparse.camera, sparse.around, sparse.spacing)
        depth = KeptPoints.from_points(view, T.copy(), *place, sparse.grid.shape, points)
        self._firm[new] = depth.at_points(self._point[new], self._sigma)
        if self._memory.wants(view):
            self._memory.add(depth)

    def _rebuild(self, size: int) -> None:
        """Put the coarse cells that are in the sample into a table of another size."""
        from semstab.statistics.loops.cells import refill

        table = np.full(size, -1, np.int64)
        self._cells = refill(self._table, self._share, self._low, table)
        self._table = table

    # --- Answers ------------------------------------------------------------------------------------------------------

    @property
    def _sigma(self) -> float:
        """The standard deviation of how depth differs between views so far, relative; of a first one, its noise."""
        return float(np.median(self._errors)) if self._errors else self._noise

    def _allowed(self) -> float:
        """Return the tolerance of depth, relative: it follows from the flight's own differences so far."""
        return min(max(SIGMAS * self._sigma, LEAST), MOST)

    def _learn(self, earlier: int, spot: npt.NDArray[np.int32], error: Float64) -> None:
        """Take how much a frame's depth differs at the spots that it did not find itself."""
        deviations = np.abs(error[(spot < earlier) & (np.abs(error) < GATE)])
        if len(deviations) >= ENOUGH:
            self._errors.append(float(np.median(deviations)) / 0.6745)

    def _answers_of_image(self, frame: Frame, T: Float64, seed: int) -> tuple[Any, ...]:
        from semstab.statistics.loops.answers import answer, project

        n, camera = self._spots, pinhole(frame.intrinsics)
        spot, pixel, (x, y, error, room) = np.empty(n, np.int32), np.empty(n, np.int64), np.empty((4, n))
        noise = SURE * self._noise if self._noise > SMOOTH else 0.0
        where = fixed(frame.depth), camera, T, noise, self._allowed()
        n = project(self._point[:n], *where, spot, pixel, x, y, error, room)
        spot, pixel, x, y, error, room = spot[:n], pixel[:n], x[:n], y[:n], error[:n], room[:n]
        self._learn(self._known, spot, error)
        self._pixel = spot, pixel
        out = _room(n)
        m = answer(
            spot, pixel, x, y, room, self._allowed(), fixed(frame.depth), *_labels(frame), self.K, camera, self._hash,
            seed, *out,
        )  # fmt: skip
        return tuple(column[:m] for column in out)

    def _answers_of_points(self, frame: Frame, sparse: SparseDepth, T: Float64, seed: int) -> tuple[Any, ...]:
        from semstab.statistics.loops.sparse import answer_points, answer_sparse, project_sparse

        n = self._spots
        spot, nearest, (x, y, error, room) = np.empty(n, np.int32), np.empty(n, np.int64), np.empty((4, n))
        place = sparse.camera, sparse.around, sparse.reach
        n = project_sparse(self._point[:n], *sparse.arrays, *place, T, spot, x, y, error, room, nearest)
        spot, x, y, error, room, nearest = spot[:n], x[:n], y[:n], error[:n], room[:n], nearest[:n]
        self._learn(self._known, spot, error)
        self._pixel = spot, nearest
        out = _room(n)
        if sparse.labels is None:
            m = answer_sparse(
                spot, x, y, error, self._allowed(), *_labels(frame), self.K, sparse.w, nearest, sparse.camera,
                self._hash, seed, *out,
            )  # fmt: skip
        else:
            m = answer_points(
                spot, x, y, error, room, self._allowed(), *sparse.arrays, sparse.labels, self.K, nearest, *place,
                self._hash, seed, *out,
            )  # fmt: skip
        return tuple(column[:m] for column in out)

    def _take(self, view: int, spot: Any, label: UInt16, second: UInt16, third: UInt16, square: Any) -> None:
        """Add the answers of a view; drop every second spot while there are too many of them."""
        end = self._answers + len(spot)
        if end > len(self._columns["spot"]):
            self._columns = {name: _longer(column, max(2 * len(column), end)) for name, column in self._columns.items()}
        values = spot, np.full(len(spot), view), label, second, third, square[:, 0], square[:, 1]
        for name, value in zip(COLUMNS, values, strict=True):
            self._columns[name][self._answers : end] = value
        self._answers = end
        while self._answers > self.budget or self._spots > MOST_SPOTS:
            self._halve()

    def _take_features(self, frame: Frame, sparse: SparseDepth | None, view: int, spot: Int32, label: UInt16) -> None:
        """Add the features of a view at the pixels, or points, that answer for spots, whatever their labels."""
        assert frame.features is not None
        assert self._pixel is not None
        spot = spot[label <= self.K]
        spots_with_pixel, pixel = self._pixel
        pixel = pixel[np.searchsorted(spots_with_pixel, spot)]
        if sparse is None:
            v, u = np.divmod(pixel, frame.shape[1])
        else:
            u, v = (pixel, 0 * pixel) if frame.is_scan else (sparse.u[pixel], sparse.v[pixel])
        self._features.add(frame.features, view, spot, frame.features.cells(u, v), self._hash)

    def _halve(self) -> None:
        self._share //= 2
        remaining = self._hash[: self._spots] < self._share
        number = np.cumsum(remaining, dtype=np.int32) - 1
        self._features.renumber(remaining, number)
        rows = np.flatnonzero(remaining[self._columns["spot"][: self._answers]])
        for name, column in self._columns.items():
            column[: len(rows)] = number[column[rows]] if name == "spot" else column[rows]
        self._answers, n = len(rows), int(remaining.sum())
        for array in (self._point, self._hash, self._found, self._firm):
            array[:n] = array[: self._spots][remaining]
        self._spots = n
        self._rebuild(len(self._table))

    def sample(self, classes: tuple[str, ...] = (), distances: Float64 | None = None) -> SpotObservations:
        """Return a copy of the sample so far, without the pixels that are left out; distances are (K, K)."""
        return replace(self._observed(), classes=classes, distances=distances, votes=self._votes())

    def _observed(self) -> SpotObservations:
        """Return a copy of the answers so far, without the votes of views."""
        counted = np.flatnonzero(self._columns["label"][: self._answers] <= self.K)
        answers: dict[str, Any] = {name: column[counted] for name, column in self._columns.items()}
        return SpotObservations(
            **answers,
            point=self._point[: self._spots].copy(),
            drawn=self._hash[: self._spots].copy(),
            views=Views.from_rows(self._views.table().copy()),
            spacing=self._spacing if len(self._views) else 1.0,
            K=self.K,
            share=self._share,
            frames=self._frames,
        )

    def moving_pixels(self, votes: SpotVotes, frame: Frame) -> Mask:
        """Return the pixels (H, W) of a frame whose surface moved, by the depth of views and the votes of a sample.

        Raises:
            ValueError: If no depth of views is kept.
        """
        if self._memory is None:
            raise ValueError("no depth of views is kept; make the sampler with moving=True")
        sparse = of_lidar(SparseDepth.from_frame(frame, self.K))
        return self._memory.moving_pixels(frame, self._sigma, votes.misplaced, self._spacing, sparse=sparse)

    def _votes(self) -> SpotVotes | None:
        """Return what views say of the spots; None without depth of views."""
        if self._memory is None:
            return None
        n, views = self._spots, len(self._views)
        spots = self._point[:n], self._found[:n], self._firm[:n]
        return self._memory.votes_on(*spots, views, self._sigma, self._spacing)

    def features(self) -> FeatureObservations | None:
        """Return a copy of the features of the sample so far; None without features."""
        return None if self._features.is_empty else self._features.sample(self._observed())


def _room(n: int) -> tuple[Any, ...]:
    """Return room for n answers: spot, three labels, two squared distances."""
    labels = (np.empty(n, np.uint16) for _ in range(3))
    return np.empty(n, np.int32), *labels, np.empty((n, 2), np.float32)


def _longer(array: npt.NDArray[Any], length: int) -> npt.NDArray[Any]:
    """Return an array with room for more rows."""
    longer = np.empty((length, *array.shape[1:]), array.dtype)
    longer[: len(array)] = array
    return longer


def _labels(frame: Frame) -> tuple[Any, Any]:
    """Return the labels, and the mask of pixels without a label, (0, 0) if there is none."""
    return fixed(frame.predicted), fixed(np.zeros((0, 0), np.bool_) if frame.unlabelled is None else frame.unlabelled)


def _stride(shape: tuple[int, int]) -> int:
    """Return the distance of the pixels in which new spots are looked for."""
    return max(1, round(math.sqrt(shape[0] * shape[1] / LOOKED_AT)))


def _width(frame: Frame, sparse: SparseDepth | None, allowed: float) -> float:
    """Return the edge, metres, of a square as large as the mean area that a block of pixels, or a point, shows."""
    from semstab.statistics.loops.sparse import mean_area_of_points
    from semstab.statistics.loops.surface import mean_area

    if sparse is not None:
        place = sparse.camera, sparse.around, sparse.reach, sparse.apart(min(len(sparse.w), LOOKED_AT))
        return math.sqrt(mean_area_of_points(*sparse.arrays, *place, allowed, max(1, len(sparse.w) // SOME_POINTS)))
    stride = _stride(frame.shape)
    return stride * math.sqrt(mean_area(fixed(frame.depth), pinhole(frame.intrinsics), 2 * stride, stride))


def _noise(frame: Frame) -> float:
    """Return the noise of a frame's depth, relative, by which one pixel differs from the next ones."""
    from semstab.statistics.loops.surface import second_differences

    stride = 2 * _stride(frame.shape)
    differences = np.empty((frame.shape[0] // stride + 1) * (frame.shape[1] // stride + 1))
    n = second_differences(fixed(frame.depth), stride, differences)
    return float(np.median(differences[:n])) / 0.6745 / math.sqrt(6) if n else 0.0


@functools.lru_cache(maxsize=64)
def _factor(total: int) -> int:
    """Return a step near the golden section of a number, with which all numbers below it are met once."""
    step = max(1, round(total * 0.6180339887))
    while math.gcd(step, total) > 1:
        step += 1
    return step
