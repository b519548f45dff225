"""Make the tables of stability in the world: by scene, by persistence, by class, and of models in one taxonomy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from semstab.config import BACKENDS, SHARED
from semstab.data.measures import SBD, VSS, measures
from semstab.data.records import ImageSpace, Record, Result
from semstab.data.results import Agreement, Means, TableSummary
from semstab.metrics import macro_mean, split_last
from semstab.metrics.image_space import mean_over_scenes
from semstab.report.means import (
    ENOUGH,
    Level,
    Pooled,
    Sweep,
    by_model,
    complete_scenes,
    levels,
    over_all,
    over_recurrent,
    pooled,
    swept,
)
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.agreement import ALPHA, PSA, VOXEL_ALPHA

VOXELS = Column("voxels", "Voxels", 0)
SHARE = Column("share_percent", "Voxels (%)", 2)
SBD_OVER = "Means of SBD (bits) run over the voxels seen twice or more."


def of_measures(*, compared: bool = False, prefix: str = "", over: str = "") -> list[Column]:
    """Return a column for each measure: the paper prints more decimals where it compares."""
    return [Column.of(measure, compared=compared, prefix=prefix, over=over) for measure in measures()]


def scenes(result: Result) -> list[Table]:
    """Return the multi-scene table.

    It has each scene, then totals and macro means (paper, Multi-Scene Voxel-Level Stability).
    """
    records = result.select()
    if not records:
        return []
    columns = (
        Column("scene", "Scene"),
        VOXELS,
        Column("points", "Sampled Points", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(),
    )
    groups = tuple(
        Group(name, tuple(_scene_row(record) for record in rows), _scene_total(rows) if len(rows) > 1 else None)
        for name, rows in by_model(records).items()
    )
    caption = (
        f"{settings(records)} A scene's numbers are means over its voxels. Total / Mean has the total voxels and"
        f" points, and macro means of the rest, in which each scene counts once. {SBD_OVER}"
    )
    return [Table("scenes", "Stability by scene", caption, columns, groups)]


def persistence(result: Result) -> list[Table]:
    """Return the persistence strata, the voxels of all scenes pooled (paper, Observation Persistence)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("persistence", "Persistence"), VOXELS, SHARE, *of_measures())
    groups = []
    for name, own in by_model(records).items():
        together = pooled(own)
        rows = (*together.strata, *together.well_seen)
        groups.append(Group(name, tuple(_means_row(row) for row in rows), _means_row(together.recurrent)))
    caption = (
        f"{settings(records)} The means are pooled: they run over the voxels of all scenes together. The last row is"
        " the recurrent voxels. A voxel seen once has no SBD; if its pixels agree, its VSS is 1 and its entropy is 0."
    )
    if any(split_last([record.summary.table for record in own]) for own in by_model(records).values()):
        caption += " If most voxels are in the last stratum, its parts follow."
    return [Table("persistence", "Stability by observation persistence", caption, columns, tuple(groups))]


def classes(result: Result) -> list[Table]:
    """Return the dominant classes, the voxels of all scenes pooled (paper, Class-wise Stability)."""
    records = result.select()
    if not records:
        return []
    columns = (Column("class", "Class"), VOXELS, *of_measures(), Column("note", "Note"))
    groups = tuple(
        Group(name, tuple(_class_row(row) for row in pooled(rows).classes)) for name, rows in by_model(records).items()
    )
    caption = (
        f"{settings(records)} The means are pooled: they run over the voxels of all scenes that the class dominates."
        f" {SBD_OVER} A rare class has fewer than {ENOUGH:,} voxels, too few to compare."
    )
    return [Table("classes", "Stability by dominant class", caption, columns, groups)]


def cross_model(result: Result) -> list[Table]:
    """Return the models in one taxonomy.

    The means are over all voxels and over the recurrent ones (paper, Cross-Model Temporal Stability).
    """
    records = comparable(result)
    if not records:
        return []
    columns = (Column("over", "Means over"), VOXELS, SHARE, *of_measures(compared=True))
    groups = tuple(Group(name, _comparison_rows(rows)) for name, rows in by_model(records).items())
    caption = (
        f"{settings(records)} In a macro mean each scene counts once; a pooled mean runs over the voxels of all scenes"
        " together. Compare the recurrent voxels (OP>=3) with the pooled row, and their share between models."
        f" {SBD_OVER}"
    )
    return [Table("cross_model", "Models in one taxonomy", caption, columns, groups)]


