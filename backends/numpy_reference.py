"""Backend `numpy`: the reference. It stores the history H(q) of every voxel; each metric follows its definition."""

from __future__ import annotations

import itertools
import math
import time
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from semstab.backends.from_observations import NumpyRules
from semstab.backends.shared.association import (
    Observations,
    check_depth,
    check_frame,
    check_settings,
    falling_into,
    observe,
)
from semstab.backends.shared.observations import Change, MapTotal
from semstab.core.types import Int32, Int64, Mask
from semstab.data.events import Events
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame
from semstab.data.results import Changes, FrameReport
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import Extent, VoxelTable, index_columns

ONE_IN, MOST = 16, 10_000
"""One voxel in `ONE_IN` is in the sample; one in twice as many, and so on, where the map has more than `MOST` allow."""

MOST_OF_ALL = 1_000_000
"""The most voxels of a map that the reference fuses as a whole."""

SHARE = 0.5
"""The most time that it takes, as a share of the fusion that it checks, while it has more than one in ONE_IN."""

ODD = np.array([-0x61C8864680B583EB, -0x3D4D51C2D82B14B1, 0x165667B19E3779F9])
"""The factors, one an axis, that mix an index's bits (odd numbers of Steele and Vigna's splitmix and of xxHash)."""


class _FrameEntry(NamedTuple):
    """The evidence of a frame for voxels, by their rows (n,): mean evidence, of which most is 0, and pixels (n,)."""

    rows: Int32
    frame: int
    s_bar: Evidence
    pixels: Int64


class NumpyHistory:
    """The history H(q) of every voxel, from which a table is computed."""

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        self.check_options(voxel_size, num_classes)
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.within = within
        self._row: defaultdict[bytes, int] = defaultdict(itertools.count().__next__)  # voxel q, as bytes -> its row
        self._history: list[_FrameEntry] = []  # frame after frame

    check_options = staticmethod(check_settings)

    def append(self, frame: Frame) -> tuple[Int64, Observations]:
        """Append the frame's observations to the history; return them, and the rows of their voxels."""
        check_depth(frame)
        check_frame(frame, self.num_classes)
        observations = self._observe(frame)
        rows = self._rows(observations)
        self._history.append(
            _FrameEntry(rows.astype(np.int32), frame.index, Evidence.from_rows(observations.s_bar), observations.pixels)
        )
        return rows, observations

    def table(self) -> VoxelTable:
        """Return the map so far, from the history."""
        return self.events().table()

    def events(self) -> Events:
        """Return the history: every observation of every voxel."""
        voxels = np.frombuffer(b"".join(self._row), dtype=np.int64).reshape(-1, 3)
        order = in_order(voxels)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        nothing = np.zeros(0, dtype=np.int64)
        voxel = np.concatenate([nothing, *(rank[stored.rows] for stored in self._history)])
        frame = np.concatenate([nothing, *(np.full(len(stored.rows), stored.frame) for stored in self._history)])
        pixels = np.concatenate([nothing, *(stored.pixels for stored in self._history)])
        s_bar = Evidence.joined(
            [Evidence.from_rows(np.zeros((0, self.num_classes))), *(stored.s_bar for stored in self._history)]
        )
        by_voxel = np.argsort(voxel, kind="stable")  # stable: keeps the order of integration within a voxel
        return Events(
            **index_columns(voxels[order]),
            voxel=voxel[by_voxel],
            frame=frame[by_voxel].astype(np.int32),
            evidence=s_bar.take(by_voxel),
            pixels=pixels[by_voxel],
            voxel_size=self.voxel_size,
        )

    def _observe(self, frame: Frame) -> Observations:
        """Return what the valid pixels observe that fall into the extent."""
        valid = frame.valid
        pixels = valid if self.within is None else valid & falling_into(self.within, frame, self.voxel_size)
        return observe(frame, self.voxel_size, self.num_classes, pixels)

    def _rows(self, observations: Observations) -> Int64:
        """Return the rows of the frame's voxels, new ones added."""
        voxels = np.ascontiguousarray(observations.index, dtype=np.int64).view("V24").ravel().tolist()
        return np.fromiter(map(self._row.__getitem__, voxels), dtype=np.int64, count=len(voxels))


