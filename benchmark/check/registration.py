"""A check that label maps and depth show the same thing at the same pixel: their edges lie on each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import OPTION
from semstab.check.reprojection import Pair, View
from semstab.check.verdict import Verdict
from semstab.core.arrays import evenly
from semstab.core.types import Float32, Float64, Mask, UInt8
from semstab.data.frames import Intrinsics
from semstab.data.measures import mean
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.pixels.edges import depth_edges, image_edges, label_edges
from semstab.pixels.warp import LEAST_DENSITY, density

WIDTH = 192
"""Approximate number of columns of the grid on which edges are compared."""

SCALES = np.arange(0.84, 1.17, 0.02)
REACH = 0.08
"""Other registrations that are tried: enlarged about the image's centre, and moved by this share of the width."""

CLEARLY = 1.1
"""Ratio of fits from which another registration counts, in each half of the frames and in most frames."""

LEAST_FIT = 0.1
"""Correlation of edges from which a fit is one."""

LEAST_OFFSET = 0.03
"""Share of the image's width: a smaller offset in the middle of its sides is no fault of the registration."""

MOST = 0.75
"""Share of the frames that another registration has to fit better."""

LEAST_FRAMES = 4

Map = Float64
Edges = tuple[Float32, Mask]
"""Depth (H, W), and edges (H, W) of labels or of the image."""


@dataclass(frozen=True)
class Offset:
    """The change that brings the label maps onto the depth: enlarge them about the centre, then move them, pixels."""

    scale: float
    shift: tuple[float, float]
    fit: float
    present: float

    def __str__(self) -> str:
        x, y = self.shift
        return (
            f"their edges fit those of depth best when they are enlarged {self.scale:.2f} times and moved by"
            f" ({x:.0f}, {y:.0f}) pixels (correlation {self.fit:.2f}, now {self.present:.2f})"
        )


def find_offset(pairs: Sequence[Edges]) -> Offset | None:
    """Return the offset of edges (H, W) of labels or images from edges of depth (H, W), frame by frame.

    The result is None if the edges fit, or if the best fit lies on the bound of the search, and is no optimum. It is
    also None if depth is sparse (`semstab.pixels.warp.density`), as edges of sparse depth are edges of its gaps.

    Both halves of the frames have to agree, so that edges that have nothing to do with each other do not count.
    """
    if not mean(np.array([density(depth) for depth, _ in pairs])) >= LEAST_DENSITY:
        return None
    maps = [(_thinned(depth_edges(depth)), _thinned(edges)) for depth, edges in pairs]
    maps = [(a, b) for a, b in maps if a.any() and b.any() and a.shape == b.shape == maps[0][0].shape]
    if len(maps) < LEAST_FRAMES:
        return None
    fits = [_fits(a, b) for a, b in maps]
    halves = [np.mean(fits[k::2], axis=0) for k in (0, 1)]
    mean_fits = np.mean(fits, axis=0)
    best, here = _peak(mean_fits), _identity(mean_fits)
    if any(position in (0, size - 1) for position, size in zip(best, mean_fits.shape, strict=True)):
        return None
    agree = all(_distance(_peak(half), best, maps[0][0].shape) < LEAST_OFFSET for half in halves)
    clear = all(half[best] > CLEARLY * half[here] for half in halves) and mean_fits[best] >= LEAST_FIT
    clear = clear and np.mean([fit[best] > fit[here] for fit in fits]) >= MOST
    if not (agree and clear) or _distance(best, here, maps[0][0].shape) < LEAST_OFFSET:
        return None
    cell, reach = pairs[0][0].shape[1] / maps[0][0].shape[1], mean_fits.shape[1] // 2
    shift = ((best[2] - mean_fits.shape[2] // 2) * cell, (best[1] - reach) * cell)
    return Offset(float(SCALES[best[0]]), shift, float(mean_fits[best]), float(mean_fits[here]))


def grey_levels(color: UInt8) -> UInt8:
    """Return the brightness (H, W) of colour (H, W, 3), 0 to 254, which can be brought to the depth like labels."""
    grey: UInt8 = (color.mean(axis=2) * (254 / 255)).astype(np.uint8)
    return grey


def _thinned(edges: Mask) -> Map:
    """Return the share of edges in each cell of a coarse grid, smoothed a little, without its mean."""
    import cv2

    cell = max(1, math.ceil(edges.shape[1] / WIDTH))
    H, W = (side // cell for side in edges.shape)
    grid = edges[: H * cell, : W * cell].reshape(H, cell, W, cell).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), 1.0), dtype=np.float64)


