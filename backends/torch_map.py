"""Backend `torch`: the whole of fusion on an accelerator, or on a CPU, and several backbones over the same depth.

Frames may be tensors that are on the device already: the logits of a model go into the map without a copy to memory.
On a CUDA device Triton kernels do the work (`triton_launch`), elsewhere plain tensor operations (`eager`).
"""

from __future__ import annotations

import time

import numpy.typing as npt
import torch

from semstab.backends import FusionBackend
from semstab.backends.shared.association import check_depth
from semstab.backends.torch_parts.maps import TorchMaps
from semstab.backends.torch_parts.storage import SLOT_BYTES
from semstab.backends.torch_parts.views import DepthView, Image, TensorPrediction, evidence_of_frame
from semstab.model.frames import Frame, Intrinsics
from semstab.model.results import FrameReport
from semstab.model.voxels import VoxelTable


class TorchMap(FusionBackend):
    """Incremental fusion on a device; the same numbers run after run.

    A map reaches 2^20 voxels to either side of its first camera.

    device     'CUDA:0', 'CPU:0', ...; the first CUDA device where torch sees one, else the CPU
    precision  'float64', which decides at a voxel's face as the other backends do, or 'float32' for points and
               evidence: less memory, and faster where the device is slow in float64
    kernels    'triton' or 'torch'; 'auto' is Triton's where the device runs them
    memory_gb  the most that the map may take of the device, the copy that growing takes included; no bound if not given
    reserve    voxels to make room for at once: a map that does not outgrow them copies nothing
    """

    def __init__(
        self,
        voxel_size: float,
        num_classes: int,
        device: str | None = None,
        precision: str = "float64",
        kernels: str = "auto",
        memory_gb: float | None = None,
        reserve: int = 0,
    ) -> None:
        self.num_classes = num_classes
        self.maps = TorchMaps(voxel_size, {"": num_classes}, device, precision, kernels, memory_gb, reserve)

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel, metres."""
        return self.maps.voxel_size

    @property
    def device(self) -> torch.device:
        """Where the map is."""
        return self.maps.device

    @staticmethod
    def expected_bytes(voxels: int, observations: int, num_classes: int) -> int:
        """Half as many rows again as there are voxels, the copy of the evidence that growing takes, and the hash."""
        return voxels * (20 * num_classes + 66 + 6 * SLOT_BYTES)

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame, copied to the device."""
        started = time.perf_counter()
        check_depth(frame)
        view, said = DepthView.of_frame(frame, self.device), evidence_of_frame(frame, self.device)
        return self.maps.fuse(view, {"": said}, started)[""]

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

        depth                   (H, W) float metres, intrinsics and T_wc (4, 4) as a `Frame` has them
        labels, scores, logits  one of them, as a `TensorPrediction` has them: scores and logits are (K, H, W)

        Raises DataError, with the map unchanged, where the frame cannot be fused.
        """
        said = TensorPrediction(labels=labels, scores=scores, logits=logits)
        return self.maps.integrate_tensors(depth, intrinsics, T_wc, {"": said}, index=index)[""]

    def table(self) -> VoxelTable:
        """The map so far, brought to memory."""
        return self.maps.table("")
