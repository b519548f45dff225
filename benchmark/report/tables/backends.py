"""Make the tables of fusion backends: the same frames through each, and where their maps differ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from semstab.config import BACKENDS
from semstab.data.measures import measures
from semstab.data.records import Record, Result
from semstab.data.results import Agreement
from semstab.data.statistics import CONFIDENCE, CorrectnessStatistics
from semstab.metrics.summary import macro_mean
from semstab.report.means import Pooled, pooled
from semstab.report.tables.stability import SBD_OVER, of_measures, settings
from semstab.report.tables.table import ALL_VOXELS, Column, Group, Row, Table
from semstab.statistics.correctness import ACCURACY, BRIER, ECE, MIOU

# The fusion implementations: the same frames through every backend, and the differences of the measures.

DIFFERENCE = "Difference to the first"
LARGEST = "Largest difference"
SEEN_TWICE = "OP>=2"
"""The stratum of voxels that were seen twice or more."""


def fusion(result: Result) -> list[Table]:
    """Return each backend and the base one side by side, over the scenes that every backend fused."""
    groups = tuple(group for name in result.models if (group := _group(result, name)) is not None)
    if not groups:
        return []
    columns = (
        Column("backend", "Backend"),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(over=ALL_VOXELS, compared=True),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        Column("fuse_ms_per_frame", "ms per frame", 1, "lower"),
        Column("delta_voxels", "Voxels", 0, signed=True, over=DIFFERENCE),
        Column("delta_mean_op", "OP", 2, signed=True, over=DIFFERENCE),
        *(Column(f"delta_{m.key}_all", m.title, m.digits[1], signed=True, over=DIFFERENCE) for m in measures()),
    )
    caption = (
        f"{settings(result.select())} The means are pooled: they run over the voxels of all scenes together; ms per"
        f" frame is the macro mean. The base backend is first. {SBD_OVER}"
    )
    return [Table("fusion", "Fusion implementations", caption, columns, groups)]


def _group(result: Result, model: str) -> Group | None:
    other_records = result.select(BACKENDS, model=model)
    by_backend: dict[str, dict[str, Record]] = {}
    for record in (*result.select(model=model), *other_records):
        by_backend.setdefault(record.unit.backend, {})[record.unit.scene] = record
    scenes = set.intersection(*(set(rows) for rows in by_backend.values()))
    if not other_records or not scenes:
        return None
    means = {name: pooled([row for scene, row in rows.items() if scene in scenes]) for name, rows in by_backend.items()}
    base = means[result.backend]
    return Group(model, tuple(_backend_row(name, mean, base) for name, mean in means.items()))


def _backend_row(backend: str, mean: Pooled, base: Pooled) -> Row:
    return (
        backend,
        mean.voxels,
        mean.mean_op,
        *mean.every.means.of_all(),
        100 * mean.recurrent.share,
        mean.fuse_ms_per_frame,
        mean.voxels - base.voxels,
        mean.mean_op - base.mean_op,
        *(mean.every[measure] - base.every[measure] for measure in measures()),
    )


def fusion_correctness(result: Result) -> list[Table]:
    """Return how right each backend's labels are, over the scenes that every backend fused; none without truth."""
    groups = []
    for model in result.models:
        rows: dict[str, dict[str, CorrectnessStatistics]] = {}
        for record in (*result.select(model=model), *result.select(BACKENDS, model=model)):
            if record.statistics is not None and record.statistics.correctness is not None:
                rows.setdefault(record.unit.backend, {})[record.unit.scene] = record.statistics.correctness
        scenes = set.intersection(*(set(of_backend) for of_backend in rows.values())) if rows else set()
        if len(rows) > 1 and scenes:
            of_rows = (
                (name, [correctness for scene, correctness in by.items() if scene in scenes])
                for name, by in rows.items()
            )
            groups.append(Group(model, tuple((name, *_right(correctness)) for name, correctness in of_rows)))
    if not groups:
        return []
    columns = (
        Column("backend", "Backend"), *(Column.for_quantity(quantity) for quantity in (ACCURACY, MIOU, ECE, BRIER)),
    )  # fmt: skip
    caption = (
        f"{settings(result.select())} The table shows the voxels seen twice or more with a true class. ECE is the"
        " expected calibration error of the largest belief; Brier is the Brier score, 0 to 2. They are macro means:"
        " each scene counts once. The base backend is first."
    )
    return [Table("fusion_correctness", "Accuracy of fusion", caption, columns, tuple(groups))]


