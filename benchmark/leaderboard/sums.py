"""Sums of a result, held against what a benchmark's definition fixes and against each other, and completed.

Depth and poses decide where spots are and which views see them, so that counts of answers are bounded by the
definition, and of one another's sums. What cannot have been counted is refused in one line.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from semstab.core.types import Float64, Int64, Mask
from semstab.errors import DataError
from semstab.leaderboard.geometry import Spots, keys_of, rows_in
from semstab.statistics.cluster_sums import MOST_CLASSES, ClusterSums, count_distinct
from semstab.statistics.cluster_sums.columns import OF_TRUTH, PLAIN

LARGEST_SHIFT = 0.2
"""Largest part of a map's true classes that may differ from the definition's, and of its observed and its predicted
ones from those of the spots: voxels are sampled otherwise than spots. Up to .12, .09 and .11 were seen."""

SPARSE_SHIFT = 0.5
"""The same for images with depth at a LiDAR's points: voxels lie where points do, most of them near, and spots are even
over the surface. Up to .20, .24 and .35 were seen."""

LEAST_LABELLED = 0.5
"""Least share of the answers that a model has to give that a result has."""

NAMES = ("first", "second", "third")
"""Words for the answers of a spot and view, from the nearest pixel on."""

NOISE = 0.01
"""Share of the answers by which those that are farther from the spot may agree more often than nearer ones; up to .0045
was seen."""

ROUNDED, LEAST = 1e-6, 0.02
"""Relative and absolute error of sums in single precision over the frames of a cube."""


class Impossible(NamedTuple):
    """A rule that sums break: what cannot be, and where."""

    what: str
    broken: Mask


def checked(
    where: str, sums: ClusterSums, spots: Spots, *, truth: bool, voxel_size: float, shift: float = LARGEST_SHIFT
) -> ClusterSums:
    """Return sums with their spots in the cubes of the definition, and its distances of answers from spots.

    Args:
        where: The file and the scene, for messages.
        sums: As they were handed in.
        spots: Of the definition.
        truth: Whether the definition has ground truth.
        voxel_size: Of the definition, metres.
        shift: Largest part of a map's classes that may differ from the spots' classes.

    Raises:
        DataError: If the sums cannot be those of a run of it.
    """
    if not sums.answers:
        raise DataError(f"{where}: its sums have no spots; run the benchmark again")
    for part in (sums, *sums.answers):
        if (part.K, part.classes) != (len(spots.classes), spots.classes):
            raise DataError(f"{where}: its classes are not those of the definition ({', '.join(spots.classes)})")
    if sums.truth != truth or abs(sums.voxel_size / voxel_size - 1) > ROUNDED:
        raise DataError(f"{where}: its voxels or its ground truth are not those of the definition; run it again")
    names = [*PLAIN, "evidence", *(OF_TRUTH if truth else ())]
    _refuse(where, "map", sums, _of_rows(sums, [name for name in names if name in sums.layout]))
    if not sums["voxels"].any():
        raise DataError(f"{where}: its map is empty; run the benchmark again")
    frames = sums.frame[sums.frame >= 0]
    if sums.fused not in (0, spots.frames) or (sums.step and len(np.unique(frames)) > spots.frames):
        raise DataError(f"{where}: its map is of other frames than the definition's {spots.frames}; run it again")
    _refuse(where, "map", sums, _of_map(sums))
    answers = tuple(_at(where, part, spots) for part in sums.answers)
    for name, part in zip(NAMES, answers, strict=True):
        _refuse(where, f"{name} answers", part, _of_rows(part, [*PLAIN, "evidence"]))
        _refuse(where, f"{name} answers", part, _of_spots(part, spots))
        if not np.array_equal(keys_of(answers[0]), keys_of(part)):
            raise DataError(f"{where}: first and {name} answers are of other spots; run it again")
    for (name, nearer), (further, part) in itertools.pairwise(zip(NAMES, answers, strict=True)):
        _refuse(where, f"{further} answers", part, _of_further(nearer, part, name))
    _refuse(where, "map", sums, _of_classes(sums, answers[0], spots, shift))
    if (share := labelled_share(answers[0], spots)) < LEAST_LABELLED:
        raise DataError(f"{where}: it has {share:.0%} of the answers that the definition asks for; run it again")
    means = spots.near, spots.far, 0.0
    vouched = (_vouched(part, mean) for part, mean in zip(answers, means, strict=True))
    return dataclasses.replace(sums, answers=tuple(vouched))


def _refuse(where: str, what: str, part: ClusterSums, rules: Iterator[Impossible]) -> None:
    for rule in rules:
        if rule.broken.any():
            row = int(rule.broken.argmax())
            if len(rule.broken) == len(part.cell):
                cube, frames = part.cell[row], f", frames from {int(part.frame[row]) * max(part.step, 1)}"
            else:
                cube, frames = part.index.cubes[min(row, len(part.index.cubes) - 1)], ""
            cube_text = " ".join(str(int(x)) for x in cube)
            raise DataError(f"{where}: {rule.what} ({what}, cube {cube_text}{frames}); run the benchmark again")


def _column(part: ClusterSums, name: str) -> Float64:
    """Return the sums (m,) of a name, over its classes."""
    total: Float64 = part[name].sum(axis=1)
    return total


def _cubes(part: ClusterSums, name: str) -> Float64:
    """Return the sums (G,) of a name by cube."""
    return part.index.by_cube(_column(part, name))


def _differ(a: Float64, b: Float64) -> Mask:
    """Return where two sums differ by more than rounding does."""
    different: Mask = ~(np.abs(a - b) <= ROUNDED * np.maximum(np.abs(a), np.abs(b)) + LEAST)
    return different


def _more(a: Float64, b: Float64) -> Mask:
    """Return where a sum is larger than another by more than rounding does, or is no number."""
    larger: Mask = ~(a <= b + ROUNDED * np.abs(b) + LEAST)
    return larger


def _any(broken: Mask) -> Mask:
    """Return where one of the columns (m, C) is broken."""
    rows: Mask = np.any(broken, axis=1)
    return rows


def _of_rows(part: ClusterSums, names: list[str]) -> Iterator[Impossible]:
    yield Impossible("a sum is no number", _any(~np.isfinite(part.side_by_side(names))))
    if count_distinct(keys_of(part)) < len(part.cell):
        yield Impossible("a cube has two rows of one frame", np.ones(len(part.cell), np.bool_))
    counts = [name for name in names if name in COUNTS]
    yield Impossible("a count is negative", _any(part.side_by_side(counts) < -LEAST))


COUNTS = ("voxels", "observations", "own", "twice", "recurrent", "evidence", "known", "class_known")
"""Sums that are negative in no cube and frame."""


# --- Spots ------------------------------------------------------------------------------------------------------------


def _at(where: str, part: ClusterSums, spots: Spots) -> ClusterSums:
    """Return the sums of spots in the cubes of the definition; refuse larger ones, other frames and other places."""
    if part.edge > spots.edge or part.step != spots.step or part.fused > spots.frames:
        raise DataError(
            f"{where}: its cubes of {part.edge:g} m and groups of {part.step} frames are not those of the definition,"
            f" {spots.edge:g} m and {spots.step}; run the benchmark again"
        )
    _refuse(where, "spots", part, _of_rows(part, ["observations"]))
    return part.coarsened(spots.edge, spots.step)


def _of_spots(part: ClusterSums, spots: Spots) -> Iterator[Impossible]:
    """Yield what cannot be of answers that are one class each: a spot has one answer a view."""
    rows, n = rows_in(keys_of(part), spots.keys), _column(part, "observations")
    yield Impossible("a view that does not see a cube has answers there", rows < 0)
    yield Impossible(
        "there are more answers than spots that the view sees", _more(n, spots.table[rows, 4].astype(float))
    )
    for name in ("observations", "twice", "evidence", *_by_class(part, "class_own")):
        yield Impossible(f"{name} is no whole number", _any(part[name] != np.round(part[name])))
    for name in ("own", "evidence", *_by_class(part, "class_own")):
        yield Impossible(f"{name} is not the number of answers", _differ(_column(part, name), n))
    if part.K <= MOST_CLASSES:
        yield Impossible("class_own is not evidence", _any(part["class_own"] != part["evidence"]))
        disagreeing = n - _column(part, "agreeing")
        yield Impossible(
            "agreeing is not what its classes give", _differ(_column(part, "class_apart") / 2, disagreeing)
        )
        of_class, disagreement = (_by_cube(part, name) for name in ("evidence", "class_apart"))
        most = 2 * np.minimum(of_class, of_class.sum(axis=1, keepdims=True) - of_class)
        yield Impossible(
            "a class disagrees more often than it was seen",
            _any(_more(disagreement, most) | _more(-disagreement, 0 * disagreement)),
        )
    yield Impossible(
        "voxels is not what its parts give",
        _differ(_column(part, "voxels"), _column(part, "twice") / 2 + _column(part, "recurrent")),
    )
    count, agreeing, of_cube = _cubes(part, "voxels"), _cubes(part, "agreeing"), _cubes(part, "observations")
    yield Impossible("the spots of a cube are no whole number", _differ(count, np.round(count)))
    yield Impossible("a spot has more than one answer of a view", _more(n, part.step * count[part.index.row]))
    yield Impossible("more answers agree than there are", _more(agreeing, of_cube) | _more(-agreeing, 0 * agreeing))


def _by_class(part: ClusterSums, name: str) -> tuple[str, ...]:
    """Return the name of sums by class, where they are stored."""
    return (name,) if part.K <= MOST_CLASSES else ()


def _by_cube(part: ClusterSums, name: str) -> Float64:
    """Return the sums (G, K) of each class by cube."""
    return np.stack([part.index.by_cube(column) for column in part[name].T], axis=1)


def _of_further(nearer: ClusterSums, part: ClusterSums, name: str) -> Iterator[Impossible]:
    """Yield what cannot be of answers farther from the spots than the `name` answers, which the same views give."""
    for column in ("voxels", "observations", "twice", "recurrent"):
        differ = _differ(_column(nearer, column), _column(part, column))
        yield Impossible(f"{column} is not that of the {name} answers", differ)
    n, before, agreeing = (
        float(columns[column].sum())
        for columns, column in ((part, "observations"), (nearer, "agreeing"), (part, "agreeing"))
    )
    yield Impossible(
        f"they agree more often than the {name} answers, which are nearer", np.array([agreeing - before > NOISE * n])
    )


# Two sums of spots decide details, and nothing else in a result vouches for them: they are computed.


def _vouched(part: ClusterSums, mean: float) -> ClusterSums:
    """Return the sums with the squared distances of the definition, metres^2 an answer, and pairs that agree as all do.

    At a spot that two views see, pairs are taken to agree as often as answers do in its cube and view.
    """
    n, agreeing = part["observations"], part["agreeing"]
    rate = np.clip(np.divide(agreeing, n, out=np.zeros_like(n), where=n > 0), 0, 1)
    return _with_columns(part, square=mean * n, twice_agreeing=rate * part["twice"])


def _with_columns(part: ClusterSums, **columns: Float64) -> ClusterSums:
    """Return the sums with other columns (m, 1) of these names."""
    changed = part.columns.copy()
    for name, values in columns.items():
        changed[:, part.layout[name]] = values
    return dataclasses.replace(part, columns=changed)


# --- The map ----------------------------------------------------------------------------------------------------------


def _of_map(sums: ClusterSums) -> Iterator[Impossible]:
    """Yield what cannot be of locations: right ones are known, consistent ones were seen three times."""
    if not sums.truth:
        return
    with_truth, right = _column(sums, "known"), _column(sums, "right")
    yield Impossible("more locations are known than there are", _more(with_truth, _column(sums, "voxels")))
    for name, total in (("class_known", with_truth), ("class_right", right), ("class_predicted", with_truth)):
        for _ in _by_class(sums, name):
            yield Impossible(f"{name} is not what its classes give", _differ(_column(sums, name), total))
    names = ("known", "right", "recurrent", "consistent", "consistent_wrong", "observed", "observed_right")
    totals = {name: _cubes(sums, name) for name in names}
    for smaller, larger in (
        ("right", "known"), ("consistent", "known"), ("consistent", "recurrent"), ("consistent_wrong", "consistent"),
        ("observed_right", "observed"),
    ):  # fmt: skip
        yield Impossible(f"{smaller} is more than {larger}", _more(totals[smaller], totals[larger]))
    for name in ("right", "consistent", "consistent_wrong"):
        yield Impossible(f"{name} is negative", _more(-totals[name], 0 * totals[name]))
    yield Impossible(
        "more are wrong than there are", _more(totals["consistent_wrong"], totals["known"] - totals["right"])
    )
    yield Impossible(
        "more are right than there are", _more(totals["consistent"] - totals["consistent_wrong"], totals["right"])
    )


def _of_classes(sums: ClusterSums, near: ClusterSums, spots: Spots, largest: float) -> Iterator[Impossible]:
    """Yield if classes of a map are not those of the spots, or its true ones are not the definition's."""
    of_spots = near["evidence"].sum(axis=0)
    compared = [("evidence", "observed classes are others than those of its spots", of_spots)]
    if spots.truth and sums.K <= MOST_CLASSES:
        compared += [
            ("class_known", "true classes are others than the definition's", np.array(spots.truth)),
            ("class_predicted", "fused classes are others than those of its spots", of_spots),
        ]
    for name, what, expected in compared:
        a, b = _shares(sums[name].sum(axis=0)), _shares(expected)
        shift = float(np.abs(a - b).sum()) / 2
        yield Impossible(f"{shift:.0%} of its {what}", np.array([not shift <= largest]))


