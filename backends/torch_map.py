"""Backend `torch`: the whole of fusion on an accelerator, or on a CPU, and several models over the same depth.

Frames may be tensors that are on the device already: the logits of a model go into the map without a copy to memory.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch

from semstab.backends import FusionBackend
from semstab.backends.shared.association import INDEX_LIMIT, check_depth, check_settings
from semstab.backends.shared.keys import HALF, columns_of_keys, index_of_keys, out_of_reach
from semstab.backends.shared.observations import Change, MapTotal
from semstab.backends.torch_operations import (
    LOST,
    Association,
    Update,
    ViewEvidence,
    associate,
    count_labels,
    parts,
    sum_scores,
    update,
)
from semstab.backends.torch_storage import (
    EMPTY,
    SLOT_BYTES,
    Columns,
    DepthView,
    Image,
    MapGrid,
    PixelLabels,
    Scores,
    Storage,
    TensorPrediction,
    evidence_of,
    on_device,
)
from semstab.data.evidence import Evidence
from semstab.data.frames import Frame, Intrinsics
from semstab.data.results import Changes, FrameReport
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError


def device_of(name: str | None) -> torch.device:
    """Return the device of that name, as torch or Open3D writes it."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    try:
        device = torch.device(str(name).lower())
    except RuntimeError as error:
        raise ConfigError(f"device '{name}' is not one; use CPU:0 or CUDA:0") from error
    if device.type == "cpu":
        return torch.device("cpu")
    if device.type != "cuda" or (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device '{name}': torch sees {torch.cuda.device_count()} CUDA devices here; use CPU:0")
    return torch.device("cuda", device.index or 0)


# Maps on a device, and how a view goes into them.

FIRST_ROWS = 1 << 12
"""Voxels that a new map has room for, at most."""

FIRST_BYTES = 1 << 27
"""Memory that a new map takes at once, at most: with 20,000 classes that are fewer voxels."""

COPIED_ROWS = 1 << 20
"""Rows that go to memory at a time."""


class TorchMaps:
    """Maps of several models over the same depth: one association and one hash, and evidence of each model.

    num_classes has K of each model by its name; the other settings are those of `TorchMap`.
    """

    def __init__(
        self,
        voxel_size: float,
        num_classes: Mapping[str, int],
        device: str | None = None,
        precision: str = "float64",
        memory_gb: float | None = None,
        reserve: int = 0,
    ) -> None:
        if not num_classes:
            raise ConfigError("num_classes names no model; give K of each by its name")
        for K in num_classes.values():
            TorchMap.check_options(voxel_size, K, device, precision, memory_gb, reserve)
        self.voxel_size = voxel_size
        self.device = device_of(device)
        self._dtype = torch.float64 if precision == "float64" else torch.float32
        self._grid: MapGrid | None = None
        self._keys = torch.empty(0)
        self._updates: dict[str, Update] = {}
        with torch.inference_mode(False):  # tensors made in inference mode could not be updated outside of it
            self.storage = Storage(num_classes, self._dtype, self.device, memory_gb)
            first = min(FIRST_ROWS, FIRST_BYTES // sum(c.row_bytes for c in self.storage.columns.values()))
            self.storage.make_room(max(reserve, 1), f"reserve = {reserve}", reserve or first)
        self._totals = {name: MapTotal(K) for name, K in num_classes.items()}

    @property
    def bytes(self) -> int:
        """Memory that the maps take on the device."""
        return self.storage.bytes

    def integrate_tensors(
        self,
        depth: Image,
        intrinsics: Intrinsics,
        T_wc: npt.ArrayLike,
        predictions: Mapping[str, TensorPrediction],
        *,
        index: int,
    ) -> dict[str, FrameReport]:
        """Fuse the predictions of some of the models on one view; return a report for each.

        Raises:
            DataError: If one of them cannot be fused, with all maps unchanged.
            ConfigError: For an unknown name.
        """
        started = time.perf_counter()
        view = DepthView.from_depth(depth, intrinsics, T_wc, index, self.device)
        predicted = {
            name: evidence_of(of_name, view, self._columns_of(name).num_classes, _where(view, of_name.kind, name))
            for name, of_name in predictions.items()
        }
        return self.fuse(view, predicted, started)

    @torch.no_grad()
    @torch.inference_mode(False)
    def fuse(
        self, view: DepthView, predicted: Mapping[str, PixelLabels | Scores], started: float
    ) -> dict[str, FrameReport]:
        """Fuse a view that is on the device, with predictions of some models; timed from `started`."""
        grid = self._grid or self._first_grid(view)
        association = associate(view, grid)
        evidence = {name: self._evidence(association, image, name, view) for name, image in predicted.items()}
        rows, voxels = self._look_up(association, evidence, view, grid)
        associated = time.perf_counter()
        self.storage.make_room(voxels, f"frame {view.camera.index}")
        self.storage.add(association.keys, rows, voxels)
        self._grid = grid
        self._updates = {
            name: update(self.storage.columns[name], rows, of_name, view.camera.index)
            for name, of_name in evidence.items()
        }
        self._keys = association.keys
        sums = torch.stack([of_name.sums for of_name in self._updates.values()]).tolist() if evidence else []
        return {
            name: self._totals[name].add(view.camera.index, Change.from_sums(of_name), started, associated)
            for name, of_name in zip(predicted, sums, strict=True)
        }

    def table(self, name: str) -> VoxelTable:
        """Return the map of a model so far, brought to memory.

        Raises:
            ConfigError: For an unknown name.
        """
        columns = self._columns_of(name)
        used = torch.nonzero(self.storage.hash.keys != EMPTY)[:, 0]
        keys, order = torch.sort(self.storage.hash.keys[used])  # packed keys sort like (ix, iy, iz)
        rows = self.storage.hash.rows[used[order]].to(torch.int64)
        observed = columns.values["op"][rows] > 0
        keys, rows = keys[observed].cpu(), rows[observed]
        values: dict[str, Any] = {name: _at_home(columns.values[name], rows) for name in Columns.TYPES}
        values["evidence"] = Evidence.read(
            len(rows), columns.num_classes, lambda part: _at_home(columns.values["evidence"], rows[part])
        )
        index = columns_of_keys(keys.numpy(), self._grid.origin if self._grid else (0, 0, 0))
        return VoxelTable(**index, **values, voxel_size=self.voxel_size)

    def changes(self, name: str) -> Changes | None:
        """Return the changes of a model's map by the last view, in main memory, or None if the view was not fused."""
        last = self._updates.get(name)
        if last is None:
            return None
        assert self._grid is not None
        index = index_of_keys(self._keys[last.observed].cpu().numpy(), self._grid.origin)
        drift, before, after = last.changed.cpu().numpy().T
        return Changes(index, drift.astype(np.float32), before.astype(np.uint16), after.astype(np.uint16))

    def _columns_of(self, name: str) -> Columns:
        if name not in self.storage.columns:
            raise ConfigError(f"there is no map of '{name}'; there is {', '.join(self.storage.columns)}")
        return self.storage.columns[name]

    def _evidence(
        self, association: Association, predicted: PixelLabels | Scores, name: str, view: DepthView
    ) -> ViewEvidence:
        K = self.storage.columns[name].num_classes
        if isinstance(predicted, PixelLabels):
            return count_labels(association, predicted, K)
        if len(predicted.values) != K:
            kind = "logits" if predicted.softmax else "scores"
            raise DataError(f"{_where(view, kind, name)}: {kind} hold {len(predicted.values)} classes, the map {K}")
        return sum_scores(association, predicted, K)

    def _look_up(
        self, association: Association, evidence: Mapping[str, ViewEvidence], view: DepthView, grid: MapGrid
    ) -> tuple[torch.Tensor, int]:
        """Return rows of the view's voxels, new ones included, and the number of voxels then; checks the evidence."""
        rows = self.storage.hash.find(association.keys)
        observed = torch.zeros_like(rows, dtype=torch.bool)
        for of_name in evidence.values():
            observed |= of_name.pixels > 0
        new = observed & (rows == EMPTY)
        row_of_new = torch.cumsum(new, dim=0) + (self.storage.voxels - 1)
        wrong = [of_name.flags for of_name in evidence.values()]
        added, *flags = torch.cat([new.sum()[None], *wrong]).tolist()  # the one wait for the device before the update
        for n, name in enumerate(evidence):
            highest, lost, negative = flags[3 * n : 3 * n + 3]
            K = self.storage.columns[name].num_classes
            if highest >= K:
                where = _where(view, "labels", name)
                raise DataError(f"{where}: label id {highest} is outside 0 to {K - 1}; map it or ignore it")
            if negative:
                where = _where(view, "scores", name)
                raise DataError(f"{where}: scores are negative; give logits as logits, or apply a softmax first")
            if lost:
                raise out_of_reach(view.frame(association.voxel == LOST), grid.origin, grid.voxel_size)
        return torch.where(new, row_of_new, rows), self.storage.voxels + int(added)

    def _first_grid(self, view: DepthView) -> MapGrid:
        """Return keys that count from the camera's voxel.

        Raises:
            DataError: If the camera is out of reach.
        """
        camera = view.camera.T_wc[:3, 3]
        origin = np.floor(camera / self.voxel_size)
        if np.abs(origin).max() > INDEX_LIMIT - 2 * HALF:
            frame = view.camera
            raise DataError(
                f"{frame.where('pose')}: frame {frame.index} has its camera at {camera.round(1).tolist()} m,"
                f" beyond 2^31 voxels of {self.voxel_size:g} m; check pose units, or use larger voxels"
            )
        x, y, z = origin.astype(np.int64).tolist()
        return MapGrid(self.voxel_size, (x, y, z), self._dtype)


def _where(view: DepthView, kind: str, name: str) -> str:
    """Return the name of a model's labels, scores or logits in an error."""
    return view.camera.where(kind) + (f" of '{name}'" if name else "")


def _at_home(column: torch.Tensor, rows: torch.Tensor) -> npt.NDArray[Any]:
    """Return rows of a column in memory.

    They are gathered a part at a time, so that the device needs no second column.
    """
    home = torch.empty((len(rows), *column.shape[1:]), dtype=column.dtype)
    for part in parts(len(rows), COPIED_ROWS):
        home[part] = column[rows[part]].cpu()
    values: npt.NDArray[Any] = home.numpy()
    return values


class TorchMap(FusionBackend):
    """Incremental fusion on a device; the same numbers run after run.

    A map reaches 2^20 voxels to either side of its first camera.

    Attributes:
        device: 'CUDA:0', 'CPU:0', ...; the first CUDA device where torch sees one, else the CPU.
        precision: 'float64', which decides at a voxel's face as the other backends do, or 'float32' for points and
            evidence: less memory, and faster where the device is slow in float64.
        memory_gb: The most that the map may take of the device, the copy that growing takes included; no bound if not
            given.
        reserve: Voxels to make room for at once: a map that does not outgrow them copies nothing.
    """

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        device: str | None = None,
        precision: str = "float64",
        memory_gb: float | None = None,
        reserve: int = 0,
    ) -> None:
        self.num_classes = num_classes
        self.maps = TorchMaps(voxel_size, {"": num_classes}, device, precision, memory_gb, reserve)

    @staticmethod
    def check_options(
        voxel_size: float,
        num_classes: int,
        device: str | None = None,
        precision: str = "float64",
        memory_gb: float | None = None,
        reserve: int = 0,
    ) -> None:
        """Raise ConfigError for settings that no map can have."""
        check_settings(voxel_size, num_classes)
        if precision not in ("float64", "float32"):
            raise ConfigError(f"precision = '{precision}': use float64 or float32")
        if memory_gb is not None and not memory_gb > 0:
            raise ConfigError(f"memory_gb = {memory_gb:g}: it must be positive")
        if reserve < 0:
            raise ConfigError(f"reserve = {reserve}: it is a number of voxels")
        device_of(device)

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel, metres."""
        return self.maps.voxel_size

    @property
    def device(self) -> torch.device:
        """The device of the map."""
        return self.maps.device

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int) -> int:
        """Return the bytes of half as many rows again as voxels, the evidence's copy while it grows, and the hash."""
        return voxels * (20 * num_classes + 66 + 6 * SLOT_BYTES)

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame, copied to the device."""
        started = time.perf_counter()
        check_depth(frame)
        points = None if frame.points is None else on_device(frame.points, self.device)
        view = DepthView(on_device(frame.depth, self.device), frame, points)
        if frame.labels is not None:
            prediction: PixelLabels | Scores = PixelLabels(
                on_device(frame.labels, self.device).reshape(-1), frame.ignore_id
            )
        else:
            scores = on_device(cast(Image, frame.scores), self.device)
            prediction = Scores(scores.reshape(-1, scores.shape[2]).T, softmax=False)
        return self.maps.fuse(view, {"": prediction}, started)[""]

    def integrate_tensors(
        self,
        depth: Image,
        intrinsics: Intrinsics,
        T_wc: npt.ArrayLike,
        *,
        index: int,
        labels: Image | None = None,
        scores: Image | None = None,
        logits: Image | None = None,
    ) -> FrameReport:
        """Fuse one frame of tensors on any device, or arrays; those that are on the map's device are not copied.

        Args:
            depth: (H, W) float metres.
            intrinsics: Intrinsics of the depth image.
            T_wc: (4, 4) camera-to-world, as a `Frame` has it.
            index: The index of the frame.
            labels: (H, W), as a `TensorPrediction` has them; give labels, scores or logits.
            scores: (K, H, W), as a `TensorPrediction` has them.
            logits: (K, H, W), as a `TensorPrediction` has them.

        Raises:
            DataError: If the frame cannot be fused, with the map unchanged.
        """
        predicted = TensorPrediction(labels=labels, scores=scores, logits=logits)
        return self.maps.integrate_tensors(depth, intrinsics, T_wc, {"": predicted}, index=index)[""]

    def table(self) -> VoxelTable:
        """Return the map so far, brought to memory."""
        return self.maps.table("")

    def changes(self) -> Changes | None:
        """Return the changes by the last frame, brought to memory."""
        return self.maps.changes("")