def _fits(a: Map, b: Map) -> Map:
    """Return (scales, shifts in y, shifts in x).

    Correlation of map a with map b, enlarged about the centre and moved.
    """
    import cv2

    H, W = a.shape
    reach = max(1, round(REACH * W))
    a = (a - a.mean()).astype(np.float32)
    around = cv2.copyMakeBorder(a, reach, reach, reach, reach, cv2.BORDER_CONSTANT)
    fits = []
    for scale in SCALES:
        about = np.array([[scale, 0, (1 - scale) * (W - 1) / 2], [0, scale, (1 - scale) * (H - 1) / 2]])
        warped = cv2.warpAffine(b, about, (W, H), flags=cv2.INTER_LINEAR)
        warped = (warped - warped.mean()).astype(np.float32)
        norm = math.sqrt(np.square(a).sum() * np.square(warped).sum())  # BLAS would wake its threads for each of them
        fits.append(cv2.matchTemplate(around, warped, cv2.TM_CCORR) / max(norm, 1e-12))
    return np.array(fits, dtype=np.float64)


def _peak(fits: Map) -> tuple[int, ...]:
    return tuple(int(k) for k in np.unravel_index(fits.argmax(), fits.shape))


def _identity(fits: Map) -> tuple[int, ...]:
    return (int(np.abs(SCALES - 1).argmin()), fits.shape[1] // 2, fits.shape[2] // 2)


def _distance(first: tuple[int, ...], second: tuple[int, ...], shape: tuple[int, ...]) -> float:
    """Return how far two registrations lie apart in the middle of the image's sides, as a share of its width."""
    H, W = shape
    scale = abs(SCALES[first[0]] - SCALES[second[0]])
    x, y = (abs(first[k] - second[k]) / W for k in (2, 1))
    return float(max(x + scale / 2, y + scale / 2 * H / W))


# A check that a surface and the poses fit the images compares neighbouring photographs by depth and pose.
#
# Depth that is cast at a surface agrees between frames wherever the surface lies; the photographs do not.

CHANGES = np.linspace(-0.3, 0.3, 241)
"""The shares of it by which depth is made larger."""

LONGEST_SIDE = 800
"""Pixels of the images that are compared: a step of depth then moves them by a pixel or so."""

POINTS = 1500
LEAST_POINTS = 100
MOST_PAIRS = 6

CLEARLY_BETTER = 0.15
MATCHING = 0.35
"""Correlations: of another depth over that of the present one, and of images that do show the same."""


@dataclass(frozen=True)
class ImageMatch:
    """The match of neighbouring images: correlation of grey values, mean over pairs.

    Attributes:
        now: The match with depth as it is.
        best: The match with depth larger by the share `change`, which is `metres` of the median depth.
    """

    now: float
    best: float
    change: float
    metres: float
    pairs: int


def match_images(scene: Scene, views: Mapping[int, View], pairs: Sequence[Pair]) -> ImageMatch | None:
    """Compare the images of neighbouring frames; return None without images, or with too little in common."""
    near = sorted((abs(a - b), a, b) for a, b in pairs if a < b)
    closest = [(a, b) for _, a, b in near[:MOST_PAIRS]]
    images = {
        position: _image(scene, views[position]) for position in {position for pair in closest for position in pair}
    }
    curves: list[Float64] = []
    depths: list[Float32] = []
    for a, b in closest:
        first, second = images[a], images[b]
        if first is not None and second is not None:
            curves.append(_correlations(views[a], first, views[b], second))
            depths.append(views[a].depth[views[a].v, views[a].u])
    present = int(np.abs(CHANGES).argmin())
    together = [np.nan_to_num(curve) for curve in curves if np.isfinite(curve[present])]
    if not together:
        return None
    mean = np.mean(together, axis=0)
    best, now = int(mean.argmax()), float(mean[present])
    change = float(CHANGES[best])
    return ImageMatch(now, float(mean[best]), change, change * float(np.median(np.concatenate(depths))), len(together))


def assess_surface(match: ImageMatch | None, frames: int) -> Verdict:
    """Return the verdict of the images on a surface and the poses."""
    if match is None:
        return Verdict(
            "unclear",
            "depth is cast at a surface and so agrees between frames whatever the poses are; without images of"
            " overlapping frames nothing tells whether they fit; option images names their folder",
            frames=frames,
        )
    if match.best >= MATCHING and match.best - match.now > CLEARLY_BETTER:
        side = "further from the cameras" if match.change > 0 else "nearer to the cameras"
        return Verdict(
            "unsound",
            f"neighbouring images match best if the surface lies {abs(match.metres):.3g} m {side} (correlation"
            f" {match.best:.2f}, now {match.now:.2f}): surface and poses differ in height or scale; bring"
            " them to the same coordinates",
            frames=frames,
            pairs=match.pairs,
        )
    if match.now < MATCHING:
        return Verdict(
            "unclear",
            f"neighbouring images hardly match (correlation {match.now:.2f})",
            frames=frames,
            pairs=match.pairs,
        )
    return Verdict(
        "sound",
        f"neighbouring images match by surface and poses (correlation {match.now:.2f}; the best is"
        f" {match.best:.2f}, with the surface moved by {abs(match.metres):.2g} m)",
        frames=frames,
        pairs=match.pairs,
    )


@dataclass(frozen=True, eq=False)
class _Image:
    """Grey values (h, w) float32 of a view's colour image, and its intrinsics."""

    grey: Float32
    camera: Intrinsics


def _image(scene: Scene, view: View) -> _Image | None:
    import cv2

    color = scene.color(view.index)
    if color is None:
        return None
    W, H = view.size
    factor = min(1.0, LONGEST_SIDE / max(W, H))
    size = max(1, round(W * factor)), max(1, round(H * factor))
    grey = cv2.resize(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    return _Image(np.asarray(smooth, dtype=np.float32), view.camera.resized((W, H), size))


def _correlations(a: View, image_a: _Image, b: View, image_b: _Image) -> Float64:
    """Return (changes,) correlation of the first image's grey values with those that they meet in the second."""
    v, u = np.nonzero((a.depth > 0) & (a.depth < np.inf))
    if len(u) < LEAST_POINTS:
        return np.full(len(CHANGES), np.nan)
    if len(u) > POINTS:
        chosen = np.random.default_rng(a.index).choice(len(u), POINTS, replace=False)
        v, u = v[chosen], u[chosen]
    K = a.camera.every(a.stride)
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(len(u))])
    motion = np.linalg.inv(b.T_wc) @ a.T_wc
    turned = motion[:3, :3] @ (rays * a.depth[v, u])
    x, y, z = (turned[axis] * (1 + CHANGES[:, None]) + motion[axis, 3] for axis in range(3))
    with np.errstate(all="ignore"):
        column, row = image_b.camera.fx * x / z + image_b.camera.cx, image_b.camera.fy * y / z + image_b.camera.cy
    h, w = image_b.grey.shape
    inside = (z > 0) & (column >= 0) & (column <= w - 1) & (row >= 0) & (row <= h - 1)
    met = _at(image_b.grey, np.where(inside, column, 0), np.where(inside, row, 0))
    K = image_a.camera
    (grey,) = _at(image_a.grey, K.fx * rays[:1] + K.cx, K.fy * rays[1:2] + K.cy)
    return np.array([_correlation(grey[valid], met[k][valid]) for k, valid in enumerate(inside)])


