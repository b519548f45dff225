"""The table of a benchmark: results that were handed in, checked, ranked with intervals, as a page, JSON and CSV."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.comparison.entries import Entry, RunHandle
from semstab.comparison.ranking import over_places, ranked
from semstab.core.files import write_json, write_text
from semstab.data.statistics import UNKNOWN, Interval
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.definition import Benchmark, Number
from semstab.leaderboard.submission import SUFFIX, Submission, load_submission
from semstab.report.charts import point_chart
from semstab.report.html import filled, table_block
from semstab.report.tables.table import Column, Group, Row, Table, relations, to_csv, to_json, to_markdown
from semstab.statistics.intervals import estimate, mean_over_frames, scope_of

NUMBERS: Mapping[Number, Column] = {
    "alpha": Column("alpha", "alpha", 3, "higher"),
    "flicker": Column("flicker_percent", "flicker, %", 2, "lower"),
    "accuracy": Column("accuracy", "accuracy", 3, "higher"),
    "miou": Column("miou", "mIoU", 3, "higher"),
    "wrong_of_consistent": Column("wrong_of_consistent", "consistent but wrong", 3, "lower"),
}
"""The columns of a headline."""


@dataclass(frozen=True, eq=False)
class BoardRow:
    """A result in the table.

    Attributes:
        rank: 1 plus the number of models that are shown to be more stable; None for a model that is not ranked.
        last: The worst rank that is possible: the models below it are shown to be less stable.
        numbers: Of the headline, over all places, with their intervals.
        scenes: Alpha in each scene, with the verdict's level.
        classes: Alpha of each class, the mean over scenes that assess it.
    """

    file: str
    name: str
    about: Submission
    rank: int | None
    last: int
    numbers: Mapping[str, Interval]
    scenes: Mapping[str, tuple[Interval, str]]
    classes: Mapping[str, float]

    @property
    def ranks(self) -> str:
        """The ranks that are possible, in print: '1', '2 to 4', '-' without one."""
        if self.rank is None:
            return "-"
        return str(self.rank) if self.rank == self.last else f"{self.rank} to {self.last}"

    @property
    def verdict(self) -> str:
        """The levels of its verdicts, in print: 'stable', 'stable 3, usable 2'."""
        levels = [level for _, level in self.scenes.values()]
        counts = Counter(levels).most_common()
        return ", ".join(level if len(counts) == 1 else f"{level} {n}" for level, n in counts)


@dataclass(frozen=True, eq=False)
class Board:
    """A benchmark with its results, the most stable first, then those that are not ranked.

    Attributes:
        unranked: Why models are not ranked, and which.
    """

    benchmark: Benchmark
    rows: tuple[BoardRow, ...]
    unranked: Mapping[str, tuple[str, ...]]

    @property
    def reasons(self) -> list[str]:
        """Sentences about models that are not ranked."""
        return [f"not ranked, as {reason}: {', '.join(names)}" for reason, names in self.unranked.items()]


Result = tuple[str, Submission, RunHandle]
"""The file of a result, what it says of its model, and its numbers."""


def boards(folder: Path, definitions: Mapping[str, Benchmark] | None = None) -> tuple[Board, ...]:
    """Return the tables of all results in a folder and below it, the benchmarks by name.

    Args:
        folder: Where the files are.
        definitions: Benchmarks that do not ship with semstab, by NAME@VERSION.

    Raises:
        ConfigError: If there is no such folder, or no result in it.
        DataError: For a file that is no result, or contradicts itself or its benchmark.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder; give the folder with the results")
    files = sorted(folder.rglob(f"*{SUFFIX}"))
    if not files:
        raise ConfigError(f"{folder}: it holds no result, NAME{SUFFIX}; write one with benchmark ... --submit")
    by_benchmark: dict[str, tuple[Benchmark, list[Result]]] = {}
    for file in files:
        benchmark, about, handle = load_submission(file, definitions)
        by_benchmark.setdefault(benchmark.id, (benchmark, []))[1].append((str(file.relative_to(folder)), about, handle))
    return tuple(board_of(benchmark, results) for _, (benchmark, results) in sorted(by_benchmark.items()))


