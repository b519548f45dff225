"""Small pictures of the worst places of a map, from the frames that see them: the image and its labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64
from semstab.data.frames import Frame
from semstab.statistics.places import Place, PlaceView
from semstab.task import Task, read

PICTURED, READ, EACH = 6, 4, 2
"""The most places that have pictures, the most frames that are read again for them, and the most of a place."""

EDGE, AROUND, LEAST = 160, 3.0, 48
"""Edge of a picture in pixels; the edge of the part of the frame that it shows, as a multiple of the place's extent;
and the least edge of this part, in pixels."""


def pictures_of_places(task: Task, places: Sequence[Place], pixel_stride: int) -> dict[str, npt.NDArray[Any]]:
    """Return pictures of the first places, as arrays (n, ...) by name.

    - `place_of`: number of the place
    - `place_centre`: (n, 3) centre of the place
    - `place_frame`: frame
    - `place_labels`: (n, h, w) rows 0..K-1, or a larger number without a label
    - `place_color`: (n, h, w, 3) colour, if all frames have colour
    - `place_ring`: (n, 3) centre (x, y) and radius of a circle around the place, as shares of the picture
    """
    places = places[:PICTURED]
    chosen = chosen_frames(places)
    frames = {index: read(task, index, pixel_stride, color=True) for index in sorted(chosen)}
    rows = []
    for place in places:
        for view in pictured_views(place, chosen):
            if (cut := cut_out(frames[view.frame], place.points)) is not None:
                rows.append((place.number, place.centre, view.frame, *cut))
    if not rows:
        return {}
    numbers, centres, frame_indices, labels, color, rings = zip(*rows, strict=True)
    arrays = {
        "of": np.array(numbers),
        "centre": np.array(centres),
        "frame": np.array(frame_indices),
        "ring": np.array(rings),
    }
    arrays |= {"labels": np.stack(labels)}
    arrays |= {} if any(image is None for image in color) else {"color": np.stack(color)}
    return {f"place_{name}": values for name, values in arrays.items()}


def chosen_frames(places: Sequence[Place]) -> set[int]:
    """Return few frames that show the places; a frame may show several places."""
    chosen = set[int]()
    for place in places:
        for label in (place.label, place.other):
            class_views = [view for view in place.views if view.label == label]
            if class_views and len(chosen) < READ and not any(view.frame in chosen for view in class_views):
                chosen.add(max(class_views, key=lambda view: view.spots).frame)
    return chosen


def pictured_views(place: Place, chosen: set[int]) -> list[PlaceView]:
    """Return the views of a place among the chosen frames, with one of each class first."""
    candidates = sorted((view for view in place.views if view.frame in chosen), key=lambda view: -view.spots)
    first = {view.label: view for view in reversed(candidates)}
    different = [view for view in candidates if first[view.label] is view]
    return [*different, *(view for view in candidates if view not in different)][:EACH]


def cut_out(
    frame: Frame, points: Float64
) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None, tuple[float, float, float]] | None:
    """Return the square part of a frame around points (n, 3): labels and colour (EDGE, EDGE), and the place's ring.

    Returns None if the frame does not show the points.
    """
    H, W = frame.shape
    camera = (points - frame.T_wc[:3, 3]) @ frame.T_wc[:3, :3]
    before = camera[camera[:, 2] > 0]
    if not len(before):
        return None
    K = frame.intrinsics
    pixel = before[:, :2] / before[:, 2:] * (K.fx, K.fy) + (K.cx, K.cy)
    inside = ((pixel >= 0) & (pixel <= (W - 1, H - 1))).all(axis=1)
    if not inside.any():
        return None
    pixel = pixel[inside]
    middle, extent = np.median(pixel, axis=0), float(np.ptp(pixel, axis=0).max()) + 1
    edge = int(np.clip(AROUND * extent, min(LEAST, H, W), min(H, W)))
    x, y = (int(np.clip(round(m - edge / 2), 0, size - edge)) for m, size in zip(middle, (W, H), strict=True))
    across, down = (np.linspace(start, start + edge - 1, EDGE).round().astype(int) for start in (x, y))
    labels = frame.predicted[np.ix_(down, across)]
    ring = ((middle[0] - x) / edge, (middle[1] - y) / edge, 0.6 * extent / edge)
    return labels, _color(frame, x, y, edge), (float(ring[0]), float(ring[1]), float(ring[2]))


def _color(frame: Frame, x: int, y: int, edge: int) -> npt.NDArray[Any] | None:
    """Return the colour (EDGE, EDGE, 3) of a square of the frame's pixels."""
    if frame.color is None:
        return None
    down, across = (
        color_size / frame_size for color_size, frame_size in zip(frame.color.shape[:2], frame.shape, strict=True)
    )
    rows, columns = (
        slice(round(start * by), max(round(start * by) + 1, round((start + edge) * by)))
        for start, by in ((y, down), (x, across))
    )
    return cv2.resize(np.ascontiguousarray(frame.color[rows, columns]), (EDGE, EDGE), interpolation=cv2.INTER_AREA)
