"""From a run with ground truth to the evidence from which on its labels may be acted on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from semstab.comparison.opening import open_contender
from semstab.errors import ConfigError, DataError
from semstab.model.voxels import VoxelTable
from semstab.statistics.correctness import join_truth
from semstab.statistics.judging.commit import Commit, calibrate


def calibrated(run: str | Path, *, precision: float = 0.95, confidence: float = 0.95) -> Commit:
    """Thresholds from all scenes of a run with ground truth; 'FOLDER:BACKBONE' selects one of several label sources.

    Raises ConfigError and DataError as `open_contender`, and for a scene whose ground truth was not fused.
    """
    own = open_contender(run)
    maps = []
    for scene, entry in own.scenes.items():
        record = entry.with_voxels("a calibration")
        if record.truth_file is None:
            raise ConfigError(
                f"{own.source}: ground truth of {scene} was not fused; run it with --statistics, on a scene that has it"
            )
        table = record.table()
        maps.append((table, join_truth(table, VoxelTable.load(record.truth_file))))
    first = maps[0][0]
    for table, _ in maps[1:]:
        if (table.classes, table.voxel_size) != (first.classes, first.voxel_size):
            raise DataError(f"{own.source}: its scenes differ in classes or voxel size; calibrate on one at a time")
    on = f"{own.backbone} on {', '.join(own.scenes)}"
    return calibrate(maps, precision=precision, confidence=confidence, on=on)


def lines(commit: Commit) -> Iterator[str]:
    """For the terminal."""
    yield (
        f"labels that are right with a probability of {commit.precision:g} or more, class by class at a confidence of"
        f" {commit.confidence:g}; calibrated on {commit.calibrated_on}"
    )
    width = min(max(map(len, commit.classes), default=0), 20)
    for name, own in commit.classes.items():
        right = f"{own.by:<6} >= {own.at_least:<5.3g} right in {own.precision:.3f}, at least {own.low:.3f}"
        if not own.voxels:
            yield f"  {name[:width]:<{width}}  never: no label of it has a known truth"
        elif own.never:
            yield f"  {name[:width]:<{width}}  never; best {right} ({own.voxels:,} voxels)"
        else:
            yield f"  {name[:width]:<{width}}  {right}: {own.left:.0%} left"
    yield f"{commit.left:.1%} of the voxels are left"
    if any(own.never for own in commit.classes.values()):
        yield "more places, in other scenes, show more: errors near each other count as few"
