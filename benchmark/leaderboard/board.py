"""The table of a benchmark: results that were handed in, ranked by sums that were checked, with intervals; as a page.

Each number of it is computed from the sums. What rests on the word of whoever handed a result in is a table apart.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.comparison.entries import RunHandle
from semstab.comparison.quantities import MISLEADING
from semstab.comparison.ranking import over_places, ranked
from semstab.core.files import write_text
from semstab.data.statistics import CONFIDENCE, UNKNOWN, HeadlineStatistics, Interval, Level, SpotAgreement
from semstab.errors import ConfigError, DataError
from semstab.leaderboard.definition import Benchmark, Number
from semstab.leaderboard.geometry import Spots
from semstab.leaderboard.submission import SUFFIX, Submission, load_submission
from semstab.leaderboard.sums import completed, labelled_share
from semstab.report.html import filled, table_block
from semstab.report.tables.table import Column, Group, Row, Table
from semstab.statistics.cluster_sums import ClusterSums, chance_of
from semstab.statistics.correctness import ACCURACY, MIOU
from semstab.statistics.intervals import estimate, scope_of
from semstab.statistics.verdict import verdict

OF_TRUTH: Mapping[Number, Column] = {
    "accuracy": Column.for_quantity(ACCURACY),
    "miou": Column.for_quantity(MIOU),
    "wrong_of_consistent": Column.for_quantity(MISLEADING),
}
"""The columns that need ground truth."""


@dataclass(frozen=True, eq=False)
class SceneNumbers:
    """The numbers of a model in a scene, from its sums.

    Attributes:
        whole: The sums, in which an answer that is missing disagrees.
        alpha: Alpha of these, by which models are ranked.
        of_labelled: Alpha of the answers that there are.
        labelled: Share of the answers that a model has to give that it gives.
        level: Of the verdict.
        truth: Numbers that need ground truth, by their keys.
    """

    whole: ClusterSums
    alpha: Interval
    of_labelled: Interval
    labelled: float
    level: Level
    truth: Mapping[Number, Interval]

    @classmethod
    def from_sums(cls, sums: ClusterSums, spots: Spots) -> SceneNumbers:
        """Return the numbers of sums that were checked."""
        complete = completed(sums, spots)
        alpha, of_labelled = (estimate(part, "alpha", scope=scope_of(part)) for part in (complete, sums))
        keys = OF_TRUTH if sums.truth else ()
        truth = {key: estimate(sums, key, scope=scope_of(sums, key=key)) for key in keys}
        labelled = labelled_share(sums.answers[0], spots)
        level = _level(complete, spots, alpha, _at_least_wrong(sums, truth))
        return cls(complete, alpha, of_labelled, labelled, level, truth)


def _level(complete: ClusterSums, spots: Spots, alpha: Interval, wrong: Interval) -> Level:
    """Return the level of the verdict, with all answers that a model has to give."""
    first = complete.answers[0]
    voxels, evidence = round(float(complete["voxels"].sum())), first["evidence"].sum(axis=0)
    largest, n = int(evidence.argmax()), float(evidence.sum())
    agreement = SpotAgreement(
        spacing=math.nan, spots=round(float(first["voxels"].sum())), cubes=first.cells, frames=spots.frames,
        views=len(np.unique(first.frame)) * max(first.step, 1), chance=chance_of(first),
        largest_class=complete.classes[largest], largest_share=float(evidence[largest]) / n if n else math.nan,
        labelled=1.0, classes=(),
    )  # fmt: skip
    headline = HeadlineStatistics(alpha, UNKNOWN, UNKNOWN, UNKNOWN, wrong)
    return verdict("", headline=headline, spots=agreement, voxels=voxels, share=1.0).level


def _at_least_wrong(sums: ClusterSums, truth: Mapping[Number, Interval]) -> Interval:
    """Return the wrong among the consistent locations, whose lower end is at least what agreement and accuracy give.

    Two views agree on a wrong label at least as often as they agree, less the share of the right labels.
    """
    first, wrong = sums.answers[0], truth.get("wrong_of_consistent", UNKNOWN)
    n = float(first["observations"].sum())
    agreeing = float(first["agreeing"].sum()) / n if n else math.nan
    least = 1 - truth["accuracy"].high / agreeing if truth and agreeing > 0 else math.nan
    return dataclasses.replace(wrong, value=float(np.fmax(wrong.value, least)), low=float(np.fmax(wrong.low, least)))


@dataclass(frozen=True, eq=False)
class BoardRow:
    """A result in the table.

    Attributes:
        rank: 1 plus the number of models that are shown to be more stable; None for a model that is not ranked.
        last: The worst rank that is possible: the models below it are shown to be less stable.
        scenes: Its numbers in each scene.
        places: The place of each scene.
    """

    file: str
    name: str
    about: Submission
    rank: int | None
    last: int
    scenes: Mapping[str, SceneNumbers]
    places: tuple[str, ...]

    @property
    def ranks(self) -> str:
        """The ranks that are possible, in print: '1', '2 to 4', '-' without one."""
        if self.rank is None:
            return "-"
        return str(self.rank) if self.rank == self.last else f"{self.rank} to {self.last}"

    @property
    def alpha(self) -> Interval:
        """Alpha, the mean over places, in which an answer that is missing disagrees."""
        return self._mean([scene_numbers.alpha for scene_numbers in self.scenes.values()])

    @property
    def of_labelled(self) -> Interval:
        """Alpha of the answers that there are, the mean over places."""
        return self._mean([scene_numbers.of_labelled for scene_numbers in self.scenes.values()])

    @property
    def labelled(self) -> float:
        """Share of the answers that a model has to give that it gives, the mean over scenes."""
        return float(np.mean([scene_numbers.labelled for scene_numbers in self.scenes.values()]))

    def truth(self, key: Number) -> Interval:
        """Return a number that needs ground truth, the mean over places."""
        return self._mean([scene_numbers.truth.get(key, UNKNOWN) for scene_numbers in self.scenes.values()])

    @property
    def verdict(self) -> str:
        """The levels of its verdicts, in print: 'stable', 'stable 3, usable 2'."""
        counts = Counter(scene_numbers.level for scene_numbers in self.scenes.values()).most_common()
        return ", ".join(level if len(counts) == 1 else f"{level} {n}" for level, n in counts)

    def _mean(self, values: Sequence[Interval]) -> Interval:
        defined = [not math.isnan(interval.value) for interval in values]
        return over_places(values, self.places) if all(defined) else UNKNOWN


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
"""The file of a result, what it says of its model, and its sums."""


def boards(folder: Path, definitions: Mapping[str, Benchmark] | None = None) -> tuple[Board, ...]:
    """Return the tables of all results in a folder and below it, the benchmarks by name.

    Args:
        folder: Where the files are.
        definitions: Benchmarks that do not ship with semstab, by NAME@VERSION.

    Raises:
        ConfigError: If there is no such folder, or no result in it.
        DataError: For a file that is no result, or whose sums cannot be.
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
    return board_of_numbers(benchmark, results, numbers_of(benchmark, results))


