"""The spots of a benchmark: which cubes of space hold them, and how many of them each view sees.

Depth and poses decide them, so a definition has them as it has the hashes of its data, in NAME@VERSION.geometry.json
beside it. A result states no answer that they do not have, and an answer that it lacks counts as one that disagrees.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semstab.core.files import read_json, write_text
from semstab.core.json_form import from_json, to_json
from semstab.core.types import Int64
from semstab.data.frames import Frame
from semstab.data.measures import dominant
from semstab.errors import DataError
from semstab.statistics import Sampler, SpotObservations
from semstab.statistics.accumulate import sums_of_spots
from semstab.statistics.cluster_sums import ClusterSums, distinct_rows

SUFFIX = ".geometry.json"

SCHEMA = 1

MOST_ROWS, ROWS_OF_SCENE = 2048, 400
"""Most rows of all scenes, or a scene in the mean if that is more: cubes are made larger until there are no more, so
that a result is a small file, in which a scene still has enough cubes for an interval."""


@dataclass(frozen=True)
class Spots:
    """The spots of a scene by cube and view.

    Attributes:
        classes: Names of the classes that an answer may have.
        frames: Number of frames that are fused.
        edge: Edge of a cube, metres, a power of 2.
        step: Frames of a group.
        near, far: Mean squared distance of a first and of a second answer from its spot, metres^2.
        truth: Share of the spots of each true class; empty without ground truth.
        rows: Each row (ix, iy, iz, group, answers, needed): a cube, a group of frames, the spots that these see, and
            how many of them a model has to label. These are all, and if there is ground truth, those that it labels.
    """

    classes: tuple[str, ...]
    frames: int
    edge: float
    step: int
    near: float
    far: float
    truth: tuple[float, ...]
    rows: tuple[tuple[int, int, int, int, int, int], ...]

    @functools.cached_property
    def table(self) -> Int64:
        """The rows (m, 6)."""
        return np.array(self.rows, np.int64).reshape(-1, 6)

    @property
    def keys(self) -> Int64:
        """Cube and group (m, 4) of each row."""
        return self.table[:, :4]

    def coarsened(self) -> Spots:
        """Return the same with cubes of twice the edge."""
        keys, inverse = distinct_rows(np.concatenate([self.table[:, :3] // 2, self.table[:, 3:4]], axis=1))
        counts = np.zeros((len(keys), 2), np.int64)
        np.add.at(counts, inverse, self.table[:, 4:])
        rows = np.concatenate([keys, counts], axis=1).tolist()
        return dataclasses.replace(self, edge=2 * self.edge, rows=tuple(map(tuple, rows)))

    @property
    def needed(self) -> int:
        """Number of answers that a model has to give."""
        return int(self.table[:, 5].sum())


def spots_of(views: Iterable[Frame], truth: Iterable[Frame] | None, classes: tuple[str, ...]) -> Spots:
    """Return the spots of a scene.

    Args:
        views: Its frames, in order, with one class everywhere.
        truth: The same with ground truth in rows of `classes`, if there is any.
        classes: Names of the classes.
    """
    sample, frames = _sampled(views, 1)
    sums, shares = sums_of_spots(sample), tuple[float, ...]()
    first, second, _ = sums.answers
    keys, answers = keys_of(first), first["observations"][:, 0]
    needed = answers
    if truth is not None:
        sample, _ = _sampled(truth, len(classes))
        true_answers = sums_of_spots(sample, first.edge).answers[0]
        needed, positions = np.zeros(len(keys)), rows_in(keys_of(true_answers), keys)
        needed[positions[positions >= 0]] = true_answers["observations"][positions >= 0, 0]
        shares = _class_shares(sample)
    n = max(float(answers.sum()), 1.0)
    rows = np.concatenate([keys, np.stack([answers, needed], axis=1).astype(np.int64)], axis=1)
    return Spots(
        classes, frames, first.edge, first.step, float(first["square"].sum()) / n, float(second["square"].sum()) / n,
        shares, tuple(map(tuple, rows.tolist())),
    )  # fmt: skip


def few_rows(scenes: Mapping[str, Spots]) -> dict[str, Spots]:
    """Return the spots of scenes, with larger cubes until there are few rows."""
    made, before, most = dict(scenes), math.inf, max(MOST_ROWS, ROWS_OF_SCENE * len(scenes))
    while before > (rows := sum(len(spots.rows) for spots in made.values())) > most:
        before = rows
        made = {name: spots.coarsened() for name, spots in made.items()}
    return made


def _sampled(frames: Iterable[Frame], K: int) -> tuple[SpotObservations, int]:
    """Return the sample of what frames see, and how many frames there are."""
    sampler, count = Sampler(K, moving=False), 0
    for frame in frames:
        sampler.add(frame)
        count += 1
    return sampler.sample(), count


def _class_shares(sample: SpotObservations) -> tuple[float, ...]:
    """Return the share (K,) of each class in the spots that two views saw or more."""
    table = sample.observations().table()
    count = np.bincount(dominant(table)[table.op >= 2], minlength=table.K)
    return tuple((count / max(count.sum(), 1)).tolist())


def keys_of(part: ClusterSums) -> Int64:
    """Return cube and group of frames (m, 4) of each row."""
    return np.concatenate([part.cell, part.frame[:, None]], axis=1).astype(np.int64)


def rows_in(keys: Int64, of: Int64) -> Int64:
    """Return the number of each key (n, 4) among the distinct rows (m, 4), or -1 for a key that is not a row."""
    row = {tuple(key): number for number, key in enumerate(of.tolist())}
    return np.array([row.get(tuple(key), -1) for key in keys.tolist()], np.int64)


# --- The file ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _GeometryContent:
    schema: int
    digests: str
    scenes: Mapping[str, Spots]


def geometry_file(definition: Path) -> Path:
    """Return the file next to a definition that has its spots."""
    return definition.with_name(definition.stem + SUFFIX)


def save_geometry(path: Path, scenes: Mapping[str, Spots], digests: str) -> None:
    """Write the spots of the scenes, a line a scene; `digests` is the hash of the data that they are of."""
    lines = []
    for name, spots in scenes.items():
        content = to_json(dataclasses.replace(spots, rows=()))
        rows = ",".join(f"[{','.join(map(str, row))}]" for row in spots.rows)
        content = {key: value for key, value in content.items() if key != "rows"}
        lines.append(f'{_text(name)}:{_text(content)[:-1]},"rows":[{rows}]}}')
    scenes_text = ",\n".join(lines)
    write_text(path, f'{{"schema":{SCHEMA},"digests":{_text(digests)},"scenes":{{\n{scenes_text}\n}}}}\n')


def _text(value: object) -> str:
    return json.dumps(value, separators=(",", ":"))


def load_geometry(path: Path, digests: str) -> Mapping[str, Spots]:
    """Return the spots of the scenes.

    Raises:
        DataError: If the file is damaged, or of other data.
    """
    content = from_json(_GeometryContent, read_json(path), path)
    if (content.schema, content.digests) != (SCHEMA, digests):
        raise DataError(f"{path}: it is of other data, or another version; write it with scripts/benchmark_digests.py")
    return content.scenes
