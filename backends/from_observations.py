"""A backend of one method: `observe` says what a frame sees of which voxels, and all else follows, by any rule."""

from __future__ import annotations

import functools
import itertools
import math
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from semstab.backends.rules import MEAN, Rule, VoxelObservations
from semstab.backends.shared.association import (
    INDEX_LIMIT,
    Observations,
    check_depth,
    check_frame,
    check_settings,
    falling_into,
    observe,
)
from semstab.backends.shared.observations import Change, MapTotal, Observed
from semstab.core.types import Float64, Int64
from semstab.data.events import Events
from semstab.data.evidence import Evidence, row_chunks
from semstab.data.frames import Frame
from semstab.data.information import entropy_bits, js_divergence, normalise
from semstab.data.results import Changes, FrameReport
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import Extent, VoxelTable, index_columns
from semstab.errors import DataError

if TYPE_CHECKING:
    from semstab.backends.shared.aggregator import Aggregator

Given = Observations | tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]

COLUMNS = {
    "op": np.int64, "pixels": np.int64, "first_frame": np.int64, "last_frame": np.int64, "drift_sum": np.float64,
    "self_sum": np.float64, "frame_entropy_sum": np.float64,
}  # fmt: skip
"""Columns of the table that a frame adds to."""


class FromObservations(ABC):
    """A map of whatever `observe` returns, fused by a rule; a subclass has that one method.

    Args:
        voxel_size: Edge of a voxel, metres.
        num_classes: K.
        rule: A name of `semstab.backends.rules.RULES`, or FILE.py:NAME.
        rule_options: Options of the rule, for example {"half_life": 5}.
    """

    def __init__(
        self, voxel_size: float, num_classes: int, rule: str = MEAN, rule_options: Mapping[str, Any] | None = None
    ) -> None:
        self.check_options(voxel_size, num_classes, rule, rule_options)
        self.voxel_size, self.num_classes = voxel_size, num_classes
        self._rule = Rule.from_name(rule, rule_options)
        self._row: defaultdict[bytes, int] = defaultdict(itertools.count().__next__)  # voxel, as bytes -> its row
        self._state = np.zeros((0, num_classes))  # row by row, like the columns with room for more rows
        self._columns: dict[str, npt.NDArray[Any]] = {name: np.zeros(0, kind) for name, kind in COLUMNS.items()}
        self._total = MapTotal(num_classes)
        self._changes: Changes | None = None

    @staticmethod
    def check_options(
        voxel_size: float, num_classes: int, rule: str = MEAN, rule_options: Mapping[str, Any] | None = None
    ) -> None:
        """Raise ConfigError for settings that no map can have."""
        check_settings(voxel_size, num_classes)
        Rule.from_name(rule, rule_options)

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int) -> int:
        """Return a dictionary's entry, the state and the columns a voxel."""
        return voxels * (300 + 9 * num_classes)

    @abstractmethod
    def observe(self, frame: Frame) -> Given:
        """Return what a frame sees of n voxels, each once.

        Returns:
            The voxels' indices (n, 3), floor(x_w / r); (n, K) the evidence of each, which is scaled to sum to 1; and
            (n,) the pixels behind it.
        """

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame.

        Raises:
            DataError: If the frame cannot be fused, or `observe` returns no observations, with the map unchanged.
        """
        started = time.perf_counter()
        check_depth(frame)
        check_frame(frame, self.num_classes)
        observations = self._checked(self.observe(frame), frame)
        return self.add(frame, observations, started, time.perf_counter())

    def add(self, frame: Frame, observations: Observations, started: float, observed: float = math.nan) -> FrameReport:
        """Fuse what a frame observes, each voxel once, and report it; the seconds are those of `perf_counter`."""
        num_voxels = len(self._row)
        voxels = np.ascontiguousarray(observations.index, dtype=np.int64).view("V24").ravel().tolist()
        rows = np.fromiter(map(self._row.__getitem__, voxels), dtype=np.int64, count=len(voxels))
        try:
            return self._update(frame, observations, rows, started, observed)
        except BaseException:
            for voxel in voxels:
                if self._row.get(voxel, -1) >= num_voxels:
                    del self._row[voxel]
            self._row.default_factory = itertools.count(num_voxels).__next__
            raise

    def _update(
        self, frame: Frame, observations: Observations, rows: Int64, started: float, observed: float
    ) -> FrameReport:
        self._make_room()
        columns = self._columns
        before, op, frame_index = self._state[rows], columns["op"][rows], frame.index
        distance = np.linalg.norm((observations.index + 0.5) * self.voxel_size - frame.T_wc[:3, 3], axis=1)
        age = np.where(op > 0, np.maximum(frame_index - columns["last_frame"][rows], 0), 0)
        after = self._rule(before, VoxelObservations(observations.s_bar, observations.pixels, op, age, distance, frame))
        e_before, e_after, is_repeated = self._rule.reads(before), self._rule.reads(after), op > 0
        self._state[rows] = after
        columns["drift_sum"][rows[is_repeated]] += js_divergence(
            normalise(e_after[is_repeated]), normalise(e_before[is_repeated])
        )
        for name, among in (("first_frame", np.minimum), ("last_frame", np.maximum)):
            columns[name][rows] = np.where(is_repeated, among(columns[name][rows], frame_index), frame_index)
        columns["op"][rows] += 1
        columns["pixels"][rows] += observations.pixels
        columns["self_sum"][rows] += (observations.s_bar**2).sum(axis=1)
        columns["frame_entropy_sum"][rows] += entropy_bits(observations.s_bar)
        change, changed = Change.between(e_before, e_after, op + 1, observations.pixels)
        self._changes = Changes(observations.index, *changed)
        return self._total.add(frame_index, change, started, observed)

    def table(self) -> VoxelTable:
        """Return the map so far; by another rule than the mean its evidence sums to a `weight` of its own."""
        index = np.frombuffer(b"".join(self._row), dtype=np.int64).reshape(-1, 3)
        order = in_order(index)
        columns: dict[str, Any] = {name: column[order] for name, column in self._columns.items()}
        state = self._state
        evidence = Evidence.read(len(order), self.num_classes, lambda part: self._rule.reads(state[order[part]]))
        if self._rule.name != MEAN:
            chunks = row_chunks(len(order), self.num_classes)
            columns["weight"] = np.concatenate([self._rule.reads(state[order[chunk]]).sum(axis=1) for chunk in chunks])
        return VoxelTable(**index_columns(index[order]), **columns, evidence=evidence, voxel_size=self.voxel_size)

    def events(self) -> Events | None:
        """Return None: observations are not stored."""
        return None

    def changes(self) -> Changes | None:
        """Return the changes by the last frame."""
        return self._changes

    def _make_room(self) -> None:
        if len(self._row) > len(self._state):
            room = len(self._row) + len(self._row) // 4
            self._state.resize((room, self.num_classes), refcheck=False)  # in place: no copy is made
            for column in self._columns.values():
                column.resize(room, refcheck=False)

    def _checked(self, returned: Given, frame: Frame) -> Observations:
        """Return the observations that `observe` made, as arrays.

        Raises:
            DataError: If they are none: what is wrong.
        """
        if isinstance(returned, Observations):
            return returned
        where = f"{type(self).__name__}.observe, frame {frame.index}"
        if not (isinstance(returned, tuple) and len(returned) == 3):
            raise DataError(f"{where}: it returned a {type(returned).__name__}; return voxel indices, evidence, pixels")
        index, evidence, pixels = (np.asarray(array) for array in returned)
        n = len(pixels) if pixels.ndim else 0
        if (index.shape, evidence.shape, pixels.shape) != ((n, 3), (n, self.num_classes), (n,)):
            raise DataError(
                f"{where}: it returned arrays of shapes {index.shape}, {evidence.shape} and {pixels.shape}; return"
                f" (n, 3), (n, {self.num_classes}) and (n,)"
            )
        if index.dtype.kind not in "iu" or not (
            -INDEX_LIMIT <= index.min(initial=0) <= index.max(initial=0) < INDEX_LIMIT
        ):
            raise DataError(f"{where}: voxel indices are whole numbers of 32 bits, floor(x_w / r); got {index.dtype}")
        total = evidence.sum(axis=1, keepdims=True, dtype=np.float64)
        if not (np.isfinite(total).all() and evidence.min(initial=0) >= 0 and (total > 0).all()):
            raise DataError(f"{where}: evidence of a voxel is negative, not finite or 0 in all classes; leave it out")
        if len(np.unique(index, axis=0)) < n:
            raise DataError(f"{where}: it returned a voxel twice; return each with the mean over its pixels")
        return Observations(index.astype(np.int64), evidence / total, pixels.astype(np.int64))


class _OfExtent(FromObservations):
    """A map of the voxels of an extent, of all by default."""

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        rule: str = MEAN,
        rule_options: Mapping[str, Any] | None = None,
        within: Extent | None = None,
    ) -> None:
        super().__init__(voxel_size, num_classes, rule, rule_options)
        self._within = within


class NumpyRules(_OfExtent):
    """The reference's observations, fused by a rule."""

    def observe(self, frame: Frame) -> Observations:
        """Return what the valid pixels observe that fall into the extent."""
        pixels = None if self._within is None else frame.valid & falling_into(self._within, frame, self.voxel_size)
        return observe(frame, self.voxel_size, self.num_classes, pixels)


class NumbaRules(_OfExtent):
    """The observations of the backend `numba`, made by its compiled loops, fused by a rule."""

    @functools.cached_property
    def _pixels(self) -> Aggregator:
        from semstab.backends.shared.aggregator import Aggregator

        return Aggregator(self.voxel_size, self.num_classes, self._within)

    def observe(self, frame: Frame) -> Observations:
        """Return the observations of a frame, by partitions of the hash."""
        observations = self._pixels.observe(frame)
        sums = _dense(observations, self.num_classes) if isinstance(observations, Observed) else observations.rows()
        return Observations(
            self._pixels.index_of(observations.key), sums / observations.pixels[:, None], observations.pixels.copy()
        )


def _dense(observations: Observed, K: int) -> Float64:
    sums, filled = np.zeros((len(observations.key), K)), observations.weight > 0  # the others are room that was left
    sums[np.repeat(np.arange(len(sums)), np.diff(observations.start))[filled], observations.label[filled]] = (
        observations.weight[filled]
    )
    return sums


RULED = {"numpy": NumpyRules, "numba": NumbaRules}
"""The classes that run rules for backends that have no option `rule`."""
