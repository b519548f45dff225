"""Measures of a voxel: each is declared once, with its formula, its name, its digits and the direction that is good.

Summaries, comparisons, tables, figures, Parquet, the terminal and the recording take them from here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from semstab.core.json_form import number
from semstab.core.types import Float64, Int32, Int64, Mask
from semstab.data.evidence import Evidence, row_chunks
from semstab.data.information import Concentration, entropy_bits, normalise
from semstab.errors import ConfigError

RECURRENT = 3
"""The least OP of the voxels over which the mean of a measure is printed, if nothing else is stated (paper, Sensitivity
to World-Space Association): a voxel that was seen once looks perfectly stable."""

Values = TypeVar("Values", bound=npt.NDArray[Any])


class Beliefs(Protocol):
    """The arguments of a measure, for n voxels: a VoxelTable has them, and a growing map."""

    @property
    def op(self) -> Int32:
        """(n,) the number of frames that saw the voxel."""

    @property
    def evidence(self) -> Float64 | Evidence:
        """(n, K) evidence of each class, up to a factor."""

    @property
    def drift_sum(self) -> Float64:
        """(n,) sum over t >= 2 of D_JS(p^(t), p^(t-1)), bits."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Voxels whose evidence is dense, on which formulas are computed."""

    op: Int32
    evidence: Float64
    drift_sum: Float64


@dataclass(frozen=True, eq=False)
class Voxels:
    """Voxels whose evidence is stored by its entries."""

    op: Int32
    evidence: Evidence
    drift_sum: Float64


def chunks(table: Beliefs) -> Iterator[Rows]:
    """Return the voxels, few enough at a time for dense evidence."""
    n, K = table.evidence.shape
    return (Rows(table.op[chunk], table.evidence[chunk], table.drift_sum[chunk]) for chunk in row_chunks(n, K))


def by_chunk(formula: Callable[[Rows], Values]) -> Callable[[Beliefs], Values]:
    """Return a formula of voxels, computed without dense evidence of all of them."""

    @functools.wraps(formula)
    def of_table(table: Beliefs) -> Values:
        values: Values = np.concatenate([formula(rows) for rows in chunks(table)])  # type: ignore[assignment]
        return values

    return of_table


def whole(formula: Callable[[Beliefs], Values]) -> Callable[[Beliefs], Values]:
    """Return a formula of voxels that needs no dense evidence of them."""
    formula.whole = True  # type: ignore[attr-defined]
    return formula


def by_row(
    of_concentration: Callable[[Concentration], Values],
) -> Callable[[Callable[[Rows], Values]], Callable[[Beliefs], Values]]:
    """Return a formula of voxels that reads the concentration where evidence is stored by its entries."""

    def decorate(formula: Callable[[Rows], Values]) -> Callable[[Beliefs], Values]:
        @whole
        @functools.wraps(formula)
        def of_table(table: Beliefs) -> Values:
            evidence = table.evidence
            if isinstance(evidence, Evidence):
                return of_concentration(evidence.concentration)
            return formula(Rows(table.op, evidence, table.drift_sum))

        return of_table

    return decorate


@dataclass(frozen=True, eq=False, kw_only=True)
class Quantity:
    """A number that is reported.

    Attributes:
        key: Its name in rules of a gate, and among columns that have a value a voxel.
        title: Title in print; `short` is the title for little room, `unit` its unit or ''.
        better: Direction that is good.
        digits: Decimals in the summary of a map, and in a comparison of maps.
        needs: Source: the voxel table, the log of events as well, or the ground truth as well.
        section: Section of the paper that defines it, if any.
        op: Least OP of the voxels that the number is about; 0 for a number of something else.
    """

    key: str
    title: str
    better: Literal["higher", "lower"]
    digits: tuple[int, int] = (3, 4)
    unit: str = ""
    needs: Literal["table", "events", "truth"] = "table"
    section: str = ""
    short: str = ""
    op: int = 0

    @property
    def population(self) -> str:
        """The voxels that it is a number of: 'OP>=3'; '' for a number of something else."""
        return f"OP>={self.op}" if self.op else ""

    @property
    def name(self) -> str:
        """The key with the population, as tables and JSON have it: 'vss_op3'."""
        return f"{self.key}_op{self.op}" if self.op else self.key

    @property
    def full_title(self) -> str:
        """The title with the population: 'VSS (OP>=3)'; two numbers of one name are one number."""
        return f"{self.title} ({self.population})" if self.op else self.title

    @property
    def word(self) -> str:
        """The title within a sentence: 'VSS', 'IoU', 'entropy'."""
        return f"{self.title[0].lower()}{self.title[1:]}" if self.title[1:].islower() else self.title

    @property
    def symbol(self) -> str:
        """Title for little room."""
        return self.short or self.word

    @property
    def sign(self) -> float:
        """Values times this sort the best first."""
        return 1.0 if self.better == "lower" else -1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Measure(Quantity):
    """A number of each voxel, from 0 to `largest`.

    Attributes:
        of: Computes it: (n,), NaN if undefined; from dense evidence, some voxels at a time.
        lowest_op: Lowest OP at which it is defined.
        range: Range of its colours, in which maps differ; values beyond look like the ends.
        panel: Whether it has a panel in the figure of a map: not where another one shows the same areas.
        chart: Whether the report draws it against OP.
        headline: Whether the terminal's row of a model and the report's card of it have it, of the recurrent voxels.
    """

    of: Callable[[Beliefs], Float64]
    range: tuple[float, float]
    lowest_op: int = 1
    largest: float = 1.0
    panel: bool = True
    chart: bool = False
    headline: bool = False
    op: int = RECURRENT

    def __post_init__(self) -> None:
        if not hasattr(self.of, "whole"):
            object.__setattr__(self, "of", by_chunk(self.of))


