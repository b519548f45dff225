"""Thresholds from which a map's labels are acted on: for each class the evidence that makes them right often enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import BaseModel, ConfigDict, Field

from semstab.config import read_yaml, validated
from semstab.core.files import write_text
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.measures import Beliefs, dominant, margin, vss
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.statistics.cluster_sums import ClusterSums, cubes_of, mean_functional
from semstab.statistics.correctness import Truth
from semstab.statistics.intervals import estimate

Evidence = Literal["op", "belief", "margin"]

SCHEMA = 1
EVIDENCE: Mapping[Evidence, Callable[[Beliefs], npt.NDArray[np.generic]]] = {
    "op": lambda table: table.op,
    "belief": vss,
    "margin": margin,
}
"""Kinds of evidence: frames that saw the voxel, the dominant class' share of the belief, its lead over the next."""

STEPS = 8
"""Thresholds that are tried for each kind of evidence, at equal shares of a class' voxels."""

FEW_CUBES = 3
"""So few cubes with an error do not show how far errors reach."""

NEVER = -1
"""The value instead of a class for a label that is not acted on."""


class Threshold(BaseModel):
    """The threshold from which the labels of a class are acted on, with the results of its calibration.

    Attributes:
        by, at_least: The evidence that is required.
        never: True if no threshold is shown to reach the precision: labels are not acted on; the rest is of the best.
        precision, low: Share of such labels that are right, and the lower end of its one-sided interval.
        voxels, left: Labels of the class with a known truth that were counted; share of all its labels that is left.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    by: Evidence = "op"
    at_least: float = 0.0
    never: bool = False
    precision: float = 0.0
    low: float = 0.0
    voxels: int = 0
    left: float = 0.0


class AcceptanceThresholds(BaseModel):
    """The labels of a map that may be acted on, as a YAML file stores them.

    Attributes:
        schema: Version of the file.
        precision, confidence: Labels of a class that are acted on are right with at least this probability; a class'
            threshold promises too much with a probability of at most 1 - confidence.
        voxel_size: Edge of the voxels that they hold for, metres.
        calibrated_on: Runs that they come from.
        left: Share of the calibration's voxels whose label is acted on.
        classes: The threshold of each class.

    Examples:
        >>> road = {"by": "op", "at_least": 3, "precision": 0.97}
        >>> given = {"schema": 1, "precision": 0.95, "confidence": 0.95, "voxel_size": 0.5, "classes": {"road": road}}
        >>> thresholds = semstab.AcceptanceThresholds(**given)
        >>> thresholds.classes["road"].at_least
        3.0
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_: int = Field(SCHEMA, alias="schema")
    precision: float = Field(gt=0, lt=1)
    confidence: float = Field(gt=0, lt=1)
    voxel_size: float = Field(gt=0)
    calibrated_on: str = ""
    left: float = 0.0
    classes: dict[str, Threshold]

    @classmethod
    def load(cls, path: str | Path) -> AcceptanceThresholds:
        """Read a file that `save` wrote. Raises ConfigError, which names the file and the setting."""
        result = validated(cls, read_yaml(path), f"{path}: ")
        if result.schema_ != SCHEMA:
            raise ConfigError(f"{path}: schema {result.schema_}, this version reads {SCHEMA}; calibrate again")
        return result

    def save(self, path: str | Path) -> None:
        """Write YAML, atomically."""
        content = self.model_dump(by_alias=True)
        write_text(Path(path), yaml.safe_dump(content, sort_keys=False, allow_unicode=True))

    def decide(self, table: VoxelTable) -> Int64:
        """Return (n,) the class of each voxel whose label may be acted on, by its row in the table's classes, else -1.

        Raises:
            DataError: For a map of other classes, or voxels of another size.
        """
        self.require(table)
        label = dominant(table).astype(np.int64)
        least = np.full((len(EVIDENCE), table.K), np.inf)
        for k, name in enumerate(table.classes):
            chosen = self.classes[name]
            if not chosen.never:
                least[list(EVIDENCE).index(chosen.by), k] = chosen.at_least
        enough = np.zeros(len(table), np.bool_)
        for of, at_least in zip(EVIDENCE.values(), least, strict=True):
            enough |= np.asarray(of(table)) >= at_least[label]
        return np.where(enough, label, NEVER)

    def require(self, table: VoxelTable) -> None:
        """Raise DataError where a map is not of the kind that was calibrated."""
        if not table.classes or set(table.classes) != set(self.classes):
            raise DataError(
                f"the thresholds are of the classes {_few(self.classes)}, the map is of {_few(table.classes)};"
                " calibrate on a run with its taxonomy"
            )
        if not math.isclose(table.voxel_size, self.voxel_size, rel_tol=1e-6):
            raise DataError(
                f"the thresholds are of voxels of {self.voxel_size:g} m, the map is of {table.voxel_size:g} m;"
                f" calibrate on a run with --voxel-size {table.voxel_size:g}"
            )


