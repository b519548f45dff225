"""A check of label maps against depth, colour and each other: do they belong to these frames, and are they ids?

Each alternative reading of the files (another frame's map, mirrored, turned, of a part of the image) is compared with
the given one by two numbers: the correlation of the labels' edges with those of depth and colour, frame by frame, and
the agreement of labels that are reprojected from frame to frame, pair by pair.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.check.conventions import Convention
from semstab.check.coverage import CONSISTENT
from semstab.check.geometry import shifts_and_turns
from semstab.check.registration import grey_levels
from semstab.check.reprojection import Pair, Sample, View
from semstab.check.trials import Contrast
from semstab.core.arrays import evenly
from semstab.core.types import Float64, Int64, Mask
from semstab.data.labels import LabelSpace
from semstab.datasets import Scene
from semstab.errors import DataError
from semstab.pixels.edges import depth_edges, image_edges, label_edges

IN_A_RUN = 5
"""Frames in a row that are read together: labels may be those of a neighbour."""

PIXELS = 2**17
COLUMNS = 256
"""Of a larger image every n-th pixel of each axis is used; edges are compared on a grid of at most so many columns."""

POINTS = 1000
"""Points of a frame that are reprojected into another."""

BETTER = 1.15
LEAST_FIT = 0.08
"""The factor by which the edges of an alternative must fit better, and the correlation that is a fit, ..."""

FEWER = 0.85
"""... or the part of the disagreement that remains."""

LEAST_FRAMES = 4
LEAST_POINTS = 50

FIRST_RUNS = 2
"""Runs of frames that are read first."""

MOST_ORDERED, ORDER_COLUMNS, ORDER_PIXELS = 200, 64, 200 * 640 * 480
"""Frames whose maps are looked for among those of all others, their edges on a grid of so many columns; the pixels of
all of them, ..."""

QUICK_PIXELS = 44 * 640 * 480
"""... and those of a quick check."""

SAME_ORDER = 0.8
"""Share of the maps that an order explains."""

TELLING = 0.9
"""An alternative whose edges fit this part as well as the given ones cannot be told from them."""

MOST_OPEN = 2
"""Alternatives that are named where they cannot be told from the given maps; of more the reason is said."""

MOVES = 0.01
TURNS = 1.0
"""The camera moves where it does by this share of the depth, or turns by these degrees, from frame to frame."""

BAND_SHARE = 0.5
BAND_PAIRS = 2
BAND_BORDERS = 50
"""The share of the borders of two classes at which the pixel between has an id between, which shows interpolation
(real networks: up to 0.1, resized maps from 0.9); in so many pairs of classes, of those with so many border pixels."""

ID_SHARE = 0.75
"""The share of the ids between the first and the last that are used where ids are suspected to count from 1."""

NOTHINGS = ("background", "clutter", "ignore", "none", "other", "unknown", "unlabeled", "unlabelled", "void")
"""Words in the name of a first class that labels may well lack."""

Ids = npt.NDArray[Any]
Change = Callable[[Ids, int], Ids]


@dataclass(frozen=True)
class LabelFindings:
    """The result for one model.

    Attributes:
        wrong: Lines on label maps that do not belong to the frames as they are, each with the mend.
        remarks: Lines on ids that look wrong, but may be right.
        open: Line on what these frames cannot tell; None where they tell it all.
    """

    model: str
    wrong: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    open: str | None = None


@dataclass(frozen=True)
class Alternative:
    """Another way to read label maps.

    Attributes:
        says: Completes 'labels of X ...'.
        mend: The remedy.
        step: Which frame's map is taken, relative to the frame.
        change: What is done to the map (H, W), whose ignore id is given too.
    """

    says: str
    mend: str
    step: int = 0
    change: Change = lambda labels, _: labels


def shifted(step: int) -> Alternative:
    """Return the mistake that each frame has the map of `step` frames before."""
    side, sign = ("late", "+") if step > 0 else ("early", "-")
    mend = f"give frame k the file of frame k {sign} {abs(step)}"
    return Alternative(f"are {frames_of(abs(step))} {side}", mend, step=step)


def frames_of(count: int) -> str:
    """Return a number of frames in words.

    >>> frames_of(1), frames_of(5)
    ('one frame', '5 frames')
    """
    return "one frame" if count == 1 else f"{('two', 'three', 'four')[count - 2] if count < 5 else count} frames"


def alternatives(width: int, height: int) -> tuple[Alternative, ...]:
    """Return the mistakes that are tried, for images of that size."""
    mistakes = [
        *map(shifted, (1, -1, 2, -2)),
        Alternative("are mirrored left to right", "mirror the files", change=lambda L, _: L[:, ::-1]),
        Alternative("are upside down", "mirror the files", change=lambda L, _: L[::-1]),
        Alternative("are turned by 180 degrees", "turn the files", change=lambda L, _: L[::-1, ::-1]),
        Alternative("are transposed", "transpose the files", change=lambda L, _: _fill(L.T, L.shape)),
        Alternative("are turned by 90 degrees", "turn the files", change=lambda L, _: _fill(np.rot90(L, 1), L.shape)),
        Alternative("are turned by 270 degrees", "turn the files", change=lambda L, _: _fill(np.rot90(L, 3), L.shape)),
        Alternative("are twice too large", "halve the files", change=lambda L, none: _scaled(L, 0.5, 0.5, none)),
        Alternative("are half too small", "enlarge the files twice", change=lambda L, none: _scaled(L, 2, 2, none)),
    ]
    if max(width, height) > 1.1 * min(width, height):
        x, y = (min(width, height) / side for side in (width, height))
        crop = "are those of the central square of the image"
        padded = "have the padding to a square still in them"
        mistakes += [
            Alternative(crop, "label the whole image", change=lambda L, none: _scaled(L, x, y, none)),
            Alternative(padded, "cut it off", change=lambda L, none: _scaled(L, 1 / y, 1 / x, none)),
        ]
    return tuple(mistakes)


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


# --- the frames ------------------------------------------------------------------------------------------------------


def runs_of(scene: Scene, indices: Sequence[int], model: str, count: int) -> list[list[int]]:
    """Return `count` runs of frames in a row, evenly spaced; of selected frames where the ones between lack labels."""
    count = max(1, min(count, len(indices) // IN_A_RUN))
    starts = [indices[position] for position in evenly(max(1, len(indices) - IN_A_RUN + 1), count)]
    wanted, runs = [[*range(start, start + IN_A_RUN)] for start in starts], []
    for run in wanted:
        if all(i < len(scene) and scene.tracked(i) and not scene.missing(i, [model]) for i in run):
            runs.append(run)
    if runs:
        return runs
    return [[*indices[k : k + IN_A_RUN]] for k in range(0, len(indices), IN_A_RUN)][:count]


@dataclass(frozen=True, eq=False)
class Seen:
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
        """The edges of the labels on the grid, of length 1; None where there are none."""
        return _edges(self.labels, self.view.ignore_id)

    def fit(self, edges: Float64 | None) -> float:
        """Return the correlation of edges of labels with those of depth and of colour, their mean."""
        if edges is None or not self.references:
            return math.nan
        return float(np.mean([np.sum(edges * reference) for reference in self.references]))


def read(scene: Scene, index: int, model: str) -> Seen:
    """Read a frame with its labels and its colour; raises DataError."""
    frame = scene.frame(index, model, color=False)
    stride = max(1, math.ceil(math.sqrt(math.prod(frame.shape) / PIXELS)))
    view = View.of(frame.every(stride), POINTS)
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
    return Seen(view, tuple(_smooth(each) for each in edges if each.any()), frame.predicted)


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


@dataclass(frozen=True, eq=False)
class Shared:
    """The pixels of two frames, by their places in a run, that see the same points: rows and columns in each."""

    a: int
    b: int
    first: tuple[Int64, Int64]
    second: tuple[Int64, Int64]
    ignore: int

    def agreement(self, maps: Mapping[int, Ids]) -> float:
        """Return the share of the points whose labels agree; NaN where too few have some."""
        first, second = maps[self.a][self.first], maps[self.b][self.second]
        told = (first != self.ignore) & (second != self.ignore)
        return float(np.mean(first[told] == second[told])) if told.sum() >= LEAST_POINTS else math.nan


def shared_of(views: Mapping[int, View], pairs: Sequence[Pair]) -> list[Shared]:
    """Return what pairs of frames see in common, where that is enough."""
    sample, one = Sample(dict(views), pairs, Convention()), np.array([1.0])
    found = []
    for a, b in pairs:
        matches = sample.matched((a, b), Convention(), one)
        same = matches.error[0] < CONSISTENT
        if same.sum() >= LEAST_POINTS:
            first, second = (views[a].v[same], views[a].u[same]), (matches.v[0][same], matches.u[0][same])
            found.append(Shared(a, b, first, second, views[a].ignore_id))
    return found


@dataclass(frozen=True, eq=False)
class Tried:
    """An alternative in the frames of a run for which it has a map.

    Attributes:
        maps: The map (H, W) of each, by its place in the run.
        fits: The fit of the map as it is, and of this one, by the same places.
    """

    alternative: Alternative
    maps: Mapping[int, Ids]
    fits: Mapping[int, tuple[float, float]]


class Run:
    """Frames in a row, and all alternatives tried on them, once."""

    def __init__(self, frames: Sequence[Seen]) -> None:
        self.frames = frames

    @functools.cached_property
    def shared(self) -> list[Shared]:
        """What each two of the frames see in common."""
        return shared_of(self._views, [*itertools.combinations(self._views, 2)])

    @functools.cached_property
    def tried(self) -> list[Tried]:
        """All alternatives."""
        H, W = self.frames[0].labels.shape
        return [self.trial(each) for each in alternatives(W, H)]

    def trial(self, alternative: Alternative) -> Tried:
        """Try one alternative."""
        maps, fits = dict[int, Ids](), dict[int, tuple[float, float]]()
        for k, seen in enumerate(self.frames):
            if not 0 <= k + alternative.step < len(self.frames):
                continue
            source = self.frames[k + alternative.step]
            other = alternative.change(source.labels, seen.view.ignore_id)
            if other.shape == seen.labels.shape:
                edges = source.edges if other is source.labels else _edges(other, seen.view.ignore_id)
                maps[k], fits[k] = other, (seen.fit(seen.edges), seen.fit(edges))
        return Tried(alternative, maps, fits)

    def agreements(self, maps: Mapping[int, Ids]) -> list[tuple[float, float]]:
        """Return for each pair of frames the share of common points whose labels agree, as given and by other maps."""
        given = {k: self.frames[k].labels for k in maps}
        pairs = [pair for pair in self.shared if pair.a in maps and pair.b in maps]
        return [(pair.agreement(given), pair.agreement(maps)) for pair in pairs]

    @property
    def _views(self) -> dict[int, View]:
        return {k: seen.view for k, seen in enumerate(self.frames)}


# --- the comparison --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """An alternative with what speaks for it: edges frame by frame, agreement pair by pair."""

    alternative: Alternative
    edges: Contrast
    agreement: Contrast

    @property
    def is_better(self) -> bool:
        """Return whether one measure is clearly better, and the other is not worse."""
        edges, agreement = self.edges, self.agreement
        by_edges = edges.is_clear and edges.other >= max(LEAST_FIT, BETTER * edges.given)
        by_agreement = agreement.is_clear and 1 - agreement.other <= FEWER * (1 - agreement.given)
        if by_edges:
            return by_agreement or not agreement.other < agreement.given - 0.01
        return by_agreement and not edges.other < edges.given

    @property
    def is_doubt(self) -> bool:
        """Return whether the alternative fits better, clearly or not."""
        return self.edges.other >= BETTER * self.edges.given

    @property
    def is_open(self) -> bool:
        """Return whether edges fit about as well under the alternative, so that nothing is told."""
        return not self.edges.other < TELLING * self.edges.given

    def __str__(self) -> str:
        text = (
            f"their edges correlate {self.edges.other:.2f} with those of depth and colour, {self.edges.given:.2f} now"
        )
        if math.isfinite(self.agreement.other):
            text += f"; {self.agreement.other:.0%} agree between frames, {self.agreement.given:.0%} now"
        return f"{self.alternative.says} ({text}): {self.alternative.mend}"


def compare(runs: Sequence[Run]) -> list[Comparison]:
    """Compare every alternative with the maps as they are."""
    return [_compared(each, runs) for each in zip(*(run.tried for run in runs), strict=True)]


def counted(found: Comparison, runs: Sequence[Run]) -> Comparison:
    """Return the comparison with maps as many frames late, or early, as fit best, where one of these was found."""
    if not found.alternative.step:
        return found
    side = 1 if found.alternative.step > 0 else -1
    others = [shifted(side * count) for count in range(1, IN_A_RUN)]
    return max((_compared([run.trial(each) for run in runs], runs) for each in others), key=_fit_of)


def _fit_of(comparison: Comparison) -> float:
    return -math.inf if math.isnan(comparison.edges.other) else comparison.edges.other


def _compared(tried: Sequence[Tried], runs: Sequence[Run]) -> Comparison:
    fits = [both for each in tried for both in each.fits.values()]
    agreements = [both for each, run in zip(tried, runs, strict=True) for both in run.agreements(each.maps)]
    return Comparison(tried[0].alternative, _contrast(fits), _contrast(agreements))


def _contrast(rows: Sequence[tuple[float, float]]) -> Contrast:
    return Contrast.of(*zip(*rows, strict=True)) if rows else Contrast.of((), ())


# --- from a frame on -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Turn:
    """A frame from which on maps are otherwise: of their fits as given and otherwise the better one changes there."""

    at: int
    before: Contrast
    after: Contrast

    @classmethod
    def of(cls, given: Sequence[float], other: Sequence[float]) -> Turn:
        """Find the place at which the sum of the better fits is largest."""
        gain = np.nan_to_num(np.subtract(other, given))
        sums = [gain[k:].sum() - gain[:k].sum() for k in range(len(gain), -1, -1)]
        at = len(gain) - int(np.argmax(sums))  # the last one of several
        return cls(at, Contrast.of(other[:at], given[:at]), Contrast.of(given[at:], other[at:]))

    @property
    def is_one(self) -> bool:
        """Return whether maps fit clearly better as given before it, and otherwise after it."""
        return all(
            side.is_clear and side.other >= max(LEAST_FIT, BETTER * side.given) for side in (self.before, self.after)
        )


def from_a_frame_on(scene: Scene, model: str, runs: Sequence[Run]) -> str | None:
    """Return the finding where maps fit as they are up to a frame, and otherwise from it on."""
    for tried in zip(*(run.tried for run in runs), strict=True):
        rows = [row for each, run in zip(tried, runs, strict=True) for row in _rows(each, run)]
        if len(rows) < 2 * LEAST_FRAMES:
            continue
        turn = Turn.of([given for _, given, _ in rows], [other for *_, other in rows])
        if turn.is_one:
            alternative = tried[0].alternative
            last, first = rows[turn.at - 1][0], rows[turn.at][0]
            index = _located(scene, model, alternative, last, first)
            before, after = turn.before, turn.after
            says, mend = alternative.says, alternative.mend
            if alternative.step:
                says, mend = (
                    f"are {'late' if alternative.step > 0 else 'early'}",
                    "give each frame the map of its own image",
                )
            return (
                f"{says} from frame {scene.frame_name(index)} on (their edges correlate {after.other:.2f}"
                f" with those of depth and colour there, {after.given:.2f} now; before it {before.other:.2f} as they"
                f" are): {mend}"
            )
    return None


def _rows(tried: Tried, run: Run) -> list[tuple[int, float, float]]:
    """Return for each frame of a run its index, and the fit of its map as given and otherwise."""
    return [(run.frames[k].view.index, given, other) for k, (given, other) in tried.fits.items()]


def _located(scene: Scene, model: str, alternative: Alternative, last: int, first: int) -> int:
    """Return the index of the frame from which on maps are otherwise, between two that are known."""
    while first - last > 2 * IN_A_RUN:
        middle = (last + first) // 2
        run = Run([*_readable(scene, range(middle - IN_A_RUN // 2, middle + IN_A_RUN // 2 + 1), model)])
        gains = [other - given for given, other in run.trial(alternative).fits.values()]
        if not np.isfinite(gains).any():
            return first
        if float(np.nansum(gains)) > 0:
            first = middle
        else:
            last = middle
    span = range(max(0, last - IN_A_RUN), min(len(scene), first + IN_A_RUN + 1))
    run = Run([*_readable(scene, span, model)])
    rows = _rows(run.trial(alternative), run)
    if not rows:
        return first
    at = Turn.of([given for _, given, _ in rows], [other for *_, other in rows]).at
    return rows[min(at, len(rows) - 1)][0]


# --- another order ---------------------------------------------------------------------------------------------------


def in_another_order(scene: Scene, indices: Sequence[int], model: str, pixels: int) -> str | None:
    """Return the finding where the maps are those of these frames, but in another order: reversed, late, shuffled.

    Each frame gets the map whose edges fit its depth and colour best, each map once. That is right where labels then
    agree clearly better between frames, which the edges do not know.
    """
    from scipy.optimize import linear_sum_assignment

    first = next(_readable(scene, indices[:1], model), None)
    if first is None:
        return None
    count = min(MOST_ORDERED, max(IN_A_RUN, pixels // first.whole.size))
    chosen = [indices[k] for k in evenly(len(indices), count)]
    frames = [*_readable(scene, chosen, model)]
    frames = [seen for seen in frames if seen.references and seen.labels.shape == frames[0].labels.shape]
    if len(frames) < 2 * IN_A_RUN:
        return None
    n = len(frames)
    own = np.stack([_coarse(seen.references) for seen in frames])
    none = np.zeros_like(frames[0].references[0])
    maps = np.stack([_coarse((none if seen.edges is None else seen.edges,)) for seen in frames])
    fits = own @ maps.T
    order = np.asarray(linear_sum_assignment(-fits)[1])
    moved = order != np.arange(n)
    if moved.mean() < 0.5 or fits[np.arange(n), order].mean() < max(LEAST_FIT, BETTER * float(np.diag(fits).mean())):
        return None
    near = [(a, b) for a in range(n) for b in range(a + 1, min(n, a + 4))]
    given = {k: seen.labels for k, seen in enumerate(frames)}
    other = {k: frames[order[k]].labels for k in range(n)}
    pairs = shared_of({k: seen.view for k, seen in enumerate(frames)}, near)
    agreement = _contrast([(pair.agreement(given), pair.agreement(other)) for pair in pairs])
    if not (agreement.is_clear and 1 - agreement.other <= FEWER * (1 - agreement.given)):
        return None
    text = (
        f"(their edges correlate {fits[np.arange(n), order].mean():.2f} with those of depth and colour so,"
        f" {np.diag(fits).mean():.2f} now; {agreement.other:.0%} agree between frames, {agreement.given:.0%} now)"
    )
    return f"{_order(order, frames, scene)} {text}: give each frame the map of its own image"


def _order(order: Int64, frames: Sequence[Seen], scene: Scene) -> str:
    """Return what the order of the maps is: map `order[k]` is that of frame k."""
    n, k = len(order), np.arange(len(order))
    steps, counts = np.unique(order - k, return_counts=True)
    if np.mean(np.abs(order + k - (n - 1)) <= 1) >= SAME_ORDER:
        return "are in reversed order: the first frame has the map of the last one"
    whole = frames[-1].view.index - frames[0].view.index == n - 1
    if whole and counts.max() >= SAME_ORDER * (n - abs(int(steps[counts.argmax()]))):
        step = int(steps[counts.argmax()])
        return f"are {frames_of(abs(step))} {'late' if step > 0 else 'early'}"
    at = int(np.flatnonzero(order != k)[0])
    of, to = (scene.frame_name(frames[one].view.index) for one in (int(order[at]), at))
    return f"are in another order than the frames (the map of frame {of} is that of frame {to}, and so on)"


def _coarse(edges: Sequence[Float64]) -> Float64:
    """Return (cells,) the mean of maps of edges on a coarse grid, without its mean, of length 1."""
    import cv2

    H, W = edges[0].shape
    size = (min(W, ORDER_COLUMNS), max(1, round(H * min(W, ORDER_COLUMNS) / W)))
    mean = np.mean([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in edges], axis=0).ravel()
    mean = mean - mean.mean()
    coarse: Float64 = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return coarse


# --- findings --------------------------------------------------------------------------------------------------------


def check_labels(
    scene: Scene,
    indices: Sequence[int],
    model: str,
    space: LabelSpace | None,
    runs: int,
    *,
    thorough: bool = True,
) -> LabelFindings:
    """Compare the label maps of a model with depth, colour and each other, in `runs` times five frames.

    Two of them come first; the others are read where these do not show that the maps are right, or, unless `thorough`,
    where they fit better another way. Then frames are read to find maps in another order. Frames
    that cannot be read are passed over.
    """
    known = dict[int, Run]()
    few = _findings(scene, indices, model, space, min(runs, FIRST_RUNS), known)
    if few.clear or not (thorough or few.doubted):
        return few.found
    whole = _findings(scene, indices, model, space, runs, known)
    if whole.clear or whole.found.wrong:
        return whole.found
    pixels = ORDER_PIXELS if thorough else QUICK_PIXELS
    if (other := in_another_order(scene, indices, model, pixels)) is None:
        return whole.found
    return dataclasses.replace(whole.found, wrong=(f"labels of {model} {other}",), open=None)


@dataclass(frozen=True)
class _Findings:
    """What some runs show.

    Attributes:
        clear: Whether maps as they are fit clearly better than any other way.
        doubted: Whether another way fits better, however few frames show it.
    """

    found: LabelFindings
    clear: bool = False
    doubted: bool = False


def _findings(
    scene: Scene, indices: Sequence[int], model: str, space: LabelSpace | None, count: int, known: dict[int, Run]
) -> _Findings:
    """Return what some runs show; those that are read are kept in `known`, by their first frames."""
    wanted = runs_of(scene, indices, model, count)
    for run in wanted:
        if run[0] not in known:
            known[run[0]] = Run([*_readable(scene, run, model)])
    runs = [known[run[0]] for run in wanted if len(known[run[0]].frames) > 1]
    frames = [seen for run in runs for seen in run.frames]
    if len(frames) < 2 or any(seen.labels.shape != frames[0].labels.shape for seen in frames):
        return _Findings(LabelFindings(model))
    texts = id_remarks(
        [seen.labels for seen in frames], frames[0].view.ignore_id, space, [run.frames[0].whole for run in runs]
    )
    remarks = tuple(f"labels of {model} {text}" for text in texts)
    if (same := _identical(runs)) is not None:
        return _Findings(LabelFindings(model, (f"labels of {model} {same}",), remarks), clear=True)
    comparisons = compare(runs)
    if (turned := from_a_frame_on(scene, model, runs)) is not None:
        return _Findings(LabelFindings(model, (f"labels of {model} {turned}",), remarks), doubted=True)
    better = sorted((each for each in comparisons if each.is_better), key=lambda each: -each.edges.other)
    wrong = tuple(f"labels of {model} {counted(each, runs)}" for each in better[:1])
    return _Findings(
        LabelFindings(model, wrong, remarks, None if wrong else _open(comparisons)),
        clear=not better and all(map(_is_right, runs)),
        doubted=any(each.is_doubt for each in comparisons),
    )


def _is_right(run: Run) -> bool:
    """Return whether maps of a run fit better as they are than in any other way."""
    fits = [_contrast([*each.fits.values()]) for each in run.tried]
    return all(each.other < TELLING * each.given for each in fits)


def _readable(scene: Scene, run: Sequence[int], model: str) -> Iterator[Seen]:
    for index in run:
        try:
            yield read(scene, index, model)
        except DataError:
            return


def _identical(runs: Sequence[Run]) -> str | None:
    """Return the finding where all maps are the same, of several classes, though the camera moves."""
    frames = [seen for run in runs for seen in run.frames]
    first = frames[0].labels
    if len(frames) < LEAST_FRAMES or len(np.unique(first)) < 2:
        return None
    if any(not np.array_equal(first, seen.labels) for seen in frames[1:]) or not any(map(_moves, runs)):
        return None
    return f"are the same map in all {len(frames)} frames that were read, though the camera moves: predict them again"


def _moves(run: Run) -> bool:
    views = {k: seen.view for k, seen in enumerate(run.frames)}
    shifts, turns = shifts_and_turns(Sample(views, [(0, len(views) - 1)], Convention()))
    return bool(shifts.max() > MOVES or turns.max() > TURNS)


def _open(comparisons: Sequence[Comparison]) -> str | None:
    """Return what the frames cannot tell, in one line."""
    says = [each.alternative.says for each in comparisons if each.is_open]
    if len(says) > MOST_OPEN:
        return "their edges lie on those of depth and colour no better than mirrored, turned or of another frame"
    return f"these frames cannot tell whether they {', or '.join(says)}" if says else None


def id_remarks(maps: Sequence[Ids], ignore: int, space: LabelSpace | None, whole: Sequence[Ids]) -> Iterator[str]:
    """Yield what ids of label maps (H, W) look wrong in, each with the mend; completes 'labels of X ...'.

    `whole` are maps of which no pixel was left out.
    """
    used = sorted({int(i) for labels in maps for i in np.unique(labels)} - {ignore})
    if len(used) == 1 and len(maps) >= LEAST_FRAMES:
        name = f" ({space.classes[space.ids.index(used[0])]})" if space is not None and used[0] in space.ids else ""
        yield f"have one class, id {used[0]}{name}, in all {len(maps)} frames that were read: are the files right?"
    if space is not None and _from_one(used, space):
        first, last = space.classes[0], space.classes[-1]
        yield (
            f"never have the first id, {space.ids[0]} ({first}), but the last, {space.ids[-1]} ({last}): if they count"
            " from 1, subtract 1"
        )
    if _is_interpolated(whole, ignore):
        yield "have thin bands of ids between those of the two sides at their borders: resize them by the nearest"


def _from_one(used: Sequence[int], space: LabelSpace) -> bool:
    ids = sorted(space.ids)
    if (
        len(ids) < 3
        or ids[0] in used
        or ids[-1] not in used
        or any(word in space.classes[0].lower() for word in NOTHINGS)
    ):
        return False
    return sum(i in used for i in ids[1:]) >= ID_SHARE * (len(ids) - 1)


def _is_interpolated(maps: Sequence[Ids], ignore: int) -> bool:
    """Return whether between two classes more than one id apart there mostly is an id between them."""
    between: dict[tuple[int, int], list[int]] = {}
    for labels in maps:
        for triple in _triples(labels):
            border = triple[0] != triple[2]
            a, b, c = (ids[border].astype(np.int64) for ids in triple)
            apart = (np.abs(a - c) >= 2) & (a != ignore) & (c != ignore) & (b != ignore)
            low, high, middle = np.minimum(a, c)[apart], np.maximum(a, c)[apart], b[apart]
            inside = (middle > low) & (middle < high)
            for pair, count, hits in _counted(low, high, inside):
                total = between.setdefault(pair, [0, 0])
                total[0] += count
                total[1] += hits
    shares = [hits / count for count, hits in between.values() if count >= BAND_BORDERS]
    return len(shares) >= BAND_PAIRS and float(np.median(shares)) >= BAND_SHARE


def _triples(labels: Ids) -> Iterator[tuple[Ids, Ids, Ids]]:
    """Yield the labels before, at and after each pixel, along rows and along columns."""
    yield labels[:, :-2], labels[:, 1:-1], labels[:, 2:]
    yield labels[:-2], labels[1:-1], labels[2:]


def _counted(low: Ids, high: Ids, inside: Ids) -> Iterator[tuple[tuple[int, int], int, int]]:
    """Yield for each pair of ids how many borders there are, and at how many an id between."""
    keys, at = np.unique(low * 2**20 + high, return_inverse=True)
    counts, hits = np.bincount(at, minlength=len(keys)), np.bincount(at, weights=inside, minlength=len(keys))
    for key, count, hit in zip(keys.tolist(), counts.tolist(), hits.tolist(), strict=True):
        yield (key >> 20, key & (2**20 - 1)), int(count), int(hit)