def numbers_of(benchmark: Benchmark, results: Sequence[Result]) -> dict[str, dict[str, SceneNumbers]]:
    """Return the numbers of each result, by its name and by scene.

    Raises:
        DataError: For two results of one name.
    """
    names = [_name(about, handle) for _, about, handle in results]
    if twice := next((name for name in names if names.count(name) > 1), None):
        first, second = (file for (file, _, _), name in zip(results, names, strict=True) if name == twice)
        raise DataError(f"{first} and {second}: both are called '{twice}'; name one otherwise in its card")
    geometry = benchmark.geometry
    return {
        name: {scene: SceneNumbers.from_sums(handle.scenes[scene].sums, geometry[scene]) for scene in benchmark.scenes}
        for name, (_, _, handle) in zip(names, results, strict=True)
    }


def board_of_numbers(
    benchmark: Benchmark, results: Sequence[Result], numbers: Mapping[str, Mapping[str, SceneNumbers]]
) -> Board:
    """Return the table of results whose numbers are these, in the order of the results."""
    places, names = benchmark.places(), [*numbers]
    unranked = _unranked(numbers)
    compared = [name for name in names if not any(name in unranked_names for unranked_names in unranked.values())]
    ranking = ranked(
        [{name: numbers[name][scene].whole for name in compared} for scene in numbers[names[0]]], compared, places
    )
    rank: dict[str, int | None] = {name: number for number, group in ranking.ranks for name in group}
    worse = dict.fromkeys(compared, 0)
    for difference in ranking.differences:
        if difference.shown:
            worse[difference.model if difference.value > 0 else difference.other] += 1
    rows = [
        BoardRow(file, name, about, rank.get(name), len(compared) - worse.get(name, 0), numbers[name], places)
        for name, (file, about, _) in zip(names, results, strict=True)
    ]
    rows.sort(key=lambda row: (math.inf if row.rank is None else row.rank, *_falling(row.alpha.value), row.name))
    return Board(benchmark, tuple(rows), unranked)


