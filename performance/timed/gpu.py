"""Time of one frame through backend `torch`, its input on the device already, with the floor and the CPU backends.

The map grows by one view fused at ever new places; then places chosen at random are fused again, as ids, as logits, and
as ids of three models at once. Medians of `rounds` frames by CUDA events, after a warm-up. The floor is the bytes
that must move (depth, ids or logits, and the rows of the touched voxels, read and written) over the bandwidth of a copy
on the device. At the end the maps of torch and numba are compared, voxel by voxel.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from statistics import median
from typing import Any, Literal

import flight
import measuring
import numpy as np
import torch

import semstab
from semstab import backends
from semstab.backends.torch_map import TorchMap, TorchMaps
from semstab.backends.torch_storage import Columns, TensorPrediction
from semstab.data.results import UnitName
from semstab.metrics import compare

VOXEL_SIZE, APART, WARM_UP, MODELS = 0.2, 200.0, 5, 3


@dataclasses.dataclass
class DeviceView:
    """A view on the device: its frame, and what is fused of it at a place."""

    frame: semstab.Frame
    depth: torch.Tensor
    ids: torch.Tensor
    logits: torch.Tensor

    @classmethod
    def from_frame(cls, frame: semstab.Frame, K: int, dtype: torch.dtype, device: torch.device) -> DeviceView:
        """Logits that favour the frame's labels."""
        ids = torch.tensor(frame.labels, device=device)
        logits = torch.empty((K, *frame.shape), dtype=dtype, device=device)
        for k in range(K):
            logits[k] = torch.randn(frame.shape, device=device) + 4 * (ids == k)
        return cls(frame, torch.tensor(frame.depth, device=device), ids, logits)

    def view(self, place: int) -> tuple[torch.Tensor, semstab.Intrinsics, np.ndarray[Any, Any]]:
        """Depth and camera, moved by a whole number of voxels."""
        T_wc = np.array(self.frame.T_wc)
        T_wc[:2, 3] += APART * (place % 100), APART * (place // 100)
        return self.depth, self.frame.intrinsics, T_wc


def seconds(work: Callable[[int], Any], places: list[int], device: torch.device) -> float:
    """Median time of `work` at these places, after a warm-up: by events on a CUDA device, else by the clock."""
    times = []
    warm_up = places[:WARM_UP]
    for place in [*warm_up, *places]:
        if device.type != "cuda":
            times.append(measuring.wall_ms(work, place) / 1e3)
            continue
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        work(place)
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end) / 1e3)
    return median(times[len(warm_up) :])


def copy_bandwidth(device: torch.device, megabytes: int) -> float:
    """Bytes a second, read and written, of a copy on the device: the best of several."""
    source = torch.ones(megabytes * 2**18, dtype=torch.float32, device=device)
    target = torch.empty_like(source)
    best = min(seconds(lambda _: target.copy_(source), [0] * WARM_UP, device) for _ in range(3))
    return 2 * source.numel() * source.element_size() / best


