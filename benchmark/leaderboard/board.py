"""The table of a benchmark: results that were handed in, checked, ranked with intervals, as a page, JSON and CSV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semstab.comparison.runs import Entry, RunHandle
from semstab.core.files import write_json, write_text
from semstab.data.statistics import UNKNOWN, Interval
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.definition import Benchmark, Number
from semstab.leaderboard.submission import SUFFIX, Submission, load_submission
from semstab.report.charts import point_chart
from semstab.report.html import filled, table_block
from semstab.report.ranking import over_places, ranked
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
        rank: 1 plus the number of models that are shown to be more stable; last is the worst rank that is possible: no
            model below it is shown to be less stable.
        numbers: Of the headline, over all places, with their intervals.
        scenes: Alpha in each scene, with the verdict's level.
        classes: Alpha of each class, the mean over scenes that assess it.
    """

    file: str
    name: str
    about: Submission
    rank: int
    last: int
    numbers: Mapping[str, Interval]
    scenes: Mapping[str, tuple[Interval, str]]
    classes: Mapping[str, float]

    @property
    def ranks(self) -> str:
        """The ranks that are possible, in print: '1', '2 to 4'."""
        return str(self.rank) if self.rank == self.last else f"{self.rank} to {self.last}"


@dataclass(frozen=True, eq=False)
class Board:
    """A benchmark with its results, the most stable first.

    Attributes:
        apart: Results whose label space is another one, which cannot be ranked with the others.
        uninformative: Results whose maps are nearly one class in every scene, about which alpha tells nothing.
    """

    benchmark: Benchmark
    rows: tuple[BoardRow, ...]
    apart: tuple[str, ...] = ()
    uninformative: tuple[str, ...] = ()

    @property
    def unranked(self) -> list[str]:
        """Sentences about results that are not ranked."""
        reasons = ("their classes are others", self.apart), ("nearly the whole map is one class", self.uninformative)
        return [f"not ranked, as {reason}: {', '.join(names)}" for reason, names in reasons if names]


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
    found: dict[str, tuple[Benchmark, list[Result]]] = {}
    for file in files:
        benchmark, about, handle = load_submission(file, definitions)
        found.setdefault(benchmark.id, (benchmark, []))[1].append((str(file.relative_to(folder)), about, handle))
    return tuple(board_of(benchmark, results) for _, (benchmark, results) in sorted(found.items()))


def board_of(benchmark: Benchmark, results: Sequence[Result]) -> Board:
    """Return the table of results of one benchmark.

    Raises:
        DataError: For two results of one name.
    """
    names = [_name(about, handle) for _, about, handle in results]
    if twice := next((name for name in names if names.count(name) > 1), None):
        first, second = (file for (file, _, _), name in zip(results, names, strict=True) if name == twice)
        raise DataError(f"{first} and {second}: both are called '{twice}'; name one otherwise in its card")
    own = dict(zip(names, results, strict=True))
    classes = {name: handle.scenes[benchmark.scenes[0]].classes for name, (_, _, handle) in own.items()}
    most = max(classes.values(), key=[*classes.values()].count)
    one_class = [name for name in names if _is_uninformative(own[name][2])]
    compared = [name for name in names if classes[name] == most and name not in one_class]
    places = benchmark.places()
    sums = [{name: own[name][2].scenes[scene].sums for name in compared} for scene in benchmark.scenes]
    ranking = ranked(sums, compared, places)
    rank = {name: number for number, group in ranking.ranks for name in group} or dict.fromkeys(compared, 1)
    worse = dict.fromkeys(compared, 0)
    for each in ranking.differences:
        if each.shown:
            worse[each.model if each.value > 0 else each.other] += 1
    rows = [_row(benchmark, name, own[name], rank[name], len(compared) - worse[name], places) for name in compared]
    rows.sort(key=lambda row: (row.rank, -row.numbers["alpha"].value))
    apart = tuple(name for name in names if name not in compared and name not in one_class)
    return Board(benchmark, tuple(rows), apart, tuple(one_class))


