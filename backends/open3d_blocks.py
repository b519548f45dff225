"""Backend `open3d`: semantic attributes on the hashed voxel blocks of `open3d.t.geometry.VoxelBlockGrid`.

Pixels become one observation a voxel, in compiled code, before the hash is touched: a frame costs one look-up a block.
Hash and attributes live on the device. On a CPU the touched voxels are updated in place; a CUDA device hands their rows
to the host and takes them back, because Open3D tensors have no logarithm.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
import open3d.core as o3c
from open3d.t.geometry import VoxelBlockGrid

from semstab.backends import FusionBackend
from semstab.backends.shared.aggregator import Aggregator
from semstab.backends.shared.association import check_depth, check_frame, check_settings
from semstab.backends.shared.columns import blocks_of, mask_words, update_rows
from semstab.backends.shared.observations import BeliefChange, Change, MapTotal, Observed, ObservedScores
from semstab.core.types import Int64
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame
from semstab.data.results import Changes, FrameReport
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import Extent, VoxelTable, index_columns
from semstab.errors import ConfigError

INITIAL_BYTES = 32 * 2**20
"""Memory for attributes that a new map takes at once: small maps never grow."""

LEAST_BLOCKS = 4
"""The blocks of a new map at least, however many classes there are."""

FILLED, OFTEN = 0.2, 1.2
"""Share of the voxels of a block that a frame sees, and how many times as many all frames do."""

SPARE, GROWING = 1.3, 1.0
"""Blocks that a grid has room for, and those of the one that it grew from, to each that is seen, on average."""

RESERVED = 8
"""Blocks of another map of the same frames to each spare one: labels lie a little differently there."""

DENSE = ("evidence", "classes")
"""Attributes of more than one number."""

COPIED_BLOCKS = 1024
"""Blocks that move at a time when a map grows, so that the copy needs no second map's worth of memory."""


