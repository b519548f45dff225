"""The storage of a map of the torch backend on its device: a hash from voxel keys to rows, and columns of these rows.

Voxel indices are packed into a key with 21 bits an axis, as they count from the map's origin.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.dlpack import from_dlpack

from semstab.core.types import Float64
from semstab.data.frames import Frame, Intrinsics
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.errors import DataError, summarize_error

GB = 1e9

EMPTY = -1
"""The key of a free slot."""

FULL = 0.5
"""Largest share of the hash's slots in use."""

SLOT_BYTES = 8 + 4

MOVED_SLOTS = 1 << 20
"""Slots that move at a time when the hash grows."""


@dataclass(frozen=True)
class MapGrid:
    """The voxels of a map: edge in metres, the voxel index from which keys count, and the type that points are in."""

    voxel_size: float
    origin: tuple[int, int, int]
    dtype: torch.dtype


class VoxelHash:
    """Open addressing with linear probing: keys (S,) int64 and the rows (S,) int32 of those that are not EMPTY."""

    def __init__(self, slots: int, device: torch.device) -> None:
        self.keys = torch.full((slots,), EMPTY, dtype=torch.int64, device=device)
        self.rows = torch.zeros(slots, dtype=torch.int32, device=device)

    @property
    def capacity(self) -> int:
        """Return how many voxels it takes."""
        return int(FULL * len(self.keys))

    @property
    def bytes(self) -> int:
        """Memory that it takes."""
        return SLOT_BYTES * len(self.keys)

    def find(self, keys: torch.Tensor) -> torch.Tensor:
        """Return rows (n,) int64 of keys (n,), EMPTY for those that the hash does not hold."""
        rows = torch.full_like(keys, EMPTY)
        mask = len(self.keys) - 1
        slots, searched = mix(keys) & mask, torch.arange(len(keys), device=keys.device)
        while len(searched):
            held = self.keys[slots]
            hit = held == keys[searched]
            rows[searched[hit]] = self.rows[slots[hit]].to(torch.int64)
            further = ~hit & (held != EMPTY)
            slots, searched = (slots[further] + 1) & mask, searched[further]
        return rows

    def insert(self, keys: torch.Tensor, rows: torch.Tensor, first: int = 0) -> None:
        """Add distinct keys (n,) which the hash does not hold and has slots for, with their rows (n,).

        EMPTY keys are left out, and those whose row is below `first`.
        """
        added = (keys != EMPTY) & (rows >= first)
        keys, rows, mask = keys[added], rows[added].to(torch.int32), len(self.keys) - 1
        slots = mix(keys) & mask
        while len(keys):
            free = self.keys[slots] == EMPTY
            self.keys[slots[free]] = keys[free]  # several keys may want a slot: one of them gets it
            written = free & (self.keys[slots] == keys)
            self.rows[slots[written]] = rows[written]
            slots, keys, rows = (slots[~written] + 1) & mask, keys[~written], rows[~written]


def mix(key: torch.Tensor) -> torch.Tensor:
    """Return the finaliser of splitmix64: every bit of the key moves every bit of the hash."""
    for bits, odd in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        key = (key ^ _shifted(key, bits)) * (odd - (1 << 64))
    return key ^ _shifted(key, 31)


def _shifted(x: torch.Tensor, bits: int) -> torch.Tensor:
    """Return a logical shift to the right, which torch has for unsigned numbers only."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def slots_for(voxels: int) -> int:
    """Return slots of a hash for that many voxels: a power of 2."""
    return 1 << max(10, (int(voxels / FULL) - 1).bit_length())


class Columns:
    """One model's columns of a VoxelTable by name, (N,) or (N, K), with room for more rows; 0 where never seen."""

    TYPES: ClassVar = {
        "op": torch.int32, "drift_sum": torch.float64, "pixels": torch.int64, "first_frame": torch.int32,
        "last_frame": torch.int32, "self_sum": torch.float64, "frame_entropy_sum": torch.float64,
    }  # fmt: skip

    def __init__(self, num_classes: int, evidence: torch.dtype, device: torch.device) -> None:
        self.num_classes = num_classes
        self.values = {"evidence": torch.zeros((0, num_classes), dtype=evidence, device=device)}
        self.values |= {name: torch.zeros(0, dtype=dtype, device=device) for name, dtype in self.TYPES.items()}

    @property
    def capacity(self) -> int:
        """Rows that there is room for in every column."""
        return min(map(len, self.values.values()))

    @property
    def row_bytes(self) -> int:
        """Memory of a row."""
        return sum(column.element_size() * math.prod(column.shape[1:]) for column in self.values.values())

    def grow(self, capacity: int) -> None:
        """Make room for that many rows. One column is copied at a time, and its old copy freed before the next."""
        for name in self.values:
            old = self.values[name]
            if len(old) < capacity:
                self.values[name] = old.new_zeros((capacity, *old.shape[1:]))
                self.values[name][: len(old)] = old


