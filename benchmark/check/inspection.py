"""The frames of a scene that a check reads, thinned, and the verdict on their geometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.check.chain import Chain
from semstab.check.continuity import Neighbours, with_continuity
from semstab.check.conventions import Reading, reading
from semstab.check.geometry import assess, with_mistakes
from semstab.check.histogram import LabelTally
from semstab.check.intrinsics import with_intrinsics
from semstab.check.mounting import with_mounting
from semstab.check.precision import with_precision
from semstab.check.registration import assess_surface, match_images
from semstab.check.reprojection import Sample, View, frames_at, pairs_within, reader
from semstab.check.timing import with_lateness
from semstab.check.verdict import Verdict
from semstab.core.arrays import evenly
from semstab.core.types import Float32
from semstab.data.frames import Frame
from semstab.datasets import Scene

LEAST_POINTS_A_VIEW, MOST_POINTS_A_VIEW = 50, 500
"""Points of a frame that are reprojected into another."""

MOST_VOXELS = 2**20
"""Voxels from a map's origin to its end, along an axis."""


@dataclass(frozen=True)
class Depth:
    """The depth of the sampled frames: share of valid pixels, and percentiles, metres."""

    valid: float
    p5: float
    p50: float
    p95: float

    @classmethod
    def from_samples(cls, valid: Sequence[float], depths: Sequence[Float32]) -> Depth:
        """Return it from the share and the valid depths of each frame."""
        all_depths = np.concatenate(depths)
        p5, p50, p95 = np.percentile(all_depths, (5, 50, 95)).tolist() if len(all_depths) else (np.nan,) * 3
        return cls(float(np.mean(valid)), p5, p50, p95)


class Inspection:
    """The frames of a scene that a check reads, thinned as they come in.

    Attributes:
        source: Label source to read frames with; None needs no labels.
        groups: Positions in `indices` of frames that are compared with each other.
        points: About how many points are reprojected in all.
        fused: Number of frames, evenly spaced, that are also held in memory for fusion.
        chained: Frames in order, once a verdict compared them.
        passing_over: Leave out frames that cannot be read, instead of raising what reading them raises.
        with_color: Whether to read also the size of a colour image: intrinsics may be for that.
    """

    def __init__(
        self,
        scene: Scene,
        indices: Sequence[int],
        source: str | None,
        groups: Sequence[Sequence[int]],
        points: int,
        *,
        fused: int = 0,
        passing_over: bool = False,
        with_color: bool = False,
    ) -> None:
        self.scene, self.indices, self.source = scene, indices, source
        self.tally = LabelTally(source or "")
        self.views: dict[int, View] = {}
        self.fused = evenly(len(indices), fused)
        self.chained: tuple[Neighbours, Chain] | None = None
        self._first: Frame | None = None
        self.farthest: tuple[float, Frame, tuple[int, int]] | None = None
        self._pairs = pairs_within(groups)
        self._compared = {position for group in groups for position in group}
        self._points = min(MOST_POINTS_A_VIEW, max(LEAST_POINTS_A_VIEW, points // max(1, len(self._pairs))))
        self._labelled = source is not None
        color = scene.color(indices[0]) if with_color else None
        self._color_shape = None if color is None else color.shape
        self._read(indices, reader(scene, source), passing_over)

    def _read(self, indices: Sequence[int], read: Callable[[int], Frame], passing_over: bool) -> None:
        positions = self._compared | set(self.fused)
        for position, frame in frames_at(positions, indices, read, passing_over=passing_over):
            self._first = self._first or frame
            self._take_note(frame)
            if self._labelled:
                self.tally.add(frame)
            self.views[position] = View.from_frame(frame, self._points, labelled=self._labelled)

    def _take_note(self, frame: Frame) -> None:
        """Remember the farthest pixel of all frames."""
        depth = np.where(frame.depth < np.inf, frame.depth, np.float32(0))  # NaN is not less
        pixel = int(depth.argmax())
        if self.farthest is None or float(depth.flat[pixel]) > self.farthest[0]:
            v, u = divmod(pixel, depth.shape[1])
            self.farthest = float(depth.flat[pixel]), dataclasses.replace(frame.every(64), files=frame.files), (u, v)

    def too_far(self, voxel_size: float) -> str | None:
        """Return the farthest pixel where a map of voxels of that size does not reach it."""
        if self.farthest is None or self.farthest[0] < MOST_VOXELS * voxel_size:
            return None
        depth, frame, (u, v) = self.farthest
        return (
            f"{frame.where('depth')}: pixel ({u}, {v}) has depth {depth:,.0f} m, more than 2^20 voxels of"
            f" {voxel_size:g} m away, so that a run refuses it; set max_depth: METRES, from which depth is not valid"
        )

    def reading(self, options: Mapping[str, Any]) -> Reading:
        """Return how the scene is configured."""
        assert self._first is not None
        return reading(self.scene, self._first, options, self._color_shape)

    def sample(self, options: Mapping[str, Any]) -> Sample:
        """Return the frames that are compared."""
        views = {position: view for position, view in self.views.items() if position in self._compared}
        pairs = [pair for pair in self._pairs if pair[0] in views and pair[1] in views]
        return Sample(views, pairs, self.reading(options).convention)

    def verdict(self, options: Mapping[str, Any], *, thorough: bool, labels_of: str | None = None) -> Verdict:
        """Assess depth by reprojection from frame to frame, and depth that is cast at a surface by the images.

        Frames in order are read with the labels of `labels_of`, by default those of `source`.
        """
        sample = self.sample(options)
        if self.scene.surface is not None:
            return assess_surface(match_images(self.scene, sample.views, sample.pairs), len(sample.views))
        how = self.reading(options)
        verdict = assessed = assess(sample, how, thorough=thorough)
        if (mistaken := with_mistakes(verdict, sample)) != verdict:
            return mistaken
        timed = with_lateness(verdict, self.scene, sample, how)
        if timed != verdict:
            verdict = timed
        elif self.scene.made or (mounted := with_mounting(verdict, sample)) == verdict:
            verdict = with_intrinsics(verdict, sample, how)
        else:
            verdict = mounted
        explained = verdict != assessed
        verdict = with_precision(verdict, sample)
        if self.scene.made and not thorough:
            return verdict  # rendering its frames takes longer than fusing them
        if verdict.mend:
            return verdict
        source = labels_of or self.source
        views = self.views if source == self.source else None
        neighbours = Neighbours(self.scene, self.indices, source, how.convention, views)
        chain = neighbours.chain({*neighbours.spread(how.size, thorough=thorough), *neighbours.striking()})
        self.chained = neighbours, chain
        return with_continuity(verdict, neighbours, chain, explained=explained)

    def depth(self) -> Depth:
        """Return the depth of all frames that were read."""
        views = self.views.values()
        valid = [float(np.mean((view.depth > 0) & (view.depth < np.inf))) for view in views]
        return Depth.from_samples(valid, [view.depth[view.v, view.u] for view in views])
