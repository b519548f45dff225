"""Fusion backends behind one protocol: `create("open3d", voxel_size=0.2, num_classes=7)`."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from semstab.core.registry import Entry, Registry
from semstab.core.types import Float32, Float64, Int64, UInt16
from semstab.data.events import Events
from semstab.data.frames import Frame
from semstab.data.results import FrameReport
from semstab.data.voxels import Extent, VoxelTable
from semstab.errors import ConfigError

OPEN3D_LIBRARIES = "libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0 libgomp1"

GIVEN = ("voxel_size", "num_classes", "within")
"""Settings of every map; the rest are options of its backend."""

WITH_OPEN3D = f"pip install semstab, and on Debian or Ubuntu: apt-get install {OPEN3D_LIBRARIES}"

REGISTRY = Registry(
    "backend",
    {
        "numpy": Entry(
            "semstab.backends.numpy_reference:NumpyReference",
            "the reference: it stores every observation and computes each metric from its definition",
        ),
        "numba": Entry(
            "semstab.backends.numba_hash:NumbaHash",
            "the fast one on a CPU: an open-addressing hash map in compiled parallel code",
            install="pip install semstab",
        ),
        "open3d": Entry(
            "semstab.backends.open3d_blocks:Open3DBlocks",
            "Open3D VoxelBlockGrid with semantic attributes on hashed voxel blocks; CPU or CUDA",
            install=WITH_OPEN3D,
            needs=("open3d",),
        ),
        "torch": Entry(
            "semstab.backends.torch_map:TorchMap",
            "the fast one on an accelerator: a hash map on a CUDA device, fed from tensors; runs on a CPU too",
            install="pip install 'semstab[torch]'",
            needs=("torch",),
        ),
        "open3d-projective": Entry(
            "semstab.backends.open3d_projective:Open3DProjective",
            "voxels look up their pixel, as Open3D's integration does; to compare: differs from the others by design",
            install=WITH_OPEN3D,
            needs=("open3d",),
        ),
    },
)


class FusionBackend(Protocol):
    """A fusion of frames into metric voxels, made with `voxel_size` (metres), `num_classes` (K >= 2) and own options.

    A pixel (u, v) with depth d falls into the voxel floor(x_w / r), evaluated in float64 in this order, so that
    every backend decides alike at a voxel's face:

        x_c = ((u - cx) / fx) * d        y_c = ((v - cy) / fy) * d        z_c = d
        x_w = ((R00 * x_c + R01 * y_c) + R02 * z_c) + t0     and so on

    A voxel takes one evidence vector a frame: the mean over the frame's pixels in it.

    A backend that associates pixels and voxels in another way says `pointwise = False`: it is compared with the
    others, but they need not agree.
    """

    def integrate(self, frame: Frame) -> FrameReport:
        """Fuse one frame: one more observation of the voxels it sees, whatever its index.

        Raises:
            DataError: If the frame cannot be fused, with the map unchanged.
        """

    def table(self) -> VoxelTable:
        """Return the map so far."""

    def events(self) -> Events | None:
        """Return the log of observations, or None where the backend has none."""
        return None


@dataclass(frozen=True, eq=False)
class Changes:
    """The change that one frame made to each of the n voxels that it saw.

    Attributes:
        row: (n,) int64 the voxel's number: voxels are numbered from 0 in the order of their first observation.
        key: (n,) int64 its index, packed, relative to the map's origin; overwritten by the next frame.
        drift: (n,) float32 D_JS of its belief before and after the frame, bits; NaN where it was not seen before.
        before, after: (n,) uint16 its dominant class; where it was not seen before, both are the one after.
    """

    row: Int64
    key: Int64
    drift: Float32
    before: UInt16
    after: UInt16

    @classmethod
    def room(cls, row: Int64, key: Int64) -> Changes:
        """Return changes to be filled, for the voxels of these rows and keys."""
        n = len(row)
        return cls(row, key, np.empty(n, np.float32), np.empty(n, np.uint16), np.empty(n, np.uint16))


@runtime_checkable
class GrowingMap(FusionBackend, Protocol):
    """A backend whose map can be followed voxel by voxel while it grows, as the recording needs it.

    A voxel's number, its row, stays the same; keys are packed as in `semstab.backends.shared.keys`.
    """

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel, metres."""

    @property
    def origin(self) -> Int64:
        """(3,) voxel index that packed keys count from; of an empty map 0."""

    @property
    def changes(self) -> Changes:
        """The change of each voxel by the last frame."""

    def __len__(self) -> int:
        """Return the number of voxels."""

    def column(self, name: str, rows: Int64 | slice = ...) -> npt.NDArray[Any]:
        """Return a table column (n,), such as op or drift_sum, for the voxels of those rows; for all if not given."""

    def evidence_of(self, rows: Int64) -> Float64:
        """Return the evidence (n, K) of the voxels of those rows."""

    def index_of(self, rows: Int64) -> Int64:
        """Return voxel indices (n, 3) of the voxels of those rows."""


def create(
    name: str, *, voxel_size: float, num_classes: int, within: Extent | None = None, **options: Any
) -> FusionBackend:
    """Return a new, empty map, restricted to the voxels `within` an extent where one is given.

    voxel_size in metres, num_classes K >= 2; options are the backend's own (open3d: device, block_resolution).

    Raises:
        ConfigError: For an unknown name or option, and for an extent where the backend does not associate pixel by
            pixel.
        MissingDependencyError: If its engine is not installed.
    """
    cls = REGISTRY.load(name)
    known = _options(cls)
    if not isinstance(within, Extent | None):
        raise ConfigError(f"backend '{name}' has no option 'within'; the plan sets it")
    if unknown := sorted(set(options) - set(known)):
        listed = f"it takes {', '.join(known)}" if known else "it takes none"
        raise ConfigError(f"backend '{name}' has no option '{unknown[0]}'; {listed}")
    make: Any = partial(cls, voxel_size=voxel_size, num_classes=num_classes, **options)
    if within is None:
        return cast(FusionBackend, make())
    if not restrictable(name):
        raise ConfigError(f"backend '{name}' does not associate pixel by pixel; it cannot be restricted to a part")
    if "within" in inspect.signature(cls).parameters:
        return cast(FusionBackend, make(within=within))
    from semstab.backends.shared.association import Restricted

    return Restricted(make(), voxel_size, within)


def restrictable(name: str) -> bool:
    """Return whether maps of the backend of that name can be restricted to an extent."""
    return bool(getattr(REGISTRY.load(name), "pointwise", True))


def takes_option(name: str, option: str) -> bool:
    """Return whether the backend of that name has such an option, for example 'device'."""
    return option in _options(REGISTRY.load(name))


def keeps_log(name: str) -> bool:
    """Return whether the backend of that name can give a log of observations: with option `history`, or always."""
    return takes_option(name, "history") or getattr(REGISTRY.load(name), "keeps_log", False)


def expected_bytes(name: str, voxels: int, observations: int, num_classes: int, *, soft: bool = False) -> int:
    """Return the bytes that a backend's map of that size takes, roughly; 0 for one that does not say.

    A backend says it with a static method of that name, those three parameters, and `soft` where a map of scores takes
    other than one of labels.
    """
    says = getattr(REGISTRY.load(name), "expected_bytes", None)
    if says is None:
        return 0
    more = {"soft": soft} if "soft" in inspect.signature(says).parameters else {}
    return int(says(voxels, observations, num_classes, **more))


def _options(cls: Any) -> list[str]:
    return [name for name in inspect.signature(cls).parameters if name not in GIVEN]