def board_of(benchmark: Benchmark, results: Sequence[Result]) -> Board:
    """Return the table of results of one benchmark.

    Raises:
        DataError: For two results of one name.
    """
    names = [_name(about, handle) for _, about, handle in results]
    if twice := next((name for name in names if names.count(name) > 1), None):
        first, second = (file for (file, _, _), name in zip(results, names, strict=True) if name == twice)
        raise DataError(f"{first} and {second}: both are called '{twice}'; name one otherwise in its card")
    own, places = dict(zip(names, results, strict=True)), benchmark.places()
    unranked = _unranked(own, benchmark)
    compared = [name for name in names if not any(name in left for left in unranked.values())]
    sums = [{name: own[name][2].scenes[scene].sums for name in compared} for scene in benchmark.scenes]
    ranking = ranked(sums, compared, places)
    rank: dict[str, int | None] = {name: number for number, group in ranking.ranks for name in group}
    worse = dict.fromkeys(compared, 0)
    for each in ranking.differences:
        if each.shown:
            worse[each.model if each.value > 0 else each.other] += 1
    last = {name: len(compared) - number for name, number in worse.items()}
    rows = [_row(benchmark, name, result, rank.get(name), last.get(name, 0)) for name, result in own.items()]
    rows.sort(key=lambda row: (math.inf if row.rank is None else row.rank, -row.numbers["alpha"].value))
    return Board(benchmark, tuple(rows), unranked)


NOT_RANKED = {"uninformative": "nearly the whole map is one class", "misleading": "consistent labels are often wrong"}
"""Levels of verdicts in all scenes at which alpha assesses no labels, and why."""

OTHER_CLASSES = "their classes are others"


def _unranked(own: Mapping[str, Result], benchmark: Benchmark) -> dict[str, tuple[str, ...]]:
    """Return the models that alpha cannot rank, by the reason."""
    classes = {name: handle.scenes[benchmark.scenes[0]].classes for name, (_, _, handle) in own.items()}
    most = max(classes.values(), key=[*classes.values()].count)
    reasons = {OTHER_CLASSES: tuple(name for name in own if classes[name] != most)}
    for level, reason in NOT_RANKED.items():
        left = [name for name, (_, _, handle) in own.items() if {*_levels(handle)} == {level}]
        reasons[reason] = tuple(name for name in left if classes[name] == most)
    return {reason: names for reason, names in reasons.items() if names}


def _levels(handle: RunHandle) -> list[str]:
    statistics = [entry.summary.statistics for entry in handle.scenes.values()]
    return ["" if own is None else own.verdict.decisive for own in statistics]


def _name(about: Submission, handle: RunHandle) -> str:
    return str(about.card.get("name") or handle.model)


def _row(benchmark: Benchmark, name: str, result: Result, rank: int | None, last: int) -> BoardRow:
    file, about, handle = result
    entries, places = [handle.scenes[scene] for scene in benchmark.scenes], benchmark.places()
    shown = dict.fromkeys(("alpha", *benchmark.measures))
    numbers: dict[str, Interval] = {
        key: _over_places([_number(entry, key) for entry in entries], places) for key in shown
    }
    alphas = [_number(entry, "alpha") for entry in entries]
    scenes = dict(zip(benchmark.scenes, zip(alphas, _levels(handle), strict=True), strict=True))
    return BoardRow(file, name, about, rank, last, numbers, scenes, _classes(entries))


def _number(entry: Entry, key: Number) -> Interval:
    """Return a number of a scene with its interval, from its sums."""
    if key == "flicker":
        frames = np.array([*entry.flicker], dtype=np.int64)
        return mean_over_frames(frames, np.array([*entry.flicker.values()]))
    if key != "alpha" and not entry.sums.truth:
        return UNKNOWN
    return estimate(entry.sums, key, scope=scope_of(entry.sums, key=key))


def _over_places(values: Sequence[Interval], places: Sequence[str]) -> Interval:
    known = [not math.isnan(own.value) for own in values]
    return over_places(values, places) if all(known) else UNKNOWN


