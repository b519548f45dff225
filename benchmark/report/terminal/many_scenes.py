"""Several scenes: a row for each model over all scenes, then a line for each scene with alpha of each model."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from scipy import special

from semstab.core.console import wrapped
from semstab.data.measures import headlines
from semstab.data.records import Record, Result
from semstab.data.statistics import CONFIDENCE, Estimate, short
from semstab.metrics import macro_mean
from semstab.report.means import ENOUGH, by_model, pooled
from semstab.report.ranking import order_of_models
from semstab.report.terminal.disagreement import class_lines
from semstab.report.terminal.head import head_lines
from semstab.report.terminal.layout import common_beginning, cut, laid_out, legend, number, percent
from semstab.report.terminal.several_models import miou

LEAST_SCENES = 3
"""Scenes from which on an interval over scenes is printed: the spread of two says almost nothing."""

FEW_ROWS = 8
"""Most units for which the classes that disagree most are printed."""

SCENE_NAME, CELL = 18, 6
"""Columns of the name of a scene, and the least columns of a model's cell."""


def many_scenes(result: Result, records: Sequence[Record], width: int) -> Iterator[str]:
    """Yield the answer, a row for each model over all scenes, a line for each scene, and what refutes a verdict."""
    listed = ", ".join(result.scenes) if len(result.scenes) <= 3 else f"{len(result.scenes)} scenes"
    yield from head_lines(listed, result, records, width)
    for text in (sentences := list(order_of_models(result))):
        yield from wrapped(text)
    if sentences:
        yield ""
    models, begin = by_model(records), common_beginning([*result.models])
    yield from _model_rows(models, begin, width)
    yield from legend(has_truth=any(not math.isnan(miou(record)) for record in records))
    yield ""
    yield from _scene_lines(result.scenes, models, begin, width)
    if begin:
        yield f"  names of models begin with '{begin}'"
    if len(records) <= FEW_ROWS:
        yield from class_lines(records, width, begin)
    yield from _refuted(models)
    yield from _silent(models)
    yield from _outlying(models)
    yield ""


def over_scenes(alphas: Sequence[float]) -> Estimate:
    """Return the mean of alpha over scenes, each counting once, with Student's interval for other scenes like these."""
    defined = [alpha for alpha in alphas if not math.isnan(alpha)]
    n, value = len(defined), macro_mean(defined)
    if n < LEAST_SCENES:
        return Estimate(value, math.nan, math.nan)
    spread = math.sqrt(sum((alpha - value) ** 2 for alpha in defined) / (n - 1) / n)
    half = float(special.stdtrit(n - 1, (1 + CONFIDENCE) / 2)) * spread
    return Estimate(value, max(value - half, -1.0), min(value + half, 1.0))


def _model_rows(models: dict[str, list[Record]], begin: str, width: int) -> Iterator[str]:
    interval = f"({CONFIDENCE:.0%} CI)".replace("%", " %")
    heads = ["all scenes", "verdicts", f"alpha {interval}", "agree", "flicker"]
    units = ["", "", "", "%", "%"]
    heads += [measure.title for measure in headlines()]
    units += ["OP>=3" for _ in headlines()]
    rows = [_model_row(name.removeprefix(begin), of_model) for name, of_model in models.items()]
    if any(row[-1] != "-" for row in rows):
        heads, units = [*heads, "mIoU"], [*units, "OP>=2"]
    else:
        rows = [row[:-1] for row in rows]
    yield from laid_out([heads, units, *rows], width)


