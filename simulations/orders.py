"""Share of voxels without drift whose p-values fall below a level: none may be above it but by chance.

    python simulations/orders.py [--voxels 10000] [--seed 0]

Observations of each voxel are exchangeable: labels, scores, or labels of which three in ten are mixed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from simulated_events import log_of_evidence, soft

from semstab.statistics import voxel_drift

LEVELS = (0.05, 0.01, 0.002)


def evidence(kind: str, rng: np.random.Generator, n: int, T: int) -> npt.NDArray[np.float64]:
    """(n, T, 3) of that kind."""
    if kind == "scores":
        return soft(rng, n, T)
    labels = np.eye(3)[rng.choice(3, size=(n, T), p=[0.9, 0.1, 0.0] if kind == "labels, few err" else [0.6, 0.3, 0.1])]
    if kind == "mixed":
        some = rng.random((n, T)) < 0.3
        labels[some] = rng.dirichlet([1, 1, 0.2], size=int(some.sum()))
    return labels


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voxels", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| OP | evidence | of | tested | " + " | ".join(f"{100 * level:g} %" for level in LEVELS) + " |")
    for T in (6, 9, 19, 60):
        for kind in ("labels", "labels, few err", "mixed", "scores"):
            rng = np.random.default_rng([arguments.seed, T])
            events = log_of_evidence(evidence(kind, rng, arguments.voxels, T))
            drift = voxel_drift(events.table(), events, seed=arguments.seed, sample=arguments.voxels)
            for name, p in (("SBD", drift.p_value), ("trend", drift.trend_p)):
                tested = p[~np.isnan(p)]
                shares = " | ".join(f"{100 * np.mean(tested <= level):.2f}" for level in LEVELS)
                print(f"| {T} | {kind} | {name} | {len(tested)} | {shares} |")


if __name__ == "__main__":
    main()