def _falling(value: float) -> tuple[bool, float]:
    return math.isnan(value), 0.0 if math.isnan(value) else -value


NOT_RANKED: Mapping[Level, str] = {
    "uninformative": "nearly the whole map is one class",
    "misleading": "consistent labels are often wrong",
    "no verdict": "too few locations were seen twice",
}
"""Levels at which alpha assesses no labels, and why: a model that has one in most scenes is not ranked."""


def _unranked(numbers: Mapping[str, Mapping[str, SceneNumbers]]) -> dict[str, tuple[str, ...]]:
    """Return the models that alpha cannot rank, by the reason."""
    reasons: dict[str, tuple[str, ...]] = {}
    for name, scenes in numbers.items():
        levels = Counter(
            scene_numbers.level
            for scene_numbers in scenes.values()
            if scene_numbers.level in NOT_RANKED or math.isnan(scene_numbers.alpha.value)
        )
        if 2 * levels.total() > len(scenes) or any(
            math.isnan(scene_numbers.alpha.value) for scene_numbers in scenes.values()
        ):
            reason = NOT_RANKED.get(levels.most_common(1)[0][0], NOT_RANKED["no verdict"])
            reasons[reason] = (*reasons.get(reason, ()), name)
    return reasons


def _name(about: Submission, handle: RunHandle) -> str:
    return str(about.card.get("name") or handle.model)


# --- Tables -----------------------------------------------------------------------------------------------------------


def headline(board: Board) -> Table:
    """Return the table of a benchmark: rank, model, and the numbers that follow from its sums."""
    keys = [key for key in OF_TRUTH if key in board.benchmark.measures]
    columns = (
        Column("rank", "rank"), Column("model", "model"), Column("alpha", "alpha", 3, "higher"),
        Column("of_labelled", "of what it labels", 3, "higher"), Column("labelled", "labelled, %", 1, "higher"),
        *(OF_TRUTH[key] for key in keys), Column("verdict", "verdict"),
    )  # fmt: skip
    rows: tuple[Row, ...] = tuple(
        (
            row.ranks, row.name, row.alpha, row.of_labelled, 100 * row.labelled, *(row.truth(key) for key in keys),
            row.verdict,
        )
        for row in board.rows
    )  # fmt: skip
    benchmark = board.benchmark
    count = len({*benchmark.places()})
    what = f"{count} {'place' if benchmark.flights else 'scene'}{'' if count == 1 else 's'}"
    caption = (
        f"{benchmark.description[0].upper()}{benchmark.description[1:]}; definition {benchmark.digest}. Means over"
        f" {what}, with intervals at {CONFIDENCE:.0%}, all computed from sums that were checked. Alpha counts an answer"
        " that a model leaves out as one that disagrees. A rank is 1 plus the number of models that are shown to be"
        " more stable in it (paired by frames and cubes, Holm); 'to' names the last rank that is possible: models that"
        " share ranks are not told apart."
    )
    caption += "".join(f" {text[0].upper()}{text[1:]}." for text in board.reasons)
    definition = f"{benchmark.id} ({benchmark.digest})"
    return _table(board, "leaderboard", benchmark.id, caption, columns, rows, definition)