def _classes(entries: Sequence[Entry]) -> dict[str, float]:
    alphas: dict[str, list[float]] = {}
    for entry in entries:
        spots = None if entry.summary.statistics is None else entry.summary.statistics.spots
        for own in () if spots is None else spots.classes:
            if own.counts_for_verdict and math.isfinite(own.alpha.value):
                alphas.setdefault(own.name, []).append(own.alpha.value)
    return {name: float(np.mean(values)) for name, values in alphas.items()}


Rows = tuple[Row, ...]

# --- Tables -----------------------------------------------------------------------------------------------------------


def headline(board: Board) -> Table:
    """Return the table of a benchmark: rank, model, the headline's numbers, cost and origin."""
    shown = [key for key in NUMBERS if key in board.benchmark.measures]
    columns = (
        Column("rank", "rank"), Column("model", "model"), *(NUMBERS[key] for key in shown),
        Column("verdict", "verdict"), Column("milliseconds", "ms a frame", 1, "lower"),
        Column("parameters", "parameters, M", 1), Column("by", "by"), Column("made", "day"),
        Column("semstab", "semstab"),
    )  # fmt: skip
    rows: Rows = tuple(
        (
            row.ranks, row.name, *(row.numbers[key] for key in shown), row.verdict, row.about.milliseconds,
            float(row.about.card.get("parameters") or math.nan), str(row.about.card.get("by", "")), row.about.made,
            row.about.semstab,
        )
        for row in board.rows
    )  # fmt: skip
    benchmark = board.benchmark
    count = len({*benchmark.places()})
    what = f"{count} {'place' if benchmark.flights else 'scene'}{'' if count == 1 else 's'}"
    caption = (
        f"{benchmark.description[0].upper()}{benchmark.description[1:]}; definition {benchmark.digest}. Means over"
        f" {what}, with intervals at 95 %. A rank is 1 plus the number of models that are shown to be more stable in"
        " alpha (paired by frames and cubes, Holm); 'to' names the last rank that is possible: models that share ranks"
        " are not told apart. Milliseconds are of the model on the machine that it was run on, and unknown where label"
        " maps were read."
    )
    caption += "".join(f" {text[0].upper()}{text[1:]}." for text in board.reasons)
    named = f"{benchmark.id} ({benchmark.digest})"
    return Table(f"leaderboard-{benchmark.id}", benchmark.id, caption, columns, (Group("", rows),), "", named)


def by_scene(board: Board) -> Table:
    """Return alpha of each model in each scene, with the level of its verdict."""
    scenes = board.benchmark.scenes
    columns = (Column("model", "model"), *(Column(scene, scene, 3, "higher") for scene in scenes))
    rows: Rows = tuple((row.name, *(row.scenes[scene][0] for scene in scenes)) for row in board.rows)
    caption = "Alpha in each scene, with intervals at 95 %."
    return Table(
        f"scenes-{board.benchmark.id}", f"{board.benchmark.id} by scene", caption, columns, (Group("", rows),), ""
    )


def by_class(board: Board) -> Table:
    """Return alpha of each model for each class that counts somewhere."""
    names = list(dict.fromkeys(name for row in board.rows for name in row.classes))
    columns = (Column("model", "model"), *(Column(name, name, 3, "higher") for name in names))
    rows: Rows = tuple((row.name, *(row.classes.get(name, math.nan) for name in names)) for row in board.rows)
    caption = "Alpha of a class against all others, the mean over scenes in which it counts for the verdict."
    return Table(
        f"classes-{board.benchmark.id}", f"{board.benchmark.id} by class", caption, columns, (Group("", rows),), ""
    )


# --- Files ------------------------------------------------------------------------------------------------------------


