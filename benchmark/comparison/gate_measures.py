"""What a rule may be about: the numbers that follow from the sums of a run, and what to run for those it lacks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.comparison.opening import open_contender
from semstab.comparison.pairing import in_share, share_of
from semstab.comparison.tables import (
    COVERAGE,
    FLICKER,
    IOU,
    MISLEADING,
    PRECISION,
    REACHED,
    RECALL,
    RECURRENT_VSS,
    SBD_EXCESS,
)
from semstab.config import nearest
from semstab.errors import ConfigError, DataError
from semstab.model.measures import ENTROPY, Quantity
from semstab.model.records import Record
from semstab.model.tiles import Tiles, side_by_side
from semstab.model.voxels import VoxelTable
from semstab.statistics.agreement import ALPHA, ALPHA_BETWEEN, PSA
from semstab.statistics.commit import Commit, calibrate
from semstab.statistics.correctness import ACCURACY, ECE, MIOU, Truth, join_truth

TRUTH = "run it with --statistics, on a scene with ground truth"
LOOK_ACCURACY = Quantity(key="look_accuracy", title="Accuracy of looks", better="higher", needs="truth")


@dataclass(frozen=True)
class GateMeasure:
    """A number that rules know.

    quantity  its key among influence sums, its title, which way is good
    name      by which a rule calls it; `also` other names
    of_all, of_class  where it has a value: of all classes, of one
    only_change       it has none by itself
    lacking   what to do where a run does not have it
    """

    quantity: Quantity
    name: str
    also: tuple[str, ...] = ()
    of_all: bool = True
    of_class: bool = False
    only_change: bool = False
    lacking: str = "run it again with more overlap between frames"

    @property
    def key(self) -> str:
        """Of the number among the sums."""
        return self.quantity.key


MEASURES = (
    GateMeasure(PSA, "psa"),
    GateMeasure(ALPHA, "alpha", of_class=True),
    GateMeasure(ALPHA_BETWEEN, "alpha between", of_class=True),
    GateMeasure(REACHED, "reached", ("share of ceiling",), of_class=True),
    GateMeasure(RECURRENT_VSS, "vss"),
    GateMeasure(ENTROPY, "entropy"),
    GateMeasure(SBD_EXCESS, "sbd excess", lacking="run it with --statistics, which keeps the order of looks"),
    GateMeasure(FLICKER, "flicker", lacking="run it again with two frames or more"),
    GateMeasure(COVERAGE, "coverage", only_change=True),
    GateMeasure(ACCURACY, "accuracy", lacking=TRUTH),
    GateMeasure(LOOK_ACCURACY, "look accuracy", lacking=TRUTH),
    GateMeasure(MIOU, "miou", lacking=TRUTH),
    GateMeasure(ECE, "ece", lacking=TRUTH),
    GateMeasure(MISLEADING, "wrong of stable", ("stable-and-wrong",), lacking=TRUTH),
    GateMeasure(RECALL, "recall", of_all=False, of_class=True, lacking=TRUTH),
    GateMeasure(PRECISION, "precision", of_all=False, of_class=True, lacking=TRUTH),
    GateMeasure(IOU, "iou", of_all=False, of_class=True, lacking=TRUTH),
)
"""In the order in which they are listed."""

OF_EVIDENCE = (PSA, ALPHA, ALPHA_BETWEEN, REACHED, RECURRENT_VSS, ENTROPY, SBD_EXCESS, ECE)
"""What depends on whether a model gives labels or scores."""


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]+", " ", name.strip()).lower()


NAMED = {_plain(name): each for each in MEASURES for name in (each.name, each.quantity.title, *each.also)}


def measure_named(name: str, where: str) -> GateMeasure:
    """By any of its names. Raises ConfigError, which says where, for one that there is not."""
    found = NAMED.get(_plain(name))
    if found is None:
        raise ConfigError(f"{where}: no measure '{name}'; {nearest(_plain(name), listed())}")
    return found


def listed() -> Sequence[str]:
    """The names of all measures."""
    return [measure.name for measure in MEASURES]


# From a run with ground truth to the evidence from which on its labels may be acted on.


def calibrated(run: str | Path, *, precision: float = 0.95, confidence: float = 0.95) -> Commit:
    """Thresholds from all scenes of a run with ground truth; 'FOLDER:BACKBONE' selects one of several label sources.

    Raises ConfigError and DataError as `open_contender`, and for a scene whose ground truth was not fused.
    """
    own = open_contender(run)
    maps, sampled = [], 1.0
    for scene, entry in own.scenes.items():
        record = entry.with_voxels("a calibration")
        if record.truth_file is None:
            raise ConfigError(
                f"{own.source}: ground truth of {scene} was not fused; run it with --statistics, on a scene that has it"
            )
        maps.append(_judged(record, record.truth_file))
        sampled = min(sampled, share_of(record.summary.table.voxels))
    first = maps[0][0]
    for table, _ in maps[1:]:
        if (table.classes, table.voxel_size) != (first.classes, first.voxel_size):
            raise DataError(f"{own.source}: its scenes differ in classes or voxel size; calibrate on one at a time")
    on = f"{own.backbone} on {', '.join(own.scenes)}"
    on += f", 1 in {round(1 / sampled)} of the places of a large map" if sampled < 1 else ""
    return calibrate(maps, precision=precision, confidence=confidence, on=on)


def _judged(record: Record, truth_file: Path) -> tuple[VoxelTable, Truth]:
    """A map with its true classes; of a very large one a sample, by a hash of the place."""
    share, parts = share_of(record.summary.table.voxels), []
    files = [file for file in (record.voxels_file, truth_file) if file is not None]
    for table, truth in side_by_side([Tiles.open(file, VoxelTable) for file in files]):
        some = table.rows(in_share(table, share))
        parts.append((some, join_truth(some, truth).label))
    order = np.lexsort(np.concatenate([table.index for table, _ in parts]).T[::-1])
    label = np.concatenate([own for _, own in parts])[order]
    return VoxelTable.joined([table for table, _ in parts]), Truth(label >= 0, label)


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
