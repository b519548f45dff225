"""Rules by which observations of a voxel become its belief: each is one equation over the same observations.

A rule is a function of the voxels' state (n, K), 0 where a voxel is new, and of what a frame observes there; it returns
the new state. The state is the voxel's evidence, or what the rule's `reads` makes evidence of. docs/fusion-rules.md
says when to take which.

Examples:
    >>> fused = semstab.fuse(frames, voxel_size=0.5, rule="recent")
    >>> fused.backend
    'numba+recent'
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from semstab.core.code import Code, guarded, is_code
from semstab.core.types import Float64, Int64
from semstab.data.frames import Frame
from semstab.errors import ConfigError, DataError, nearest

MEAN = "mean"
"""The paper's rule, which every backend has by itself."""


@dataclass(frozen=True, eq=False)
class VoxelObservations:
    """The observations of n voxels by one frame, as a rule reads them.

    Attributes:
        s_bar: (n, K) mean evidence of the frame's pixels in the voxel, a distribution over the classes.
        pixels: (n,) how many they are.
        op: (n,) frames that saw the voxel before.
        age: (n,) frames since the last one that saw it, by their index, never less than 0; 0 where the voxel is new.
        distance: (n,) metres from the sensor to the voxel's centre.
        frame: The frame itself.
    """

    s_bar: Float64
    pixels: Int64
    op: Int64
    age: Int64
    distance: Float64
    frame: Frame

    @property
    def new(self) -> Any:
        """(n, 1) whether the voxel is seen for the first time."""
        return self.op[:, None] == 0


Update = Callable[[Float64, VoxelObservations], Float64]


def mean(state: Float64, observed: VoxelObservations) -> Float64:
    """Return e + s_bar: each frame counts once (the paper, Persistent Voxel Evidence)."""
    return state + observed.s_bar


def votes(state: Float64, observed: VoxelObservations) -> Float64:
    """Return e + |A| s_bar: each pixel counts once, so that near and large views weigh more (pySLAM)."""
    return state + observed.pixels[:, None] * observed.s_bar


def bayes(state: Float64, observed: VoxelObservations, *, error: float = 0.1) -> Float64:
    """Return log p + log sum_j s_bar_j P(j | k), with P(k | k) = 1 - error and the rest on the other classes.

    It is Bayes' theorem with frames that err independently (McCormac et al. 2017, SemanticFusion; Rosinol et al. 2020,
    Kimera, whose measurement probability is 1 - error): beliefs become sure in a few frames.
    """
    if not 0 < error < 1:
        raise ConfigError(f"rule bayes: error = {error:g}: use a number between 0 and 1")
    other = error / (observed.s_bar.shape[1] - 1)
    likelihood: Float64 = other + (1 - error - other) * observed.s_bar
    return state + np.log(likelihood)


def softmax(state: Float64) -> Float64:
    """Return the distributions (n, K) of logarithms, up to a constant of each row."""
    p = np.exp(state - state.max(axis=1, keepdims=True))
    belief: Float64 = p / p.sum(axis=1, keepdims=True)
    return belief


bayes.reads = softmax  # type: ignore[attr-defined]


def weighted(state: Float64, observed: VoxelObservations, *, distance: float = 2.0, score: float = 0.0) -> Float64:
    """Return e + w s_bar, w = (max_k s_bar_k)^score / d^distance: near and sure views weigh more.

    1 / d^2 is the weight of depth measurements in a TSDF (Curless and Levoy 1996; Oleynikova et al. 2017, Voxblox).
    """
    w: Float64 = observed.s_bar.max(axis=1) ** score / np.maximum(observed.distance, NEAREST) ** distance
    return state + w[:, None] * observed.s_bar


NEAREST = 1e-3
"""Metres: a voxel around the sensor itself weighs as one at this distance."""


def recent(state: Float64, observed: VoxelObservations, *, half_life: float = 10.0) -> Float64:
    """Return 2^(-age / half_life) e + s_bar: evidence fades, age in frames since it was seen, by index."""
    if not half_life > 0:
        raise ConfigError(f"rule recent: half_life = {half_life:g}: use a number of frames above 0")
    return 2.0 ** (-observed.age / half_life)[:, None] * state + observed.s_bar


def first(state: Float64, observed: VoxelObservations) -> Float64:
    """Return s_bar of the first frame that saw the voxel, whatever comes later: a belief that never drifts."""
    return np.where(observed.new, observed.s_bar, state)


def last(state: Float64, observed: VoxelObservations) -> Float64:  # noqa: ARG001  every rule takes both
    """Return s_bar of the last frame: the map as a single frame paints it."""
    return observed.s_bar


def maximum(state: Float64, observed: VoxelObservations) -> Float64:
    """Return max(e, s_bar), class by class: the surest frame of each class counts (max pooling)."""
    return np.maximum(state, observed.s_bar)


RULES: dict[str, Callable[..., Float64]] = {
    MEAN: mean, "votes": votes, "bayes": bayes, "weighted": weighted, "recent": recent, "first": first, "last": last,
    "max": maximum,
}  # fmt: skip


@dataclass(frozen=True)
class Rule:
    """A rule with its options set: `update` makes the new state, `reads` the evidence of a state."""

    name: str
    update: Update
    reads: Callable[[Float64], Float64]

    @classmethod
    def from_name(cls, name: str, options: Mapping[str, Any] | None = None) -> Rule:
        """Return the rule of that name, or of FILE.py:NAME.

        Raises:
            ConfigError: For an unknown name or option, or a value that the rule does not take.
        """
        if is_code(name):
            function = Code.load(name, "rule").target
        elif name in RULES:
            function = RULES[name]
        else:
            raise ConfigError(f"rule '{name}' is not known; {nearest(name, sorted(RULES))}, or name FILE.py:NAME")
        taken = [*inspect.signature(function).parameters][2:]
        for key, value in (options or {}).items():
            if key not in taken:
                listed = f"it takes {', '.join(taken)}" if taken else "it takes none"
                raise ConfigError(f"rule '{name}' has no option '{key}'; {listed}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigError(f"rule '{name}': {key} = {value!r}: use a number")
        rule = cls(name, partial(function, **(options or {})), getattr(function, "reads", _as_it_is))
        if name in RULES:
            rule(np.zeros((1, 2)), _ONE)  # a value that it does not take is found before a frame is read
        return rule

    def __call__(self, state: Float64, observed: VoxelObservations) -> Float64:
        """Return the new state.

        Raises:
            DataError: If the rule returns no such array, or evidence that is negative or sums to 0.
        """
        if not len(state):
            return state
        made = (
            guarded(self.name, lambda: self.update(state, observed))
            if is_code(self.name)
            else self.update(state, observed)
        )
        after = np.asarray(made, dtype=np.float64)
        if after.shape != state.shape:
            raise DataError(f"rule '{self.name}' returned shape {after.shape} of a state of {state.shape}; return one")
        evidence = self.reads(after)
        if not (evidence.min() >= 0 and np.isfinite(evidence).all() and (evidence.sum(axis=1) > 0).all()):
            raise DataError(f"rule '{self.name}' made evidence that is negative, not finite or 0 in all classes")
        return after


def _as_it_is(state: Float64) -> Float64:
    return state


_ONE = VoxelObservations(
    np.array([[1.0, 0.0]]), np.array([1]), np.array([0]), np.array([0]), np.array([1.0]),
    Frame(0, np.ones((1, 1), np.float32), np.eye(3), np.eye(4), labels=np.zeros((1, 1), np.uint8)),  # type: ignore[arg-type]
)  # fmt: skip
"""One pixel in one voxel."""