def calibrate(
    maps: Sequence[tuple[VoxelTable, Truth]], *, precision: float = 0.95, confidence: float = 0.95, on: str = ""
) -> AcceptanceThresholds:
    """Return for each class the threshold of OP, belief or margin that retains most labels at that precision.

    STEPS thresholds of each evidence are tried. One is taken where the lower end of the share of right labels is at
    least the precision, at the error 1 - confidence divided by all that are tried (Bonferroni; as in Angelopoulos et
    al. 2021, Learn then Test). The end is Clopper and Pearson's, at the effective number of labels (Korn and
    Graubard 1998): the variance is that of cubes of space, with errors that reach as far as the data show. Where errors
    are too few for that, cubes are counted instead of labels.

    Args:
        maps: Maps of scenes with the same classes and voxel size, with the true class of their voxels; their errors
            are independent.
        precision: Share of right labels that each class is to reach.
        confidence: Probability with which it reaches that share.
        on: Name of the data, for messages.
    """
    tables = [table for table, _ in maps]
    if not 0 < precision < 1 or not 0.5 <= confidence < 1:
        raise ConfigError(
            f"precision {precision:g}, confidence {confidence:g}: use more than 0 and 0.5 or more, both below 1"
        )
    index = np.concatenate([table.index + np.array([i << 20, 0, 0]) for i, table in enumerate(tables)]).astype(np.int32)
    label = np.concatenate([dominant(table) for table in tables])
    true = np.concatenate([truth.label for _, truth in maps])
    size, names = tables[0].voxel_size, tables[0].classes
    values = {by: np.concatenate([np.asarray(of(table), float) for table in tables]) for by, of in EVIDENCE.items()}
    result = {}
    for k, name in enumerate(names):
        rows = np.flatnonzero((label == k) & (true >= 0))
        evidence = {by: value[rows] for by, value in values.items()}
        sample = _ClassLabels(index[rows], true[rows] == k, evidence, size)
        result[name] = sample.least(precision, 1 - confidence)
    thresholds = AcceptanceThresholds(
        schema=SCHEMA, precision=precision, confidence=confidence, voxel_size=size, calibrated_on=on, classes=result
    )
    decided = [thresholds.decide(table) for table in tables]
    retained = float((np.concatenate(decided) >= 0).mean())
    of_class = {
        name: float((np.concatenate(decided) == k).sum() / max((label == k).sum(), 1)) for k, name in enumerate(names)
    }
    classes = {name: threshold.model_copy(update={"left": of_class[name]}) for name, threshold in result.items()}
    return thresholds.model_copy(update={"left": retained, "classes": classes})


class _ClassLabels:
    """The labels of one class: their location (n, 3), their correctness (n,), and their evidence (n,) of each kind."""

    def __init__(self, index: Int32, right: Mask, evidence: Mapping[Evidence, Float64], size: float) -> None:
        self._right, self._evidence = right, evidence
        if len(index):
            self._cell, self._of, self._edge = cubes_of((index[:, 0], index[:, 1], index[:, 2]), size)

    def least(self, precision: float, error: float) -> Threshold:
        """Return the threshold that retains most of them."""
        tried, retained = self._tried()
        best = Threshold(never=True)
        for by, at in sorted(tried, key=lambda pair: -retained[pair]):
            share, low = self._share(by, at, error / len(tried))
            result = Threshold(
                by=by, at_least=at, never=low < precision, precision=share, low=low, voxels=retained[by, at]
            )
            if low >= precision:
                return result
            best = max(best, result, key=lambda threshold: threshold.low)
        return best

    def _tried(self) -> tuple[list[tuple[Evidence, float]], dict[tuple[Evidence, float], int]]:
        """Return thresholds that retain different labels, chosen without the truth, and how many each retains."""
        tried: dict[bytes, tuple[Evidence, float]] = {}
        retained = {}
        for by, values in self._evidence.items() if len(self._right) else ():
            for at in np.unique(np.quantile(values, np.arange(STEPS) / STEPS, method="lower")).tolist():
                accepted = values >= at
                retained[tried.setdefault(np.packbits(accepted).tobytes(), (by, at))] = int(accepted.sum())
        return list(tried.values()), retained

    def _share(self, by: Evidence, at: float, error: float) -> tuple[float, float]:
        """Return the share of those with so much evidence that is right, and its lower end."""
        accepted = self._evidence[by] >= at
        of, cells = self._of[accepted], len(self._cell)
        right, ones = self._right[accepted].astype(np.float64), np.ones(len(of))
        sums: Float64 = np.stack([np.bincount(of, w, cells) for w in (right, ones)], axis=1).astype(np.float64)
        sums = sums[sums[:, 1] > 0]
        if np.count_nonzero(sums[:, 0] < sums[:, 1]) <= FEW_CUBES:
            return share_of_few_cubes(sums, error)
        there = ClusterSums.of_cubes(self._cell[np.unique(of)], self._edge, {"right": sums})
        result = estimate(there, mean_functional("right"), level=1 - 2 * error)
        return result.value, result.low if result.decided else 0.0


def share_of_few_cubes(sums: Float64, error: float) -> tuple[float, float]:
    """Return the share that is right and its lower end, where few cubes (m, 2) hold an error.

    Cubes, of one size, count as right or wrong as a whole (Clopper and Pearson 1934).
    """
    from scipy import special

    right, size = sums.sum(axis=0)
    cubes = size**2 / float((sums[:, 1] ** 2).sum())
    wrong = max(np.count_nonzero(sums[:, 0] < sums[:, 1]), cubes * (1 - right / size))
    low = float(special.betaincinv(cubes - wrong, wrong + 1, error)) if cubes > wrong else 0.0
    return float(right / size), low


def _few(names: Sequence[str] | Mapping[str, Threshold]) -> str:
    listed = list(names)
    return ", ".join(listed[:4]) + (", ..." if len(listed) > 4 else "") if listed else "no names"
