"""Find annotation tasks: the locations of a map on which frames disagree, each with the view that shows it best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import find_objects

from semstab.backends.shared.association import back_project
from semstab.core.prefetch import prefetch
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.frames import Frame
from semstab.data.measures import bits, dominant
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.exports.join import NONE, VoxelLookup
from semstab.exports.voxels import ExportedUnit
from semstab.metrics import CATEGORIES, categories
from semstab.statistics import psa
from semstab.statistics.places import connected
from semstab.task import Task

MIN_PSA = 0.8
"""The share of pairs of frames that must agree. A location with a smaller share is annotated, as is one that drifts or
is uncertain."""

BLOCK = 16
"""The largest edge of a location, voxels, that a person can assess at once."""

SMALLEST = 1 / 5000
"""The least share of an image that an outline encloses, 8 x 8 pixels of 640 x 480; a person cannot assess less."""

MORE = 8
"""The number of locations that are searched in the frames for each task: perhaps no frame shows a location well."""


@dataclass(frozen=True, eq=False)
class AnnotationTask:
    """A location to annotate, in the image that shows it best.

    Attributes:
        score: Bits of entropy that its label removes from the map: the sum over the voxels that the outline shows.
        label: The fused class, and `other` the next one; names.
        voxels: Number of voxels of the location; `op` is the median of the frames that saw them.
        center: (3,) of the location, metres: global coordinates where the scene has a georeference.
        frame: Number of the best view, `image` the name of its files.
        outline: Polygons (n, 2) in pixels x, y of the image of `size` (width, height).
        views: Names of the other images that show it, the best first.
    """

    score: float
    label: str
    other: str
    voxels: int
    op: float
    center: tuple[float, ...]
    frame: int
    image: str
    size: tuple[int, int]
    outline: tuple[Float64, ...]
    views: tuple[str, ...]


def annotation_tasks(chosen: ExportedUnit, task: Task, most: int) -> list[AnnotationTask]:
    """Return at most `most` tasks, the highest score first.

    A location is a connected set of voxels that at least two frames saw, with the same two likeliest classes, on which
    frames disagree. Its best view has the largest product of size in the image, how frontal and how sharp it is. A
    location where all frames make the same error is not found.

    Args:
        chosen: The voxels that may be annotated.
        task: The task whose frames were fused.
        most: The largest number of tasks.

    Raises:
        ConfigError: If frames disagree nowhere, or no frame shows it large enough.
        DataError: If the frames have no colour image.
    """
    locations = _Locations.from_unit(chosen, MORE * most)
    views = [view for fetched in prefetch(lambda i: _views(task, i, locations), task.indices) for view in fetched.item]
    by_location: dict[int, list[_View]] = {}
    for view in views:
        by_location.setdefault(view.location, []).append(view)
    if not by_location:
        raise ConfigError(
            "no image shows a location where frames disagree large enough for a person; use larger voxels"
        )
    best = [_ranked(location_views) for location_views in by_location.values()]
    best.sort(key=lambda location_views: -location_views[0].bits)
    return [locations.task(location_views, task) for location_views in best[:most]]


@dataclass(frozen=True, eq=False)
class _Locations:
    """The voxels that are annotated: (n,) the location of each, 0, 1, ..., its two classes, and its entropy in bits.

    Attributes:
        projected: The function that projects points (n, 3) of the scene, where the scene has a projection.
    """

    table: VoxelTable
    location: Int64
    label: Int64
    other: Int64
    bits: Float64
    names: tuple[str, ...]
    projected: Callable[[Float64], Float64]

    @classmethod
    def from_unit(cls, chosen: ExportedUnit, most: int) -> _Locations:
        """Return the locations with the most entropy, at most `most`."""
        parts = list(chosen)
        first = parts[0]
        table = VoxelTable.joined([part.table.rows(_disagreed(part.table)) for part in parts])
        if not len(table):
            raise ConfigError("the frames disagree nowhere; there is nothing to annotate")
        label, entropy = dominant(table), bits(table)
        rest = table.evidence[:]
        rest[np.arange(len(table)), label] = -1
        other = rest.argmax(axis=1)
        location = _connected(table.index, np.stack([label, other], axis=1))
        total = np.bincount(location, entropy)
        rank = np.empty(len(total), np.int64)
        rank[np.argsort(-total, kind="stable")] = np.arange(len(total))
        rows = np.flatnonzero(rank[location] < most)
        return cls(
            table.rows(rows),
            rank[location[rows]],
            label[rows],
            other[rows],
            entropy[rows],
            first.classes,
            first.in_file,
        )

    def task(self, views: list[_View], task: Task) -> AnnotationTask:
        """Return the task of a location from its views, the best first."""
        best, names = views[0], task.scene.image_name
        in_location = self.location == best.location
        k = int(np.flatnonzero(in_location)[0])
        center = self.projected(self.table.centers[in_location].mean(axis=0, keepdims=True))[0]
        return AnnotationTask(
            best.bits, self.names[self.label[k]], self.names[self.other[k]], int(in_location.sum()),
            float(np.median(self.table.op[in_location])), tuple(center.tolist()), best.frame, names(best.frame),
            best.size, best.outline, tuple(names(view.frame) for view in views[1:]),
        )  # fmt: skip


def _disagreed(table: VoxelTable) -> Int64:
    """Return the rows of voxels on which frames disagree."""
    category = np.array(CATEGORIES)[categories(table)]
    uncertain = np.isin(category, ("drifting", "uncertain")) | (np.nan_to_num(psa(table), nan=1.0) < MIN_PSA)
    return np.flatnonzero(uncertain & (table.op >= 2))


def _connected(index: Int32, classes: Int64) -> Int64:
    """Return the connected set (n,) of each voxel (n, 3) with others of its classes (n, 2); blocks cut large ones."""
    component = connected(index, classes)
    corner = np.full((component.max() + 1, 3), np.iinfo(index.dtype).max)
    np.minimum.at(corner, component, index)
    return connected(index, np.column_stack([component, (index - corner[component]) // BLOCK]))


# Locations in the images.


@dataclass(frozen=True, eq=False)
class _View:
    """A location in a frame.

    Attributes:
        bits: Entropy of the voxels that it shows, bits.
        pixels: Pixels of the outline.
        area: Area of the surface across the line of sight, square metres: the more frontal, the larger.
        sharp: Mean square of the image's second derivative in the outline.
    """

    location: int
    frame: int
    size: tuple[int, int]
    outline: tuple[Float64, ...]
    bits: float
    pixels: float
    area: float
    sharp: float


def _ranked(views: list[_View]) -> list[_View]:
    """Return the views of a location, the best first."""
    area, sharp = (max(getattr(view, name) for view in views) for name in ("area", "sharp"))
    return sorted(views, key=lambda view: -view.bits * view.pixels * (view.area / area) * (view.sharp / sharp))


def _views(task: Task, index: int, locations: _Locations) -> list[_View]:
    """Return the locations that a frame shows."""
    image = task.scene.color(index)
    if image is None:
        raise DataError(f"{task.scene.name}, {task.scene.image_name(index)}: the frame has no colour image to annotate")
    frame = task.scene.view(index, image.shape[:2])
    rows = np.full(frame.shape, NONE)
    rows[frame.valid] = VoxelLookup(locations.table).rows(back_project(frame).T)
    location = np.where(rows == NONE, NONE, locations.location[rows])
    sharpness: Float64 = cv2.Laplacian(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.CV_64F).astype(np.float64) ** 2
    boxes = enumerate(find_objects(location + 1))
    candidates = [_view(frame, rows, location, k, box, locations, sharpness) for k, box in boxes if box is not None]
    return [view for view in candidates if view is not None]


def _view(
    frame: Frame,
    rows: Int64,
    location: Int64,
    k: int,
    box: tuple[slice, slice],
    locations: _Locations,
    sharpness: Float64,
) -> _View | None:
    """Return location k within a box of the image, or None if the image shows too little of it."""
    pixels = location[box] == k
    K, z = frame.intrinsics, frame.depth[box][pixels].astype(np.float64)
    outline, mask = outlined(pixels, locations.table.voxel_size * K.fx / float(np.median(z)), SMALLEST * rows.size)
    if not mask.any():
        return None
    corner, (H, W) = np.array([box[1].start, box[0].start], np.float64), frame.shape
    return _View(
        k, frame.index, (W, H), tuple(polygon + corner for polygon in outline),
        float(locations.bits[np.unique(rows[box][pixels])].sum()), float(mask.sum()),
        float((z**2).sum() / (K.fx * K.fy)), float(sharpness[box][mask].mean()) + 1e-9,
    )  # fmt: skip


def outlined(pixels: Mask, voxel: float, smallest: float) -> tuple[tuple[Float64, ...], Mask]:
    """Return polygons around pixels (H, W), gaps up to the width of a voxel filled, and what they enclose.

    Args:
        pixels: (H, W), those to outline.
        voxel: Width of a voxel, pixels.
        smallest: Area of an outline, square pixels.
    """
    width = int(np.clip(np.ceil(voxel), 3, 31)) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    closed = cv2.morphologyEx(np.pad(pixels.astype(np.uint8), width), cv2.MORPH_CLOSE, kernel)
    closed = np.pad(closed[width:-width, width:-width], (0, 1))
    square = np.ones((2, 2), np.uint8)  # OpenCV's contours run through the centres of pixels: here, along their edges
    edged = cv2.dilate(closed, square, anchor=(1, 1))
    contours, _ = cv2.findContours(edged, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    selected = [cv2.approxPolyDP(c, 1.0, True) for c in contours if cv2.contourArea(c) >= max(4, smallest)]
    selected = [c for c in selected if len(c) >= 3]
    mask = np.zeros(closed.shape, np.uint8)
    cv2.drawContours(mask, selected, -1, 1, cv2.FILLED)
    inside = cv2.erode(mask, square, anchor=(0, 0))[:-1, :-1].astype(np.bool_)
    return tuple(c[:, 0].astype(np.float64) for c in selected), inside
