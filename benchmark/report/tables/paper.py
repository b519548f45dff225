"""Make the tables that compare a study with the paper: findings and numbers of both."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from semstab.config import SHARED
from semstab.data.measures import ENTROPY, SBD, VSS
from semstab.data.records import Record, Result
from semstab.data.results import Means
from semstab.metrics import macro_mean
from semstab.report.means import Level, Pooled, by_model, levels, over_all, over_recurrent, pooled
from semstab.report.tables.table import Column, Group, Row, Table

STUDIES = ("paper", "uavid3d")
"""The studies of the paper's protocol: on the built-in city, and on the paper's own data."""

OPEN, CLOSED = "SegEarth-OV", "SegFormer"
"""The two models of the paper that are compared; its other tables are of the first one."""

STANDS_FOR = {"sim-flicker": OPEN, "sim-steady": CLOSED, "segearth-ov": OPEN, "segformer": CLOSED}
"""The model of a study that stands for one of the paper's."""

NEARLY = 1 / 3
"""A change is little if it is less than this fraction of the change that it is compared with."""

Numbers = tuple[float, float, float, float]
"""Percent of the voxels, VSS, SBD in bits, normalised entropy."""

STRATA: Mapping[str, Numbers] = {
    "OP=1": (57.89, 1.0, math.nan, 0.0), "OP=2": (20.32, 0.873, 0.0790, 0.1602),
    "3<=OP<=5": (18.02, 0.869, 0.0454, 0.2285), "OP>5": (3.77, 0.870, 0.0216, 0.2530),
}  # fmt: skip
"""Paper, Observation Persistence."""

CLASSES: Mapping[str, Numbers] = {
    "building": (286_565 / 7059.02, 0.939, 0.0626, 0.0464), "road": (207_895 / 7059.02, 0.915, 0.0913, 0.0685),
    "tree": (97_988 / 7059.02, 0.929, 0.0851, 0.0612), "low vegetation": (102_703 / 7059.02, 0.961, 0.0393, 0.0375),
    "moving car": (10_564 / 7059.02, 0.960, 0.0498, 0.0403),
}  # fmt: skip
"""Paper, Class-wise Stability; of its 705,902 voxels."""

ALL: Numbers = (100.0, 0.957, 0.0845, 0.0336)
"""Paper, Multi-Scene Voxel-Level Stability: the means over scenes."""

SHARED_TAXONOMY: Mapping[str, tuple[Numbers, Numbers]] = {
    OPEN: ((100.0, 0.9657, 0.0661, math.nan), (21.79, 0.8692, 0.0413, math.nan)),
    CLOSED: ((100.0, 0.9848, 0.0380, math.nan), (15.29, 0.9410, 0.0186, math.nan)),
}
"""Paper, Cross-Backbone Temporal Stability: of all voxels, and of those with OP >= 3."""

FLICKER = {"SAM + heuristic": 29.47, "Raw SAM proposals": 21.64, CLOSED: 25.39, OPEN: 15.73}
"""Paper, Frame-wise Semantic Flicker: mean flicker in percent."""


def paper(result: Result) -> list[Table]:
    """Return the findings of the paper with whether they hold in the study, and the numbers of both."""
    models = {STANDS_FOR[name]: name for name in result.models if name in STANDS_FOR}
    if result.name not in STUDIES or OPEN not in models:
        return []
    stand_ins = " and ".join(
        f"{model} stands for {paper_name}"
        for paper_name, model in models.items()
        if model.lower() != paper_name.lower()
    )
    remark = f" Here {stand_ins}; absolute numbers are not comparable, the findings are." if stand_ins else ""
    return [_findings(result, models, remark), _numbers(result, models, remark)]


@dataclass(frozen=True)
class Finding:
    """A finding of the paper, by numbers of the paper and of the study in the same order.

    Attributes:
        digits: Decimals in print.
        holds: True if the study's numbers show it, too; None without such numbers in the study.
    """

    text: str
    theirs: Sequence[float]
    ours: Sequence[float]
    digits: int
    holds: bool | None

    def row(self) -> Row:
        """Return its row of the table."""
        published, measured = (
            " → ".join(f"{value:.{self.digits}f}" for value in values) for values in (self.theirs, self.ours)
        )
        held = "--" if self.holds is None else "yes" if self.holds else "no"
        return self.text, published, "--" if self.holds is None else measured, held