def _shares(of_class: Float64) -> Float64:
    total = float(of_class.sum())
    return of_class / total if total else of_class


# --- What a model leaves out ------------------------------------------------------------------------------------------


def completed(sums: ClusterSums, spots: Spots) -> ClusterSums:
    """Return sums in which each answer that a model has to give, and did not, disagrees with all others.

    In a cube and view with n answers of n + m, the share (n / (n + m))^2 of the pairs have two labels. What is missing
    is of the map's classes in proportion, so that chance stays.
    """
    return dataclasses.replace(sums, answers=tuple(_completed(part, spots) for part in sums.answers))


SHARED = ("agreeing", "twice_agreeing")
"""Sums of agreement of two answers."""


def _completed(part: ClusterSums, spots: Spots) -> ClusterSums:
    rows: Int64 = rows_in(spots.keys, keys_of(part))
    here = rows >= 0
    columns = np.zeros((len(rows), part.columns.shape[1]))
    columns[here] = part.columns[rows[here]]
    complete = dataclasses.replace(
        part, cell=spots.keys[:, :3].astype(np.int32), frame=spots.keys[:, 3].astype(np.int32), columns=columns,
        fused=spots.frames,
    )  # fmt: skip
    n = complete["observations"][:, 0].copy()
    missing = np.maximum(spots.table[:, 5] - n, 0)
    shares = _shares(complete["evidence"].sum(axis=0))
    with np.errstate(invalid="ignore"):
        labelled = np.where(n > 0, n / (n + missing), 0.0)
    for name in SHARED:
        columns[:, complete.layout[name]] *= labelled[:, None]
    for name in ("observations", "own"):
        columns[:, complete.layout[name]] += missing[:, None]
    columns[:, complete.layout["evidence"]] += missing[:, None] * shares
    filled = columns[:, complete.layout["observations"]][:, 0] > 0
    return dataclasses.replace(
        complete, cell=complete.cell[filled], frame=complete.frame[filled], columns=columns[filled]
    )


def labelled_share(first: ClusterSums, spots: Spots) -> float:
    """Return the share of the answers that a model has to give that it gives, from sums of first answers."""
    rows: Int64 = rows_in(keys_of(first), spots.keys)
    needed = spots.table[:, 5].astype(np.float64)
    answered = np.zeros(len(needed))
    answered[rows] = first["observations"][:, 0]
    return float(np.minimum(answered, needed).sum() / needed.sum()) if needed.any() else 1.0
