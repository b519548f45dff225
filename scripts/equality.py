"""Hold measures against the code of others, on random labels, and print a table in Markdown.

    python scripts/equality.py [--cases 200] [--seed 0]

Needs what the tests need. Each measure gets the same labels as the other code; a case has 2 to 12 frames, 2 to 9
classes, 20 to 400 places, some of which frames do not see.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import math
from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from semstab.data.events import Events
from semstab.statistics import fleiss_kappa, krippendorff_alpha, psa
from semstab.statistics.correctness import BINS, correctness

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.int64]


def labels_of(rng: np.random.Generator, *, all_seen: bool, raters: int | None = None) -> tuple[Labels, int]:
    """Return labels (n, F) of places in frames, -1 where one is not seen, and the number of classes."""
    n, F, K = int(rng.integers(20, 400)), raters or int(rng.integers(2, 13)), int(rng.integers(2, 10))
    true = rng.integers(0, K, (n, 1))
    labels = np.where(rng.random((n, F)) < rng.uniform(0.05, 0.6), rng.integers(0, K, (n, F)), true)
    if not all_seen:
        labels[:, 1:][rng.random((n, F - 1)) < rng.uniform(0, 0.8)] = -1
    return labels, K


def log_of(labels: Labels, K: int) -> Events:
    """Return the observations of voxels (0, 0, 0), (0, 0, 1), ..."""
    n = len(labels)
    voxel, frame = np.nonzero(labels >= 0)
    none = np.zeros(n, np.int64)
    evidence = np.eye(K)[labels[voxel, frame]]
    return Events(none, none, np.arange(n), voxel, frame, evidence, np.ones(len(voxel)), 0.2)


def alpha(rng: np.random.Generator) -> tuple[float, float]:
    """Krippendorff's alpha of nominal labels."""
    import krippendorff

    labels, K = labels_of(rng, all_seen=False)
    data = np.where(labels >= 0, labels, np.nan).T
    return krippendorff_alpha(log_of(labels, K).table()), krippendorff.alpha(data, level_of_measurement="nominal")


def kappa(rng: np.random.Generator) -> tuple[float, float]:
    """Fleiss' kappa, of places that all frames see."""
    from statsmodels.stats.inter_rater import fleiss_kappa as statsmodels_kappa

    labels, K = labels_of(rng, all_seen=True)
    counts = np.stack([(labels == k).sum(axis=1) for k in range(K)], axis=1)
    return fleiss_kappa(log_of(labels, K).table()), float(statsmodels_kappa(counts))


def observed(rng: np.random.Generator) -> tuple[float, float]:
    """PSA of two frames: the observed agreement in Cohen's kappa, which follows from it and the margins."""
    from sklearn.metrics import cohen_kappa_score

    labels, K = labels_of(rng, all_seen=True, raters=2)
    a, b = (np.bincount(rater, minlength=K) / len(labels) for rater in labels.T)
    chance, agreement = float(a @ b), float(psa(log_of(labels, K).table()).mean())
    return (agreement - chance) / (1 - chance), float(cohen_kappa_score(*labels.T))


def beliefs(rng: np.random.Generator) -> tuple[Array, Labels]:
    """Return beliefs (n, K) with true classes (n,)."""
    n, K = int(rng.integers(20, 400)), int(rng.integers(2, 10))
    belief = rng.dirichlet(np.full(K, rng.uniform(0.2, 2)), n)
    drawn = (belief.cumsum(axis=1) < rng.random((n, 1))).sum(axis=1).clip(max=K - 1)
    return belief, np.where(rng.random(n) < 0.3, rng.integers(0, K, n), drawn)


def iou(rng: np.random.Generator) -> tuple[float, float]:
    """Mean IoU over the classes that are true or predicted somewhere."""
    import torch
    from torchmetrics.classification import MulticlassJaccardIndex

    belief, true = beliefs(rng)
    predicted, K = belief.argmax(axis=1), belief.shape[1]
    there = np.union1d(predicted, true)
    other = MulticlassJaccardIndex(K, average="none")(torch.from_numpy(predicted), torch.from_numpy(true)).numpy()
    return correctness(belief, true).miou, float(other[there].mean())


def accuracy(rng: np.random.Generator) -> tuple[float, float]:
    """Share of right labels."""
    import torch
    from torchmetrics.classification import MulticlassAccuracy

    belief, true = beliefs(rng)
    other = MulticlassAccuracy(belief.shape[1], average="micro")
    return correctness(belief, true).accuracy, float(other(torch.from_numpy(belief), torch.from_numpy(true)))


def calibration(rng: np.random.Generator) -> tuple[float, float]:
    """Expected calibration error with as many bins."""
    import torch
    from torchmetrics.classification import MulticlassCalibrationError

    belief, true = beliefs(rng)
    other = MulticlassCalibrationError(belief.shape[1], n_bins=BINS, norm="l1")
    return correctness(belief, true).ece, float(other(torch.from_numpy(belief), torch.from_numpy(true)))


MEASURES: list[tuple[str, str, str, Callable[[np.random.Generator], tuple[float, float]]]] = [
    ("voxel alpha", "krippendorff", "alpha, nominal", alpha),
    ("Fleiss' kappa", "statsmodels", "fleiss_kappa", kappa),
    ("PSA of two frames, as Cohen's kappa", "scikit-learn", "cohen_kappa_score", observed),
    ("mIoU", "torchmetrics", "MulticlassJaccardIndex", iou),
    ("accuracy", "torchmetrics", "MulticlassAccuracy", accuracy),
    ("ECE", "torchmetrics", "MulticlassCalibrationError", calibration),
]


def rows(cases: int, seed: int) -> Iterator[list[str]]:
    """Yield the cells of each measure."""
    for row, (name, package, function, measure) in enumerate(MEASURES):
        rng, largest = np.random.default_rng([seed, row]), 0.0
        for _ in range(cases):
            ours, other = measure(rng)
            assert math.isnan(ours) == math.isnan(other)
            largest = max(largest, abs(ours - other)) if not math.isnan(ours) else largest
        version = importlib.metadata.version(package)
        yield [name, f"{package} {version}, {function}", f"{cases}", f"{largest:.1e}"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| measure | other code | cases | largest difference |\n| --- | --- | --- | --- |")
    for cells in rows(arguments.cases, arguments.seed):
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