def falls(values: Sequence[float]) -> bool:
    """Return whether each value is below the one before it."""
    return all(a > b for a, b in itertools.pairwise(values))


def _finding(text: str, published: Sequence[float], measured: Sequence[float], digits: int) -> Finding:
    """Return a finding that numbers fall, or rise, as the paper's numbers do."""
    is_defined = len(measured) == len(published) and not any(map(math.isnan, measured))
    holds = falls(measured) if falls(published) else falls([-value for value in measured])
    return Finding(text, published, measured, digits, holds if is_defined else None)


def _changes_little(
    text: str, published: Sequence[float], measured: Sequence[float], held: float, digits: int
) -> Finding:
    """Return a finding that numbers hardly change, beside a change that `held` is."""
    if len(measured) != len(published) or any(map(math.isnan, (*measured, held))):
        return Finding(text, published, measured, digits, None)
    return Finding(text, published, measured, digits, abs(measured[-1] - measured[0]) < NEARLY * abs(held))


def _findings(result: Result, models: Mapping[str, str], remark: str) -> Table:
    columns = (Column("finding", "Finding"), Column("paper", "Paper"), Column("here", "Here"), Column("holds", "Holds"))
    groups = (
        Group("Observation persistence", tuple(finding.row() for finding in _persistence(result, models[OPEN]))),
        Group("Two models in one taxonomy", tuple(finding.row() for finding in _order(result, models))),
        Group("World-space association", tuple(finding.row() for finding in _association(result, models[OPEN]))),
    )
    caption = (
        "The findings of the paper (arXiv:2608.28665) in its numbers, and in those of this study. 'Little' holds where"
        " the change is less than a third of that of all voxels above it."
    )
    return Table("findings", "Findings of the paper", caption + remark, columns, groups)


def _persistence(result: Result, model: str) -> Iterator[Finding]:
    strata = {row.name: row for row in pooled(result.select(model=model)).strata}
    recurrent = pooled(result.select(model=model)).recurrent
    once = strata["OP=1"][VSS] if "OP=1" in strata else math.nan
    published = [STRATA["OP=1"][1], STRATA["3<=OP<=5"][1]]
    yield _finding("VSS: seen once → OP>=3", published, [once, recurrent[VSS]], 3)
    repeated = [name for name in STRATA if name != "OP=1"]
    measured = [strata[name][SBD] for name in repeated if name in strata]
    yield _finding("SBD falls with OP: 2 → 3 to 5 → more", [STRATA[name][2] for name in repeated], measured, 4)


def _order(result: Result, models: Mapping[str, str]) -> Iterator[Finding]:
    records = result.select(SHARED) or result.select()
    means = {paper_name: pooled([r for r in records if r.unit.model == name]) for paper_name, name in models.items()}
    compared: Sequence[tuple[str, int, int, Callable[[Pooled], float]]] = (
        ("VSS of all voxels", 0, 1, over_all(VSS)),
        ("VSS of voxels with OP>=3", 1, 1, over_recurrent(VSS)),
        ("SBD of voxels with OP>=3", 1, 2, over_recurrent(SBD)),
        ("share of voxels with OP>=3, %", 1, 0, _share),
    )
    for text, row, column, take in compared:
        published = [SHARED_TAXONOMY[name][row][column] for name in (OPEN, CLOSED)]
        measured = [take(means[name]) for name in (OPEN, CLOSED) if name in means]
        yield _finding(f"{text}: {OPEN} → {CLOSED}", published, measured, 2 if column == 0 else 4)


