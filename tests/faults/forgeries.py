"""Forge results of a benchmark, by one field or column and as somebody would who wants a rank.

Each is to be refused, or to change no rank.

    python tests/faults/forgeries.py results livingroom@1 [MODEL]

prints a table: how many forgeries there are of each kind, how many are refused, leave all as it was, or change a rank.
It ends with code 1 if a rank changes.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import io
import itertools
import json
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from semstab.comparison.entries import RunHandle
from semstab.core.sealed_zip import packed
from semstab.errors import SemstabError
from semstab.leaderboard.board import board_of
from semstab.leaderboard.definition import Benchmark
from semstab.leaderboard.submission import SUFFIX, Submission, load_submission

Content = dict[str, Any]
Table = dict[str, np.ndarray]
"""Columns of the sums of a scene by name; 'part' is 0 for the map, 1 and 2 for the answers of spots."""


@dataclasses.dataclass
class Parts:
    """A result that is taken apart: its text, and of each scene the sums and what is said of them."""

    content: Content
    sums: list[Table]
    about: list[Content]

    @classmethod
    def load(cls, file: Path) -> Parts:
        with zipfile.ZipFile(file) as archive:
            content = json.loads(archive.read("summary.json"))
            tables = [pq.read_table(io.BytesIO(archive.read(f"{i}.parquet"))) for i in range(len(content["scenes"]))]
        about = [json.loads(table.schema.metadata[b"semstab"]) for table in tables]
        return cls(content, [{name: table[name].to_numpy() for name in table.column_names} for table in tables], about)

    def save(self, file: Path) -> None:
        members = {"summary.json": json.dumps(self.content).encode()}
        for i, (sums, about) in enumerate(zip(self.sums, self.about, strict=True)):
            table = pa.table(sums).replace_schema_metadata({"semstab": json.dumps(about)})
            data = io.BytesIO()
            pq.write_table(table, data)
            members[f"{i}.parquet"] = data.getvalue()
        file.write_bytes(packed(members))


Forgery = tuple[str, str, Callable[[Parts], None]]
"""Its kind, what it does, and the change."""


def forgeries(parts: Parts, *, fields: bool) -> Iterator[Forgery]:
    """Yield all forgeries of a result; with `fields` also those of single fields and columns."""
    yield from ((f"as somebody would: {group}", name, change) for group, name, change in by_hand())
    if not fields:
        return
    yield from of_fields(parts.content)
    yield from of_columns(parts.sums[0])
    yield from of_meta(parts.about[0])


# --- Fields and columns -----------------------------------------------------------------------------------------------


def of_fields(content: Content) -> Iterator[Forgery]:
    """Yield a change of each field of the text, one of those that differ in a number in their path."""
    yielded = set()
    for path, value in leaves(content):
        name = ".".join("0" if isinstance(step, int) else step for step in path)
        for how, new in replacements(value):
            if (name, how) not in yielded:
                yielded.add((name, how))
                yield (
                    "a field of the text",
                    f"{name} {how}",
                    lambda parts, path=path, new=new: put(parts.content, path, new),
                )


def replacements(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, bool):
        yield "otherwise", not value
    elif isinstance(value, int | float):
        yield "larger", value * 1.5 + 1 if isinstance(value, float) else value + 1
        yield "negative", -abs(value) - 1
    elif isinstance(value, str):
        yield "another", f"{value}x"
    else:
        yield "0", 0


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from leaves(item, (*path, key))
    if not isinstance(value, dict | list):
        yield path, value


def put(value: Any, path: tuple[Any, ...], new: Any) -> None:
    for step in path[:-1]:
        value = value[step]
    value[path[-1]] = new


EDITS: Mapping[str, Callable[[np.ndarray], Any]] = {
    "0": np.zeros_like,
    "halved": lambda x: x / 2,
    "a hundredth more": lambda x: x * 1.01,
    "doubled": lambda x: x * 2,
    "1 more": lambda x: x + 1,
    "times 1000": lambda x: x * 1000,
    "negative": lambda x: -x - 1,
    "reversed": lambda x: x[::-1],
    "nan": lambda x: np.full(len(x), np.nan),
}


def of_columns(sums: Table) -> Iterator[Forgery]:
    """Yield edits of each column, of the first two classes, in the map and in the answers of the first scene."""
    names = [
        name for name in sums if name != "part" and (name.rpartition("_")[2] in ("0", "1") or not name[-1].isdigit())
    ]
    for name in names:
        for part, of in enumerate(("map", "first answers", "second answers", "third answers")):
            for how, edit in EDITS.items():
                if np.any(sums[name][sums["part"] == part]):
                    yield (
                        f"a column of the {of}",
                        f"{name} {how}",
                        lambda parts, a=(name, part, edit): edited(parts, *a),
                    )


def edited(parts: Parts, name: str, part: int, edit: Callable[[np.ndarray], Any], scenes: slice = slice(1)) -> None:
    for sums in parts.sums[scenes]:
        rows, column = sums["part"] == part, sums[name].copy()
        kind = column.dtype
        column = column.astype(np.float64)
        column[rows] = edit(column[rows])
        if kind.kind in "iu" and np.isfinite(column).all():
            column = np.clip(np.round(column), -(2**31), 2**31 - 1).astype(kind)
        sums[name] = column if column.dtype == kind or kind.kind in "iu" else column.astype(kind)


def of_meta(about: Content) -> Iterator[Forgery]:
    for path, value in leaves(about):
        for how, new in replacements(value):
            yield (
                "what is said of sums",
                f"{'.'.join(map(str, path))} {how}",
                (lambda parts, path=path, new=new: put(parts.about[0], path, new)),
            )


# --- As somebody would ------------------------------------------------------------------------------------------------


def by_hand() -> Iterator[Forgery]:
    """Yield edits that would buy a rank if nobody looked."""
    for forged in (
        forged_text, forged_rows, forged_places, forged_scaled_sums, forged_agreement, forged_classes, forged_truth,
    ):  # fmt: skip
        yield from forged()


def forged_text() -> Iterator[Forgery]:
    """Yield edits of fields of the text."""
    yield "text", "nothing is wrong, the level is stable", unwrong
    yield "text", "the level is stable", level
    yield "text", "the level is usable", lambda parts: level(parts, "usable")
    yield "text", "alpha is .99", stated("alpha", value=0.99)
    yield "text", "alpha is .99, undecided", stated("alpha", value=0.99, undecided="x")
    yield "text", "alpha's interval is narrow", stated("alpha", low=0.98, high=0.99)
    yield "text", "accuracy is 1", stated("accuracy", value=1.0, low=1.0, high=1.0)
    yield "text", "flicker is .01", flicker
    yield "text", "-5 ms a frame", lambda parts: parts.content["about"].update(milliseconds=-5.0, predicted=True)
    yield "text", "0.01 ms a frame", lambda parts: parts.content["about"].update(milliseconds=0.01, predicted=True)
    yield "text", "100 frames more", frames
    yield (
        "text",
        "frames twice",
        lambda parts: [
            scene.update(frames=2 * scene["frames"], flicker=2 * scene["flicker"]) for scene in parts.content["scenes"]
        ],
    )
    yield "text", "class rows dropped", classes
    yield (
        "text",
        "an unknown class",
        lambda parts: [record["spots"]["classes"][0].update(name="x") for record in statistics(parts)],
    )
    yield "text", "a scene twice", lambda parts: parts.content["scenes"].append(parts.content["scenes"][0])
    yield "text", "a scene fewer", lambda parts: parts.content["scenes"].pop()


def forged_rows() -> Iterator[Forgery]:
    """Yield edits of rows of the sums, left out or doubled."""
    for share in (0.02, 0.05, 0.1, 0.3, 0.6):
        yield "rows", f"the worst {share:.0%} of cubes and views left out", of_rows(worst(share))
    yield "rows", "the worst 5 % of second answers left out", of_rows(worst(0.05, (2,)))
    yield "rows", "the worst 5 % of third answers left out", of_rows(worst(0.05, (3,)))
    yield "rows", "all rows twice", of_rows(lambda sums: np.tile(np.arange(len(sums["part"])), 2))
    yield (
        "rows",
        "rows of spots twice",
        of_rows(lambda sums: np.concatenate([np.arange(len(sums["part"])), np.flatnonzero(sums["part"] > 0)])),
    )
    yield (
        "rows",
        "a single cube",
        of_rows(lambda sums: np.flatnonzero((sums["part"] == 0) | (sums["ix"] == sums["ix"][sums["part"] == 1][0]))),
    )
    yield "rows", "no map", of_rows(lambda sums: np.flatnonzero(sums["part"] > 0))
    yield "rows", "no spots", of_rows(lambda sums: np.flatnonzero(sums["part"] == 0))
    yield "rows", "no second answers", of_rows(lambda sums: np.flatnonzero(sums["part"] < 2))
    yield "rows", "no third answers", of_rows(lambda sums: np.flatnonzero(sums["part"] < 3))


def forged_places() -> Iterator[Forgery]:
    """Yield edits of cubes, frames and their sizes."""
    yield "places", "each row a cube of its own", in_each_part(put_all(ix=number))
    yield "places", "each cube its own", in_each_part(put_all(ix=lambda sums: 1000 * sums["ix"] + sums["frame"]))
    yield "places", "cubes a mile away", in_each_part(put_all(iz=lambda sums: sums["iz"] + 100))
    yield (
        "places",
        "one cube",
        in_each_part(put_all(ix=lambda s: 0 * s["ix"], iy=lambda s: 0 * s["iy"], iz=lambda s: 0 * s["iz"])),
    )
    yield "places", "frames shifted", in_each_part(put_all(frame=lambda sums: sums["frame"] + 1))
    yield (
        "places",
        "frames reversed",
        in_each_part(put_all(frame=lambda s: np.where(s["frame"] < 0, -1, s["frame"].max() - s["frame"]))),
    )
    yield "places", "one frame", in_each_part(put_all(frame=lambda sums: np.minimum(sums["frame"], 0)))
    yield "places", "groups of 0 frames", in_each_part(said(step=lambda values: [0] * len(values)))
    yield "places", "groups of 64 frames", in_each_part(said(step=lambda values: [64] * len(values)))
    yield "places", "100 frames more were fused", in_each_part(said(fused=lambda values: [n + 100 for n in values]))
    yield "places", "0 frames were fused", in_each_part(said(fused=lambda values: [0] * len(values)))
    yield "places", "cubes said to be twice as large", in_each_part(said(edge=lambda values: [2 * x for x in values]))
    yield "places", "cubes said to be half as large", in_each_part(said(edge=lambda values: [x / 2 for x in values]))
    yield "places", "voxels said to be larger", in_each_part(said(voxel_size=lambda values: [2 * x for x in values]))
    for times, groups in ((2, 1), (4, 1), (64, 1), (1, 2), (1, 16), (64, 64)):
        yield "places", f"cubes {times} times as large, groups of {groups}", in_each_part(larger(times, groups))


def forged_scaled_sums() -> Iterator[Forgery]:
    """Yield edits of sums that are multiplied."""
    for factor in (1000.0, 10.0, 2.0, 1.5, 0.5, 0.1):
        yield "all sums", f"times {factor:g}", in_each_part(times(factor))
        yield "all sums", f"of spots times {factor:g}", in_each_part(times(factor, (1, 2, 3)))
        yield "all sums", f"of the map times {factor:g}", in_each_part(times(factor, (0,)))
        yield "all sums", f"of second answers times {factor:g}", in_each_part(times(factor, (2,)))
        yield "all sums", f"of third answers times {factor:g}", in_each_part(times(factor, (3,)))


def forged_agreement() -> Iterator[Forgery]:
    """Yield edits of agreement of the answers."""
    for parts, of in (((1,), "first"), ((2,), "second"), ((3,), "third"), ((1, 2, 3), "all")):
        yield "agreement", f"all of {of} answers agree", in_each_part(within(parts, agreeing=all_agree))
        yield (
            "agreement",
            f"a tenth more of {of} answers agree",
            in_each_part(within(parts, agreeing=lambda s: 1.1 * s["agreeing"])),
        )
        yield "agreement", f"no one's own in {of} answers", in_each_part(within(parts, own=lambda s: 0 * s["own"]))
        yield (
            "agreement",
            f"pairs agree in {of} answers",
            in_each_part(within(parts, twice_agreeing=lambda s: s["twice"])),
        )
        yield "agreement", f"psa is 1 in {of} answers", in_each_part(within(parts, psa=lambda s: s["voxels"]))
    yield "agreement", "second answers are near", in_each_part(within((2,), square=lambda s: s["square"] / 4))
    yield "agreement", "second answers are far", in_each_part(within((2,), square=lambda s: 4 * s["square"]))
    yield "agreement", "first answers are far", in_each_part(within((1,), square=lambda s: 4 * s["square"]))
    yield (
        "agreement",
        "evidence of two classes swapped",
        in_each_part(within((1, 2, 3), evidence_0=lambda s: s["evidence_1"], evidence_1=lambda s: s["evidence_0"])),
    )
    yield "agreement", "classes are as frequent as each other", in_each_part(even)
    yield "agreement", "first and second answers exchanged", in_each_part(answers(2, 1, 3))
    yield "agreement", "answers in the opposite order", in_each_part(answers(3, 2, 1))
    yield "agreement", "third answers are the second ones", in_each_part(answers(1, 2, 2))
    yield "agreement", "third answers are the first ones", in_each_part(answers(1, 2, 1))
    yield "agreement", "second answers are the third ones", in_each_part(answers(1, 3, 3))


def forged_classes() -> Iterator[Forgery]:
    """Yield edits of classes."""
    yield "classes", "an unknown class", in_each_part(with_names(lambda names: ["x", *names[1:]]))
    yield "classes", "classes in another order", in_each_part(with_names(lambda names: names[::-1]))
    yield "classes", "no names", in_each_part(with_names(lambda names: []))
    yield (
        "classes",
        "a class more",
        in_each_part(lambda sums, about: about.update(K=about["K"] + 1, classes=[*about["classes"], "x"])),
    )
    yield (
        "classes",
        "a class fewer",
        in_each_part(lambda sums, about: about.update(K=about["K"] - 1, classes=about["classes"][:-1])),
    )
    yield "classes", "no ground truth", in_each_part(lambda sums, about: about.update(truth=not about["truth"]))


def forged_truth() -> Iterator[Forgery]:
    """Yield edits of what is right by the ground truth."""
    yield "truth", "nothing consistent is wrong", in_each_part(if_truth(consistent_wrong=zeros))
    yield "truth", "nothing is consistent", in_each_part(if_truth(consistent_wrong=zeros, consistent=zeros))
    yield "truth", "all is right", in_each_part(if_truth(right=lambda s: s["known"]))
    yield (
        "truth",
        "all is right, nothing wrong",
        in_each_part(if_truth(right=lambda s: s["known"], consistent_wrong=zeros)),
    )
    yield "truth", "all is right, class by class", in_each_part(right)
    yield "truth", "cubes that are mostly wrong left out", of_rows(only_right)
    for name in ("accuracy", "miou", "wrong_of_consistent"):
        yield "truth", f"{name} is stated as .99", stated(name, value=0.99, undecided="x")


# Changes that these are made of


def statistics(parts: Parts) -> Iterator[Content]:
    return (
        scene["summary"]["statistics"] if "summary" in scene else scene["statistics"]
        for scene in parts.content["scenes"]
    )


def stated(key: str, **changes: Any) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        for record in statistics(parts):
            record["headline"].setdefault(key, {}).update(changes)

    return change


def level(parts: Parts, wanted: str = "stable") -> None:
    for record in statistics(parts):
        record["verdict"].update(level=wanted, of_all=None)


def in_each_part(change: Callable[[Table, Content], None]) -> Callable[[Parts], None]:
    def apply(parts: Parts) -> None:
        for sums, about in zip(parts.sums, parts.about, strict=True):
            change(sums, about)

    return apply


def take(sums: Table, rows: np.ndarray) -> None:
    for name in sums:
        sums[name] = sums[name][rows]


def of_rows(choose: Callable[[Table], np.ndarray]) -> Callable[[Parts], None]:
    return in_each_part(lambda sums, about: take(sums, choose(sums)))


def worst(share: float, parts: tuple[int, ...] = (1, 2, 3)) -> Callable[[Table], np.ndarray]:
    """Leave out the cubes and views with the least agreement."""

    def choose(sums: Table) -> np.ndarray:
        rate = sums["agreeing"] / np.maximum(sums["observations"], 1)
        first = sums["part"] == 1
        bad = np.quantile(rate[first], share)
        key = np.stack([sums[name] for name in ("ix", "iy", "iz", "frame")], axis=1)
        left = {tuple(row) for row in key[first & (rate < bad)].tolist()}
        out = np.array([tuple(row) in left for row in key.tolist()]) & np.isin(sums["part"], parts)
        return np.flatnonzero(~out)

    return choose


def put_all(**columns: Callable[[Table], np.ndarray]) -> Callable[[Table, Content], None]:
    def change(sums: Table, about: Content) -> None:
        sums.update({name: make(sums).astype(sums[name].dtype) for name, make in columns.items()})

    return change


def said(**changes: Callable[[list[float]], list[float]]) -> Callable[[Table, Content], None]:
    def change(sums: Table, about: Content) -> None:
        about.update({name: make(about[name]) for name, make in changes.items()})

    return change


def larger(times: int, frames: int) -> Callable[[Table, Content], None]:
    """Join cubes, and frames, as honest sums would be made coarser: intervals get wide."""

    def change(sums: Table, about: Content) -> None:
        for name in ("ix", "iy", "iz"):
            sums[name] = sums[name] // times
        sums["frame"] = np.where(sums["frame"] < 0, -1, sums["frame"] // frames)
        keys = np.stack([sums[name] for name in ("part", "ix", "iy", "iz", "frame")], axis=1)
        rows, of = np.unique(keys, axis=0, return_inverse=True)
        for name in list(sums):
            summed = np.zeros(len(rows))
            np.add.at(summed, of.ravel(), sums[name].astype(np.float64))
            sums[name] = summed.astype(sums[name].dtype)
        for k, name in enumerate(("part", "ix", "iy", "iz", "frame")):
            sums[name] = rows[:, k]
        about.update(edge=[times * x for x in about["edge"]], step=[frames * x for x in about["step"]])

    return change


numbers = lambda sums: [name for name in sums if name not in ("part", "ix", "iy", "iz", "frame")]  # noqa: E731


def times(factor: float, parts: tuple[int, ...] = (0, 1, 2, 3)) -> Callable[[Table, Content], None]:
    def change(sums: Table, about: Content) -> None:
        rows = np.isin(sums["part"], parts)
        for name in numbers(sums):
            sums[name] = np.where(rows, factor * sums[name], sums[name]).astype(sums[name].dtype)

    return change


def within(parts: tuple[int, ...], **columns: Callable[[Table], np.ndarray]) -> Callable[[Table, Content], None]:
    def change(sums: Table, about: Content) -> None:
        rows = np.isin(sums["part"], parts)
        made = {name: np.where(rows, make(sums), sums[name]).astype(sums[name].dtype) for name, make in columns.items()}
        sums.update(made)

    return change


def all_agree(sums: Table) -> np.ndarray:
    return sums["observations"]


zeros = lambda sums: 0 * sums["voxels"]  # noqa: E731


def even(sums: Table, about: Content) -> None:
    """Say that all classes are as frequent: chance falls, and alpha rises."""
    K, rows = about["K"], sums["part"] > 0
    for k in range(K):
        for name in (f"evidence_{k}", f"class_own_{k}"):
            if name in sums:
                share = np.floor(sums["observations"] / K) + (k < sums["observations"] % K)
                sums[name] = np.where(rows, share, sums[name]).astype(sums[name].dtype)


def answers(*of: int) -> Callable[[Table, Content], None]:
    """Give the rows of these answers as the first, second and third ones."""

    def change(sums: Table, about: Content) -> None:
        rows = [np.flatnonzero(sums["part"] == part) for part in (0, *of)]
        part = np.repeat(np.arange(4), [len(record) for record in rows]).astype(sums["part"].dtype)
        take(sums, np.concatenate(rows))
        sums["part"] = part

    return change


def with_names(change: Callable[[list[str]], list[str]]) -> Callable[[Table, Content], None]:
    def apply(sums: Table, about: Content) -> None:
        about["classes"] = change(about["classes"])

    return apply


def if_truth(**columns: Callable[[Table], np.ndarray]) -> Callable[[Table, Content], None]:
    def change(sums: Table, about: Content) -> None:
        if about["truth"]:
            within((0,), **columns)(sums, about)

    return change


def right(sums: Table, about: Content) -> None:
    if not about["truth"]:
        return
    made = {"right": lambda s: s["known"], "consistent_wrong": zeros, "observed_right": lambda s: s["observed"]}
    for k in range(about["K"]):
        for name in ("class_right", "class_predicted"):
            made[f"{name}_{k}"] = lambda s, k=k: s[f"class_known_{k}"]
    within((0,), **made)(sums, about)


def only_right(sums: Table) -> np.ndarray:
    if "right" not in sums:
        return np.arange(len(sums["part"]))
    good = (sums["part"] > 0) | (sums["frame"] < 0) | (sums["right"] >= 0.8 * sums["known"])
    return np.flatnonzero(good)


def unwrong(parts: Parts) -> None:
    stated("wrong_of_consistent", value=0.0, low=0.0, high=0.0, undecided="x")(parts)
    level(parts)


def flicker(parts: Parts) -> None:
    for scene in parts.content["scenes"]:
        scene["flicker"] = [0.01] * len(scene["flicker"])
        scene.get("summary", scene)["flicker_percent"] = 0.01


def frames(parts: Parts) -> None:
    for scene in parts.content["scenes"]:
        scene.get("summary", scene)["frames"] += 100


def classes(parts: Parts) -> None:
    for record in statistics(parts):
        record["spots"]["classes"] = record["spots"]["classes"][:1]


number = lambda sums: np.arange(len(sums["part"]))  # noqa: E731


# --- What becomes of them ---------------------------------------------------------------------------------------------

Loaded = tuple[str, Submission, RunHandle]


@dataclasses.dataclass
class Referee:
    """The honest results of a benchmark, against which a forgery of one of them is held."""

    benchmark: Benchmark
    honest: dict[str, Loaded]

    @classmethod
    def from_folder(
        cls, folder: Path, benchmark_name: str, definitions: Mapping[str, Benchmark] | None = None
    ) -> Referee:
        files = sorted(folder.glob(f"{benchmark_name}__*{SUFFIX}"))
        loaded = {file.name: load_submission(file, definitions) for file in files}
        benchmark = next(iter(loaded.values()))[0]
        return cls(benchmark, {name: (name, about, handle) for name, (_, about, handle) in loaded.items()})

    def ranks(self, changed: Mapping[str, Loaded] | None = None) -> dict[str, tuple[int | None, int]]:
        rows = board_of(self.benchmark, [*(self.honest | dict(changed or {})).values()]).rows
        return {row.file: (row.rank, row.last) for row in rows}

    def outcome(self, name: str, forged: Path, before: Mapping[str, tuple[int | None, int]]) -> str:
        """Return 'refused', 'no rank changes', or the ranks that change."""
        definitions = {self.benchmark.id: self.benchmark}
        try:
            benchmark, about, handle = load_submission(forged, definitions)
        except SemstabError as error:
            line = str(error)
            assert "\n" not in line, line
            assert len(line) <= 400, line
            return "refused"
        if benchmark is not self.benchmark:
            return "refused"
        if _same(self.honest[name][2], handle):
            return "no rank changes"
        after = self.ranks({name: (name, about, handle)})
        changes = [f"{file} {before[file]} {ranks}" for file, ranks in after.items() if before[file] != ranks]
        return ", ".join(changes) or "no rank changes"


def _same(one: RunHandle, other: RunHandle) -> bool:
    """Return whether the sums of two results are equal, bit for bit, so that all that follows from them is."""
    for scene, entry in one.scenes.items():
        for a, b in zip(_parts(entry.sums), _parts(other.scenes[scene].sums), strict=True):
            equal = all(
                np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name == "columns")
                for name in ("cell", "frame", "columns")
            )
            if not equal or (a.edge, a.step, a.fused) != (b.edge, b.step, b.fused):
                return False
    return True


def _parts(sums: Any) -> tuple[Any, ...]:
    return sums, *sums.answers


def judged(referee: Referee, file: Path, *, fields: bool = True, one_in: int = 1) -> Iterator[tuple[str, str, str]]:
    """Yield the kind of each forgery of a result, what it does, and what becomes of it; `fields`: also single ones."""
    before, honest = referee.ranks(), Parts.load(file)
    with tempfile.TemporaryDirectory() as folder:
        forged = Path(folder) / file.name
        for kind, what, change in itertools.islice(forgeries(honest, fields=fields), 0, None, one_in):
            parts = copy.deepcopy(honest)
            change(parts)
            parts.save(forged)
            yield kind, what, referee.outcome(file.name, forged, before)


CHANGES = "A RANK CHANGES"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("benchmark")
    parser.add_argument("model", nargs="?", help="the one whose result is forged; that of the last rank by default")
    parser.add_argument("--hand", action="store_true", help="leave out changes of single fields and columns")
    given = parser.parse_args()
    referee = Referee.from_folder(given.folder, given.benchmark)
    ranks = referee.ranks()
    file = max(ranks, key=lambda name: (ranks[name][0] or 0, name))
    if given.model:
        file = f"{given.benchmark}__{given.model}{SUFFIX}"
    count: Counter[tuple[str, str]] = Counter()
    for kind, what, outcome in judged(referee, given.folder / file, fields=not given.hand):
        plain = outcome if outcome in ("refused", "no rank changes") else CHANGES
        count[kind, plain] += 1
        if plain == CHANGES:
            print(f"{kind}: {what}: {outcome}", flush=True)
    print(f"{file}: {len(ranks)} honest results, {count.total()} forgeries")
    for kind in dict.fromkeys(kind for kind, _ in count):
        print(
            f"  {kind:<40}", *(f"{what} {n}" for (family, what), n in sorted(count.items()) if family == kind), sep="  "
        )
    sys.exit(any(outcome == CHANGES for _, outcome in count))


if __name__ == "__main__":
    main()