def comparable(result: Result) -> tuple[Record, ...]:
    """Return records of several models in one taxonomy.

    They are the records fused for it, else the base records if these share a taxonomy.
    """
    records = result.select(SHARED) or result.select()
    several = len(by_model(records)) > 1
    return records if several and len({record.summary.taxonomy for record in records}) == 1 else ()


def settings(records: Sequence[Record]) -> str:
    """Return the voxel sizes and taxonomies of the units, as a sentence."""
    sizes = sorted({record.summary.table.voxel_size for record in records})
    spaces = dict.fromkeys(f"{record.summary.taxonomy} (K = {record.summary.table.K})" for record in records)
    return f"Voxels measure {', '.join(f'{size:g}' for size in sizes)} m; the taxonomy is {', '.join(spaces)}."


def _scene_row(record: Record) -> Row:
    table = record.summary.table
    return record.unit.scene, table.voxels, table.points, table.mean_op, *table.means.of_all()


def _scene_total(records: Sequence[Record]) -> Row:
    tables = [record.summary.table for record in records]
    return (
        "Total / Mean",
        sum(table.voxels for table in tables),
        sum(table.points for table in tables),
        macro_mean([table.mean_op for table in tables]),
        *_macro(tables),
    )


def _macro(tables: Sequence[TableSummary]) -> list[float]:
    """Return the macro mean of each measure."""
    return [macro_mean([table[measure] for table in tables]) for measure in measures()]


def _means_row(row: Means) -> Row:
    return row.name, row.voxels, 100 * row.share, *row.means.of_all()


def _class_row(row: Means) -> Row:
    note = "" if row.voxels >= ENOUGH else "rare" if row.voxels else "absent"
    return row.name, row.voxels, *row.means.of_all(), note


def _comparison_rows(records: Sequence[Record]) -> tuple[Row, ...]:
    tables, together = [record.summary.table for record in records], pooled(records)
    return (
        ("all voxels, macro", together.voxels, 100.0, *_macro(tables)),
        ("all voxels, pooled", *_means_row(together.every)[1:]),
        ("OP>=3, pooled", *_means_row(together.recurrent)[1:]),
    )


# The overview of the models has alpha, the means of all voxels and of the recurrent ones, and their share.

_HEADLINES = (VSS, SBD)
"""The two measures of the paper: an overview has no room for all."""

_COLUMNS = (
    Column("model", "Model"),
    Column.of(ALPHA),
    Column("once_percent", "Seen once (%)", 2),
    Column("recurrent_percent", "OP>=3 (%)", 2),
    *(Column.of(measure, over="All voxels") for measure in _HEADLINES),
    *(Column.of(measure, prefix="recurrent_", over="OP>=3") for measure in _HEADLINES),
    Column("flicker_percent", "Pixel flicker (%)", 2, "lower"),
    Column("compensated_flicker_percent", "Flicker (%)", 2, "lower"),
)


def overview(result: Result) -> list[Table]:
    """Return one row for each model."""
    records = result.select()
    if not records:
        return []
    rows = tuple(_row(name, own) for name, own in by_model(records).items())
    caption = (
        f"{settings(records)} The means are pooled over the voxels of all scenes; alpha and flicker are macro means of"
        f" the scenes; pixel flicker includes the camera's motion. {SBD_OVER}"
    )
    return [Table("overview", "Overview", caption, _COLUMNS, (Group("", rows),), by="")]


def _row(model: str, records: Sequence[Record]) -> Row:
    voxels = pooled(records)
    return (
        model,
        voxels.alpha.value,
        100 * voxels.once,
        100 * voxels.recurrent.share,
        *(voxels.every[measure] for measure in _HEADLINES),
        *(voxels.recurrent[measure] for measure in _HEADLINES),
        macro_mean([record.image_space.flicker_percent for record in records]),
        macro_mean([record.image_space.compensated_flicker_percent for record in records]),
    )


# The sensitivity sweeps: means of all voxels and of the recurrent ones side by side, with their share.


