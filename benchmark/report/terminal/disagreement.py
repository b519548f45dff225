"""Where frames disagree most: the classes with most of the disagreement, and frames that stand out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from semstab.core.console import wrapped
from semstab.data.records import Record
from semstab.data.statistics import short
from semstab.metrics import macro_mean
from semstab.report.narrative import outlying_line
from semstab.report.terminal.layout import cut

MAJORITY = 0.5
"""A class with this share of the map or more is not listed for several models: all other classes disagree with it."""

CONFUSED = "confused with"
CLASS_HEAD = ("disagreement by class", "alpha", CONFUSED, "of map", "of disagreement")
CLASS_COLUMNS, LEAST_CLASS = 35, 27
"""The columns of a line of classes without its two names, and the least width of the first name."""

CONTRIBUTES = 0.01
"""The least share of the disagreement of a class that is listed."""

MOST_CLASSES = {1: 5, 2: 3}
"""The number of classes that are listed for each model, by the number of rows above; else 1."""


def class_lines(records: Sequence[Record], width: int, begin: str = "") -> Iterator[str]:
    """Yield a line for each of the classes with most of the disagreement, and the classes that are not listed.

    Names of models are printed without their common beginning `begin`.
    """
    names = list(dict.fromkeys(record.unit.model for record in records))
    most, alone = MOST_CLASSES.get(len(records), 1), len(names) == 1
    rows: list[tuple[str, str, str, str, str]] = []
    left_out: dict[str, None] = {}
    for name in names:
        of_model = [record for record in records if record.unit.model == name]
        classes, shares = class_means(of_model), _class_shares(of_model)
        confused_with = {k: v for record in of_model for k, v in record.map_summary.confused_with.items()}
        listed = sorted(
            (key for key, (_, disagreement) in classes.items() if disagreement >= CONTRIBUTES and key in shares),
            key=lambda key: -classes[key][1],
        )
        small = [key for key in listed if shares.get(key, 0.0) < MAJORITY]
        if not alone and small:
            left_out |= dict.fromkeys(key for key in listed if key not in small)
            listed = small
        for key in listed[:most]:
            label, (alpha, disagreement) = key if alone else f"{name.removeprefix(begin)}: {key}", classes[key]
            of_map, of_all = f"{100 * shares.get(key, 0.0):.0f} %", f"{100 * disagreement:.0f} %"
            rows.append((f"  {label}", short(alpha), confused_with.get(key, ""), of_map, of_all))
    if rows:
        room = width - CLASS_COLUMNS
        first = max(LEAST_CLASS, min(room * 2 // 3, max(len(row[0]) for row in rows)))
        second = max(len(CONFUSED), min(room - first, max(len(row[2]) for row in rows)))
        for label, alpha_, other, of_map, of_all in (CLASS_HEAD, *rows):
            line = f"  {cut(label, first):<{first}}{alpha_:>5}   {cut(other, second):<{second}}"
            yield f"{line}{of_map:>8}{of_all:>17}"
    if left_out:
        yield f"    not listed: {', '.join(left_out)} (half of the map or more)"


def class_means(records: Sequence[Record]) -> dict[str, tuple[float, float]]:
    """Return alpha of each class and its share of the disagreement, macro means over scenes, where both are known."""
    by_class: dict[str, list[tuple[float, float]]] = {}
    for statistics in (record.statistics for record in records if record.statistics is not None):
        for row in () if statistics.spots is None else statistics.spots.classes:
            if not (math.isnan(row.alpha.value) or math.isnan(row.disagreement)):
                by_class.setdefault(row.name, []).append((row.alpha.value, row.disagreement))
    return {
        name: (macro_mean([a for a, _ in values]), macro_mean([d for _, d in values]))
        for name, values in by_class.items()
    }


def _class_shares(records: Sequence[Record]) -> dict[str, float]:
    """Return the share of the map that each class dominates."""
    voxels: dict[str, int] = {}
    for row in (row for record in records for row in record.map_summary.classes):
        voxels[row.name] = voxels.get(row.name, 0) + row.voxels
    total = sum(record.map_summary.voxels for record in records)
    return {name: n / max(1, total) for name, n in voxels.items()}


def outlying_lines(records: Sequence[Record]) -> Iterator[str]:
    """Yield the frames that stand out; of several maps, only the maps that have such frames."""
    for record in records:
        outlying = record.outlying_frames
        if outlying is None or (len(records) > 1 and not outlying.frames):
            continue
        scene = record.unit.scene if len({other.unit.scene for other in records}) > 1 else ""
        subject = ", ".join(name for name in (scene, record.unit.model) if name) if len(records) > 1 else ""
        yield from wrapped(outlying_line(outlying, subject))
