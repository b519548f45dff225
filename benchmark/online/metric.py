"""Measure temporal stability in a training loop: `update` with every batch, `compute` at the end of an epoch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.backends import FusionBackend, check_options, create, rule_of
from semstab.backends.numpy_reference import ODD, in_sample
from semstab.backends.shared.pixel_keys import drawn_of
from semstab.core.types import Float64, Int64
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.data.measures import SBD, VSS, mean
from semstab.data.voxels import VoxelTable, index_columns
from semstab.errors import ConfigError, DataError
from semstab.metrics import compensated_flicker, summarise
from semstab.metrics.image_space import SIDE
from semstab.online.frames import as_array
from semstab.online.summary import Summary
from semstab.statistics import MapSample, Sampler, SpotObservations, Views, analyse, psa
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import value
from semstab.statistics.feature_spots import MOST_BYTES, FeatureObservations
from semstab.statistics.features import alpha_of_features
from semstab.statistics.sampler import BUDGET

MOST_VOXELS = 2_000_000


@dataclass(frozen=True)
class State:
    """The state of one process for one sequence; states of several processes are added.

    Attributes:
        updates: (n,) how often a further frame moved the belief of each voxel.
        spots: The sampled observations from which alpha is computed; None without alpha.
        one_in: The table holds a sample of one in `one_in` voxels.
        features: The sampled features; None without any.
    """

    frames: int
    table: VoxelTable
    updates: Int64
    spots: SpotObservations | None
    flicker: tuple[float, int]
    one_in: int
    features: FeatureObservations | None = None

    def __add__(self, other: State) -> State:
        """Return the sum of this state and that of another process for the same sequence.

        All numbers are as if one process had seen all frames, except SBD and flicker: they are means over the steps
        from frame to frame that each process saw.
        """
        one_in = max(self.one_in, other.one_in)
        a, b = (state._thinned(one_in) for state in (self, other))
        table, updates = _added(a.table, b.table, a.updates, b.updates)
        flicker = self.flicker[0] + other.flicker[0], self.flicker[1] + other.flicker[1]
        spots = None if a.spots is None or b.spots is None else _joined(a.spots, b.spots)
        first, second = self.features, other.features
        features = _with_features(first, second) if first is not None and second is not None else first or second
        return State(self.frames + other.frames, table, updates, spots, flicker, one_in, features)

    def _thinned(self, one_in: int) -> State:
        if one_in == self.one_in:
            return self
        rows = in_sample(self.table.index.T, one_in)
        return dataclasses.replace(self, table=self.table.rows(rows), updates=self.updates[rows], one_in=one_in)

    def scalars(self) -> dict[str, float]:
        """Return the numbers of `Summary.NAMES`, which `summary` has too, without intervals."""
        table = self._table()
        map_summary, sample = summarise(table), MapSample.draw(table).table.measured()
        alpha = math.nan
        if self.spots is not None and len(self.spots):
            alpha = value(sums_of_spots(self.spots), "alpha")
        numbers = (
            alpha,
            map_summary.recurrent[VSS],
            map_summary.recurrent[SBD],
            mean(psa(sample)),
            self._flicker,
            map_summary.recurrent.share,
        )
        scalars = dict(zip(Summary.NAMES, map(float, numbers), strict=True))
        if self.features is not None:
            scalars["feature_alpha"] = alpha_of_features(self.features)
        return scalars

    def summary(self) -> Summary:
        """Return the numbers of a run of these frames."""
        analysis = analyse(MapSample.draw(self._table()), self.spots, features=self.features)
        return Summary.from_statistics(self.frames, analysis.table, analysis.summary, self._flicker)

    def _table(self) -> VoxelTable:
        """Return the map; of a voxel that two processes saw, SBD is the mean over the steps that were taken."""
        steps = self.table.op - 1
        fewer = self.updates < steps
        if not fewer.any():
            return self.table
        scale = np.where(fewer, steps / np.maximum(self.updates, 1), 1.0)
        return dataclasses.replace(self.table, drift_sum=self.table.drift_sum * scale)

    @property
    def _flicker(self) -> float:
        total, steps = self.flicker
        return total / steps if steps else math.nan


class _Map:
    """A sequence whose frames are being fused; beyond `most` voxels only a random half of them is fused, and so on."""

    def __init__(self, backend: FusionBackend, voxel_size: float, sampler: Sampler | None, most: int) -> None:
        self._backend, self._voxel_size, self._sampler, self._most = backend, voxel_size, sampler, most
        self._frames, self._one_in, self._left_out = 0, 1, 0
        self._flicker, self._pairs = 0.0, 0
        self._previous: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Fuse the next frame."""
        frame = dataclasses.replace(frame, index=self._frames)
        if self._sampler is not None:
            self._sampler.add(frame)
        if self._previous is not None:
            sample = frame.within(SIDE)
            step = compensated_flicker(self._previous, sample, voxel_size=self._voxel_size).flicker_percent
            if not math.isnan(step):
                self._flicker, self._pairs = self._flicker + step, self._pairs + 1
        self._previous = frame
        report = self._backend.integrate(self._drawn(frame))
        self._frames += 1
        if report.map_voxels - self._left_out > self._most:
            index = self._backend.table().index.T
            while np.count_nonzero(in_sample(index, self._one_in)) > self._most:
                self._one_in *= 2
            self._left_out = int(np.count_nonzero(~in_sample(index, self._one_in)))

    def _drawn(self, frame: Frame) -> Frame:
        """Return the frame without the depth of pixels that show voxels outside of the sample."""
        if self._one_in == 1:
            return frame
        near = drawn_of(frame, self._voxel_size, ODD, self._one_in)
        return dataclasses.replace(frame, depth=np.where(near, frame.depth, np.float32(0)))

    def state(self) -> State:
        """Return the state so far."""
        table = self._backend.table()
        if self._one_in > 1:
            table = table.rows(in_sample(table.index.T, self._one_in))
        spots = None if self._sampler is None else self._sampler.sample()
        flicker = self._flicker, self._pairs
        features = None if self._sampler is None else self._sampler.features()
        return State(self._frames, table, table.op.astype(np.int64) - 1, spots, flicker, self._one_in, features)


