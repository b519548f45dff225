"""Building blocks of the tests: frames whose map is known by hand, random ones, and a comparison of two maps."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from semstab.backends import FusionBackend
from semstab.conformance import random_frames
from semstab.core.types import Float64
from semstab.data.frames import Frame, Intrinsics
from semstab.data.measures import SBD_MAX
from semstab.data.results import FrameReport
from semstab.data.voxels import VoxelTable
from semstab.metrics import entropy, sbd, vss
from semstab.metrics.agreement import mismatches

__all__ = ["random_frames"]

Voxel = tuple[int, int, int]
Label = int | Sequence[float]
Hit = tuple[float, Label]

LOOKING = {
    "x": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
}
"""Rotations of cameras that look along a world axis."""

H_THIRD = math.log2(3) - 2 / 3
"""Entropy of (2/3, 1/3) in bits: 2/3 log2(3/2) + 1/3 log2 3."""

JS_HALF = SBD_MAX
"""D_JS((1, 0), (1/2, 1/2)) = 0.31128 bits: with m = (3/4, 1/4) it is H(m) - (H(1, 0) + H(1/2, 1/2)) / 2.

H(m) = 3/4 log2(4/3) + 1/4 log2 4 = 2 - 3/4 log2 3, and the other two entropies are 0 and 1.
"""


# --- Frames -----------------------------------------------------------------------------------------------------------


def sight_line(
    index: int,
    hits: Sequence[Hit],
    *,
    start: Sequence[float] = (0.5, 0.5, 0.0),
    along: str = "z",
    dtype: type[Any] = np.uint8,
) -> Frame:
    """Return a frame whose pixels all look along one line: pixel i lies at start + depth_i * axis, exactly.

    The focal length is so long (2^60 pixels) that the pixels' rays coincide. A hit is (depth, label id), or
    (depth, K scores); `dtype` is the label map's, or the scores'. With voxels of 1 m the default line runs through the
    voxels (0, 0, 0), (0, 0, 1), ...: a hit at depth 2.5 falls into (0, 0, 2).
    """
    T_wc = np.eye(4)
    T_wc[:3, :3], T_wc[:3, 3] = LOOKING[along], start
    values = np.array([[value for _, value in hits]], dtype=dtype)
    return Frame(
        index=index,
        depth=np.array([[depth for depth, _ in hits]], dtype=np.float32),
        intrinsics=Intrinsics(fx=2.0**60, fy=2.0**60, cx=0, cy=0),
        T_wc=T_wc,
        labels=values if values.ndim == 2 else None,
        scores=values if values.ndim == 3 else None,
    )


DEPTHS = st.sampled_from([0.0, 0.25, 0.5, 1.5, 2.5, 3.5])  # 0 is invalid; the others lie inside voxels of 1 m
LABELS = st.sampled_from([0, 1, 2, 255])
HITS = st.lists(st.tuples(DEPTHS, LABELS), min_size=1, max_size=6)
SEQUENCES = st.lists(HITS, min_size=1, max_size=5)
"""Random sequences for K = 3, one list of hits a frame."""

checks = settings(
    max_examples=25,
    derandomize=True,  # the same examples in each run
    database=None,
    deadline=None,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
    suppress_health_check=[HealthCheck.differing_executors],  # subclasses share these tests
)


def as_frames(sequence: Iterable[Sequence[Hit]]) -> list[Frame]:
    """Return the frames of a random sequence."""
    return [sight_line(index, hits) for index, hits in enumerate(sequence)]


# --- Tables -----------------------------------------------------------------------------------------------------------


def voxels(table: VoxelTable) -> list[Voxel]:
    """Return the voxels of a table in its order."""
    return [(int(x), int(y), int(z)) for x, y, z in table.index]


def only(table: VoxelTable) -> int:
    """Return the row of a map of one voxel."""
    assert len(table) == 1
    return 0


EXACT = ("ix", "iy", "iz", "op", "pixels", "first_frame", "last_frame")
SUMS = ("evidence", "drift_sum", "self_sum", "frame_entropy_sum")


def assert_same_map(
    a: VoxelTable, b: VoxelTable, tolerance: float, leaving_out: Sequence[str] = (), cause: Callable[[], str] = str
) -> None:
    """Assert that the voxels and rows of `a` are those of `b`, the expected ones.

    Counts are equal, sums agree to `tolerance`, those above 1 relative to the sum. The error says what `conform` says:
    column, voxel, what it is and what was expected, and the likely cause.
    """
    columns = {*EXACT, *SUMS} - {*leaving_out}
    wrong = [m for m in mismatches(a, b, tolerance) if re.sub(r"_\d+$", "", m.column) in columns]
    assert not wrong, "; ".join(
        [*map(str, wrong), *(f"likely: {explanation}" for explanation in [cause()] if explanation)]
    )


def share_that_differs(a: VoxelTable, b: VoxelTable, tolerance: float) -> float:
    """Return the share of all voxels that are in one map only, or whose rows differ by more than `tolerance`."""
    rows_a, rows_b = _rows(a), _rows(b)
    everywhere = rows_a.keys() | rows_b.keys()
    same = [
        q
        for q in rows_a.keys() & rows_b.keys()
        if np.allclose(rows_a[q], rows_b[q], rtol=0, atol=tolerance, equal_nan=True)
    ]
    return 1 - len(same) / len(everywhere) if everywhere else 0.0


def _rows(table: VoxelTable) -> dict[Voxel, Float64]:
    measures = np.stack([vss(table), sbd(table), entropy(table)], axis=1)
    columns = [measures, *(np.asarray(getattr(table, name)).reshape(len(table), -1) for name in (*EXACT, *SUMS))]
    return dict(zip(voxels(table), np.concatenate(columns, axis=1), strict=True))


class _Partial:
    """A backend that leaves something out: a test that gives it that is skipped."""

    def __init__(self, backend: FusionBackend, tests: BackendTests) -> None:
        self._backend, self._tests = backend, tests

    def integrate(self, frame: Frame) -> FrameReport:
        if not self._tests.takes(frame):
            left_out = "scores" if frame.scores is not None and not self._tests.scores else "scans"
            pytest.skip(f"{left_out} = False: this backend does without")
        return self._backend.integrate(frame)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)


def _as_declared(create: Callable[..., FusionBackend]) -> Callable[..., FusionBackend]:
    @functools.wraps(create)
    def made(tests: BackendTests, voxel_size: float, num_classes: int) -> FusionBackend:
        backend = create(tests, voxel_size, num_classes)
        return backend if tests.scans and tests.scores else cast(FusionBackend, _Partial(backend, tests))

    return made


# Common to all groups of tests: a backend to test, and the fusion with it.


class BackendTests:
    """Tests of the backend that `create` makes; BackendConformance explains the attributes."""

    tolerance: float = 1e-9
    voxel_share: float = 0.0
    reach: int = 2**31
    long_cases: bool = False
    scans: bool = True
    scores: bool = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "create" in vars(cls):
            cls.create = _as_declared(cls.create)  # type: ignore[method-assign]

    def takes(self, frame: Frame) -> bool:
        """Return whether the backend is declared to fuse such a frame."""
        return (self.scans or not frame.is_scan) and (self.scores or frame.scores is None)

    def create(self, voxel_size: float, num_classes: int) -> FusionBackend:
        """Return a new, empty map."""
        raise NotImplementedError("a subclass of BackendConformance says how its backend is made")

    def fuse(self, *frames: Frame, voxel_size: float = 1.0, K: int = 3) -> VoxelTable:
        """Return the map of these frames."""
        backend = self.create(voxel_size, K)
        for frame in frames:
            backend.integrate(frame)
        return backend.table()

    def near(self, value: Any) -> Any:
        """Return `value`, give or take the tolerance."""
        return pytest.approx(value, abs=self.tolerance)