def measure(
    case: DeviceView, K: int, voxels: int, device: str, rounds: int, logits: str, *, several: bool
) -> list[dict[str, Any]]:
    """Rows of the table for one map: ids, logits, and ids of several models."""
    backend = TorchMap(VOXEL_SIZE, K, device=device, reserve=voxels + voxels // 5)
    places = map_voxels = 0
    while map_voxels < voxels:
        report = backend.integrate_tensors(*case.view(places), index=places, labels=case.ids)
        map_voxels, touched = report.map_voxels, report.voxels
        places += 1
    visits = np.random.default_rng(0).integers(0, places, rounds).tolist()
    row_bytes = Columns(K, torch.float64, torch.device("cpu")).row_bytes
    of_rows, pixels = 2 * touched * row_bytes, case.depth.numel()

    def fuse(place: int, **said: torch.Tensor) -> None:
        backend.integrate_tensors(*case.view(place), index=place, **said)

    maps = TorchMaps(VOXEL_SIZE, dict.fromkeys("abc"[:MODELS], K), device=device)

    def fuse_several(place: int) -> None:
        said = {name: TensorPrediction(labels=case.ids) for name in "abc"[:MODELS]}
        maps.integrate_tensors(*case.view(place % 4), said, index=place)

    works: dict[str, tuple[Callable[[int], None], int]] = {
        "ids": (lambda place: fuse(place, labels=case.ids), pixels * 5 + of_rows),
        f"{logits} logits": (
            lambda place: fuse(place, logits=case.logits),
            pixels * (4 + K * case.logits.element_size()) + of_rows,
        ),
    }
    if several:
        works[f"ids x{MODELS}"] = (fuse_several, pixels * (4 + MODELS) + MODELS * of_rows)
    return [
        {"voxels": map_voxels, "input": name, "seconds": seconds(work, visits, backend.device), "bytes": size}
        for name, (work, size) in works.items()
    ]


def on_the_cpu(frame: semstab.Frame, K: int, name: str, rounds: int) -> dict[str, Any]:
    """The row of another backend: the median time of a frame that it has seen before."""
    backend = backends.create(name, voxel_size=VOXEL_SIZE, num_classes=K)
    voxels = backend.integrate(frame).map_voxels
    times = [measuring.wall_ms(backend.integrate, frame) for _ in range(rounds)]
    return {"voxels": voxels, "input": "ids", "seconds": median(times) / 1e3, "bytes": None}


def agreement(K: int, size: tuple[int, int], device: str) -> bool:
    """Return whether torch and numba make the same map of four frames."""
    tables = []
    for name, options in (("torch", {"device": device}), ("numba", {})):
        backend = backends.create(name, voxel_size=VOXEL_SIZE, num_classes=K, **options)
        for index in range(4):
            backend.integrate(flight.frame(index, *size, K))
        tables.append(backend.table())
    units = (UnitName("flight", "", "torch"), UnitName("flight", "", "numba"))
    return compare(tables[0], tables[1], units).agrees


def main(
    device: str = "CUDA:0" if torch.cuda.is_available() else "CPU:0",
    sizes: tuple[str, ...] = ("3840x2160",),
    classes: tuple[int, ...] = (7, 20),
    voxels: tuple[int, ...] = (1_000_000, 20_000_000),
    rounds: int = 50,
    logits: Literal["float16", "bfloat16", "float32"] = "float16",
    cpu_backends: tuple[str, ...] = ("numba", "open3d"),
    copied_megabytes: int = 1024,
) -> Any:
    there = TorchMap(VOXEL_SIZE, 2, device=device).device
    bandwidth = copy_bandwidth(there, copied_megabytes)
    name = torch.cuda.get_device_name(there) if there.type == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}; a copy moves {bandwidth / 1e9:.0f} GB/s\n")
    table = measuring.MarkdownTable(size="", K="", voxels=",", input="", by="", ms=".3f", floor_ms=".3f", ratio=".1f")
    for size, K in itertools.product(sizes, classes):
        case = DeviceView.from_frame(flight.frame(0, *measuring.sides(size), K), K, getattr(torch, logits), there)
        rows = [
            {"by": "torch", **row}
            for wanted in voxels
            for row in measure(case, K, wanted, device, rounds, logits, several=wanted == min(voxels))
        ]
        rows += [{"by": by, **on_the_cpu(case.frame, K, by, min(rounds, 10))} for by in cpu_backends]
        for row in rows:
            floor = row["bytes"] / bandwidth if row["bytes"] else None
            beside = {"floor_ms": 1e3 * floor, "ratio": row["seconds"] / floor} if floor else {}
            table.add(size=size, K=K, ms=1e3 * row["seconds"], **row, **beside)
    agrees = agreement(classes[0], measuring.sides(sizes[-1]), device)
    print(f"\ntorch and numba {'agree' if agrees else 'DISAGREE'}")
    about = {"device": name, "torch": torch.__version__, "copy_bytes_per_second": bandwidth}
    return about | {"agrees": agrees, "rows": table.rows}
