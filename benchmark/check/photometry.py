"""Do a surface and the poses fit the images? Neighbouring photographs, compared where depth and pose carry them.

Depth that is cast at a surface agrees between frames wherever the surface lies; the photographs do not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semstab.check.geometry import Verdict
from semstab.check.views import Pair, View
from semstab.datasets import Scene
from semstab.model.frames import Intrinsics

Float64 = npt.NDArray[np.float64]

CHANGES = np.linspace(-0.3, 0.3, 241)
"""By which shares of it depth is made larger."""

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
    """How neighbouring images match: correlation of grey values, mean over pairs.

    now     with depth as it is
    best    with depth larger by the share `change`, which is `metres` of the median depth
    """

    now: float
    best: float
    change: float
    metres: float
    pairs: int


def match_images(scene: Scene, views: Mapping[int, View], pairs: Sequence[Pair]) -> ImageMatch | None:
    """Compare the images of neighbouring frames; None where there are none, or they have too little in common."""
    near = sorted((abs(a - b), a, b) for a, b in pairs if a < b)
    closest = [(a, b) for _, a, b in near[:MOST_PAIRS]]
    images = {at: _image(scene, views[at]) for at in {at for pair in closest for at in pair}}
    curves: list[Float64] = []
    depths: list[npt.NDArray[np.float32]] = []
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
    at, now = int(mean.argmax()), float(mean[present])
    change = float(CHANGES[at])
    return ImageMatch(now, float(mean[at]), change, change * float(np.median(np.concatenate(depths))), len(together))


def judge_surface(match: ImageMatch | None, frames: int) -> Verdict:
    """What the images say of a surface and the poses."""
    if match is None:
        return Verdict(
            "unclear",
            "depth is cast at a surface and so agrees between frames whatever the poses are; without images of"
            " overlapping frames nothing tells whether they fit",
            frames=frames,
        )
    if match.best >= MATCHING and match.best - match.now > CLEARLY_BETTER:
        side = "further from the cameras" if match.change > 0 else "nearer to the cameras"
        return Verdict(
            "unsound",
            f"neighbouring images match where the surface lies {abs(match.metres):.3g} m {side} (correlation"
            f" {match.best:.2f}, as it is {match.now:.2f}): surface and poses lie in other heights or scales; bring"
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
        f"neighbouring images match where surface and poses carry them (correlation {match.now:.2f}; best"
        f" {match.best:.2f}, with the surface {abs(match.metres):.2g} m away)",
        frames=frames,
        pairs=match.pairs,
    )


@dataclass(frozen=True, eq=False)
class _Image:
    """Grey values (h, w) float32 of a view's colour image, and its intrinsics."""

    grey: npt.NDArray[np.float32]
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
    """(changes,) correlation of the first image's grey values with those that they meet in the second."""
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
    seen = (z > 0) & (column >= 0) & (column <= w - 1) & (row >= 0) & (row <= h - 1)
    met = _at(image_b.grey, np.where(seen, column, 0), np.where(seen, row, 0))
    K = image_a.camera
    (own,) = _at(image_a.grey, K.fx * rays[:1] + K.cx, K.fy * rays[1:2] + K.cy)
    return np.array([_correlation(own[one], met[k][one]) for k, one in enumerate(seen)])


def _at(image: npt.NDArray[np.float32], column: Float64, row: Float64) -> npt.NDArray[np.float32]:
    import cv2

    return np.asarray(cv2.remap(image, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR))


def _correlation(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> float:
    if len(a) < LEAST_POINTS or a.std() == 0 or b.std() == 0:
        return np.nan
    return float(np.corrcoef(a, b)[0, 1])
