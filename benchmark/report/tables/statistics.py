"""Make the tables of each map's statistics: agreement, drift, uncertainty and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from semstab.data.measures import ENTROPY, VSS
from semstab.data.records import Record, Result
from semstab.data.statistics import (
    CONFIDENCE,
    UNDEFINED,
    ClassAlpha,
    DriftStatistics,
    Estimate,
    MapStatistics,
    OutlyingFrames,
    RangeStratum,
    SpotAgreement,
    metres,
)
from semstab.metrics import macro_mean
from semstab.report.means import by_model
from semstab.report.tables.table import Cell, Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA, ALPHA_BY_MEANING, KAPPA, PSA, VOXEL_ALPHA
from semstab.statistics.drift import FLIP_RATE
from semstab.statistics.frame_disagreement import LEAST_EXCESS, LEAST_PLACES, LEVEL
from semstab.statistics.frame_disagreement import LEAST_FRAMES as LEAST_JUDGED
from semstab.statistics.intervals import LEAST_FRAMES
from semstab.statistics.verdict import ADVICE, DANGEROUS, DECIDED, LEAST_CLASSES, LIMITS

SCENE = Column("scene", "Scene")
REPEATED = Column("repeated_voxels", "Voxels", 0)
INTERVALS = (
    f"Brackets hold intervals at {CONFIDENCE:.0%}: of alpha, PSA and accuracy for this scene flown again if there are"
    f" {LEAST_FRAMES} frames, of other numbers for these frames."
)
NO_LABELS = "it gives features and no labels: see alpha of features"
SEEN_TWICE = "The table shows the voxels seen twice or more."

T = TypeVar("T")
Number = Callable[[MapStatistics], float | Estimate]


def temporal_agreement(result: Result) -> list[Table]:
    """Return alpha with the data that it rests on, and the agreement at voxels, which depends on their size."""
    columns = (
        Column.for_quantity(ALPHA),
        Column.for_quantity(ALPHA_BY_MEANING),
        Column("spots", "Spots", 0),
        Column("views", "Views", 0),
        Column("labelled_percent", "Labelled (%)", 0, "higher"),
        REPEATED,
        *(Column.for_quantity(q, over="OP>=2") for q in (VSS, PSA, KAPPA, VOXEL_ALPHA)),
        Column("within", "within a frame", 3, "lower", over="Disagreement"),
        Column("between", "between frames", 3, "lower", over="Disagreement"),
        Column.for_quantity(FLIP_RATE),
    )
    numbers: tuple[Number, ...] = (
        lambda stats: stats.headline.alpha.ends,
        of_spots(lambda spots: math.nan if spots.meaning is None else spots.meaning.alpha.ends),
        of_spots(lambda spots: spots.spots),
        of_spots(lambda spots: spots.views),
        of_spots(lambda spots: 100 * spots.labelled),
        lambda stats: stats.repeated.voxels,
        lambda stats: stats.agreement.vss_op2.value,
        lambda stats: stats.agreement.psa_op2,
        lambda stats: stats.agreement.kappa_op2.value,
        lambda stats: stats.agreement.voxel_alpha_op2,
        lambda stats: stats.agreement.within.value,
        lambda stats: stats.agreement.between.value,
        lambda stats: math.nan if stats.drift.flips is None else stats.drift.flips.rate.value,
    )
    caption = (
        "Alpha is the agreement of two views at the same spot beyond chance: 1 is perfect, 0 is chance. It is measured"
        " at spots of the surface that two views saw, and does not depend on voxel size. The other numbers are of the"
        " voxels seen twice or more. PSA is the share of pairs of frames that agree about a voxel; kappa (Fleiss) and"
        " voxel alpha (Krippendorff) are the same agreement beyond chance. Disagreement has the parts of 1 - PSA within"
        " a frame and between frames. Flip rate is the share of the steps from one observation to the next at which the"
        f" predicted class changes. {INTERVALS}"
    )
    return by_scene(result, "temporal_agreement", "Agreement of the frames", caption, columns, numbers)


def class_agreement(result: Result) -> list[Table]:
    """Return alpha of each class against all others; macro means over scenes."""
    assessed = assessed_records(result)
    groups = tuple(Group(name, _class_rows([stats for _, stats in rows])) for name, rows in assessed.items())
    if not any(group.rows for group in groups):
        return []
    columns = (
        Column("observations", "Observations", 0),
        Column.for_quantity(ALPHA),
        Column("counts_for_verdict", "Counts for verdict"),
        Column("unstable_percent", "Unstable (%)", 0, "lower"),
        *(Column.for_quantity(q, over="OP>=2") for q in (KAPPA, VOXEL_ALPHA)),
    )
    cells = [row[1:] for group in groups for row in group.rows]
    filled = [k for k in range(len(columns)) if any(_has_content(row[k]) for row in cells)]
    retained = tuple(
        Group(group.name, tuple((row[0], *(row[1 + k] for k in filled)) for row in group.rows)) for group in groups
    )
    caption = (
        "The table compares each class with all others. Observations are the evidence for a class in voxels seen twice"
        " or more, in frames, of all scenes. A class counts for the verdict if it has enough locations. Unstable is the"
        f" probability that its alpha is below {LIMITS.usable:.3f}. Classes that no frame saw are left out. The numbers"
        f" are macro means: each scene counts once. {INTERVALS}"
    )
    title = "Agreement of the frames, by class"
    return [
        Table("class_agreement", title, caption, (Column("class", "Class"), *(columns[k] for k in filled)), retained)
    ]


def ranges(result: Result) -> list[Table]:
    """Return alpha by the distance from which spots were seen, scene by scene."""
    groups = []
    for name, rows in assessed_records(result).items():
        several = len(rows) > 1
        of_model = [
            (
                f"{record.unit.scene}: {_from_to(row)}" if several else _from_to(row),
                100 * row.share,
                row.spots,
                row.alpha if row.is_assessed else "not assessed",
            )
            for record, stats in rows
            if stats.ranges is not None
            for row in stats.ranges.strata
        ]
        groups += [Group(name, tuple(of_model))] if of_model else []
    if not groups:
        return []
    columns = (
        Column("range", "Range (m)"), Column("observations_percent", "Observations (%)", 1),
        Column("spots", "Spots seen twice", 0), Column.for_quantity(ALPHA),
    )  # fmt: skip
    caption = (
        "The range of an observation is the distance from which a spot was seen; two of one spot count together where"
        f" both were made in the same range. Labels can be used where alpha is above {LIMITS.usable:.3f}. A range is"
        f" not assessed where too few spots were seen twice from it, or nearly all of them are one class. {INTERVALS}"
    )
    return [Table("ranges", "Agreement by range", caption, columns, tuple(groups))]


def merges(result: Result) -> list[Table]:
    """Return the merges of classes, scene by scene: each makes alpha as large as one merge can."""
    assessed, groups = assessed_records(result), []
    several = any(len(rows) > 1 for rows in assessed.values())
    for name, rows in assessed.items():
        of_model = [
            (
                *((record.unit.scene,) if several else ()), " + ".join(merge.first), " + ".join(merge.second),
                merge.groups, merge.effective, merge.alpha,
            )
            for record, stats in rows
            if stats.groupings is not None
            for merge in stats.groupings.merges
        ]  # fmt: skip
        groups += [Group(name, tuple(of_model))] if of_model else []
    if not groups:
        return []
    columns = (
        *((Column("scene", "Scene"),) if several else ()),
        Column("first", "Merged"), Column("second", "With"), Column("groups", "Groups left", 0),
        Column("effective", "Effective", 1), Column.for_quantity(ALPHA),
    )  # fmt: skip
    caption = (
        "Of all merges of two groups of classes each row has the one that raises alpha most, until two groups are left."
        " Alpha is that after the merge, less what the choice flatters: by how much, on one half of the space, groups"
        " that were chosen there have a larger alpha than groups that were chosen on the other half. Effective is the"
        " number of groups of equal size whose labels would tell as much."
    )
    return [Table("merges", "Which distinctions between classes hold", caption, columns, tuple(groups))]


def _from_to(stratum: RangeStratum) -> str:
    return f"{stratum.low:g} to {metres(stratum.high)}"


def drift(result: Result) -> list[Table]:
    """Return SBD and the SBD of the same observations in random order."""
    columns = (
        Column("voxels", "Voxels", 0),
        Column("sbd_op2", "observed", 4, over="SBD (bits)"),
        Column("sbd_null_op2", "random order", 4, over="SBD (bits)"),
        Column("sbd_excess_op2", "excess", 4, signed=True, over="SBD (bits)"),
    )
    numbers: tuple[Number, ...] = (
        ordered(lambda drift: drift.voxels),
        ordered(lambda drift: drift.sbd_op2.value),
        ordered(lambda drift: drift.null.value),
        ordered(lambda drift: drift.excess),
    )
    logged = any(r.statistics is not None and r.statistics.drift.flips is not None for r in result.select())
    one_class = f"{SEEN_TWICE[:-1]} in which each frame has one class; --statistics adds the others."
    population = SEEN_TWICE if logged else one_class
    caption = (
        f"{population} Random order is the mean SBD of the same observations over all orders; excess is SBD less that"
        f" mean. {INTERVALS}"
    )
    return by_scene(result, "drift", "Belief drift against random order", caption, columns, numbers)


def frames(result: Result) -> list[Table]:
    """Return the frames that stand out, by the names of their files; a map without any has one row that says so."""
    groups = []
    for model, records in by_model(result.select()).items():
        pairs = [(record, record.outlying_frames) for record in records]
        lines = tuple(
            row for record, outlying in pairs if outlying is not None for row in _frame_rows(record, outlying)
        )
        groups += [Group(model, lines)] if lines else []
    if not groups:
        return []
    columns = (
        SCENE,
        Column("frame", "Frame"),
        Column("places", "Places", 0),
        Column("lone_percent", "alone (%)", 1, "lower", over="Of its places"),
        Column("lone_null_percent", "other frames there (%)", 1, over="Of its places"),
        Column("judged", "Judged", 0),
        Column("unjudged", "Not judged", 0),
    )
    caption = (
        "A frame stands alone at a place where the views that saw it next before and after agree on another class. It"
        " is named if it does so more often than other frames do at the same places, beyond the spread of the frames"
        f" (generalized extreme studentized deviate test, at {LEVEL:g}), and by {LEAST_EXCESS:.0%} of the places or"
        " more. Places are the sampled ones that the frame saw, as two other views did at least. Frames with fewer than"
        f" {LEAST_PLACES} places are not judged, and none is where fewer than {LEAST_JUDGED} frames can be."
    )
    if not result.maps.records:
        caption += " The places of a video are pixels that the frames before and after it show, too, by optical flow."
    return [Table("frames", "Frames that stand out", caption, columns, tuple(groups))]


def _frame_rows(record: Record, outlying: OutlyingFrames) -> Iterator[Row]:
    counts = outlying.judged, outlying.unjudged
    for outlier in outlying.frames:
        yield record.unit.scene, outlier.name, outlier.places, 100 * outlier.share, 100 * outlier.null, *counts
    if not outlying.frames:
        yield record.unit.scene, "none", math.nan, math.nan, math.nan, *counts


def uncertainty(result: Result) -> list[Table]:
    """Return the entropy of the belief, within frames and between them."""
    columns = (
        Column.for_quantity(ENTROPY, over="OP>=2"),
        Column("within", "within frames", 4, "lower"),
        Column("between", "between frames", 4, "lower"),
        Column("within_percent", "within (%)", 0),
    )

    def share(stats: MapStatistics) -> float:
        entropy = stats.uncertainty.entropy_op2.value
        return 100 * stats.uncertainty.within.value / entropy if entropy else math.nan

    numbers: tuple[Number, ...] = (
        lambda stats: stats.uncertainty.entropy_op2,
        lambda stats: stats.uncertainty.within,
        lambda stats: stats.uncertainty.between,
        share,
    )
    caption = (
        f"{SEEN_TWICE} The entropy of the belief, in units of log K, is the sum of the entropy within each frame"
        " (borders, voxels larger than objects, uncertain scores) and of the entropy by the frames' disagreement."
        f" {INTERVALS}"
    )
    return by_scene(result, "uncertainty", "Sources of uncertainty", caption, columns, numbers)


def verdicts(result: Result) -> list[Table]:
    """Return the verdict on each model on each scene, and a recommendation."""
    assessed = assessed_records(result)
    if not assessed:
        return []
    columns = (
        SCENE,
        Column("verdict", "Verdict"),
        Column("of_all", "Of all"),
        Column("probability_percent", "Probability (%)", 0),
        Column.for_quantity(ALPHA),
        Column("labelled_percent", "Labelled (%)", 0, "higher"),
        Column("wrong_of_consistent_op3_percent", "Wrong of consistent (OP>=3, %)", 0, "lower"),
        REPEATED,
        Column("repeated_percent", "of the map (%)", 0),
        Column("advice", "Recommendation"),
    )
    groups = tuple(Group(name, tuple(_verdict_row(*row) for row in rows)) for name, rows in assessed.items())
    caption = (
        "The verdict is the most probable level of alpha for the same scene flown again: stable from"
        f" {LIMITS.stable:g} on, usable from {LIMITS.usable:.3g}, unstable below. It is undecided if no level has"
        f" {DECIDED:.0%}, or the interval holds both limits; of all it is the level if what has no label counts as"
        f" disagreeing; misleading if more than {DANGEROUS:.0%} of the consistent locations are wrong, which only"
        f" ground truth shows; uninformative if a map has fewer than {LEAST_CLASSES:g} effective classes. Labelled is"
        " the share of locations that have a label in half of their observations or more; below"
        f" {LIMITS.labelled:.0%} a model is at most usable. Voxels are those seen twice or more. {INTERVALS}"
    )
    return [Table("verdicts", "Verdicts", caption, columns, groups)]


# --- Parts ------------------------------------------------------------------------------------------------------------


def by_scene(
    result: Result, name: str, title: str, caption: str, columns: Sequence[Column], numbers: Sequence[Number]
) -> list[Table]:
    """Return one row for each scene, and the macro mean of several; columns and units without numbers are left out."""
    cells = {
        model: {record.unit.scene: [take(stats) for take in numbers] for record, stats in rows}
        for model, rows in assessed_records(result).items()
    }
    cells = {model: {scene: row for scene, row in rows.items() if _known(row)} for model, rows in cells.items()}
    filled = sorted({k for rows in cells.values() for row in rows.values() for k in _known(row)})
    if not filled:
        return []

    def row(scene: str, values: Sequence[float | Estimate]) -> Row:
        return scene, *(values[k] for k in filled)

    groups = tuple(
        Group(
            model,
            tuple(row(scene, of_scene) for scene, of_scene in rows.items()),
            row("Mean", _means(list(rows.values()))) if len(rows) > 1 else None,
        )
        for model, rows in cells.items()
        if rows
    )
    return [Table(name, title, caption, (SCENE, *(columns[k] for k in filled)), groups)]


def assessed_records(result: Result) -> dict[str, list[tuple[Record, MapStatistics]]]:
    """Return the base units that have statistics, with these, by model."""
    assessed = {
        model: [(record, record.statistics) for record in records if record.statistics is not None]
        for model, records in by_model(result.select()).items()
    }
    return {model: rows for model, rows in assessed.items() if rows}


def ordered(take: Callable[[DriftStatistics], float | Estimate]) -> Number:
    """Return a function that takes a number of drift; NaN if too few locations give the drift of a random order."""
    return lambda stats: take(stats.drift) if stats.order_known else math.nan


def of_spots(take: Callable[[SpotAgreement], float | Estimate]) -> Number:
    """Return a function that takes a number of the spots; NaN without spots."""
    return lambda stats: math.nan if stats.spots is None else take(stats.spots)


def _value(number: float | Estimate) -> float:
    return number.value if isinstance(number, Estimate) else number


def _has_content(cell: Cell) -> bool:
    value = cell.value if isinstance(cell, Estimate) else cell
    return value != "" and not (isinstance(value, float) and math.isnan(value))


def _known(row: Sequence[float | Estimate]) -> list[int]:
    """Return the positions of the numbers that are defined."""
    return [k for k, cell in enumerate(row) if not math.isnan(_value(cell))]


def _means(rows: Sequence[Sequence[float | Estimate]]) -> list[float]:
    """Return the macro mean of each column."""
    return [macro_mean([_value(cell) for cell in column]) for column in zip(*rows, strict=True)]


def grouped(rows: Iterable[T], name: Callable[[T], str]) -> dict[str, list[T]]:
    """Return the rows of several units by their name, in order of appearance."""
    groups: dict[str, list[T]] = {}
    for row in rows:
        groups.setdefault(name(row), []).append(row)
    return groups


def _class_rows(assessed: Sequence[MapStatistics]) -> tuple[Row, ...]:
    by_name = grouped((row for stats in assessed for row in stats.agreement.classes), lambda row: row.name)
    spots = (stats.spots for stats in assessed if stats.spots is not None)
    alphas: dict[str, list[ClassAlpha]] = grouped(
        (row for of_map in spots for row in of_map.classes), lambda row: row.name
    )
    return tuple(
        (
            name,
            sum(row.observations for row in rows),
            _one_or_mean([row.alpha.ends for row in alphas.get(name, [])]),
            "yes" if any(row.counts_for_verdict for row in alphas.get(name, [])) else "",
            macro_mean([100 * row.unstable for row in alphas.get(name, [])]),
            macro_mean([row.kappa_op2 for row in rows]),
            macro_mean([row.voxel_alpha_op2 for row in rows]),
        )
        for name, rows in by_name.items()
        if any(row.observations for row in rows)
    )


def _one_or_mean(values: Sequence[Estimate]) -> float | Estimate:
    """Return a single value with its interval; of several scenes the macro mean, which has no interval."""
    return values[0] if len(values) == 1 else macro_mean([estimate.value for estimate in values])


def _verdict_row(record: Record, stats: MapStatistics) -> Row:
    right = stats.correctness
    return (
        record.unit.scene,
        stats.verdict.level,
        stats.verdict.decisive,
        100 * stats.verdict.probability,
        stats.headline.alpha.ends,
        math.nan if stats.spots is None else 100 * stats.spots.labelled,
        UNDEFINED if right is None else right.quadrants.wrong_of_consistent_op3.percent,
        stats.repeated.voxels,
        100 * stats.repeated.share,
        NO_LABELS if stats.features is not None and stats.features.alone else ADVICE[stats.verdict.decisive],
    )