def _at(image: Float32, column: Float64, row: Float64) -> Float32:
    import cv2

    return np.asarray(cv2.remap(image, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR))


def _correlation(a: Float32, b: Float32) -> float:
    if len(a) < LEAST_POINTS or a.std() == 0 or b.std() == 0:
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])


# Properties of a scene that look wrong, but may be right: little depth, labels off the edges of depth.

FEW = 0.1
"""The share of the pixels with depth below which it is said."""

REGISTERED_FRAMES = 16
"""Frames in which the edges of labels are compared with those of depth."""


def notes(scene: Scene, views: Sequence[View], model: str) -> Iterator[str]:
    """Yield one line each; the views have the labels of `model`, or none."""
    sampled = [views[k] for k in evenly(len(views), REGISTERED_FRAMES)]
    if (share := mean(np.array([np.mean((v.depth > 0) & (v.depth < np.inf)) for v in sampled]))) < FEW:
        yield (
            f"{100 * share:.2g} % of the pixels have depth: labels of the others are in no map, and flicker is of those"
            " that have it"
        )
    if (offset := find_offset(list(_edges(scene, sampled)))) is not None:
        what = "the images" if sampled[0].labels is None else f"labels of {model}"
        mend = "register them to the depth"
        if "color_intrinsics" in scene.settings:
            value = scene.usual.get("color_intrinsics", "[fx, fy, cx, cy]")
            mend = f"set {OPTION}color_intrinsics: {value}, or {mend}"
        yield f"{what} look as if they were not registered to the depth: {offset}; {mend}"


def _edges(scene: Scene, views: Sequence[View]) -> Iterator[Edges]:
    """Yield depth and edges of the labels, or without labels of the images, of views."""
    for view in views:
        if view.labels is not None:
            yield view.depth, label_edges(view.labels, view.ignore_id)
            continue
        try:
            grey = scene.predicted(view.index, labels=grey_levels(scene.image(view.index))).labels
        except DataError:  # no image of the depth's view: the error is raised where one is needed
            continue
        if grey is not None:
            yield view.depth, image_edges(grey[:: view.stride, :: view.stride])