def sensitivity(result: Result) -> list[Table]:
    """Return one table for each sweep (paper, Sensitivity to World-Space Association), and one with agreement."""
    pairs = [(_table(result, sweep), _agreement_table(result, sweep)) for sweep in swept(result)]
    return [table for pair in pairs for table in pair if table is not None]


def _table(result: Result, sweep: Sweep) -> Table:
    columns = (
        Column("value", sweep.header),
        Column("repeats", "Repeats", 0),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        *of_measures(compared=True, over="All voxels"),
        *of_measures(compared=True, prefix="recurrent_", over="OP>=3"),
        Column("note", "Note"),
    )
    models = [name for name in result.models if complete_scenes(result, sweep.name, name)]
    groups = tuple(
        Group(name, tuple(_sweep_row(sweep, level) for level in levels(result, sweep.name, name))) for name in models
    )
    scenes = dict.fromkeys(scene for name in models for scene in complete_scenes(result, sweep.name, name))
    caption = (
        f"The means are pooled: they run over the voxels of all scenes together ({', '.join(scenes)}); ± is the"
        f" standard deviation over the repeats, each with a seed of its own. {SBD_OVER} The note 'few' marks fewer than"
        f" {ENOUGH:,} recurrent voxels."
    )
    return Table(f"sensitivity_{sweep.name}", f"Sensitivity to {sweep.title}", caption, columns, groups)


def _agreement_table(result: Result, sweep: Sweep) -> Table | None:
    """Return the table of agreement; None where the units have no statistics."""
    columns = (
        Column("value", sweep.header),
        Column("mean_op", "Mean OP", 2),
        Column("vss", "VSS, all voxels", VSS.digits[1], VSS.better),
        *(Column.of(quantity, compared=True) for quantity in (PSA, ALPHA)),
        Column("sbd_excess", "SBD excess", 4, signed=True),
    )
    by_model = {name: levels(result, sweep.name, name) for name in result.models}
    known = {name: rows for name, rows in by_model.items() if any(level.assessed for level in rows)}
    if not known:
        return None
    groups = tuple(Group(name, tuple(_agreement_row(sweep, level) for level in rows)) for name, rows in known.items())
    caption = (
        "VSS is pooled over the voxels of all scenes. The other numbers are of the voxels seen twice or more, and are"
        " macro means of the scenes. PSA is the share of pairs of frames that agree about a voxel. Alpha is the"
        " agreement of two views at the same spot beyond chance. SBD excess is SBD less that of the same observations"
        " in random order (bits), over the voxels where that is known. These three do not depend on how often a voxel"
        " was seen, but the set of voxels seen twice changes along the sweep. ± is the standard deviation over the"
        " repeats."
    )
    title = f"Agreement against {sweep.title}"
    return Table(f"sensitivity_agreement_{sweep.name}", title, caption, columns, groups)


def _agreement_row(sweep: Sweep, level: Level) -> Row:
    spread = level.spread if len(level.repeats) > 1 else level.mean
    return (
        sweep.text(level.value),
        level.mean(lambda p: p.mean_op),
        spread(over_all(VSS)),
        spread(lambda p: p.psa.value),
        spread(lambda p: p.alpha.value),
        spread(lambda p: p.excess_drift),
    )


def _sweep_row(sweep: Sweep, level: Level) -> Row:
    spread = level.spread if len(level.repeats) > 1 else level.mean
    return (
        sweep.text(level.value),
        len(level.repeats),
        level.mean(lambda p: p.voxels),
        level.mean(lambda p: p.mean_op),
        spread(lambda p: 100 * p.recurrent.share),
        *(spread(over_all(measure)) for measure in measures()),
        *(spread(over_recurrent(measure)) for measure in measures()),
        "" if level.mean(lambda p: p.recurrent.voxels) >= ENOUGH else "few",
    )


# Stability in image coordinates: flicker, flicker without the camera's motion, video consistency.

