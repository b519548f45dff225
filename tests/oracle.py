"""The paper once more, in plain Python: loops over pixels, dictionaries, math.log. Slow, and independent of the rest.

It takes frames and gives tables, so it is a backend; but it shares no line of arithmetic with the others. Its small
methods are what `test_broken_backend.py` breaks one by one.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from semstab import VoxelTable
from semstab.data.results import FrameReport
from semstab.errors import ConfigError, DataError


@dataclass
class Observation:
    """One frame's view of one voxel."""

    frame: int
    s_bar: list
    pixels: int


@dataclass
class Oracle:
    voxel_size: float
    num_classes: int
    history: dict = field(default_factory=dict)  # H(q): voxel -> observations, in order of integration

    def __post_init__(self):
        if not (math.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise ConfigError("voxel size")
        if self.num_classes < 2:
            raise ConfigError("classes")

    def integrate(self, frame):
        self.check(frame)
        vectors_of = {}  # A_t(q): voxel -> evidence vectors of the frame's pixels in it
        for v, row in enumerate(frame.depth.tolist()):
            for u, d in enumerate(row):
                s = self.evidence(frame, u, v)
                if self.has_depth(d) and s is not None:
                    vectors_of.setdefault(self.voxel(frame, self.world_point(frame, u, v, d)), []).append(s)
        new = {q for q in vectors_of if q not in self.history}
        for q, vectors in vectors_of.items():
            self.observe(q, frame, vectors)
        return FrameReport(
            frame=frame.index,
            points=sum(len(vectors) for vectors in vectors_of.values()),
            voxels=len(vectors_of),
            new_voxels=len(new),
            drift_sum=math.fsum(self.divergence(*self.beliefs(q)[-2:]) for q in vectors_of if q not in new),
            seconds=0.0,
            map_voxels=len(self.history),
        )

    def check(self, frame):
        if frame.scores is not None and frame.scores.shape[2] != self.num_classes:
            raise DataError(f"scores of {frame.scores.shape[2]} classes")

    # --- Semantic Evidence and World-Space Association ---

    def has_depth(self, d):
        return math.isfinite(d) and d > 0

    def evidence(self, frame, u, v):
        """s_t(u, v), or None where the pixel has none."""
        if frame.labels is not None:
            return self.one_hot(frame, u, v)
        scores = [float(score) for score in frame.scores[v, u]]
        total = sum(scores)
        return self.normalised(scores, total) if math.isfinite(total) and total > 0 else None

    def one_hot(self, frame, u, v):
        label = int(frame.labels[v, u])
        if self.is_ignored(label, frame.labels.dtype.itemsize):
            return None
        if label >= self.num_classes:
            if not self.has_depth(float(frame.depth[v, u])):
                return None
            raise DataError(f"label {label}")
        return [1.0 if k == label else 0.0 for k in range(self.num_classes)]

    def is_ignored(self, label, itemsize):
        return label == {1: 255, 2: 65535}[itemsize]

    def normalised(self, scores, total):
        return [score / total for score in scores]

    def world_point(self, frame, u, v, d):
        K, T = frame.intrinsics, frame.T_wc.tolist()
        if frame.points is not None:
            x_c = frame.points[v, u].tolist()
        else:
            x_c = [(u - K.cx) / K.fx * d, (v - K.cy) / K.fy * d, d]
        return [T[i][0] * x_c[0] + T[i][1] * x_c[1] + T[i][2] * x_c[2] + T[i][3] for i in range(3)]

    def voxel(self, frame, x_w):
        q = tuple(self.discretise(x) for x in x_w)
        if not all(-(2**31) <= i < 2**31 for i in q):
            raise DataError(f"frame {frame.index}: voxel {q}")
        return q

    def discretise(self, x):
        return math.floor(x / self.voxel_size)

    # --- Persistent Voxel Evidence ---

    def observe(self, q, frame, vectors):
        self.history.setdefault(q, []).append(Observation(frame.index, self.average(vectors), len(vectors)))

    def average(self, vectors):
        return [math.fsum(s[k] for s in vectors) / len(vectors) for k in range(self.num_classes)]

    def accumulated(self, q):
        """The sum of s_bar after each observation; the last one is e(q)."""
        total, sums = [0.0] * self.num_classes, []
        for visit in self.history[q]:
            total = [a + b for a, b in zip(total, visit.s_bar, strict=True)]
            sums.append(total)
        return sums

    def beliefs(self, q):
        return [[e / sum(total) for e in total] for total in self.accumulated(q)]

    # --- Voxel-Level Stability Metrics ---

    def vss(self, q):
        e = self.accumulated(q)[-1]
        return max(e) / sum(e)

    def drift(self, q):
        """The sum of D_JS over t = 2..T."""
        p = self.beliefs(q)
        return math.fsum(self.divergence(p[t], p[t - 1]) for t in range(1, len(p)))

    def sbd(self, q):
        return self.drift(q) / (self.op(q) - 1) if self.op(q) >= 2 else math.nan

    def op(self, q):
        return len(self.history[q])

    def entropy(self, q):
        return -sum(p * math.log(p) for p in self.beliefs(q)[-1] if p > 0) / math.log(self.num_classes)

    def divergence(self, p, q):
        """D_JS in bits."""
        m = [(a + b) / 2 for a, b in zip(p, q, strict=True)]
        return (self.relative_entropy(p, m) + self.relative_entropy(q, m)) / 2

    def relative_entropy(self, p, m):
        return sum(a * math.log(a / b) for a, b in zip(p, m, strict=True) if a > 0) / math.log(2)

    # --- The contract ---

    def first_frame(self, q):
        return min(visit.frame for visit in self.history[q])

    def last_frame(self, q):
        return max(visit.frame for visit in self.history[q])

    def self_sum(self, q):
        return sum(s * s for visit in self.history[q] for s in visit.s_bar)

    def frame_entropy_sum(self, q):
        return -sum(s * math.log2(s) for visit in self.history[q] for s in visit.s_bar if s > 0)

    def pixels(self, q):
        return sum(visit.pixels for visit in self.history[q])

    def rows(self):
        return sorted(self.history)

    def table(self):
        rows = self.rows()
        ix, iy, iz = np.array(rows, dtype=np.int32).reshape(-1, 3).T
        evidence = np.array([self.accumulated(q)[-1] for q in rows]).reshape(-1, self.num_classes)
        names = ("op", "drift_sum", "pixels", "first_frame", "last_frame", "self_sum", "frame_entropy_sum")
        column = {"drift_sum": self.drift}
        columns = {name: np.array([column.get(name, getattr(self, name, None))(q) for q in rows]) for name in names}
        return VoxelTable(ix, iy, iz, evidence=evidence, **columns, voxel_size=self.voxel_size)

    def events(self):
        return None