def _association(result: Result, model: str) -> Iterator[Finding]:
    sweeps = {name: levels(result, name, model) for name in ("voxel_size", "depth_noise", "frame_count")}
    voxels, frames = _ends(sweeps["voxel_size"]), _ends(sweeps["frame_count"])
    noise = _ends([level for level in sweeps["depth_noise"] if level.value <= 0.003])
    yield _finding("Voxels of 0.1 → 0.4 m: share with OP>=3, %", (3.90, 42.61), _each(voxels, _share), 2)
    yield _finding("and VSS of all voxels", (0.9824, 0.9274), _each(voxels, over_all(VSS)), 4)
    yield _finding("Depth noise of 0 → 0.3 %: share with OP>=3, %", (22.12, 9.81), _each(noise, _share), 2)
    yield _finding("and VSS of all voxels", (0.9569, 0.9777), _each(noise, over_all(VSS)), 4)
    yield _finding("20 → 80 frames: share with OP>=3, %", (1.61, 18.99), _each(frames, _share), 2)
    aggregate = _each(frames, over_all(VSS))
    yield _finding("and VSS of all voxels", (0.9805, 0.9400), aggregate, 4)
    held = aggregate[-1] - aggregate[0] if aggregate else math.nan
    recurrent = _each(frames, over_recurrent(VSS))
    yield _changes_little("and little VSS of those with OP>=3", (0.8544, 0.8446), recurrent, held, 4)


def _ends(of_sweep: Sequence[Level]) -> Sequence[Level]:
    return (of_sweep[0], of_sweep[-1]) if len(of_sweep) > 1 else ()


def _each(of_sweep: Sequence[Level], take: Callable[[Pooled], float]) -> list[float]:
    return [level.mean(take) for level in of_sweep]


def _share(voxels: Pooled) -> float:
    return 100 * voxels.recurrent.share


# --- Numbers side by side ---------------------------------------------------------------------------------------------


def _numbers(result: Result, models: Mapping[str, str], remark: str) -> Table:
    measured = (
        Column("percent", "Voxels (%)", 2), Column("vss", "VSS", 4), Column("sbd", "SBD", 4),
        Column("entropy", "Entropy", 4),
    )  # fmt: skip
    columns = (
        Column("what", ""),
        *(Column(f"paper_{c.key}", c.header, c.digits, over="Paper") for c in measured),
        *(Column(f"here_{c.key}", c.header, c.digits, over="Here") for c in measured),
    )
    of_model = result.select(model=models[OPEN])
    together = pooled(of_model)
    strata, classes = {row.name: row for row in together.strata}, {row.name: row for row in together.classes}
    everywhere: Row = ("all voxels", *ALL, *_macro(of_model))
    groups = [
        Group("All scenes, means over scenes", (everywhere,)),
        Group("By observation persistence", tuple(_beside(STRATA, strata))),
        Group("By class", tuple(_beside(CLASSES, classes))),
    ]
    records = result.select(SHARED) or result.select()
    for paper_name, name in models.items():
        voxels = pooled([record for record in records if record.unit.model == name])
        all_voxels, recurrent = SHARED_TAXONOMY[paper_name]
        rows: tuple[Row, ...] = (
            ("all voxels", *all_voxels, *_of(voxels.every)),
            ("OP>=3", *recurrent, *_of(voxels.recurrent)),
        )
        groups.append(Group(f"{paper_name} in the shared taxonomy", rows))
    flicker = {
        name: macro_mean([record.image_space.flicker_percent for record in rows])
        for name, rows in by_model(result.select()).items()
    }
    caption = (
        "The numbers of the paper (arXiv:2608.28665, SegEarth-OV unless said) beside those of this study, whose tables"
        " have all of its own. Mean flicker in percent, paper:"
        f" {', '.join(f'{name} {value:.2f}' for name, value in FLICKER.items())}; here:"
        f" {', '.join(f'{name} {value:.2f}' for name, value in flicker.items())}."
    )
    return Table("published", "Numbers of the paper", caption + remark, columns, tuple(groups))


def _beside(published: Mapping[str, Numbers], measured: Mapping[str, Means]) -> Iterator[Row]:
    for name, numbers in published.items():
        yield name, *numbers, *(_of(measured[name]) if name in measured else (math.nan,) * 4)


def _of(means: Means) -> Numbers:
    return 100 * means.share, means[VSS], means[SBD], means[ENTROPY]


def _macro(records: Sequence[Record]) -> Numbers:
    tables = [record.map_summary for record in records]
    vss, sbd, entropy = (macro_mean([table[measure] for table in tables]) for measure in (VSS, SBD, ENTROPY))
    return 100.0, vss, sbd, entropy