class Storage:
    """The hash, and the columns of each model, which share its rows; both grow within a bound on their memory."""

    def __init__(
        self, num_classes: Mapping[str, int], evidence: torch.dtype, device: torch.device, memory_gb: float | None
    ) -> None:
        self.voxels = 0
        self.hash = VoxelHash(slots_for(0), device)
        self.columns = {name: Columns(K, evidence, device) for name, K in num_classes.items()}
        self.memory_gb = memory_gb

    @property
    def capacity(self) -> int:
        """Voxels that there is room for."""
        return min(self.hash.capacity, *(columns.capacity for columns in self.columns.values()))

    @property
    def bytes(self) -> int:
        """Memory that it takes on the device."""
        return self.hash.bytes + sum(columns.capacity * columns.row_bytes for columns in self.columns.values())

    def add(self, keys: torch.Tensor, rows: torch.Tensor, voxels: int) -> None:
        """Enter the keys (n,) whose row is new; the map then has `voxels` voxels."""
        if voxels > self.voxels:
            self.hash.insert(keys, rows, self.voxels)
            self.voxels = voxels

    def make_room(self, needed: int, where: str, wanted: int = 0) -> None:
        """Make room for that many voxels, and for half as many again as there was if there is memory for them.

        Raises:
            DataError: If they would outgrow `memory_gb`, or the device, with the maps unchanged.
        """
        if needed <= self.capacity:
            return
        limit = math.inf if self.memory_gb is None else self.memory_gb * GB
        wanted = max(needed, wanted, self.capacity + self.capacity // 2)
        if self._bytes_to_grow(wanted) > limit:
            wanted = needed
        if self._bytes_to_grow(wanted) > limit:
            raise DataError(
                f"{where}: to hold {needed:,} voxels the map would take {self._bytes_to_grow(needed) / GB:.3g} GB while"
                f" it grows, and memory_gb is {self.memory_gb:g}; use larger voxels, raise memory_gb, or make room at"
                " once (reserve), which takes less"
            )
        try:
            self._grow(wanted)
        except RuntimeError as error:  # torch.OutOfMemoryError is one; on a CPU it is plain
            device = self.hash.keys.device
            raise DataError(
                f"{where}: the device {device} has no room for {wanted:,} voxels ({summarize_error(error)});"
                f" use larger voxels"
            ) from error

    def _bytes_to_grow(self, voxels: int) -> int:
        """Return the most memory taken while it grows: its memory then, and the column or hash that is copied."""
        columns = self.columns.values()
        grown = SLOT_BYTES * slots_for(voxels) + voxels * sum(c.row_bytes for c in columns)
        copied = max(self.hash.bytes, *(c.values["evidence"].nbytes for c in columns))
        return grown + copied

    def _grow(self, voxels: int) -> None:
        for columns in self.columns.values():
            columns.grow(voxels)
        slots = slots_for(voxels)
        if slots > len(self.hash.keys):
            grown = VoxelHash(slots, self.hash.keys.device)
            for start in range(0, len(self.hash.keys), MOVED_SLOTS):
                part = slice(start, start + MOVED_SLOTS)
                grown.insert(self.hash.keys[part], self.hash.rows[part])
            self.hash = grown


# The input of the torch backend: a view (depth, camera and pose) and predictions for its pixels, as tensors.

INTEGERS = (torch.uint8, torch.uint16, torch.int8, torch.int16, torch.int32, torch.int64)

Image = torch.Tensor | npt.NDArray[Any]
"""An image as a tensor on any device, or as an array."""


@dataclass(frozen=True, eq=False)
class TensorPrediction:
    """The prediction of a model for each pixel of a view: one of the three. A batch dimension of 1 is left away.

    Attributes:
        labels: (H, W) integer class ids. Ignored are 255 in uint8 and 65535 in uint16; in other types every negative
            id, and 255 (65535 with more than 255 classes).
        scores: (K, H, W) float, non-negative; normalised per pixel, pixels without a finite positive sum left out.
        logits: (K, H, W) float, as models give them; softmax over the classes, in float32 unless they are float64.

    Raises:
        DataError: If none or several are given.
    """

    labels: Image | None = None
    scores: Image | None = None
    logits: Image | None = None

    def __post_init__(self) -> None:
        if len(self._given) != 1:
            raise DataError(
                f"a prediction takes labels, scores or logits, one of them; got {list(self._given) or 'none'}"
            )

    @property
    def kind(self) -> str:
        """'labels', 'scores' or 'logits'."""
        return next(iter(self._given))

    @property
    def image(self) -> Image:
        """The one that is given."""
        return self._given[self.kind]

    @property
    def _given(self) -> dict[str, Image]:
        return {name: image for name, image in vars(self).items() if image is not None}


@dataclass(frozen=True, eq=False)
class DepthView:
    """A depth image on the device, with its camera; or a scan.

    Attributes:
        depth: (H, W) float32, contiguous, metres along the optical axis; of a scan from the sensor.
        camera: A frame of one empty pixel, or the whole frame: index, intrinsics, pose, and the names of files.
        points: (H, W, 3) float32 of a scan, in the sensor's coordinates.
    """

    depth: torch.Tensor
    camera: Frame
    points: torch.Tensor | None = None

    @classmethod
    def from_depth(
        cls, depth: Image, intrinsics: Intrinsics, T_wc: npt.ArrayLike, index: int, device: torch.device
    ) -> DepthView:
        """Return a view of a depth image on any device, copied if the image is on another device.

        Raises:
            DataError: As Frame does.
        """
        if isinstance(T_wc, torch.Tensor):
            T_wc = T_wc.detach().cpu().numpy()
        no_depth, no_label = np.zeros((1, 1), dtype=np.float32), np.zeros((1, 1), dtype=np.uint8)
        pose = np.asarray(T_wc, dtype=np.float64)
        camera = Frame(index=index, depth=no_depth, labels=no_label, intrinsics=intrinsics, T_wc=pose)
        image = without_batch(on_device(depth, device), dimensions=2)
        if image.ndim != 2 or image.numel() == 0:
            raise DataError(f"{camera.where('depth')}: depth must be (H, W), got shape {tuple(image.shape)}")
        if not image.is_floating_point():
            raise DataError(
                f"{camera.where('depth')}: depth is {_type(image)}; convert it to metres (float32) with its depth scale"
            )
        return cls(image.to(torch.float32).contiguous(), camera)

    @cached_property
    def rays(self) -> tuple[Float64, Float64]:
        """(u - cx) / fx of each column and (v - cy) / fy of each row; none of a scan."""
        if self.points is not None:
            return np.zeros(0), np.zeros(0)
        v, u = (np.arange(size, dtype=np.float64) for size in self.depth.shape)
        K = self.camera.intrinsics
        return (u - K.cx) / K.fx, (v - K.cy) / K.fy

    def frame(self, usable: torch.Tensor) -> Frame:
        """Return the view as a frame in memory, in which the pixels (H, W) that are usable have the label 0."""
        labels = torch.where(usable, 0, IGNORE_8BIT).to(torch.uint8)
        return dataclasses.replace(
            self.camera, depth=self.depth.cpu().numpy(), labels=labels.cpu().numpy(), scores=None, color=None
        )


@dataclass(frozen=True, eq=False)
class PixelLabels:
    """Class ids of a view's P pixels: (P,) integers; `ignore` is one of them that means none, as all below 0 do."""

    ids: torch.Tensor
    ignore: int


@dataclass(frozen=True, eq=False)
class Scores:
    """Class scores of a view's P pixels, (K, P) of any strides; `softmax` says that they are logits."""

    values: torch.Tensor
    softmax: bool


def evidence_of(prediction: TensorPrediction, view: DepthView, num_classes: int, where: str) -> PixelLabels | Scores:
    """Return the prediction of a model for the view's pixels, on the view's device; `where` is its name in errors.

    Raises:
        DataError: If the image does not fit the depth image, or is of a wrong type.
    """
    kind, device = prediction.kind, view.depth.device
    image = without_batch(on_device(prediction.image, device), dimensions=2 if kind == "labels" else 3)
    layout = "(H, W)" if kind == "labels" else "(K, H, W)"
    fits = image.dtype in INTEGERS if kind == "labels" else image.is_floating_point()
    if not fits or image.ndim != len(layout.split(",")):
        expected = "integers" if kind == "labels" else "float"
        raise DataError(
            f"{where}: {kind} must be {expected} {layout}, got {_type(image)} of shape {tuple(image.shape)}"
        )
    if image.shape[-2:] != view.depth.shape:
        (H, W), (h, w) = view.depth.shape, image.shape[-2:]
        raise DataError(f"{where}: {kind} are {w}x{h} but depth is {W}x{H}; bring them to one size")
    if kind == "labels":
        return PixelLabels(image.reshape(-1), _ignored_id(image.dtype, num_classes))
    return Scores(image.reshape(len(image), -1), softmax=kind == "logits")


def on_device(image: Image, device: torch.device) -> torch.Tensor:
    """Return the image as a tensor on that device.

    One that is there already, or an array where that is memory, is shared.
    """
    if isinstance(image, torch.Tensor):
        return image.detach().to(device)
    return from_dlpack(np.ascontiguousarray(image)).to(device)  # unlike from_numpy it takes read-only arrays


def without_batch(image: torch.Tensor, dimensions: int) -> torch.Tensor:
    """Return the image without a leading batch dimension of 1."""
    return image[0] if image.ndim == dimensions + 1 and len(image) == 1 else image


def _ignored_id(dtype: torch.dtype, num_classes: int) -> int:
    if dtype == torch.uint8:
        return IGNORE_8BIT
    if dtype == torch.uint16 or num_classes > IGNORE_8BIT:
        return IGNORE_16BIT
    return IGNORE_8BIT


def _type(image: torch.Tensor) -> str:
    return str(image.dtype).removeprefix("torch.")