_NUMBERS = (
    Column("flicker_percent", "Pixel flicker (%)", 2, "lower"),
    Column("compensated_flicker_percent", "Flicker (%)", 2, "lower"),
    Column("compensated_share_percent", "co-visible (%)", 2),
    Column("vc8", "VC8", 4, "higher"),
    Column("vc16", "VC16", 4, "higher"),
    Column("self_vc8", "VC8", 4, "higher", over="Without truth"),
    Column("self_vc16", "VC16", 4, "higher", over="Without truth"),
)
_WHAT = (
    "Pixel flicker is the share of the pixels valid in two consecutive sampled frames whose label changes. Flicker is"
    " the same share after the earlier map is warped by {motion}, without occluded pixels, so that {motion_of}"
    " does not count; co-visible is the share of the valid pixels that the warped map reaches. VC8 and VC16 are video"
    " consistency: of the pixels whose ground truth stays the same through a clip of 8 or 16 frames, the share whose"
    " prediction stays the same. Without truth they are of all pixels that are valid throughout the clip."
)
_REGIONS = (
    " Regions without classes ({names}) are matched from frame to frame; a pixel is unchanged if its regions match."
)


def flicker(result: Result) -> list[Table]:
    """Return flicker by model, and scene by scene (paper, Frame-wise Temporal Semantic Flicker)."""
    regions = dict.fromkeys(row.model for row in result.regions)
    what = _WHAT.format(motion="depth and pose", motion_of="camera motion")
    return flicker_tables(_by_method(result), what + (_REGIONS.format(names=", ".join(regions)) if regions else ""))


def flicker_of_videos(methods: Mapping[str, Mapping[str, ImageSpace]]) -> list[Table]:
    """Return flicker of videos without depth and poses, by model and scene: with the motion removed by flow."""
    motion = "optical flow between the images (OpenCV's DIS)"
    return flicker_tables(methods, _WHAT.format(motion=motion, motion_of="motion of the camera and of things"))


def flicker_tables(methods: Mapping[str, Mapping[str, ImageSpace]], what: str) -> list[Table]:
    """Return flicker of each model by scene, and of all scenes; `what` explains the numbers."""
    if not methods:
        return []
    macro = tuple((name, *_numbers(scenes.values())) for name, scenes in methods.items())
    columns, caption = (
        (Column("method", "Method"), *_NUMBERS),
        f"{what} The numbers are macro means: each scene counts once.",
    )
    tables = [Table("flicker", "Flicker in image space", caption, columns, (Group("", macro),), by="")]
    if any(len(scenes) > 1 for scenes in methods.values()):
        groups = tuple(
            Group(name, tuple((scene, *_numbers([numbers])) for scene, numbers in scenes.items()))
            for name, scenes in methods.items()
        )
        columns = (Column("scene", "Scene"), *_NUMBERS)
        tables.append(Table("flicker_by_scene", "Flicker in image space, by scene", what, columns, groups))
    return tables


def _by_method(result: Result) -> dict[str, dict[str, ImageSpace]]:
    """Return the numbers by model and scene; regions without classes have flicker only."""
    methods: dict[str, dict[str, ImageSpace]] = {}
    for record in result.select():
        methods.setdefault(record.unit.model, {})[record.unit.scene] = record.image_space
    for row in result.regions:
        numbers = ImageSpace(row.flicker_percent, row.compensated_flicker_percent, row.compensated_share)
        methods.setdefault(row.model, {})[row.scene] = numbers
    return methods


def _numbers(scenes: Iterable[ImageSpace]) -> Row:
    own = mean_over_scenes(scenes)
    return (
        own.flicker_percent, own.compensated_flicker_percent, 100 * own.compensated_share, own.vc8, own.vc16,
        own.self_vc8, own.self_vc16,
    )  # fmt: skip


# The fusion implementations: the same frames through every backend, and the differences of the measures.

DIFFERENCE = "Difference to the first"
LARGEST = "Largest difference"


def fusion(result: Result) -> list[Table]:
    """Return each backend and the base one side by side, over the scenes that every backend fused."""
    groups = tuple(group for name in result.models if (group := _group(result, name)) is not None)
    if not groups:
        return []
    columns = (
        Column("backend", "Backend"),
        Column("voxels", "Voxels", 0),
        Column("mean_op", "Mean OP", 2),
        *of_measures(compared=True),
        Column("recurrent_percent", "OP>=3 (%)", 2),
        Column("fuse_ms_per_frame", "ms per frame", 1, "lower"),
        Column("delta_voxels", "Voxels", 0, signed=True, over=DIFFERENCE),
        Column("delta_mean_op", "OP", 2, signed=True, over=DIFFERENCE),
        *(Column(f"delta_{m.key}", m.title, m.digits[1], signed=True, over=DIFFERENCE) for m in measures()),
    )
    caption = (
        f"{settings(result.select())} The means are pooled: they run over the voxels of all scenes together; ms per"
        f" frame is the macro mean. The base backend is first. {SBD_OVER}"
    )
    return [Table("fusion", "Fusion implementations", caption, columns, groups)]