def _right(scenes: Sequence[CorrectnessStatistics]) -> tuple[float, ...]:
    """Return the macro means of accuracy, mIoU, ECE and Brier score at OP >= 2."""
    repeated = [next(row for row in correctness.strata if row.name == SEEN_TWICE) for correctness in scenes]
    numbers = zip(*((row.accuracy, row.miou, row.ece, row.brier) for row in repeated), strict=True)
    return tuple(macro_mean(column) for column in numbers)


def compared(result: Result) -> list[Table]:
    """Return the differences of maps by backends that fuse in another way than the base one."""
    if not result.compared:
        return []
    titles = {"op": "OP", **{measure.key: measure.title for measure in measures() if not measure.lowest_op > 1}}
    columns = (
        Column("scene", "Scene"),
        Column("model", "Model"),
        Column("first_only_percent", "in the first only (%)", 1, over="Voxels"),
        Column("other_only_percent", "in the other only (%)", 1, over="Voxels"),
        Column("relabelled_percent", "Other label (%)", 2),
        *(Column(f"mean_{name}", header, 4, over="Mean difference") for name, header in titles.items()),
    )
    pairs = dict.fromkeys(row.backends for row in result.compared)
    groups = tuple(
        Group(" and ".join(pair), tuple(_compared_row(row, titles) for row in result.compared if row.backends == pair))
        for pair in pairs
    )
    caption = (
        "The same frames were fused by another rule, or by backends that associate pixels and voxels in another way;"
        " their maps need not agree. Labels and differences, which have no sign, are of the voxels that both maps have."
    )
    return [Table("fusion_compared", "Differences of fusion implementations", caption, columns, groups, "backends")]


def _compared_row(row: Agreement, names: Iterable[str]) -> Row:
    shares = (100 * only / max(1, n) for only, n in zip(row.only_in, row.voxels, strict=True))
    means = (row.difference(name).mean for name in names)
    return row.scene, row.model, *shares, 100 * row.differences["label"].mean, *means


def agreement(result: Result) -> list[Table]:
    """Return the agreement of each backend's map with the base one's, voxel by voxel."""
    if not result.agreement:
        return []
    differ = any(row.first for row in result.agreement)
    titles = {"op": "OP", **{measure.key: measure.title for measure in measures()}, "evidence": "Evidence"}
    columns = (
        Column("scene", "Scene"),
        Column("model", "Model"),
        Column("only_in_one", "Voxels in one only", 0),
        *(Column(f"max_{name}", header, 0, scientific=True, over=LARGEST) for name, header in titles.items()),
        Column("verdict", "Verdict"),
        *([Column("first", "First difference")] if differ else []),
    )
    pairs = dict.fromkeys(row.backends for row in result.agreement)
    rows = [
        (row.backends, (*_backend_agreement_row(row, titles), *([str(row.first or "")] if differ else [])))
        for row in result.agreement
    ]
    groups = tuple(
        Group(" and ".join(pair), tuple(row for backends, row in rows if backends == pair)) for pair in pairs
    )
    caption = (
        "Two backends fused the same frames. The table shows the largest difference of any voxel that both maps have."
    )
    if fraction := one_in(result.agreement):
        caption += f" With the numpy reference, {fraction} voxels were compared, drawn at random."
    return [Table("agreement", "Agreement of the fusion implementations", caption, columns, groups, "backends")]


def _backend_agreement_row(row: Agreement, names: Iterable[str]) -> Row:
    largest = (row.difference(name).max for name in names)
    return row.scene, row.model, sum(row.only_in), *largest, "agree" if row.agrees else "disagree"


def largest_share(voxels: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper limit, at this confidence, of the share of wrong voxels if a sample of `voxels` holds none.

    With the share p all are right with probability (1 - p)^n: the upper end of Clopper and Pearson (1934) for none.

    >>> round(100 * largest_share(1595), 2)
    0.19
    """
    return float(1 - (1 - confidence) ** (1 / voxels))


def one_in(rows: Sequence[Agreement]) -> str:
    """Return which share of the voxels was compared: '1 in 64', '1 in 64 to 128'; '' where all were."""
    fractions = sorted({row.one_in for row in rows})
    return (
        "" if fractions in ([], [1]) else f"1 in {' to '.join(map(str, dict.fromkeys((fractions[0], fractions[-1]))))}"
    )
