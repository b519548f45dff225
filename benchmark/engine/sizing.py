"""Whole, or in tiles? Decided before anything is fused, by the estimate of what the maps take."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from semstab.backends import expected_bytes, is_pointwise
from semstab.config import Config
from semstab.engine.map_size import MapSize, geometry, map_size, voxels_in
from semstab.engine.memory import GB, MapMemory, available_for_maps, process_bytes
from semstab.engine.units import Unit
from semstab.errors import ConfigError, DataError
from semstab.task import read, truth_task

DOUBT = 10
"""A sequence whose frames might see that many times the voxels of the first one, all new, is surely small enough."""

SHARE = 0.6
"""The part of the memory for maps that a tile takes: a hash or a grid that doubles needs room."""

SMALLEST, LARGEST = 8, 1 << 16
"""Edges of a tile that is chosen, in voxels."""


@dataclass
class Sizing:
    """Units that would not fit, by identity: the edge of their tiles, or why they cannot be fused; `lines` say so."""

    tile_sizes: dict[str, int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


def planned_sizes(config: Config, missing: Iterable[Unit], width: int) -> Sizing:
    """Estimate the units that are to be fused; where one cannot be read, its computation reports the error."""
    sizing, together = Sizing(), dict[object, list[Unit]]()
    for unit in missing:
        if unit.fuses:  # watched units of a sequence are in memory together; others can be put off
            key = (unit.name.scene, unit.name.model) if unit.stored else unit.identity
            together.setdefault(key, []).append(unit)
    for group in together.values():
        try:
            _plan_sizes(config, group, width, sizing)
        except DataError:
            continue
    return sizing


def _plan_sizes(config: Config, units: Sequence[Unit], width: int, sizing: Sizing) -> None:
    """Decide it for units whose maps are in memory together."""
    task, settings = units[0].task, units[0].config
    whole = _whole_only(config, units)
    if isinstance(config.tile_size, int):
        if whole is not None:
            raise ConfigError(f"tile_size = {config.tile_size}: {whole}")
        sizing.tile_sizes |= {unit.identity: config.tile_size for unit in units}
        return
    kinds, free = _room(config, units, width)
    if not kinds:
        return
    size = map_size(task, settings)
    needed = sum(kind.whole(size.voxels, size.observations) for kind in kinds)
    if needed <= free:
        return
    takes = (
        f"{task.scene.name}, {task.model}: about {size.voxels / 1e6:.2g} million voxels of {settings.voxel_size:g} m"
        f" would take {needed / GB:.2g} GB"
    )
    if whole is not None:
        free_text = f"{free / GB:.2g} GB " + ("are free for it" if config.memory_gb is None else "is memory_gb")
        line = (
            f"{takes}, and {free_text}; use larger voxels (voxel_size), fewer frames (frames), a larger pixel_stride"
            f"{_without(units, settings)}; or set memory_gb to try anyway ({whole})"
        )
        sizing.refused |= {unit.identity: line for unit in units}
        return
    edges = [_tile_edge(kind, size, SHARE * free, width) for kind in kinds]
    sizing.tile_sizes |= {unit.identity: edge for unit, edge in zip(units, edges, strict=True)}
    tiles = max(
        kind.tiles(size.voxels, size.observations, size.of_tile(edge)) for kind, edge in zip(kinds, edges, strict=True)
    )
    sizing.lines.append(
        f"{takes}, {free / GB:.2g} GB are free{' for each process' if width > 1 else ''}: it is fused in tiles of"
        f" {edges[0] * settings.voxel_size:g} m, which take {tiles / GB:.2g} GB"
    )


def _whole_only(config: Config, units: Sequence[Unit]) -> str | None:
    """Return why the units cannot be fused in tiles; None if they can."""
    if config.tile_size == "off":
        return "tile_size: off forbids to fuse it in tiles"
    backends = (unit.name.backend for unit in units)
    other = next((backend for backend in backends if not is_pointwise(backend)), None)
    return None if other is None else f"backend '{other}' cannot be restricted to tiles"


def _room(config: Config, units: Sequence[Unit], width: int) -> tuple[list[MapMemory], float]:
    """Return the memory of each unit's map, and the bytes that are free for all; no map if they surely fit.

    If maps of scores would fit, no label is decoded to know whether there are scores: a network may have to predict it.
    """
    task, settings = units[0].task, units[0].config
    first = geometry(task, settings, task.indices[0])
    most = DOUBT * len(task.indices) * len(voxels_in(first.every(2), settings.voxel_size))

    def room(*, soft: bool) -> tuple[list[MapMemory], float]:
        taken = process_bytes(first, len(task.mapping.target), settings.threads, soft=soft)
        kinds, free = [_map_memory(unit, soft=soft) for unit in units], available_for_maps(config, width, taken)
        return ([] if sum(kind.whole(most, most) for kind in kinds) <= free else kinds), free

    kinds, free = room(soft=True)
    if kinds and read(task, task.indices[0], settings.pixel_stride).scores is None:
        kinds, free = room(soft=False)
    return kinds, free


def _map_memory(unit: Unit, *, soft: bool) -> MapMemory:
    """Return the memory of a unit's map."""
    config, K = unit.config, len(unit.task.mapping.target)
    compared = unit.compares_truth and truth_task(unit.task) is not None
    return MapMemory(unit.name.backend, K, soft, config.statistics or config.events, unit.sampled, compared)


def _without(group: Sequence[Unit], settings: Config) -> str:
    backends = [unit.name.backend for unit in group]
    keep_all = [name for name in backends if expected_bytes(name, 1, 2, 2) > expected_bytes(name, 1, 1, 2)]
    without = f", no backend that keeps every observation ({', '.join(keep_all)})" if keep_all else ""
    return without + (", no statistics" if settings.statistics else "")


def _tile_edge(kind: MapMemory, size: MapSize, budget: float, width: int) -> int:
    """Return the largest edge of a tile, a power of 2, within the budget.

    It is smaller where several processes share the tiles.
    """
    edge = LARGEST
    while edge > SMALLEST:
        voxels = size.of_tile(edge)
        alone = width > 1 and 2 * width * size.by_column * edge**2 > size.voxels
        if kind.tile(voxels, voxels * size.observations / max(size.voxels, 1.0)) <= budget and not alone:
            break
        edge //= 2
    return edge