def write_site(made: Sequence[Board], out: Path) -> list[Path]:
    """Write index.html, and for each benchmark NAME@VERSION.json, .csv and .md; return the paths."""
    written = []
    for board in made:
        table, stem = headline(board), out / board.benchmark.id
        for suffix, text in ((".csv", to_csv(table)), (".md", to_markdown(table))):
            written.append(stem.with_name(stem.name + suffix))
            write_text(written[-1], text)
        written.append(stem.with_name(f"{stem.name}.json"))
        write_json(written[-1], _content(board))
    written.append(out / "index.html")
    write_text(written[-1], filled("leaderboard.html.j2", boards=[_section(board) for board in made]))
    return written


def _content(board: Board) -> dict[str, Any]:
    benchmark = board.benchmark
    return {
        "benchmark": benchmark.id, "digest": benchmark.digest,
        "results": [
            {
                "rank": row.rank, "last_rank": row.last, "name": row.name, "file": row.file, "about": row.about,
                "numbers": row.numbers, "classes": row.classes,
                "scenes": {scene: {"alpha": alpha, "level": level} for scene, (alpha, level) in row.scenes.items()},
            }
            for row in board.rows
        ],
        "tables": [to_json(table) for table in (headline(board), by_scene(board), by_class(board))],
    }  # fmt: skip


def _section(board: Board) -> dict[str, Any]:
    benchmark = board.benchmark
    return {
        "id": benchmark.id,
        "description": benchmark.description,
        "facts": [*_facts(benchmark)],
        "superseded": benchmark.superseded_by,
        "charts": [*_charts(board)],
        "table": table_block(headline(board)),
        "more": [table_block(table) for table in (by_scene(board), by_class(board))],
        "cards": [(row.name, [*_card(row)]) for row in board.rows],
        "caption": relations(headline(board).caption),
    }


def _charts(board: Board) -> Iterator[dict[str, str]]:
    """Yield stability against accuracy, cost and size, where two models have both."""
    rows = [row for row in board.rows if row.verdict != "uninformative"]
    accuracy = [(row.name, row.numbers.get("accuracy", UNKNOWN).value, row.numbers["alpha"]) for row in rows]
    cost = [(row.name, row.about.milliseconds, row.numbers["alpha"]) for row in rows]
    size = [(row.name, float(row.about.card.get("parameters") or math.nan), row.numbers["alpha"]) for row in rows]
    for title, points, label in (
        ("Stability and accuracy", accuracy, "accuracy of the fused labels"),
        ("Stability and cost", cost, "milliseconds a frame"),
        ("Stability and size", size, "parameters, millions"),
    ):
        if sum(math.isfinite(x) for _, x, _ in points) > 1:
            yield {"title": title, "chart": point_chart(points, label, "alpha")}


def _facts(benchmark: Benchmark) -> Iterator[tuple[str, str]]:
    yield "dataset", benchmark.dataset.name
    yield "scenes", ", ".join(benchmark.scenes)
    yield "voxels", f"{benchmark.voxel_size:g} m"
    yield "definition", benchmark.digest
    if benchmark.get:
        yield "data", benchmark.get
    yield "licence", benchmark.license
    yield "citation", benchmark.citation


def _card(row: BoardRow) -> Iterator[tuple[str, str]]:
    about = row.about
    for key, title in (
        ("by", "by"), ("url", "address"), ("license", "licence"), ("trained_on", "trained on"), ("notes", "notes"),
    ):  # fmt: skip
        if about.card.get(key):
            yield title, str(about.card[key])
    yield "result", f"{row.file}, {about.made}, semstab {about.semstab}"
    yield "machine", f"{about.processor}, {about.cores} cores, {about.platform}, Python {about.python}"
    if about.packages:
        yield "packages", ", ".join(f"{name} {version}" for name, version in about.packages.items())


def lines(made: Sequence[Board]) -> Iterator[str]:
    """Yield what a terminal shows: the rank, the model and alpha of each result."""
    for board in made:
        count = len(board.rows)
        yield f"{board.benchmark.id} ({board.benchmark.digest}), {count} result{'' if count == 1 else 's'}"
        for row in board.rows:
            yield f"  {row.ranks:>8}  {row.name:<28} alpha {row.numbers['alpha'].text()}"
        yield from (f"  {text}" for text in board.reasons)
