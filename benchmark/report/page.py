"""Write report.html: first the answer of a run or a study, then maps, time lines and classes; the rest is folded."""

from __future__ import annotations

import itertools
import json
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from semstab.core.palette import KINDS
from semstab.core.prefetch import prefetch
from semstab.core.types import UInt8
from semstab.data.features import OF_FEATURES
from semstab.data.georeference import Georeference
from semstab.data.measures import SBD, VSS, dominant, headlines, measures
from semstab.data.records import OVERVIEW, Failure, Record, Result
from semstab.data.results import slug
from semstab.data.statistics import CONFIDENCE, Correlogram, Estimate, MapStatistics, short
from semstab.data.topdown import EMPTY
from semstab.metrics import CATEGORIES, CATEGORY_COLORS, NOT_ASSESSED, categories, macro_mean
from semstab.metrics.image_space import mean_over_scenes
from semstab.report.charts import Joint, Line, dot_chart, line_chart, sample, tree_chart
from semstab.report.figures.located import Located
from semstab.report.figures.maps import Overview, TopViews
from semstab.report.filter_study import advice, filter_studies, of_interest
from semstab.report.html import filled, jpeg, lone_pictures, png, table_block, templates
from semstab.report.means import ENOUGH, by_model, describe, levels, over_recurrent, pooled, swept
from semstab.report.narrative import not_assessed, noted, notes, outlying_line, warnings
from semstab.report.places import LISTED, ShownMap, described_places, map_frame
from semstab.report.ranking import order_of_models
from semstab.report.saved_run import read_series
from semstab.report.tables import tables
from semstab.report.tables.table import relations
from semstab.report.terminal import miou
from semstab.statistics.correctness import MIOU
from semstab.statistics.moving import STATE_COLORS, STATE_NAMES, states_of
from semstab.statistics.places import places_of
from semstab.statistics.verdict import LIMITS

TEMPLATE, PARTS = "report.html.j2", "parts.html.j2"
"""The template of the page, and the one that it takes parts from."""

MOST_NAMED = 3
"""The most scenes that are named in the title."""

CELLS, BYTES, ALL_BYTES = 1_200_000, 1_000_000, 12_000_000
"""The most cells of a map in the page, and the most bytes of the images of one map and of all maps; a larger map is
reduced to every n-th cell."""

AT_ONCE = 2
"""Maps whose images are made at once; one more may be in memory."""

SBD_END = 0.25
"""The SBD, bits, that the largest code of a map's image stands for."""

UNKNOWN = 255
"""The code of a value that is not defined; as a category, the code of a cell without a voxel."""


def load_templates() -> None:
    """Compile the templates of the page, so that `render` need not."""
    for name in (TEMPLATE, PARTS):
        templates().get_template(name)


def render(result: Result, folder: Path, digest: str = "", maps: Mapping[str, ShownMap] = MappingProxyType({})) -> str:
    """Return the page of the result whose files lie in the folder, with the digest of what it is made from.

    Args:
        result: The result of the run or study.
        folder: Its folder.
        digest: Digest of the files that the page is made from.
        maps: What is shown of a map, by the unit's slug; the voxels of other units are read.
    """
    everything, result = result, of_interest(result)
    scenes, views = list(_scenes(result, folder, maps)), [table_block(table) for table in tables(everything)]
    return filled(
        TEMPLATE,
        kind="Study of temporal semantic stability" if result.sweeps() else "Temporal semantic stability",
        digest=digest,
        confidence=CONFIDENCE,
        title=_title(result),
        subtitle=_subtitle(result),
        models=_legend(result.models),
        cards=[_card(name, records) for name, records in by_model(result.select()).items()],
        answers=[relations(text) for text in order_of_models(result)],
        noted=[relations(text) for text in noted(result)],
        advice=[sentence for study in filter_studies(everything) for sentence in advice(study)],
        warnings=[relations(text) for text in warnings(result)],
        notes=[relations(text) for text in notes(result)],
        scenes=scenes,
        maps=_script([_for_script(unit) for scene in scenes for unit in scene["maps"]]),
        layers=_script(
            {
                "categories": CATEGORIES,
                "colors": CATEGORY_COLORS,
                "sbd": SBD_END,
                "states": [*zip(STATE_COLORS, STATE_NAMES, strict=True)],
            }
        ),
        charts_all=[*_by_op(result.maps), *_sweeps(result.maps)],
        tables=views,
        failures=[_failure(row) for row in result.failures],
        facts=list(_facts(result.manifest)),
        manifest=json.dumps(result.manifest, indent=2, default=str),
    )


