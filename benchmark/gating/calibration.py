"""Acceptance thresholds from a run with ground truth, and their text for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from semstab.comparison.opening import open_run
from semstab.comparison.voxels import in_share, share_of
from semstab.data.records import Record
from semstab.data.tiles import Tiles, side_by_side
from semstab.data.voxel_keys import in_order
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.statistics.acceptance import AcceptanceThresholds, calibrate
from semstab.statistics.correctness import Truth, join_truth


def calibrate_run(run: str | Path, *, precision: float = 0.95, confidence: float = 0.95) -> AcceptanceThresholds:
    """Return thresholds from all scenes of a run with ground truth.

    'FOLDER:MODEL' selects one of several label sources.

    Raises:
        ConfigError, DataError: As `open_run` does, and for a scene whose ground truth was not fused.
    """
    handle = open_run(run)
    handle.require_labels()
    maps, sampled = [], 1.0
    for scene, entry in handle.scenes.items():
        record = entry.with_voxels("a calibration")
        if record.truth_file is None:
            raise ConfigError(
                f"{handle.where}: ground truth of {scene} was not fused;"
                " run it on a scene that has it, without --no-truth"
            )
        maps.append(_with_truth(record, record.truth_file))
        sampled = min(sampled, share_of(record.map_summary.voxels))
    first = maps[0][0]
    for table, _ in maps[1:]:
        if (table.classes, table.voxel_size) != (first.classes, first.voxel_size):
            raise DataError(f"{handle.where}: its scenes differ in classes or voxel size; calibrate on one at a time")
    on = f"{handle.model} on {', '.join(handle.scenes)}"
    on += f", 1 in {round(1 / sampled)} of the locations of a large map" if sampled < 1 else ""
    return calibrate(maps, precision=precision, confidence=confidence, on=on)


def _with_truth(record: Record, truth_file: Path) -> tuple[VoxelTable, Truth]:
    """Return a map with its true classes, or a sample of a very large map by a hash of the location."""
    share, parts = share_of(record.map_summary.voxels), []
    files = [file for file in (record.voxels_file, truth_file) if file is not None]
    for table, truth in side_by_side([Tiles.open(file, VoxelTable) for file in files]):
        sample = table.rows(in_share(table, share))
        parts.append((sample, join_truth(sample, truth).label))
    order = in_order(np.concatenate([table.index for table, _ in parts]))
    label = np.concatenate([labels for _, labels in parts])[order]
    return VoxelTable.joined([table for table, _ in parts]), Truth(label >= 0, label)


def lines(result: AcceptanceThresholds) -> Iterator[str]:
    """Yield the thresholds in sentences for the terminal."""
    yield (
        f"these labels are right with a probability of {result.precision:g} or more, each class at a confidence of"
        f" {result.confidence:g}; they were calibrated on {result.calibrated_on}"
    )
    width = min(max(map(len, result.classes), default=0), 20)
    for name, threshold in result.classes.items():
        evidence = f"{threshold.by:<6} >= {threshold.at_least:<5.3g}"
        right = f"{evidence} right in {threshold.precision:.3f}, at least {threshold.low:.3f}"
        if not threshold.voxels:
            yield f"  {name[:width]:<{width}}  never: no label of this class has a known truth"
        elif threshold.never:
            yield f"  {name[:width]:<{width}}  never; best {right} ({threshold.voxels:,} voxels)"
        else:
            yield f"  {name[:width]:<{width}}  {right}: {threshold.left:.0%} left"
    yield f"{result.left:.1%} of the voxels are left"
    if any(threshold.never for threshold in result.classes.values()):
        yield "more locations in other scenes may show more: errors near each other count as few"