class TemporalStability:
    """A metric of how stable predictions are at the same physical place, over the frames of one or more sequences.

    It has the interface of torchmetrics, and is a `torchmetrics.Metric` if torchmetrics is installed.

    Attributes:
        num_classes: The number of classes, K.
        voxel_size: The edge of a voxel, metres.
        ignore_index: The label of pixels without a class.
        soft: True to fuse scores; else the likeliest class of each pixel is fused, as from label maps on disk.
        alpha: True to ask frames at the spots that give alpha and a verdict: half of the time of an update.
        max_voxels: The most voxels of a sequence; a larger map is sampled at random, so that its memory is bounded.
        backend: The backend that fuses.
        of_torchmetrics: The arguments of `torchmetrics.Metric`, if torchmetrics is installed.

    Examples:
        >>> metric = semstab.TemporalStability(num_classes=3, voxel_size=0.1)
        >>> K, pose = [[50, 0, 32], [0, 50, 24], [0, 0, 1]], np.eye(4)
        >>> depth, labels = np.ones((48, 64), np.float32), np.zeros((48, 64), int)
        >>> labels[:, 32:] = 1
        >>> for wrong in (0, 0, 12):
        ...     predicted = labels.copy()
        ...     predicted[:, :wrong] = 2
        ...     metric.update(predicted, depth, K, pose)
        >>> numbers = metric.compute()
        >>> {name: round(float(numbers[name]), 2) for name in ("vss_op3", "recurrent_share")}
        {'vss_op3': 0.93, 'recurrent_share': 1.0}
    """

    higher_is_better = True
    """True for alpha, VSS and PSA; SBD and flicker are better when low."""

    def __init__(
        self,
        num_classes: int,
        voxel_size: float = 0.1,
        *,
        ignore_index: int | None = IGNORE_8BIT,
        soft: bool = False,
        alpha: bool = True,
        max_voxels: int = MOST_VOXELS,
        backend: str = "numba",
    ) -> None:
        if num_classes < 2:
            raise ConfigError(f"num_classes = {num_classes}: stability needs at least 2 classes")
        if max_voxels < 1:
            raise ConfigError(f"max_voxels = {max_voxels}: use 1 or more")
        if rule := rule_of(backend):
            raise ConfigError(
                f"backend '{backend}': maps by rule '{rule}' cannot be added up over processes; use the mean here, or"
                " semstab.fuse(frames, rule=...)"
            )
        check_options(backend, voxel_size=voxel_size, num_classes=num_classes)
        self.num_classes, self.voxel_size, self.ignore_index, self.soft = num_classes, voxel_size, ignore_index, soft
        self.alpha, self.max_voxels, self.backend = alpha, max_voxels, backend
        self._maps: dict[str, _Map] = {}
        self._merged: dict[str, State] = {}

    def update(
        self,
        predicted: Any,
        depth: Any,
        intrinsics: Any,
        T_wc: Any,
        sequence: str | int | Sequence[Any] = "",
        features: Any = None,
    ) -> None:
        """Fuse one frame, or a batch of frames in the order of time.

        Raises DataError, which names the frame of the batch, where shapes, labels or a pose cannot be; then no frame
        of the batch was fused.

        Args:
            predicted: Labels (H, W), or logits or probabilities (K, H, W); of a batch (B, H, W) or (B, K, H, W).
            depth: (H, W) or (B, H, W) float, metres along the optical axis.
            intrinsics: (3, 3) or (B, 3, 3) camera matrix, or `Intrinsics`.
            T_wc: (4, 4) or (3, 4), camera to world in metres; or (B, ...).
            sequence: Which sequence they belong to, one name or one a frame; sequences may alternate.
            features: (D, h, w) or (B, D, h, w) float of a grid that covers the image evenly, optional: `compute` then
                has feature_alpha, too. Without labels predicted is None.
        """
        depth = as_array(depth)
        predicted = np.zeros(depth.shape, np.uint8) if predicted is None else as_array(predicted)
        frames = self._frames(predicted, depth, intrinsics, as_array(T_wc))
        if features is not None:
            frames = _featured(frames, as_array(features))
        names = [sequence] * len(frames) if isinstance(sequence, str | int) else [*sequence]
        if len(names) != len(frames):
            raise DataError(f"sequence: {len(names)} names for {len(frames)} frames; give one name, or one a frame")
        for sequence_name, frame in zip(names, frames, strict=True):
            name = str(sequence_name.item() if hasattr(sequence_name, "item") else sequence_name)
            if name not in self._maps:
                self._maps[name] = self._new_map()
            self._maps[name].add(frame)

    def compute(self) -> dict[str, float]:
        """Return alpha, vss_op3, sbd_op3 (bits), psa_op2, flicker (percent) and recurrent_share, means over sequences.

        With features there is feature_alpha, too; the numbers of labels mean nothing if predicted was None.

        A run of these frames gives the same numbers; an undefined number is NaN, as before the first update.
        """
        rows = [state.scalars() for state in self.states().values()]
        names = dict.fromkeys((*Summary.NAMES, *(name for row in rows for name in row)))
        return {name: mean(np.array([row.get(name, math.nan) for row in rows], np.float64)) for name in names}

    def by_sequence(self) -> dict[str, Summary]:
        """Return the numbers of each sequence, its verdict among them."""
        return {name: state.summary() for name, state in self.states().items()}

    def reset(self) -> None:
        """Forget all frames."""
        self._maps, self._merged = {}, {}

    def states(self) -> dict[str, State]:
        """Return the state of each sequence, to be sent to another process and merged there."""
        return _sum(self._merged, {name: sequence_map.state() for name, sequence_map in self._maps.items()})

    def merge_state(self, incoming_state: TemporalStability | Mapping[str, State]) -> None:
        """Add the states of another metric, or its `states`; a sequence may have been split between them."""
        other = incoming_state.states() if isinstance(incoming_state, TemporalStability) else incoming_state
        self._merged = _sum(self._merged, other)

    def _new_map(self) -> _Map:
        backend = create(self.backend, voxel_size=self.voxel_size, num_classes=self.num_classes)
        sampler = Sampler(self.num_classes, moving=False) if self.alpha else None
        return _Map(backend, self.voxel_size, sampler, self.max_voxels)

    def _frames(
        self, predicted: npt.NDArray[Any], depth: npt.NDArray[Any], intrinsics: Any, T_wc: Float64
    ) -> list[Frame]:
        """Return the frames of a batch, checked."""
        if depth.ndim == 2:
            predicted, depth, T_wc = predicted[None], depth[None], T_wc[None]
        B = len(depth)
        if depth.ndim != 3 or len(predicted) != B or predicted.shape[-2:] != depth.shape[-2:]:
            raise DataError(
                f"predicted {predicted.shape} and depth {depth.shape} do not belong together; give labels or logits and"
                " depth of one frame, (H, W) or (K, H, W) and (H, W), or of a batch, with B before them"
            )
        if not isinstance(intrinsics, Intrinsics | list | tuple):
            intrinsics = as_array(intrinsics)
        cameras = [*intrinsics] if np.ndim(intrinsics) == 3 or _are_cameras(intrinsics) else [intrinsics] * B
        poses = [*T_wc] if T_wc.ndim == 3 else [T_wc] * B
        if not len(cameras) == len(poses) == B:
            raise DataError(
                f"{len(cameras)} intrinsics and {len(poses)} poses for {B} frames; give one, or one a frame"
            )
        return [self._frame(k, predicted[k], depth[k], cameras[k], poses[k]) for k in range(B)]

    def _frame(self, k: int, predicted: npt.NDArray[Any], depth: npt.NDArray[Any], camera: Any, pose: Float64) -> Frame:
        labels = scores = None
        if predicted.ndim == 3:
            if len(predicted) != self.num_classes:
                raise DataError(f"frame {k}: logits of shape {predicted.shape}; give ({self.num_classes}, H, W)")
            if self.soft:
                scores = _probabilities(predicted)
            else:
                labels = predicted.argmax(axis=0)
                labels[np.isnan(predicted).any(axis=0)] = IGNORE_16BIT
        else:
            labels = predicted
            if not np.issubdtype(labels.dtype, np.integer):
                raise DataError(f"frame {k}: labels are {labels.dtype}; give integers, or logits (K, H, W)")
        if labels is not None:
            labels = self._checked(k, labels)
        frame = Frame(k, depth.astype(np.float32, copy=False), camera, pose, labels=labels, scores=scores)
        none = (frame.predicted == frame.ignore_id) & (frame.depth > 0) & (frame.depth < np.inf)
        return dataclasses.replace(frame, unlabelled=none) if none.any() else frame

    def _checked(self, k: int, labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return labels as uint8, or uint16 with more classes; ignored pixels get the highest id."""
        dtype, none = (np.uint8, IGNORE_8BIT) if self.num_classes < IGNORE_8BIT else (np.uint16, IGNORE_16BIT)
        valid = (labels >= 0) & (labels < self.num_classes)
        if not valid.all():
            ignored = labels == IGNORE_16BIT if self.ignore_index is None else labels == self.ignore_index
            wrong = labels[~valid & ~ignored & (labels != IGNORE_16BIT)]
            if len(wrong):
                raise DataError(f"frame {k}: label {int(wrong[0])} is not below num_classes = {self.num_classes}")
        if self.ignore_index is not None:
            valid &= labels != self.ignore_index
        return np.where(valid, labels, none).astype(dtype)


def _featured(frames: Sequence[Frame], features: npt.NDArray[Any]) -> list[Frame]:
    """Return frames with their features (D, h, w), of a batch (B, D, h, w)."""
    features = features[None] if features.ndim == 3 else features
    if features.ndim != 4 or len(features) != len(frames):
        raise DataError(f"features of shape {features.shape} for {len(frames)} frames; give (D, h, w), or (B, D, h, w)")
    pairs = zip(frames, np.moveaxis(features, 1, -1), strict=True)
    return [dataclasses.replace(frame, features=frame_features) for frame, frame_features in pairs]


def _are_cameras(intrinsics: Any) -> bool:
    return isinstance(intrinsics, list | tuple) and all(isinstance(camera, Intrinsics) for camera in intrinsics)


def _probabilities(logits: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return (H, W, K) scores that sum to 1: as given, or by a softmax where they are not probabilities."""
    values = np.moveaxis(logits, 0, -1).astype(np.float32, copy=False)
    if values.min(initial=0) >= 0 and values.max(initial=1) <= 1:
        return values
    powers = np.exp(values - values.max(axis=-1, keepdims=True))
    probabilities: npt.NDArray[Any] = powers / powers.sum(axis=-1, keepdims=True)
    return probabilities


def _sum(first: Mapping[str, State], second: Mapping[str, State]) -> dict[str, State]:
    """Return the states of the sequences of both; states of the same sequence are added."""
    total = dict(first)
    for name, state in second.items():
        total[name] = total[name] + state if name in total else state
    return total


def _added(a: VoxelTable, b: VoxelTable, updates_a: Int64, updates_b: Int64) -> tuple[VoxelTable, Int64]:
    """Return the map of the frames of two maps, and how often its voxels were moved."""
    index, inverse = np.unique(np.concatenate([a.index, b.index]), axis=0, return_inverse=True)
    n, inverse = len(index), inverse.ravel()

    def total(name: str) -> npt.NDArray[Any]:
        sums = np.zeros(n, getattr(a, name).dtype)
        np.add.at(sums, inverse, np.concatenate([getattr(a, name), getattr(b, name)]))
        return sums

    first, last = np.full(n, np.iinfo(np.int32).max, np.int32), np.zeros(n, np.int32)
    np.minimum.at(first, inverse, np.concatenate([a.first_frame, b.first_frame]))
    np.maximum.at(last, inverse, np.concatenate([a.last_frame, b.last_frame]))
    updates = np.zeros(n, np.int64)
    np.add.at(updates, inverse, np.concatenate([updates_a, updates_b]))
    evidence = Evidence.joined([a.evidence, b.evidence])
    voxel = np.repeat(inverse, np.diff(evidence.starts))
    key, positions = np.unique(voxel * a.K + evidence.label, return_inverse=True)
    starts = np.searchsorted(key, np.arange(n + 1) * a.K)
    weight = np.bincount(positions.ravel(), evidence.weight, len(key)).astype(np.float64, copy=False)
    summed = {name: total(name) for name in ("op", "drift_sum", "pixels", "self_sum", "frame_entropy_sum")}
    return VoxelTable(
        **index_columns(index), **summed, first_frame=first, last_frame=last, voxel_size=a.voxel_size,
        evidence=Evidence(starts, (key % a.K).astype(np.uint16), weight, a.K), classes=a.classes,
    ), updates  # fmt: skip


def _with_features(a: FeatureObservations, b: FeatureObservations) -> FeatureObservations:
    """Return the features of both, each for its own spots, in no more memory than those of one process.

    Raises:
        DataError: If their numbers of components differ.
    """
    if a.D != b.D:
        raise DataError(f"features have {a.D} components in one process, {b.D} in another; give one network's")
    share, most = min(a.spots.share, b.spots.share), min(BUDGET, MOST_BYTES // (2 * a.D))
    a, b = a.within(share), b.within(share)
    while len(a.vectors) + len(b.vectors) > most:
        share //= 2
        a, b = a.within(share), b.within(share)
    spots = _joined(a.spots, b.spots)
    return FeatureObservations(spots, np.concatenate([a.vectors, b.vectors]), max(a.one_in, b.one_in))


def _joined(a: SpotObservations, b: SpotObservations) -> SpotObservations:
    """Return the answers of both, each for its own spots; frames are numbered again, those of b after those of a."""
    share = min(a.share, b.share)
    a, b = a.within(share), b.within(share)
    while len(a) + len(b) > BUDGET:
        share //= 2
        a, b = a.within(share), b.within(share)
    later = dataclasses.replace(b, spot=b.spot + np.int32(len(a.point)), view=b.view + np.int32(len(a.views)))
    views = Views.joined([a.views, b.views])
    views = dataclasses.replace(views, frame=np.arange(len(views)))
    joined = SpotObservations.stacked([a, later])
    point, cell_hash = np.concatenate([a.point, b.point]), np.concatenate([a.drawn, b.drawn])
    return dataclasses.replace(
        joined, point=point, drawn=cell_hash, views=views, share=share, spacing=max(a.spacing, b.spacing),
        frames=a.frames + b.frames,
    )  # fmt: skip