def _for_script(unit: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the script paints of a map: the rest stands in the page already."""
    return {name: value for name, value in unit.items() if name not in ("around", "places", "plain")}


def _script(content: Any) -> str:
    """Return JSON that may stand in a script element."""
    return json.dumps(content).replace("<", "\\u003c")


def _legend(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the names with samples of their lines."""
    return [(name, sample(k)) for k, name in enumerate(names)]


# --- Cards ------------------------------------------------------------------------------------------------------------


def _card(model: str, records: Sequence[Record]) -> dict[str, Any]:
    """Return the card of a model: the verdict on it in each scene, and the numbers that the verdict rests on."""
    assessed = [record.statistics for record in records if record.statistics is not None]
    single = assessed[0] if len(assessed) == 1 else None
    return {
        "model": model,
        "scenes": [_scene_verdict(record) for record in records[:12] if record.pixels is None],
        "more": max(0, len(records) - 12),
        "reasons": relations(single.verdict.line.partition(": ")[2]) if single is not None else "",
        "numbers": [(name, value, note) for name, value, note in _numbers(records, assessed, single) if value],
    }


def _scene_verdict(record: Record) -> dict[str, str]:
    statistics = record.statistics
    if statistics is None:
        return {"scene": record.unit.scene, "level": "not assessed", "kind": "open", "probability": ""}
    verdict = statistics.verdict
    level, kind = verdict.difference or verdict.level, KINDS.get(verdict.decisive, "bad")
    if statistics.features is not None and statistics.features.alone:
        level, kind = "features, no labels", "open"
    p = "" if verdict.difference else verdict.stated
    return {"scene": record.unit.scene, "level": level, "kind": kind, "probability": p}


def _numbers(
    records: Sequence[Record], assessed: Sequence[MapStatistics], single: MapStatistics | None
) -> Iterator[tuple[str, str, str]]:
    """Yield rows of a card: name, value, and its interval or unit; macro means over several scenes."""

    def mean(values: Sequence[float], form: str, scale: float = 1.0) -> str:
        value = macro_mean(values)
        return "" if math.isnan(value) else form.format(scale * value)

    def interval(estimate: Estimate | None, scale: float = 1.0) -> str:
        if estimate is None or math.isnan(estimate.low):
            return ""
        if scale == 1.0:
            return f"{estimate.interval_name} {short(estimate.low)} to {short(estimate.high)}"
        return f"{estimate.interval_name} {scale * estimate.low:z.0f} to {scale * estimate.high:z.0f}"

    head = None if single is None else single.headline
    alphas = [stats.headline.alpha.value for stats in assessed]
    alpha = macro_mean(alphas)
    yield "alpha", "" if math.isnan(alpha) else short(alpha), interval(None if head is None else head.alpha)
    of_features = [stats.features.alpha for stats in assessed if stats.features is not None]
    one_of_them = of_features[0] if len(of_features) == 1 else None
    yield (
        "alpha of features",
        mean([estimate.value for estimate in of_features], "{:.2f}").lstrip("0"),
        interval(one_of_them),
    )
    yield "two views agree", mean([stats.agreeing for stats in assessed], "{:.0f} %", 100), "of the spots"
    if single is not None and single.told_ranges is not None:
        value, note = single.told_ranges.parts
        yield "reliable", value, note
    flicker = [record.image_space.compensated_flicker_percent for record in records]
    of_images = all(record.pixels is not None for record in records)
    yield (
        "flicker",
        mean(flicker, "{:.2f} %" if of_images else "{:.1f} %"),
        f"of the {records[0].image_space.changing}, motion removed",
    )
    if of_images:
        yield from _of_images(records)
        return
    together = pooled(records)
    yield "seen 3 times or more", f"{100 * together.recurrent.share:.0f} %", f"of {together.voxels:,} voxels"
    if assessed and all(stats.features is not None and stats.features.alone for stats in assessed):
        return
    enough = together.recurrent.voxels >= ENOUGH
    few = f"fewer than {ENOUGH:,} voxels with OP ≥ 3"
    for measure in headlines():
        value = short(together.recurrent[measure], digits=measure.digits[0]) if enough else "-"
        note = measure.unit
        yield measure.full_title, value, note if enough else few
    overlap = macro_mean([miou(record) for record in records])
    yield MIOU.full_title, "" if math.isnan(overlap) else short(overlap, digits=MIOU.digits[0]), "of the fused labels"
    wrong = [stats.headline.wrong_of_consistent_op3.value for stats in assessed]
    yield "consistent but wrong", mean(wrong, "{:.1f} %", 100), "of the consistent locations"


def _of_images(records: Sequence[Record]) -> Iterator[tuple[str, str, str]]:
    """Yield the further rows of a card of videos."""
    mean = mean_over_scenes(record.image_space for record in records)
    for name, value, form, note in (
        ("pixel flicker", mean.flicker_percent, "{:.2f} %", "of the pixels per frame, motion included"),
        ("co-visible", 100 * mean.compensated_share, "{:.0f} %", "of the pixels, in the frame before"),
        ("VC8", mean.self_vc8, "{:.3f}", "of the pixels keep their label for 8 frames"),
        ("VC16", mean.self_vc16, "{:.3f}", "for 16 frames"),
        ("VC8, truth", mean.vc8, "{:.3f}", "where the truth stays the same"),
    ):
        yield name, "" if math.isnan(value) else form.format(value), note


# --- A scene: the map, the time line, the classes ---------------------------------------------------------------------


def _scenes(result: Result, folder: Path, maps: Mapping[str, ShownMap]) -> Iterator[dict[str, Any]]:
    views, reading = TopViews(), threading.Lock()
    stored = [record for record in result.select() if record.voxels_file is not None]
    share = min(BYTES, ALL_BYTES // max(1, len(stored)))
    for scene in result.scenes:
        records = result.select(scene=scene)
        overviews = {}
        for record in records:
            path = folder / OVERVIEW / f"{slug(scene, record.unit.model)}.npz"
            if path.exists():
                overviews[record.unit.model] = Overview.load(path)
        up, colors = result.up.get(scene), {name: k for k, name in enumerate(result.models)}
        labelled = [record for record in records if record.taxonomy != OF_FEATURES.name]
        mapped = [] if up is None else [record for record in labelled if record.voxels_file is not None]

        def map_of(record: Record, up: Any = up, overviews: Mapping[str, Overview] = overviews) -> dict[str, Any]:
            with reading:
                shown_map = maps.get(record.unit.slug) or ShownMap(views.above(record, up), places_of(record, LISTED))
            scene, model = record.unit.scene, record.unit.model
            return _map(record, shown_map, overviews.get(model), result.georeference.get(scene), share)

        yield {
            "name": scene,
            "maps": [fetched.item for fetched in prefetch(map_of, mapped, threads=AT_ONCE)],
            "unknown_up": up is None,
            "video": all(record.pixels is not None for record in records),
            "models": _legend(result.models) if len(result.models) > 1 else [],
            "timeline": list(_timeline(records, colors)),
            "outlying": [text for record in records for text in _outlying(record, alone=len(records) == 1)],
            "lone": [row for record in records for row in _lone(record, overviews.get(record.unit.model))],
            "classes": _classes(records, colors),
            "groupings": list(_groupings(records)),
            "distance": list(_distance(records, colors)),
        }


def _map(
    record: Record, shown_map: ShownMap, overview: Overview | None, georeference: Georeference | None, most: int
) -> dict[str, Any]:
    """Return the map as the page's script paints it.

    It has images of numbers for the script, and an image of the stability for a page without script.
    """
    above = shown_map.above
    step = max(1, math.ceil(math.sqrt(above.rows.size / CELLS)))
    table, names = above.table, above.table.classes or tuple(map(str, range(above.table.K)))
    moved = states_of(record, table.centers)
    with np.errstate(invalid="ignore"):
        drift = np.nan_to_num(np.minimum(SBD.of(table) / SBD_END, 1) * (UNKNOWN - 1), nan=UNKNOWN)
    label, category = dominant(table), categories(table)
    first = np.stack([label & 255, label >> 8, category], axis=1).astype(np.uint8)
    second = np.stack([np.rint(VSS.of(table) * 255), np.minimum(table.op, 255), np.rint(drift)], axis=1)
    while True:
        rows = above.rows[::step, ::step]
        images = [_spread(rows, first), _spread(rows, second.astype(np.uint8))]
        images += [] if moved is None else [_spread(rows, moved[:, None].repeat(3, axis=1))]
        encoded = [png(image) for image in images]
        if sum(map(len, encoded)) <= most or rows.size < 10_000:
            break
        step += 1
    kinds = np.where(rows == EMPTY, len(CATEGORIES), category[rows]).astype(np.uint8)
    silent = not_assessed(record)
    shades = [NOT_ASSESSED] * len(CATEGORIES) if silent else CATEGORY_COLORS
    palette = np.array([(k * 67 % 256, k * 131 % 256, k * 29 % 256) for k in range(table.K)], dtype=np.uint8)
    palette = palette if overview is None else overview.palette
    cell, located = step * above.cell, Located.from_view(above, georeference)
    size = rows.shape[1] * cell, rows.shape[0] * cell
    cut = any(all_of_it > 1.02 * extent + 2 * cell for all_of_it, extent in zip(above.whole, size, strict=True))
    of_whole = f" of {above.whole[0]:.3g} m by {above.whole[1]:.3g} m (without outlying voxels)" if cut else ""
    return {
        "model": record.unit.model,
        "scene": record.unit.scene,
        "size": [rows.shape[1], rows.shape[0]],
        "text": f"{size[0]:.3g} m by {size[1]:.3g} m{of_whole}, seen {above.view}",
        "around": map_frame(located),
        "located": {"matrix": located.matrix.tolist(), "size": located.size, "names": located.names},
        "places": described_places(shown_map.places, record, located, overview, names),
        "cell": cell,
        "names": names,
        "palette": palette.tolist(),
        "numbers": encoded,
        "moved": moved is not None,
        "silent": silent,
        "plain": png(kinds, np.array([*shades, (255, 255, 255)], dtype=np.uint8)),
        "image": "" if overview is None or overview.color is None else jpeg(_reduced(overview.color, 960)),
        "frame": "" if overview is None else f"frame {overview.frame}",
    }


def _spread(rows: Any, values: UInt8) -> UInt8:
    """Return the values (n, 3) of each cell's voxel (H, W, 3); (0, 0, UNKNOWN) for a cell without a voxel."""
    image = values[rows]
    image[rows == EMPTY] = (0, 0, UNKNOWN)
    return image  # type: ignore[no-any-return]


def _reduced(image: UInt8, most: int) -> UInt8:
    step = -(-max(image.shape[:2]) // most)
    return image[::step, ::step]


def _timeline(records: Sequence[Record], colors: Mapping[str, int]) -> Iterator[dict[str, str]]:
    """Yield flicker, and how often a frame stands alone beyond its null, by frame."""
    series = {r.unit.model: read_series(r.series) for r in records if r.series is not None and r.series.exists()}
    what = records[0].image_space.changing.partition(" ")[0]
    for columns, title, unit in (
        (("compensated_flicker_percent",), "Flicker", f"flicker, % of the {what}"),
        (("lone_percent", "lone_null_percent"), "Frames that stand alone", "% of the places, less null"),
        (("moving_percent",), "What moved", "% of a frame's answers at spots that moved"),
    ):
        lines = []
        for name, frame_series in series.items():
            if all(column in frame_series for column in columns):
                first, *null = (frame_series[column].astype(float) for column in columns)
                values = first - null[0] if null else first
                lines.append(Line(name, frame_series["frame"].tolist(), values.tolist(), color=colors[name]))
        if any(np.isfinite(line.y).any() for line in lines):
            yield {"title": title, "chart": line_chart(lines, "frame", unit)}


def _outlying(record: Record, *, alone: bool) -> Iterator[str]:
    """Yield a sentence on the frames that stand out."""
    if (outlying := record.outlying_frames) is not None:
        yield outlying_line(outlying, "" if alone else record.unit.model, most=len(outlying.frames))


def _lone(record: Record, overview: Overview | None) -> Iterator[dict[str, Any]]:
    """Yield frames that stand out as small images: the image, its labels, and the pixels that stand alone."""
    outlying = record.outlying_frames
    if overview is None or overview.lone is None or outlying is None:
        return
    lone_frames, outliers = overview.lone, {row.frame: row for row in outlying.frames}
    for k, frame in enumerate(lone_frames.frames.tolist()):
        outlier, color = outliers[frame], None if lone_frames.color is None else lone_frames.color[k]
        shares = f"alone at {100 * outlier.share:.0f} % of its places, other frames there at {100 * outlier.null:.0f} %"
        shares = shares if record.pixels is None else f"alone at {100 * outlier.share:.0f} % of its pixels"
        pictures = lone_pictures(color, lone_frames.labels[k], lone_frames.alone[k], overview.palette)
        yield {"title": f"{record.unit.model}, {outlier.name}: {shares}", "pictures": pictures}


DISAGREES = 0.02
"""The share of the disagreement from which on a class is drawn that has too few locations for the verdict."""


def _classes(records: Sequence[Record], colors: Mapping[str, int]) -> str:
    """Return a chart of the classes that count for the verdict or disagree, with their alphas."""
    rows: dict[str, list[tuple[int, str, Estimate]]] = {}
    is_listed: dict[str, bool] = {}
    for record in records:
        statistics, name = record.statistics, record.unit.model
        for of_class in () if statistics is None or statistics.spots is None else statistics.spots.classes:
            if not math.isnan(of_class.alpha.value):
                rows.setdefault(of_class.name, []).append((colors[name], name, of_class.alpha))
                is_listed[of_class.name] = (
                    is_listed.get(of_class.name, False)
                    or of_class.counts_for_verdict
                    or of_class.disagreement >= DISAGREES
                )
    rows = {name: alphas for name, alphas in rows.items() if is_listed[name]}
    if not rows:
        return ""
    ordered = dict(sorted(rows.items(), key=lambda item: min(e.value for _, _, e in item[1])))
    guides = (LIMITS.usable, LIMITS.stable)
    return dot_chart(ordered, "alpha of the class", guides)


def _groupings(records: Sequence[Record]) -> Iterator[dict[str, str]]:
    """Yield the tree of merges of each model that has groups on which views agree, up to the largest alpha."""
    for record in records:
        statistics = record.statistics
        groupings = None if statistics is None else statistics.groupings
        if statistics is None or groupings is None or not groupings.text:
            continue
        best = max(range(len(groupings.merges)), key=lambda n: groupings.merges[n].alpha)
        joints = [Joint(merge.first, merge.second, merge.alpha) for merge in groupings.merges[: best + 1]]
        limits, start = (LIMITS.usable, LIMITS.stable), statistics.headline.alpha.value
        chart = tree_chart(joints, "alpha after the merge", limits, start)
        yield {"title": f"{record.unit.model}: {groupings.text}", "chart": chart}


def _distance(records: Sequence[Record], colors: Mapping[str, int]) -> Iterator[dict[str, str]]:
    """Yield charts of agreement by the distance of two observations."""
    kinds: dict[str, list[tuple[Record, Correlogram | None]]] = {"": [], ", features": []}
    for record in records:
        statistics = record.statistics
        features = None if statistics is None else statistics.features
        kinds[""].append((record, None if statistics is None else statistics.correlogram))
        kinds[", features"].append((record, None if features is None else features.correlogram))
    for (axis, title, unit), (suffix, correlograms) in itertools.product(
        (
            ("time", "In time", "frames apart"),
            ("angle", "In angle", "degrees between the views"),
            ("baseline", "In space", "metres between the cameras"),
        ),
        kinds.items(),
    ):
        lines = []
        for record, correlogram in correlograms:
            bins = getattr(correlogram, axis) if correlogram else ()
            if bins:
                name, alphas = record.unit.model, [lag_bin.alpha for lag_bin in bins]
                ends = [(alpha.low, alpha.high) for alpha in alphas]
                lines.append(
                    Line(
                        name, [lag_bin.mean for lag_bin in bins], [alpha.value for alpha in alphas], ends, colors[name]
                    )
                )
        if lines:
            yield {"title": f"{title}{suffix}", "chart": line_chart(lines, unit, "alpha", zero=True)}


# --- All scenes together ----------------------------------------------------------------------------------------------


def _by_op(result: Result) -> Iterator[dict[str, str]]:
    """Yield the measures by observation persistence."""
    together = {name: pooled(records) for name, records in by_model(result.select()).items()}
    for measure in (measure for measure in measures() if measure.chart):
        lines, names = [], list[str]()
        for k, (model, means) in enumerate(together.items()):
            strata = [*means.strata[:-1], *(means.well_seen or means.strata[-1:])]
            names = names or [
                row.name.replace("<=OP<=", " to ").replace("OP=", "").replace("OP>", "> ") for row in strata
            ]
            lines.append(Line(model, [*range(len(strata))], [row[measure] for row in strata], color=k))
        unit = f"{measure.title}, {measure.unit}" if measure.unit else measure.title
        if lines:
            chart = line_chart(lines, "OP, frames that saw the voxel", unit, names=names, zero=measure.range[0] == 0)
            yield {"title": f"{measure.title} by observation persistence", "chart": chart}


def _sweeps(result: Result) -> Iterator[dict[str, str]]:
    """Yield alpha and the first headline measure by the settings of each sweep."""
    first = [(measure.full_title, over_recurrent(measure)) for measure in headlines()[:1]]
    for sweep in swept(result):
        for title, take in (("alpha", lambda p: p.alpha.value), *first):
            lines = []
            for k, model in enumerate(result.models):
                if sweep_levels := levels(result, sweep.name, model):
                    spread = [level.spread(take) for level in sweep_levels]
                    ends = [(s.mean - s.sd, s.mean + s.sd) for s in spread]
                    xs = [level.value * sweep.scale for level in sweep_levels]
                    lines.append(Line(model, xs, [s.mean for s in spread], ends, k))
            if any(np.isfinite(line.y).any() for line in lines):
                label = f"{sweep.title}, {sweep.unit}" if sweep.unit else sweep.title
                yield {"title": f"{title} by {sweep.title}", "chart": line_chart(lines, label, title, zero=False)}


def _title(result: Result) -> str:
    """Return the name of a study, or of a benchmark; of a run, which has none, its scenes."""
    if result.benchmark:
        return f"Benchmark {result.benchmark.partition(' ')[0]}"
    if result.sweeps():
        return result.name
    scenes = result.scenes
    return ", ".join(scenes) if len(scenes) <= MOST_NAMED else f"{len(scenes)} scenes"


def _subtitle(result: Result) -> str:
    maps = {record.key for record in result.records}  # a sweep and the base share maps
    counts = [(len(result.scenes), "scene"), (len(result.models), "model")]
    if result.sweeps():
        counts.append((len(maps), "map"))
    parts = [f"{n:,} {name}{'' if n == 1 else 's'}" for n, name in counts]
    if records := result.select():
        classes = " and ".join(map(str, sorted({record.map_summary.K for record in records})))
        parts += [f"{records[0].frames} frames", f"{classes} classes"]
        fused = [f"voxels of {records[0].map_summary.voxel_size:g} m", f"fused by {result.backend}"]
        parts += ["no depth, no poses"] if records[0].pixels is not None else fused
    definition = [f"definition {result.benchmark.partition('(')[2].rstrip(')')}"] if result.benchmark else []
    return " · ".join([*parts, *definition])


def _failure(failure: Failure) -> dict[str, str]:
    unit, variation = failure.unit, failure.variation
    value = "" if variation.value is None else f" {describe(variation.sweep).text(variation.value)}"
    return {
        "unit": f"{unit.scene}, {unit.model}, {unit.backend}",
        "variation": f"{describe(variation.sweep).title}{value}, repeat {variation.repeat}",
        "message": failure.message,
    }


def _facts(manifest: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the manifest's short entries, by name."""
    for key, value in manifest.items():
        if isinstance(value, Mapping):
            short = len(value) <= 12 and not any(isinstance(item, Mapping | list) for item in value.values())
            text = ", ".join(f"{name} {_short(item)}" for name, item in value.items()) if short else ""
        elif isinstance(value, Sequence) and not isinstance(value, str):
            text = " ".join(str(item) for item in value)
        else:
            text = "" if value is None else _short(value)
        if text:
            yield key.replace("_", " "), text


def _short(value: Any) -> str:
    return f"{value:,.1f}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)