def _model_row(name: str, records: Sequence[Record]) -> list[str]:
    statistics = [record.statistics for record in records if record.statistics is not None]
    levels = Counter(stats.verdict.decisive for stats in statistics).most_common()
    verdicts = levels[0][0] if len(levels) == 1 else ", ".join(f"{level} {n}" for level, n in levels[:2])
    of_features = [
        stats.features.alpha.value for stats in statistics if stats.features is not None and stats.features.alone
    ]
    if of_features:
        verdicts = "features"
    alpha = over_scenes(of_features or [stats.headline.alpha.value for stats in statistics])
    agree = 100 * macro_mean([stats.agreeing for stats in statistics])
    flicker = macro_mean([record.image_space.compensated_flicker_percent for record in records])
    recurrent = pooled(records).recurrent
    means = [recurrent[m] if recurrent.voxels >= ENOUGH else math.nan for m in headlines()]
    headline_texts = [short(value, digits=m.digits[0]) for m, value in zip(headlines(), means, strict=True)]
    right = [stats.correctness.miou_op2.value for stats in statistics if stats.correctness is not None]
    overlap = short(macro_mean(right) if right else math.nan, digits=3)
    return [name, verdicts, alpha.text(), number(agree, 0), number(flicker, 1), *headline_texts, overlap]


def _scene_lines(scenes: Sequence[str], models: dict[str, list[Record]], begin: str, width: int) -> Iterator[str]:
    """Yield a line for each scene: level and alpha of each model, with the interval if there is room."""
    first = min(SCENE_NAME, max(len("by scene"), *map(len, scenes)))
    rows = [[_cell(of_model, scene, interval=True) for of_model in models.values()] for scene in scenes]
    room = (width - 2 - first) // len(models) - 2
    if max(len(cell) for row in rows for cell in row) > room:
        rows = [[_cell(of_model, scene, interval=False) for of_model in models.values()] for scene in scenes]
    size = max(CELL, min(room, max(len(text) for row in (*rows, models) for text in row)))
    names = [cut(name.removeprefix(begin), size) for name in models]
    for head, cells in (("by scene", names), *zip(scenes, rows, strict=True)):
        line = "  ".join(f"{cut(cell, size):<{size}}" for cell in cells)
        yield f"  {cut(head, first):<{first}}  {line}".rstrip()


def _cell(records: Sequence[Record], scene: str, *, interval: bool) -> str:
    (statistics, *_) = [record.statistics for record in records if record.unit.scene == scene] or [None]
    if statistics is None:
        return "-"
    alpha = statistics.headline.alpha
    if statistics.features is not None and statistics.features.alone:
        alpha = statistics.features.alpha
        return f"features {alpha.text() if interval else short(alpha.value)}"
    return f"{statistics.verdict.decisive} {alpha.text() if interval else short(alpha.value)}"


def _refuted(models: dict[str, list[Record]]) -> Iterator[str]:
    """Yield the models whose agreement ground truth refutes in a scene, with the share that is wrong there."""
    for name, records in models.items():
        assessed = [record.statistics for record in records if record.statistics is not None]
        wrong = [
            stats.headline.wrong_of_consistent_op3.value for stats in assessed if stats.verdict.level == "misleading"
        ]
        if wrong:
            low, high = percent(min(wrong)), percent(max(wrong))
            share = low if low == high else f"{low} to {high}"
            yield from wrapped(
                f"{name}: MISLEADING in {len(wrong)} of {len(records)} scenes, {share} of the voxels whose frames agree"
                " have a wrong class"
            )


def _silent(models: dict[str, list[Record]]) -> Iterator[str]:
    """Yield the models with another level if pixels without a label count as disagreeing."""
    for name, records in models.items():
        verdicts = [record.statistics.verdict for record in records if record.statistics is not None]
        if n := sum(bool(verdict.difference) for verdict in verdicts):
            yield from wrapped(
                f"{name}: another level in {n} scenes if pixels without a label count as disagreeing:"
                " semstab-bench show RUN verdicts"
            )


def _outlying(models: dict[str, list[Record]]) -> Iterator[str]:
    """Yield how many frames of each model stand out."""
    counts = []
    for name, records in models.items():
        outlying = [record.statistics.outlying_frames for record in records if record.statistics is not None]
        frames = [len(of_scene.frames) for of_scene in outlying if of_scene is not None and of_scene.frames]
        if frames:
            counts.append(f"{name} {sum(frames)} in {len(frames)} scene{'s' if len(frames) > 1 else ''}")
    if counts:
        yield from wrapped(f"frames that stand out: {', '.join(counts)}: semstab-bench show RUN frames")