class NumpyReference(NumpyHistory):
    """Fusion as the paper writes it: clear before fast; memory grows with every observation."""

    keeps_log = True

    def __init__(self, voxel_size: float, num_classes: int, within: Extent | None = None) -> None:
        super().__init__(voxel_size, num_classes, within)
        self._evidence = np.zeros((0, num_classes))  # e(q), row by row, with room for more rows
        self._op = np.zeros(0, dtype=np.int64)
        self._total = MapTotal(num_classes)
        self._changes: Changes | None = None

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int, soft: bool = False) -> int:
        """Return a dictionary's entry and the evidence a voxel.

        An observation is in the history, and sorted for a table.
        """
        return voxels * (180 + 9 * num_classes) + observations * (90 + (25 * num_classes if soft else 0))

    def integrate(self, frame: Frame) -> FrameReport:
        """Append the frame's observations to the history, and add them to the evidence so far."""
        started = time.perf_counter()
        rows, observations = self.append(frame)
        self._make_room()
        before = self._evidence[rows]
        after = before + observations.s_bar
        self._evidence[rows] = after
        self._op[rows] += 1
        change, changed = Change.between(before, after, self._op[rows], observations.pixels)
        self._changes = Changes(observations.index, *changed)
        return self._total.add(frame.index, change, started)

    def changes(self) -> Changes | None:
        """Return the changes by the last frame."""
        return self._changes

    def _make_room(self) -> None:
        if len(self._row) > len(self._op):
            room = len(self._row) + len(self._row) // 4
            self._evidence.resize((room, self.num_classes), refcheck=False)  # in place: no copy is made
            self._op.resize(room, refcheck=False)


class NumpySample(NumpyHistory):
    """The reference on one in `one_in` of the voxels, drawn at random by their index, through all frames.

    A `whole` one starts with all voxels, and keeps them as long as that takes at most SHARE of the time of the fusion
    that it checks, and there are at most MOST_OF_ALL. It fuses by the `rule`, with `rule_options`, where these are
    given.

    Each sample holds those of the next thinner one, so that it can become thinner while the map grows: a defect in a
    share p of the voxels is found with probability 1 - (1 - p)^n, and n = MOST voxels find 0.05 % of them in 99 of 100.
    """

    def __init__(
        self, voxel_size: float, num_classes: int, within: Extent | None = None, *, whole: bool = False, **rule: Any
    ) -> None:
        super().__init__(voxel_size, num_classes, within)
        self.one_in, self._left = 1 if whole else ONE_IN, 0
        self._ahead: float | None = None  # seconds of fusion times SHARE less those of the reference; None at first
        self._by_rule = NumpyRules(voxel_size, num_classes, **rule) if rule else None

    def integrate(self, frame: Frame, allowed: float = math.inf) -> None:
        """Append the frame's observations of the sample; make the sample thinner if it is too large, or too slow.

        `allowed` are the seconds that the backend took for the frame. The first frame, in which code is loaded, does
        not count.
        """
        started = time.perf_counter()
        _, observations = self.append(frame)
        if self._by_rule is not None:
            self._by_rule.add(frame, observations, time.perf_counter())
        while len(self._row) - self._left > (MOST if self.one_in >= ONE_IN else MOST_OF_ALL):
            self._thin()
        if self._ahead is None:
            self._ahead = 0.0
        elif self.one_in < ONE_IN:
            self._ahead += SHARE * allowed - (time.perf_counter() - started)
            if self._ahead < 0:
                self._thin()
                self._ahead = 0.0

    def _thin(self) -> None:
        """Leave every second voxel of the sample out."""
        self.one_in *= 2
        index = np.frombuffer(b"".join(self._row), dtype=np.int64).reshape(-1, 3)
        self._left = int(np.count_nonzero(~in_sample(index.T, self.one_in)))

    def table(self) -> VoxelTable:
        """Return the map of the sample so far."""
        table = super().table() if self._by_rule is None else self._by_rule.table()
        return table.rows(in_sample(table.index.T, self.one_in))

    def _observe(self, frame: Frame) -> Observations:
        from semstab.backends.shared.pixel_keys import drawn_of

        near = drawn_of(frame, self.voxel_size, ODD, self.one_in)
        observations = observe(frame, self.voxel_size, self.num_classes, near)
        held = in_sample(observations.index.T, self.one_in)
        held = held if self.within is None else held & self.within.holds(observations.index.T)
        return Observations(observations.index[held], observations.s_bar[held], observations.pixels[held])


def in_sample(index: npt.NDArray[np.integer], one_in: int = ONE_IN) -> Mask:
    """Return a mask (n,) of the voxels with index (3, n) that are in a sample of one in `one_in`, a power of 2."""
    mixed = np.zeros(index.shape[1], np.int64)
    for axis, odd in zip(index, ODD, strict=True):
        mixed += axis * odd
    selected: Mask = (mixed >> 40) & (one_in - 1) == 0
    return selected
