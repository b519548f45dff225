"""Label maps of frames in a row, as they are and as each hypothesis supposes, against the edges of depth and colour."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.conventions import Convention
from semstab.check.geometry import shifts_and_turns
from semstab.check.registration import grey_levels
from semstab.check.reprojection import Ids, Pair, Sample, Shared, View
from semstab.check.trials import Hypothesis
from semstab.core.arrays import evenly
from semstab.core.types import Float64, Mask
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.pixels.edges import depth_edges, image_edges, label_edges

IN_A_RUN = 5
"""Frames in a row that are read together: labels may be those of a neighbour."""

PIXELS = 2**17
COLUMNS = 256
"""The largest number of pixels of an image, else every n-th pixel of each axis is used; and of columns of the grid on
which edges are compared."""

POINTS = 1000
LEAST_POINTS = 50
"""Points of a frame that are reprojected into another, and the least that both have to see."""

MOVES = 0.01
TURNS = 1.0
"""A camera counts as moving from this share of the depth, or from these degrees of rotation, from frame to frame."""

Change = Callable[[Ids, int], Ids]


@dataclass(frozen=True, eq=False)
class LabelledFrame:
    """A frame with labels, thinned, and the maps of edges that these should lie on: of depth, and of colour if any.

    Attributes:
        whole: All labels of the file (H, W), at the depth's pixels.
    """

    view: View
    references: tuple[Float64, ...]
    whole: Ids

    @property
    def labels(self) -> Ids:
        """The labels (H, W)."""
        assert self.view.labels is not None
        return self.view.labels

    @functools.cached_property
    def edges(self) -> Float64 | None:
        """Edges of the labels on the grid, of length 1, or None without edges."""
        return _edges(self.labels, self.view.ignore_id)

    def fit(self, edges: Float64 | None) -> float:
        """Return the correlation of edges of labels with those of depth and of colour, their mean."""
        if edges is None or not self.references:
            return math.nan
        return float(np.mean([np.sum(edges * reference) for reference in self.references]))


def read(scene: Scene, index: int, model: str) -> LabelledFrame:
    """Read a frame with its labels and its colour; raises DataError."""
    frame = scene.frame(index, model, color=False)
    stride = max(1, math.ceil(math.sqrt(math.prod(frame.shape) / PIXELS)))
    view = View.from_frame(frame.every(stride), POINTS)
    edges = [depth_edges(view.depth)]
    try:
        color = scene.color(index)
        if color is not None:
            grey = grey_levels(color)
            if grey.shape != frame.shape:
                grey = scene.predicted(index, labels=grey).labels  # type: ignore[assignment]
            edges.append(image_edges(grey[::stride, ::stride]))
    except DataError:  # no image of the depth's view
        pass
    return LabelledFrame(view, tuple(_smooth(edge_map) for edge_map in edges if edge_map.any()), frame.predicted)


def _smooth(edges: Mask) -> Float64:
    """Return the share of edges in each cell of a grid, smoothed a little, without its mean, of length 1."""
    import cv2

    cell = max(1, math.ceil(edges.shape[1] / COLUMNS))
    H, W = (side // cell for side in edges.shape)
    grid = edges[: H * cell, : W * cell].reshape(H, cell, W, cell).mean(axis=(1, 3))
    smooth = np.asarray(cv2.GaussianBlur(grid, (0, 0), 1.0), dtype=np.float64)
    smooth -= smooth.mean()
    normed: Float64 = smooth / max(math.sqrt(np.square(smooth).sum()), 1e-12)
    return normed


def _edges(labels: Ids, ignore: int) -> Float64 | None:
    edges = label_edges(labels, ignore)
    return _smooth(edges) if edges.any() else None


def readable(scene: Scene, run: Sequence[int], model: str) -> Iterator[LabelledFrame]:
    """Yield frames up to the first that cannot be read."""
    for index in run:
        try:
            yield read(scene, index, model)
        except DataError:
            return


def runs_of(scene: Scene, indices: Sequence[int], model: str, count: int) -> list[list[int]]:
    """Return `count` runs of frames in a row, evenly spaced; of selected frames where the ones between lack labels."""
    count = max(1, min(count, len(indices) // IN_A_RUN))
    starts = [indices[position] for position in evenly(max(1, len(indices) - IN_A_RUN + 1), count)]
    candidates, runs = [[*range(start, start + IN_A_RUN)] for start in starts], []
    for run in candidates:
        if all(i < len(scene) and scene.tracked(i) and not scene.missing(i, [model]) for i in run):
            runs.append(run)
    if runs:
        return runs
    return [[*indices[k : k + IN_A_RUN]] for k in range(0, len(indices), IN_A_RUN)][:count]


Common = dict[Pair, Shared]


def shared_of(views: Mapping[int, View], pairs: Sequence[Pair]) -> Common:
    """Return what pairs of frames see in common, where that is enough."""
    sample, factors = Sample(dict(views), pairs, Convention()), np.array([1.0])
    shared_by_pair = {
        (a, b): Shared.from_matches(views[a], sample.matched((a, b), Convention(), factors)) for a, b in pairs
    }
    return {pair: shared for pair, shared in shared_by_pair.items() if shared.chosen.sum() >= LEAST_POINTS}


def agreements(common: Common, maps: Mapping[int, Ids], ignore: int) -> list[float]:
    """Return for each pair of frames the share of common points whose labels agree, or NaN with too few."""
    label_pairs = [shared.labels(maps[a], maps[b], ignore) for (a, b), shared in common.items()]
    return [
        float(np.mean(first == second)) if len(first) >= LEAST_POINTS else math.nan for first, second in label_pairs
    ]


class LabelRun:
    """Frames in a row, and a label map with its edges for those that have one, by their places in the run."""

    def __init__(
        self, frames: Sequence[LabelledFrame], maps: Mapping[int, tuple[Ids, Float64 | None]] | None = None
    ) -> None:
        self.frames, self._maps = frames, maps

    @functools.cached_property
    def maps(self) -> Mapping[int, tuple[Ids, Float64 | None]]:
        """Label maps with their edges: the maps of the files by default."""
        return self._maps if self._maps is not None else {k: (f.labels, f.edges) for k, f in enumerate(self.frames)}

    @functools.cached_property
    def fits(self) -> dict[int, float]:
        """The fit of each map to depth and colour."""
        return {k: self.frames[k].fit(edges) for k, (_, edges) in self.maps.items()}

    @functools.cached_property
    def common(self) -> Common:
        """Points that each pair of frames has in common."""
        views = {k: frame.view for k, frame in enumerate(self.frames)}
        return shared_of(views, [*itertools.combinations(views, 2)])

    @functools.cached_property
    def tried(self) -> list[tuple[Hypothesis[LabelRun], LabelRun]]:
        """All hypotheses, with the run as each supposes."""
        return [(hypothesis, hypothesis.change(self)) for hypothesis in MAPS if hypothesis.applies(self)]

    def otherwise(self, step: int, change: Change | None = None) -> LabelRun:
        """Return the run in which each frame has the map of the frame `step` further on, changed."""
        maps = dict[int, tuple[Ids, Float64 | None]]()
        for k, frame in enumerate(self.frames):
            if 0 <= k + step < len(self.frames):
                source, ignore = self.frames[k + step], frame.view.ignore_id
                other = source.labels if change is None else change(source.labels, ignore)
                if other.shape == frame.labels.shape:
                    maps[k] = other, source.edges if change is None else _edges(other, ignore)
        return LabelRun(self.frames, maps)

    def by_frame(self, other: LabelRun) -> list[tuple[int, float, float]]:
        """Return index, own fit and fit in the other run of the frames that have a map there."""
        return [(self.frames[k].view.index, self.fits[k], other.fits[k]) for k in other.maps]

    def by_pair(self, other: LabelRun) -> list[tuple[float, float]]:
        """Return for each pair of frames the share of common points whose labels agree, here and in the other run."""
        common = {pair: shared for pair, shared in self.common.items() if {*pair} <= other.maps.keys()}
        label_maps = [{k: labels for k, (labels, _) in run.maps.items()} for run in (self, other)]
        agreements_here, agreements_other = (
            agreements(common, maps, self.frames[0].view.ignore_id) for maps in label_maps
        )
        return [*zip(agreements_here, agreements_other, strict=True)]

    def moves(self) -> bool:
        """Return whether the camera moves from its first to its last frame."""
        views = {k: frame.view for k, frame in enumerate(self.frames)}
        shifts, turns = shifts_and_turns(Sample(views, [(0, len(views) - 1)], Convention()))
        return bool(shifts.max() > MOVES or turns.max() > TURNS)


# --- the hypotheses ---------------------------------------------------------------------------------------------------


def frames_of(count: int) -> str:
    """Return a number of frames in words.

    >>> frames_of(1), frames_of(5)
    ('one frame', '5 frames')
    """
    return "one frame" if count == 1 else f"{('two', 'three', 'four')[count - 2] if count < 5 else count} frames"


def shifted(step: int) -> Hypothesis[LabelRun]:
    """Return the mistake that each frame has the map of `step` frames before."""
    mend = f"give frame k the file of frame k {'+' if step > 0 else '-'} {abs(step)}"
    return Hypothesis(f"are {frames_of(abs(step))} {side_of(step)}", lambda run: run.otherwise(step), mend)


def side_of(step: int) -> str:
    """Return on which side of their frames maps are that belong `step` frames before."""
    return "late" if step > 0 else "early"


STEPS = {shifted(step).name: step for step in (1, -1, 2, -2)}
"""Steps of the mistakes that are tried, by name."""


def redrawn(name: str, mend: str, change: Change) -> Hypothesis[LabelRun]:
    """Return the mistake that maps (H, W) of all frames, whose ignore id is given too, are to be changed."""
    return Hypothesis(name, lambda run: run.otherwise(0, change), mend)


def _is_oblong(run: LabelRun) -> bool:
    sides = run.frames[0].labels.shape
    return bool(max(sides) > 1.1 * min(sides))


SQUARE, PADDED = "are those of the central square of the image", "have the padding to a square still in them"
MAPS: tuple[Hypothesis[LabelRun], ...] = (
    *map(shifted, STEPS.values()),
    redrawn("are mirrored left to right", "mirror the files", lambda L, _: L[:, ::-1]),
    redrawn("are upside down", "mirror the files", lambda L, _: L[::-1]),
    redrawn("are turned by 180 degrees", "turn the files", lambda L, _: L[::-1, ::-1]),
    redrawn("are transposed", "transpose the files", lambda L, _: _fill(L.T, L.shape)),
    redrawn("are turned by 90 degrees", "turn the files", lambda L, _: _fill(np.rot90(L, 1), L.shape)),
    redrawn("are turned by 270 degrees", "turn the files", lambda L, _: _fill(np.rot90(L, 3), L.shape)),
    redrawn("are twice too large", "halve the files", lambda L, none: _scaled(L, 0.5, 0.5, none)),
    redrawn("are half too small", "enlarge the files twice", lambda L, none: _scaled(L, 2, 2, none)),
    Hypothesis(SQUARE, lambda run: run.otherwise(0, _squeezed), "label the whole image", applies=_is_oblong),
    Hypothesis(PADDED, lambda run: run.otherwise(0, _unpadded), "cut it off", applies=_is_oblong),
)
"""Mistakes of label maps; the name completes 'labels of X ...'."""


def _fill(labels: Ids, shape: tuple[int, ...]) -> Ids:
    """Return labels stretched to a shape (H, W), by the nearest."""
    v, u = ((np.arange(n) + 0.5) * m / n for n, m in zip(shape, labels.shape, strict=True))
    return np.asarray(labels[v.astype(np.int64)[:, None], u.astype(np.int64)])


def _scaled(labels: Ids, x: float, y: float, ignore: int) -> Ids:
    """Return labels (H, W) enlarged about the image's centre, ignored where nothing lies."""
    H, W = labels.shape
    v, u = (np.floor((np.arange(n) + 0.5 - n / 2) / s + n / 2).astype(np.int64) for n, s in ((H, y), (W, x)))
    inside = ((v >= 0) & (v < H))[:, None] & ((u >= 0) & (u < W))
    nearest = labels[v.clip(0, H - 1)[:, None], u.clip(0, W - 1)]
    return np.asarray(np.where(inside, nearest, labels.dtype.type(ignore)))


def _squeezed(labels: Ids, ignore: int) -> Ids:
    """Return labels of the central square of an image, at their places in it."""
    H, W = labels.shape
    return _scaled(labels, min(H, W) / W, min(H, W) / H, ignore)


def _unpadded(labels: Ids, ignore: int) -> Ids:
    """Return labels of an image that was padded to a square, without the padding."""
    H, W = labels.shape
    return _scaled(labels, H / min(H, W), W / min(H, W), ignore)
