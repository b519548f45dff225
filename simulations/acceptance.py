"""Do thresholds from which labels are acted on keep what they promise?

    python simulations/simulate.py acceptance simulated [--trials 100] [--seed 0] [--precision 0.9]
    python simulations/simulate.py acceptance halves RUN [--precision 0.9]

Simulated: thresholds are calibrated on one scene, and how often labels with so much evidence are right is counted over
all other scenes of the same kind. Broken is the share of the thresholds that promise more than that; at most 1 -
confidence = 0.05 may. Halves: of a run with ground truth, calibrated on one side of a plane and counted on the other.
Both print a table in Markdown.
"""

from __future__ import annotations

from typing import Literal

import cases
import numpy as np
from flights import SimulatedFlight, World, fly, log_of, table_of, world

from semstab.comparison.opening import open_run
from semstab.data.measures import dominant
from semstab.data.voxels import VoxelTable
from semstab.metrics.agreement import rows_of
from semstab.statistics.acceptance import EVIDENCE, AcceptanceThresholds, calibrate
from semstab.statistics.correctness import Truth, join_truth

CLASSES = ("a", "b")


def conditions() -> list[tuple[str, SimulatedFlight]]:
    """Errors that reach half a voxel to six, on floors of 1,024 and 4,096 voxels."""
    return [
        (f"{side} x {side}, errors reach {reach:g} voxels", SimulatedFlight(side, reach, 0.6, 6, 6, "uneven"))
        for side in (32, 64)
        for reach in (0.5, 2.0, 6.0)
    ]


def scene(flight: SimulatedFlight, rng: np.random.Generator) -> tuple[VoxelTable, Truth]:
    """The map of a flight over a scene, and what is right."""
    over: World = world(flight, rng)
    log = log_of(fly(flight, over, rng), over, flight)
    made = table_of(log)
    table = VoxelTable(
        made.ix, made.iy, made.iz, op=made.op, evidence=made.evidence, pixels=made.pixels, self_sum=made.self_sum,
        drift_sum=made.drift_sum, frame_entropy_sum=made.frame_entropy_sum, first_frame=made.first_frame,
        last_frame=made.last_frame, voxel_size=made.voxel_size, classes=CLASSES,
    )  # fmt: skip
    return table, Truth(over.truth >= 0, over.truth.astype(np.int64))


def simulated(flight: SimulatedFlight, trials: int, seed: int, precision: float) -> list[str]:
    """How often a threshold is found, what share is left, and how often it promises too much."""
    scenes = [scene(flight, np.random.default_rng([seed, trial])) for trial in range(trials)]
    label = np.stack([dominant(table) for table, _ in scenes])
    right = label == np.stack([truth.label for _, truth in scenes])
    evidence = {by: np.stack([np.asarray(of(table), float) for table, _ in scenes]) for by, of in EVIDENCE.items()}
    found, broken, left = 0, 0, []
    for flown in scenes:
        commit = calibrate([flown], precision=precision)
        left.append(commit.left)
        for k, name in enumerate(CLASSES):
            chosen = commit.classes[name]
            if not chosen.never:
                some = (label == k) & (evidence[chosen.by] >= chosen.at_least)
                found += 1
                broken += right[some].mean() < precision
    return [f"{found / (2 * trials):.2f}", f"{np.mean(left):.2f}", f"{broken / (2 * trials):.3f}"]


def halves(run: str, precision: float) -> list[list[str]]:
    """Calibrated on either side of the median along each axis, counted on the other."""
    rows = []
    for name, entry in open_run(run).scenes.items():
        record = entry.with_voxels("this")
        table = record.table()
        truth = join_truth(table, VoxelTable.load(record.truth_file))
        for axis in range(3):
            low = table.index[:, axis] < np.median(table.index[:, axis])
            for side in (low, ~low):
                commit = calibrate([_part(table, truth, side)], precision=precision)
                rows.append(
                    [name, "xyz"[axis], "<" if side is low else ">=", *_held(commit, _part(table, truth, ~side))]
                )
    return rows


def _part(table: VoxelTable, truth: Truth, where: np.ndarray) -> tuple[VoxelTable, Truth]:
    return rows_of(table, np.flatnonzero(where)), Truth(truth.known[where], truth.label[where])


def _held(commit: AcceptanceThresholds, held: tuple[VoxelTable, Truth]) -> list[str]:
    table, truth = held
    decided = commit.decide(table)
    counted = (decided >= 0) & truth.known
    names = [name for name, limits in commit.classes.items() if not limits.never]
    right = (decided == truth.label)[counted].mean() if counted.any() else float("nan")
    return [", ".join(names) or "none", f"{commit.left:.2f}", f"{(decided >= 0).mean():.2f}", f"{right:.3f}"]


def main(
    study: Literal["simulated", "halves"],
    run: tuple[str, ...],
    trials: int = 100,
    seed: int = 0,
    precision: float = 0.9,
) -> None:
    if study == "halves":
        cases.head(["scene", "axis", "calibrated", "classes", "left", "left of the other half", "right there"])
        rows = (cells for one in run for cells in halves(one, precision))
    else:
        cases.head(["condition", "threshold found", "left of the map", "broken"])
        rows = ([name, *simulated(flight, trials, seed, precision)] for name, flight in conditions())
    for row in rows:
        cases.row(row)