# --- Formulas ---------------------------------------------------------------------------------------------------------


@by_row(lambda concentration: concentration.largest)
def vss(table: Rows) -> Float64:
    """Return the Voxel Semantic Stability (n,): max_k e_k / sum_k e_k, in [1/K, 1]; read it with OP."""
    concentration: Float64 = table.evidence.max(axis=1) / table.evidence.sum(axis=1)
    return concentration


@whole
def sbd(table: Beliefs) -> Float64:
    """Return the Semantic Belief Drift (n,): mean over t = 2..T of D_JS(p^(t), p^(t-1)), bits, in [0, 1].

    NaN for OP < 2.
    """
    return mean_drift(table.drift_sum, table.op)


def mean_drift(drift_sum: Float64, op: Int32) -> Float64:
    """Return SBD (n,) from the summed drift in bits (n,) and OP (n,); see `sbd`."""
    mean = np.full(len(op), np.nan)
    np.divide(drift_sum, op - 1, out=mean, where=op >= 2)
    return mean


def op(table: Beliefs) -> Int32:
    """Return the Observation Persistence (n,): the number of frames that observed the voxel."""
    return table.op


@whole
def entropy(table: Beliefs) -> Float64:
    """Return normalised entropy (n,): -sum_k p_k log p_k / log K, in [0, 1]; report it together with K."""
    return bits(table) / math.log2(table.evidence.shape[1])


@by_row(lambda concentration: concentration.bits)
def bits(table: Rows) -> Float64:
    """Return the entropy (n,): -sum_k p_k log2 p_k, bits."""
    return entropy_bits(normalise(table.evidence))


@by_row(lambda concentration: concentration.lead)
def margin(table: Rows) -> Float64:
    """Return how far the dominant class is ahead (n,): the largest belief less the second largest, in [0, 1]."""
    belief = normalise(table.evidence)
    top = np.arange(len(belief)), belief.argmax(axis=1)
    first = belief[top]
    belief[top] = -np.inf
    lead: Float64 = first - belief.max(axis=1)
    return lead


@by_row(lambda concentration: concentration.label.astype(np.int64))
def dominant(table: Rows) -> Int64:
    """Return the dominant class (n,): argmax_k e_k, the lowest on ties."""
    label: Int64 = table.evidence.argmax(axis=1)
    return label


# --- The register -----------------------------------------------------------------------------------------------------

SBD_MAX = 1.5 - 0.75 * math.log2(3)
"""The largest SBD there is, 0.311 bits: a voxel's second frame sees a class that its first one did not see at all."""

_SECTION = "Voxel-Level Stability Metrics"

VSS = Measure(
    key="vss", title="VSS", better="higher", of=vss, range=(0.5, 1.0), panel=False, chart=True, headline=True,
    section=_SECTION,
)  # fmt: skip
SBD = Measure(
    key="sbd", title="SBD", unit="bits", better="lower", digits=(4, 4), of=sbd, range=(0.0, SBD_MAX), largest=SBD_MAX,
    lowest_op=2, chart=True, headline=True, section=_SECTION,
)  # fmt: skip
ENTROPY = Measure(
    key="entropy", title="Entropy", short="H", better="lower", digits=(4, 4), of=entropy, range=(0.0, 0.5),
    section=_SECTION,
)  # fmt: skip
MARGIN = Measure(key="margin", title="Margin", short="M", better="higher", of=margin, range=(0.0, 1.0), panel=False)