def compared(result: Result) -> list[Table]:
    """Return the differences of maps by backends that associate pixels and voxels in another way than the base one."""
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
        "The same frames were fused by backends that associate pixels and voxels in another way; their maps need not"
        " agree. Labels and differences, which have no sign, are of the voxels that both maps have."
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
    groups = tuple(Group(" and ".join(pair), tuple(row for of, row in rows if of == pair)) for pair in pairs)
    caption = (
        "Two backends fused the same frames. The table shows the largest difference of any voxel that both maps have."
    )
    if drawn := one_in(result.agreement):
        caption += f" With the numpy reference, {drawn} voxels were compared, drawn at random."
    return [Table("agreement", "Agreement of the fusion implementations", caption, columns, groups, "backends")]


def _backend_agreement_row(row: Agreement, names: Iterable[str]) -> Row:
    largest = (row.difference(name).max for name in names)
    return row.scene, row.model, sum(row.only_in), *largest, "agree" if row.agrees else "disagree"


def _group(result: Result, model: str) -> Group | None:
    others = result.select(BACKENDS, model=model)
    by_backend: dict[str, dict[str, Record]] = {}
    for record in (*result.select(model=model), *others):
        by_backend.setdefault(record.unit.backend, {})[record.unit.scene] = record
    scenes = set.intersection(*(set(rows) for rows in by_backend.values()))
    if not others or not scenes:
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


# The same map with other settings: soft scores reduced to labels, other voxel sizes.


def reduced(result: Result) -> list[Table]:
    """Return numbers that compare hard labels with soft scores, which are reduced to each pixel's likeliest class."""
    records = result.select()
    if len({record.summary.reduced is None for record in records}) < 2:
        return []
    columns = (
        Column("scene", "Scene"),
        Column("vss", VSS.title, VSS.digits[0], VSS.better),
        Column("recurrent_vss", f"{VSS.title}, OP>=3", VSS.digits[0], VSS.better),
        Column.of(VOXEL_ALPHA),
    )
    groups = tuple(
        Group(name, tuple(_reduced_row(record) for record in rows)) for name, rows in by_model(records).items()
    )
    caption = (
        "VSS, entropy and voxel alpha do not compare hard labels with soft scores, because scores spread their"
        " evidence; alpha is of the likeliest classes. Here scores are reduced to each pixel's likeliest class; labels"
        " are unchanged."
    )
    return [Table("reduced", "Labels and reduced scores", caption, columns, groups)]


def _reduced_row(record: Record) -> Row:
    reduced, table, statistics = record.summary.reduced, record.summary.table, record.summary.statistics
    if reduced is not None:
        return record.unit.scene, reduced.vss, reduced.recurrent_vss, reduced.voxel_alpha
    alpha = math.nan if statistics is None else statistics.agreement.voxel_alpha.value
    return record.unit.scene, table[VSS], table.recurrent[VSS], alpha


def voxel_sizes(result: Result) -> list[Table]:
    """Return alpha at half, once and twice the voxel size, from some frames."""
    groups = tuple(
        Group(name, rows)
        for name, records in by_model(result.select()).items()
        if (
            rows := tuple(
                (r.unit.scene, s.voxel_size, s.frames, s.voxel_alpha) for r in records for s in r.summary.sizes
            )
        )
    )
    columns = (Column("scene", "Scene"), Column("voxel_size", "Voxel (m)", 4), Column("frames", "Frames", 0))
    caption = "The table shows Krippendorff's alpha of the same frames in voxels of other sizes."
    return (
        [Table("voxel_sizes", "Other voxel sizes", caption, (*columns, Column.of(VOXEL_ALPHA)), groups)]
        if groups
        else []
    )


def one_in(rows: Sequence[Agreement]) -> str:
    """Return which share of the voxels was compared: '1 in 64', '1 in 64 to 128'; '' where all were."""
    drawn = sorted({row.one_in for row in rows})
    return "" if drawn in ([], [1]) else f"1 in {' to '.join(map(str, dict.fromkeys((drawn[0], drawn[-1]))))}"