def by_scene(board: Board) -> Table:
    """Return alpha of each model in each scene."""
    scenes = board.benchmark.scenes
    columns = (Column("model", "model"), *(Column(scene, scene, 3, "higher") for scene in scenes))
    rows: tuple[Row, ...] = tuple((row.name, *(row.scenes[scene].alpha for scene in scenes)) for row in board.rows)
    return _table(
        board,
        "scenes",
        f"{board.benchmark.id} by scene",
        f"Alpha in each scene, with intervals at {CONFIDENCE:.0%}.",
        columns,
        rows,
    )


def stated(board: Board) -> Table:
    """Return what rests on the word of whoever handed a result in."""
    columns = (
        Column("model", "model"), Column("by", "by"), Column("made", "day"), Column("semstab", "semstab"),
        Column("milliseconds", "ms a frame", 1), Column("parameters", "parameters, M", 1),
        Column("machine", "machine"), Column("license", "licence"), Column("trained_on", "trained on"),
        Column("url", "address"), Column("notes", "notes"),
    )  # fmt: skip
    rows: tuple[Row, ...] = tuple(_stated(row) for row in board.rows)
    nonempty = [k for k, column in enumerate(columns) if k == 0 or any(_is_told(row[k]) for row in rows)]
    rows = tuple(tuple(row[k] for k in nonempty) for row in rows)
    caption = "Not checked: stated by whoever handed the result in. Ranks do not depend on it."
    filled_columns = tuple(columns[k] for k in nonempty)
    return _table(board, "stated", f"{board.benchmark.id}, as stated", caption, filled_columns, rows)


def _stated(row: BoardRow) -> Row:
    about, card = row.about, row.about.card
    texts = {key: str(card.get(key) or "") for key in ("by", "license", "trained_on", "url", "notes")}
    machine = f"{about.processor}, {about.cores} cores"
    return (
        row.name, texts["by"], about.made, about.semstab, about.milliseconds,
        float(card.get("parameters") or math.nan), machine, texts["license"], texts["trained_on"], texts["url"],
        texts["notes"],
    )  # fmt: skip


def _is_told(cell: object) -> bool:
    return not math.isnan(cell) if isinstance(cell, float) else bool(cell)


def _table(
    board: Board,
    name: str,
    title: str,
    caption: str,
    columns: tuple[Column, ...],
    rows: tuple[Row, ...],
    benchmark: str = "",
) -> Table:
    return Table(f"{name}-{board.benchmark.id}", title, caption, columns, (Group("", rows),), "", benchmark)


def tables_of(board: Board) -> list[Table]:
    """Return the tables of a benchmark."""
    several = len(board.benchmark.scenes) > 1
    return [headline(board), *([by_scene(board)] if several else []), stated(board)]


# --- The page ---------------------------------------------------------------------------------------------------------


def write_page(made: Sequence[Board], out: Path) -> Path:
    """Write index.html; return its path."""
    path = out / "index.html"
    write_text(path, filled("leaderboard.html.j2", boards=[_section(board) for board in made]))
    return path


def _section(board: Board) -> dict[str, object]:
    benchmark = board.benchmark
    return {
        "id": benchmark.id,
        "description": benchmark.description,
        "facts": [*_facts(benchmark)],
        "superseded": benchmark.superseded_by,
        "tables": [table_block(table) for table in tables_of(board)],
    }


def _facts(benchmark: Benchmark) -> Iterator[tuple[str, str]]:
    yield "dataset", benchmark.dataset.name
    yield "scenes", ", ".join(benchmark.scenes)
    yield "voxels", f"{benchmark.voxel_size:g} m"
    yield "definition", benchmark.digest
    if benchmark.get:
        yield "data", benchmark.get
    yield "licence", benchmark.license
    yield "citation", benchmark.citation


def lines(made: Sequence[Board]) -> Iterator[str]:
    """Yield what a terminal shows: the rank, the model and alpha of each result."""
    for board in made:
        count = len(board.rows)
        yield f"{board.benchmark.id} ({board.benchmark.digest}), {count} result{'' if count == 1 else 's'}"
        for row in board.rows:
            yield f"  {row.ranks:>8}  {row.name:<28} alpha {row.alpha.text()}"
        yield from (f"  {text}" for text in board.reasons)