RESERVED = frozenset((
    "accuracy", "advice", "alpha", "alpha_by_meaning", "backend", "categories", "checked", "classes",
    "compensated_flicker_percent", "confused_with", "coverage", "ece", "entropy_between", "entropy_op2",
    "entropy_within", "evidence", "feature_alpha", "files", "flicker_percent", "frames", "frames_empty",
    "frames_left_out", "fuse_ms_per_frame", "image_space", "input", "iou", "K", "key", "label", "left_out",
    "map_summary", "mean_op", "means", "miou", "model", "name", "notes", "observation_accuracy", "observations", "op",
    "pixels", "points", "precision", "psa", "quality", "recurrent", "reduced", "sbd_excess", "sbd_null", "scene",
    "scores_left_out", "series", "share", "stages_ms", "statistics", "strata", "taxonomy", "truth_file", "unit", "up",
    "variation", "video_measures", "voxel_alpha", "voxel_size", "voxels", "voxels_file", "well_seen",
    "wrong_of_consistent",
))  # fmt: skip
"""Keys that no measure may have: fields next to its mean in JSON, other differences of maps, other compared numbers."""

_REGISTER = {measure.key: measure for measure in (VSS, SBD, ENTROPY, MARGIN)}


def measures() -> tuple[Measure, ...]:
    """Return the measures of every summary, in the order of the paper's tables."""
    return tuple(_REGISTER.values())


def headlines() -> tuple[Measure, ...]:
    """Return the measures that the terminal and the cards of the report show of each model."""
    return tuple(measure for measure in measures() if measure.headline)


def register(measure: Measure) -> None:
    """Add a measure to every summary from now on.

    Raises:
        ConfigError: If its key is taken, or is the name of another number or field.
    """
    if measure.key in _REGISTER:
        raise ConfigError(f"there is a measure '{measure.key}' already; choose another key")
    if measure.key in RESERVED or measure.key.endswith("_voxels"):
        raise ConfigError(f"'{measure.key}' is the name of another number or field; choose another key")
    _REGISTER[measure.key] = measure


@contextmanager
def registered(measure: Measure) -> Iterator[None]:
    """Add a measure while the block lasts."""
    register(measure)
    try:
        yield
    finally:
        del _REGISTER[measure.key]


# --- Means ------------------------------------------------------------------------------------------------------------


def mean(values: npt.NDArray[Any]) -> float:
    """Return the mean of the defined values, or NaN without defined values."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else math.nan


@dataclass(frozen=True)
class MeasureMeans:
    """The mean of every measure over a group of voxels, by its key; NaN if undefined.

    `voxels` has the number of voxels behind the mean, for the measures that do not exist at every OP. In JSON these are
    entries KEY and KEY_voxels of the group's object.
    """

    value: Mapping[str, float]
    voxels: Mapping[str, int]

    @classmethod
    def over(cls, values: Mapping[Measure, Float64], op: Int32, where: Mask) -> MeasureMeans:
        """Return the means of each measure's values (n,) over the voxels for which `where` (n,) holds."""
        rare = {m.key: int(np.count_nonzero(where & (op >= m.lowest_op))) for m in values if m.lowest_op > 1}
        return cls({measure.key: mean(value[where]) for measure, value in values.items()}, rare)

    @classmethod
    def of_sums(cls, sums: Float64) -> MeasureMeans:
        """Make it of (3 M,): each measure's sum, over how many voxels it is defined, and in how many OP is enough."""
        of = dict(zip(measures(), sums.reshape(-1, 3), strict=True))
        value = {measure.key: float(total) / n if n else math.nan for measure, (total, n, _) in of.items()}
        return cls(value, {m.key: int(often) for m, (_, _, often) in of.items() if m.lowest_op > 1})

    def __getitem__(self, measure: Measure) -> float:
        return self.value[measure.key]

    def of_all(self) -> list[float]:
        """Return the mean of every measure, in their order."""
        return [self[measure] for measure in measures()]

    def json_content(self) -> dict[str, float]:
        """Return entries by key."""
        return {**self.value, **{f"{key}_voxels": n for key, n in self.voxels.items()}}

    @classmethod
    def of_json_content(cls, content: Any) -> MeasureMeans:
        """Return the entries of all measures; a measure that was declared later gets NaN, over 0 voxels."""
        rare = {m.key: content.get(f"{m.key}_voxels", 0) for m in measures() if m.lowest_op > 1}
        return cls({measure.key: number(content.get(measure.key)) for measure in measures()}, rare)