def _is_uninformative(handle: RunHandle) -> bool:
    statistics = [entry.summary.statistics for entry in handle.scenes.values()]
    return all(own is not None and own.verdict.level == "uninformative" for own in statistics)


def _name(about: Submission, handle: RunHandle) -> str:
    return str(about.card.get("name") or handle.model)


def _row(benchmark: Benchmark, name: str, result: Result, rank: int, last: int, places: Sequence[str]) -> BoardRow:
    file, about, handle = result
    entries = [handle.scenes[scene] for scene in benchmark.scenes]
    numbers: dict[str, Interval] = {
        key: _over_places([_number(entry, key) for entry in entries], places) for key in benchmark.measures
    }
    numbers.setdefault("alpha", _over_places([_number(entry, "alpha") for entry in entries], places))
    alphas = {scene: _number(entry, "alpha") for scene, entry in zip(benchmark.scenes, entries, strict=True)}
    levels = [entry.summary.statistics.verdict.level if entry.summary.statistics else "" for entry in entries]
    scenes = {scene: (alpha, level) for (scene, alpha), level in zip(alphas.items(), levels, strict=True)}
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
        cells = None if entry.summary.statistics is None else entry.summary.statistics.cells
        for own in () if cells is None else cells.classes:
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
        Column("milliseconds", "ms a frame", 1, "lower"), Column("parameters", "parameters, M", 1),
        Column("by", "by"), Column("made", "day"), Column("semstab", "semstab"),
    )  # fmt: skip
    rows: Rows = tuple(
        (
            row.ranks, row.name, *(row.numbers[key] for key in shown), row.about.milliseconds,
            float(row.about.card.get("parameters") or math.nan), str(row.about.card.get("by", "")), row.about.made,
            row.about.semstab,
        )
        for row in board.rows
    )  # fmt: skip
    benchmark = board.benchmark
    what = "places" if benchmark.flights else "scenes"
    caption = (
        f"{benchmark.id} (definition {benchmark.digest}): {benchmark.description}. Means over"
        f" {len({*benchmark.places()})} {what}, with intervals at 95 %. A rank is 1 plus the number of models that are"
        " shown to be more stable in alpha (paired by frames and cubes, Holm); 'to' names the last rank that is"
        " possible: models that share ranks are not told apart. Milliseconds are of the model on the machine that it"
        " was run on, and unknown where label maps were read."
    )
    caption += "".join(f" {text[0].upper()}{text[1:]}." for text in board.unranked)
    return Table(f"leaderboard-{benchmark.id}", benchmark.id, caption, columns, (Group("", rows),))


def by_scene(board: Board) -> Table:
    """Return alpha of each model in each scene, with the level of its verdict."""
    scenes = board.benchmark.scenes
    columns = (Column("model", "model"), *(Column(scene, scene, 3, "higher") for scene in scenes))
    rows: Rows = tuple((row.name, *(row.scenes[scene][0] for scene in scenes)) for row in board.rows)
    caption = "Alpha in each scene, with intervals at 95 %."
    return Table(f"scenes-{board.benchmark.id}", f"{board.benchmark.id} by scene", caption, columns, (Group("", rows),))


def by_class(board: Board) -> Table:
    """Return alpha of each model for each class that counts somewhere."""
    names = list(dict.fromkeys(name for row in board.rows for name in row.classes))
    columns = (Column("model", "model"), *(Column(name, name, 3, "higher") for name in names))
    rows: Rows = tuple((row.name, *(row.classes.get(name, math.nan) for name in names)) for row in board.rows)
    caption = "Alpha of a class against all others, the mean over scenes in which it counts for the verdict."
    return Table(
        f"classes-{board.benchmark.id}", f"{board.benchmark.id} by class", caption, columns, (Group("", rows),)
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
    """Yield stability against accuracy, and against cost, where two models have both."""
    rows = board.rows
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
        yield f"{board.benchmark.id} ({board.benchmark.digest}), {len(board.rows)} results"
        for row in board.rows:
            yield f"  {row.ranks:>8}  {row.name:<28} alpha {row.numbers['alpha'].text()}"
        yield from (f"  {text}" for text in board.unranked)