class Open3DBlocks(FusionBackend):
    """Incremental fusion on voxel blocks; `grid` is the VoxelBlockGrid, its attributes named as VoxelTable's columns.

    One attribute has no such column: the bits of `classes` tell the classes for which a voxel has evidence.

    A map reaches 2^20 voxels to either side of its first camera.

    Attributes:
        device: 'CPU:0', or 'CUDA:0' where Open3D sees such a device.
        block_resolution: Voxels along an edge of a block; a block takes memory for all of its voxels.
        within: The voxels that the map is restricted to.
    """

    def __init__(
        self, voxel_size: float, num_classes: int, device: str = "CPU:0", block_resolution: int = 4,
        within: Extent | None = None,
    ) -> None:  # fmt: skip
        Open3DBlocks.check_options(voxel_size, num_classes, device, block_resolution)
        self.voxel_size = voxel_size
        self.num_classes = num_classes
        self.block_resolution = block_resolution
        self.device = _device(device)
        self.in_place = self.device.get_type() == o3c.Device.DeviceType.CPU
        self._pixels = Aggregator(voxel_size, num_classes, within)
        self._total = MapTotal(num_classes)
        self._changes: Changes | None = None
        self.attributes = {
            "op": (o3c.int32, 1),
            "evidence": (o3c.float64, num_classes),
            "classes": (o3c.int64, mask_words(num_classes)),
            "drift_sum": (o3c.float64, 1),
            "pixels": (o3c.int64, 1),
            "first_frame": (o3c.int32, 1),
            "last_frame": (o3c.int32, 1),
            "self_sum": (o3c.float64, 1),
            "frame_entropy_sum": (o3c.float64, 1),
        }
        voxel_bytes = sum(dtype.byte_size() * channels for dtype, channels in self.attributes.values())
        self.grid = self._new_grid(max(LEAST_BLOCKS, INITIAL_BYTES // (voxel_bytes * block_resolution**3)))

    @staticmethod
    def check_options(voxel_size: float, num_classes: int, device: str = "CPU:0", block_resolution: int = 4) -> None:
        """Raise ConfigError for settings that no map can have."""
        check_settings(voxel_size, num_classes)
        if not 1 <= block_resolution <= 64:
            raise ConfigError(f"block_resolution = {block_resolution}: use 1 to 64 (4 suits surfaces)")
        _device(device)

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int) -> int:
        """Return the bytes of the attributes of all voxels of a block; frames see a larger share the more there are.

        A grid has room for more, and grows into another one. An empty one has blocks.
        """
        voxel_bytes = 8 * (num_classes + mask_words(num_classes)) + 48
        return int(max((SPARE + GROWING) * voxels / (OFTEN * FILLED), LEAST_BLOCKS * 4**3) * voxel_bytes)

    def room(self) -> int:
        """Return the blocks of the map, for `reserve` of another map of the same frames."""
        return int(self.grid.hashmap().size())

    def reserve(self, room: int) -> None:
        """Make room for that many blocks in an empty map: a grid that grows is copied each time."""
        if room > self.grid.hashmap().capacity():
            self.grid = self._new_grid(room + room // RESERVED)

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame: aggregate its pixels to voxels, activate the blocks, update the touched voxels."""
        started = time.perf_counter()
        check_depth(frame)
        if frame.scores is not None:
            check_frame(frame, self.num_classes)
        observations = self._pixels.observe(frame)
        if isinstance(observations, ObservedScores):
            observations = observations.sparse()
        observed = time.perf_counter()
        index = self._pixels.index_of(observations.key)
        rows = self._activate(index) if len(index) else observations.key
        change, changed = self._update(rows, observations, frame.index)
        self._changes = Changes(index, *changed)
        return self._total.add(frame.index, change, started, observed)

    def changes(self) -> Changes | None:
        """Return the changes by the last frame."""
        return self._changes

    def table(self) -> VoxelTable:
        """Return the map so far: the voxels of all active blocks that a frame has seen."""
        blocks = self.grid.hashmap().active_buf_indices().cpu().numpy().astype(np.int64)
        voxels_a_block = self.block_resolution**3
        rows = (blocks[:, None] * voxels_a_block + np.arange(voxels_a_block)).ravel()
        rows = rows[self._read("op", rows) > 0]
        index = self._index_of(rows)
        order = in_order(index)
        rows = rows[order]
        columns = [name for name in self.attributes if name not in DENSE]
        values: dict[str, Any] = {name: self._read(name, rows) for name in columns}
        evidence = Evidence.read(len(rows), self.num_classes, lambda part: self._read("evidence", rows[part]))
        return VoxelTable(**index_columns(index[order]), **values, evidence=evidence, voxel_size=self.voxel_size)

    def _new_grid(self, blocks: int) -> VoxelBlockGrid:
        """Return an empty grid with room for that many blocks."""
        return VoxelBlockGrid(
            attr_names=tuple(self.attributes),
            attr_dtypes=tuple(dtype for dtype, _ in self.attributes.values()),
            attr_channels=tuple((channels,) for _, channels in self.attributes.values()),
            voxel_size=self.voxel_size,
            block_resolution=self.block_resolution,
            block_count=blocks,
            device=self.device,
        )

    def _add_blocks(self, blocks: npt.NDArray[np.int32]) -> None:
        """Activate the new ones of the blocks (n, 3); where they do not fit, the map moves into a larger grid.

        Open3D's own rehash takes longer, and it would begin one for keys that are there already as well.
        """
        old = self.grid.hashmap()
        _, present = old.find(self._tensor(blocks))
        new = blocks[~present.cpu().numpy()]
        needed = old.size() + len(new)
        if needed > old.capacity():
            grid = self._new_grid(needed + needed // 2)
            if old.size():
                _copy_blocks(self.grid, grid, tuple(self.attributes))
            self.grid = grid
        if len(new):
            self.grid.hashmap().activate(self._tensor(new))

    def _activate(self, index: Int64) -> Int64:
        """Return rows of voxels (n, 3), at least one, in the attributes, their blocks activated.

        New ones are 0.
        """
        blocks, block, offset = blocks_of(index, self.block_resolution)
        self._add_blocks(blocks)
        buffer, _ = self.grid.hashmap().find(self._tensor(blocks))
        buffers: Int64 = buffer.cpu().numpy().astype(np.int64)
        return buffers[block] * self.block_resolution**3 + offset

    def _index_of(self, rows: Int64) -> Int64:
        """Return voxel indices (n, 3) of rows: the inverse of `_activate`."""
        r = self.block_resolution
        block, offset = np.divmod(rows, r**3)
        keys: Int64 = self.grid.hashmap().key_tensor().cpu().numpy().astype(np.int64)
        local = np.stack([offset % r, offset // r % r, offset // r**2], axis=1)
        index: Int64 = keys[block] * r + local
        return index

    def _update(self, rows: Int64, observations: Observed, frame: int) -> tuple[Change, BeliefChange]:
        """Add one observation to each row; return the change of the map, and of each voxel as `Changes` has it."""
        names = tuple(self.attributes)
        values = {name: self._attribute(name).numpy() if self.in_place else self._read(name, rows) for name in names}
        columns = {name: value if name in DENSE else value.reshape(-1) for name, value in values.items()}
        change = update_rows(rows if self.in_place else np.arange(len(rows)), observations, frame, **columns)
        if not self.in_place:
            for name in names:
                self._write(name, rows, values[name])
        return change

    def _attribute(self, name: str) -> Any:
        """Return the attribute, flattened to (voxels, channels).

        It is fetched at each call, because a rehash moves the buffers.
        """
        values = self.grid.attribute(name)
        return values.reshape((-1, values.shape[-1]))

    def _read(self, name: str, rows: Int64) -> npt.NDArray[Any]:
        attribute = self._attribute(name)
        # numpy takes a tenth of the time of Open3D's indices
        values: npt.NDArray[Any] = (
            attribute.numpy()[rows] if self.in_place else attribute[self._tensor(rows)].cpu().numpy()
        )
        return values if name in DENSE else values[:, 0]

    def _write(self, name: str, rows: Int64, values: npt.NDArray[Any]) -> None:
        attribute = self._attribute(name)
        attribute[self._tensor(rows)] = self._tensor(values.reshape(len(rows), attribute.shape[1])).to(attribute.dtype)

    def _tensor(self, values: npt.NDArray[Any]) -> Any:
        return o3c.Tensor.from_numpy(np.ascontiguousarray(values)).to(self.device)


def _copy_blocks(old: VoxelBlockGrid, new: VoxelBlockGrid, attributes: tuple[str, ...]) -> None:
    """Copy every block of a grid, which has one at least, into a new one."""
    source = old.hashmap().active_buf_indices().to(o3c.int64)
    keys = old.hashmap().key_tensor()[source]
    new.hashmap().activate(keys)
    target = new.hashmap().find(keys)[0].to(o3c.int64)
    if source.is_cpu:
        source, target = source.numpy(), target.numpy()
    for name in attributes:
        values, room = (grid.attribute(name) for grid in (old, new))
        values, room = (tensor.reshape((tensor.shape[0], -1)) for tensor in (values, room))
        if values.is_cpu:  # numpy takes a tenth of the time of Open3D's indices
            values, room = values.numpy(), room.numpy()
        for start in range(0, len(source), COPIED_BLOCKS):
            part = slice(start, start + COPIED_BLOCKS)
            room[target[part]] = values[source[part]]


def _device(name: str) -> Any:
    try:
        device = o3c.Device(name)
    except RuntimeError as error:
        raise ConfigError(f"device '{name}' is not one; use CPU:0 or CUDA:0") from error
    if device.get_type() == o3c.Device.DeviceType.CUDA and device.get_id() >= o3c.cuda.device_count():
        raise ConfigError(f"device '{name}': Open3D sees {o3c.cuda.device_count()} CUDA devices here; use CPU:0")
    return device
