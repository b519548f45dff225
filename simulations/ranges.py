"""Alpha by range of labels that are worse the farther away.

    python simulations/simulate.py ranges SEQUENCES [--voxel-size 0.2]

SEQUENCES is a folder in SemanticKITTI's layout with ground truth. Labels are the true ones; of the points at range r a
share of (r - 10 m) / 40 m, at most 80 %, is drawn at random from nine classes. Alpha and the strata are printed.
"""

from __future__ import annotations

import dataclasses

import cases
import numpy as np

from semstab.backends import create
from semstab.datasets import open_dataset
from semstab.statistics import Sampler, describe

DRAWN = (0, 8, 10, 12, 13, 14, 15, 16, 17)
"""car, road, sidewalk, building, fence, vegetation, trunk, terrain and pole, among the 19 classes."""


def main(sequences: str, voxel_size: float = 0.2) -> None:
    dataset = open_dataset("semantickitti", {"root": sequences})
    scene, rng = dataset.scene(dataset.scenes[0]), np.random.default_rng(0)
    mapping = scene.label_space("gt").mapping_to(scene.label_space("gt"))
    K = len(mapping.target)
    backend, sampler = create("numba", voxel_size=voxel_size, num_classes=K, history=True), Sampler(K)
    for index in range(len(scene)):
        frame = scene.frame(index, "gt")
        labels = mapping.labels(frame.predicted, scene.frame_name(index))
        wrong = rng.random(frame.shape) < np.clip((frame.depth - 10) / 40, 0, 0.8)
        drawn = rng.choice(DRAWN, frame.shape).astype(labels.dtype)
        made = dataclasses.replace(frame, labels=np.where(wrong & (labels < K), drawn, labels), mask=None)
        backend.integrate(made)
        sampler.add(made)
    found = describe(backend.table(), backend.events(), spots=sampler.sample())
    print(f"alpha {found.headline.alpha.text()}")
    assert found.ranges is not None
    print(found.ranges.text)
    cases.head(["range m", "observations %", "alpha"])
    for row in found.ranges.strata:
        cases.row([f"{row.low:g} to {row.high:g}", f"{100 * row.share:.1f}", row.alpha.text()])
