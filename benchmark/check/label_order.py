"""Label maps that fit another way from a frame on, or are those of these frames in another order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semstab.check.label_maps import (
    IN_A_RUN,
    STEPS,
    LabelledFrame,
    LabelRun,
    agreements,
    frames_of,
    readable,
    shared_of,
    side_of,
)
from semstab.check.trials import BETTER_FIT, LEAST_FIT, LEAST_TOLD, FitContrast, Hypothesis
from semstab.core.arrays import evenly
from semstab.core.types import Float64, Int64
from semstab.datasets import Scene

FEWER = 0.85
"""The part of the disagreement that remains in the right order."""

MOST_ORDERED, ORDER_COLUMNS, ORDER_PIXELS = 200, 64, 200 * 640 * 480
"""Bounds of the search for a frame's map among the maps of all frames: frames, columns of the grid of edges, and pixels
of all frames, ..."""

QUICK_PIXELS = 44 * 640 * 480
"""... and pixels of all frames in a quick check."""

SAME_ORDER = 0.8
"""Share of the maps that an order explains."""


# --- from a frame on -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Turn:
    """A frame from which on maps are otherwise: of their fits as given and otherwise the better one changes there.

    Attributes:
        at: Position of the first frame that is otherwise.
        before, after: Fits of the frames before it, and from it on.
        fit: Mean fit of all frames, those from it on otherwise.
    """

    at: int
    before: FitContrast
    after: FitContrast
    fit: float

    @classmethod
    def from_fits(cls, rows: Sequence[tuple[int, float, float]]) -> Turn:
        """Find the place at which the sum of the better fits is largest, of index, given and other fit of frames."""
        _, fit_given, fit_other = np.reshape(rows, (-1, 3)).T
        gain = np.nan_to_num(np.subtract(fit_other, fit_given))
        sums = [gain[k:].sum() - gain[:k].sum() for k in range(len(gain), -1, -1)]
        position = len(gain) - int(np.argmax(sums))  # the last one of several
        fits = np.concatenate([fit_given[:position], fit_other[position:]])
        return cls(
            position,
            FitContrast.between(fit_other[:position], fit_given[:position]),
            FitContrast.between(fit_given[position:], fit_other[position:]),
            float(np.nanmean(fits)) if np.isfinite(fits).any() else np.nan,
        )

    @property
    def is_one(self) -> bool:
        """Return whether maps fit clearly better as given before it, and otherwise after it."""
        return self.before.fits_better and self.after.fits_better


def from_a_frame_on(scene: Scene, model: str, runs: Sequence[LabelRun], everywhere: float) -> str | None:
    """Return the finding where maps fit as they are up to a frame, and otherwise from it on.

    They have to fit better than under any hypothesis that holds for all frames, whose best mean fit is `everywhere`.
    """
    for tried in zip(*(run.tried for run in runs), strict=True):
        rows = [row for (_, other), run in zip(tried, runs, strict=True) for row in run.by_frame(other)]
        if len(rows) < 2 * LEAST_TOLD:
            continue
        turn, hypothesis = Turn.from_fits(rows), tried[0][0]
        if turn.is_one and not everywhere >= turn.fit:
            index = _located(scene, model, hypothesis, rows[turn.at - 1][0], rows[turn.at][0])
            before, after = turn.before, turn.after
            says, mend = hypothesis.name, hypothesis.mend
            if (step := STEPS.get(says)) is not None:
                says, mend = f"are {side_of(step)}", "give each frame the map of its own image"
            return (
                f"{says} from frame {scene.frame_name(index)} on (their edges correlate {after.other:.2f}"
                f" with those of depth and colour there, {after.given:.2f} now; before it {before.other:.2f} as they"
                f" are): {mend}"
            )
    return None


def _located(scene: Scene, model: str, hypothesis: Hypothesis[LabelRun], last: int, first: int) -> int:
    """Return the index of the frame from which on maps are otherwise, between two that are known."""

    def rows(span: range) -> list[tuple[int, float, float]]:
        run = LabelRun([*readable(scene, span, model)])
        return run.by_frame(hypothesis.change(run))

    while first - last > 2 * IN_A_RUN:
        middle = (last + first) // 2
        gains = [
            fit_other - fit_given
            for _, fit_given, fit_other in rows(range(middle - IN_A_RUN // 2, middle + IN_A_RUN // 2 + 1))
        ]
        if not np.isfinite(gains).any():
            return first
        first, last = (middle, last) if float(np.nansum(gains)) > 0 else (first, middle)
    near = rows(range(max(0, last - IN_A_RUN), min(len(scene), first + IN_A_RUN + 1)))
    return near[min(Turn.from_fits(near).at, len(near) - 1)][0] if near else first


# --- another order ---------------------------------------------------------------------------------------------------


def in_another_order(scene: Scene, indices: Sequence[int], model: str, pixels: int) -> str | None:
    """Return the finding where the maps are those of these frames, but in another order: reversed, late, shuffled.

    Each frame gets the map whose edges fit its depth and colour best, each map once. That is right where labels then
    agree clearly better between frames, which the edges do not know.
    """
    first = next(readable(scene, indices[:1], model), None)
    if first is None:
        return None
    count = min(MOST_ORDERED, max(IN_A_RUN, pixels // first.whole.size))
    chosen = [indices[k] for k in evenly(len(indices), count)]
    frames = [*readable(scene, chosen, model)]
    frames = [frame for frame in frames if frame.references and frame.labels.shape == frames[0].labels.shape]
    if len(frames) < 2 * IN_A_RUN:
        return None
    from scipy.optimize import linear_sum_assignment  # a sixth of a second, which a scene of a few frames is spared

    n = len(frames)
    references = np.stack([_coarse(frame.references) for frame in frames])
    none = np.zeros_like(frames[0].references[0])
    edges = np.stack([_coarse((none if frame.edges is None else frame.edges,)) for frame in frames])
    fits = references @ edges.T
    order = np.asarray(linear_sum_assignment(-fits)[1])
    moved = order != np.arange(n)
    if moved.mean() < 0.5 or fits[np.arange(n), order].mean() < max(
        LEAST_FIT, BETTER_FIT * float(np.diag(fits).mean())
    ):
        return None
    near = [(a, b) for a in range(n) for b in range(a + 1, min(n, a + 4))]
    common = shared_of({k: frame.view for k, frame in enumerate(frames)}, near)
    maps = ({k: frames[source].labels for k, source in enumerate(sequence)} for sequence in (range(n), order))
    agreement = FitContrast.between(*(agreements(common, labels, frames[0].view.ignore_id) for labels in maps))
    if not (agreement.is_clear and 1 - agreement.other <= FEWER * (1 - agreement.given)):
        return None
    text = (
        f"(their edges correlate {fits[np.arange(n), order].mean():.2f} with those of depth and colour so,"
        f" {np.diag(fits).mean():.2f} now; {agreement.other:.0%} agree between frames, {agreement.given:.0%} now)"
    )
    return f"{_order(order, frames, scene)} {text}: give each frame the map of its own image"


def _order(order: Int64, frames: Sequence[LabelledFrame], scene: Scene) -> str:
    """Return what the order of the maps is: map `order[k]` is that of frame k."""
    n, k = len(order), np.arange(len(order))
    steps, counts = np.unique(order - k, return_counts=True)
    if np.mean(np.abs(order + k - (n - 1)) <= 1) >= SAME_ORDER:
        return "are in reversed order: the first frame has the map of the last one"
    is_contiguous = frames[-1].view.index - frames[0].view.index == n - 1
    if is_contiguous and counts.max() >= SAME_ORDER * (n - abs(int(steps[counts.argmax()]))):
        step = int(steps[counts.argmax()])
        return f"are {frames_of(abs(step))} {side_of(step)}"
    position = int(np.flatnonzero(order != k)[0])
    source, target = (scene.frame_name(frames[k_frame].view.index) for k_frame in (int(order[position]), position))
    return f"are in another order than the frames (the map of frame {source} is that of frame {target}, and so on)"


def _coarse(edges: Sequence[Float64]) -> Float64:
    """Return (cells,) the mean of maps of edges on a coarse grid, without its mean, of length 1."""
    import cv2

    H, W = edges[0].shape
    size = (min(W, ORDER_COLUMNS), max(1, round(H * min(W, ORDER_COLUMNS) / W)))
    mean = np.mean([cv2.resize(edge_map, size, interpolation=cv2.INTER_AREA) for edge_map in edges], axis=0).ravel()
    mean = mean - mean.mean()
    coarse: Float64 = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return coarse
