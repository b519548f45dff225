"""Does disagreement tell which labels are wrong, and how many, without ground truth?

    python simulations/simulate.py risk made [--scenes 3] [--seed 0]
    python simulations/simulate.py risk city [--frames 20] [--width 288]
    python simulations/simulate.py risk runs RUN ...
    python simulations/simulate.py risk runs RUN ... --signs [--scores MODEL]

Places are the voxels of a map that were seen three times or more and have a true class; the label of one is its
dominant class. `made` takes flights of `orbit_views.py`, with errors of eight kinds at four rates, `city` the simulated
models on scenes of the city, `runs` the maps of runs with ground truth (`semstab-bench --statistics`).

How well disagreement, 1 - PSA, tells wrong places from right ones is the area under the ROC curve (AUROC): the
probability that it is larger at a wrong place than at a right one. The probability that a label is wrong, given the
disagreement, OP and class of its place, is then counted on other flights of the same model, and on other models, and
held against the map: at all places, and at those where frames disagree (PSA < 0.8). No truth is needed for one bound:
of the frames that see a place, no more can be right than give it its most frequent label. Prints a table in Markdown.

`--signs` asks instead what else tells wrong places (`signs.py`): the AUROC of disagreement, of the border of the
model's own labels, in the map or in images, and of low scores. One frame is the middle one of those that see a place.
The images of the run are read again; scores may be those of another label source of the run.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cases
import numpy as np
from alpha import RATES
from orbit_views import KINDS, K, OrbitViews, frames, predicted, scene
from signs import auroc
from signs import table as table_of_signs

import semstab
from semstab import backends
from semstab.comparison.opening import open_run
from semstab.data.measures import dominant
from semstab.data.voxels import VoxelTable
from semstab.statistics.agreement import CONSISTENT, psa
from semstab.statistics.correctness import join_truth

VOXEL = 0.5
"""Metres along the edge of a voxel of the made flights."""

STEPS = (1e-9, 0.1, 0.2, 0.35, 0.5)
"""Disagreement: none, and up to each; then more."""

SEEN = (5, 10, 20)
"""OP: below each, and from the last one on."""

SIMULATED = ("sim-steady", "sim-flicker", "sim-soft", "trick-two-class", "trick-blur-81", "trick-coarse-16")
"""Models of the city: their errors last, are independent in each frame, or come from the way they label."""

WEIGHT = 20
"""Places of a class that count as much as all classes together."""

HEAD = (
    "model", "wrong, %", "AUROC, mean (least to most)", "frames disagree at, %", "wrong there, %",
    "as on its other flights", "as with other models", "wrong in all, as with other models",
    "of the frames' labels wrong, %", "at least, %",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Places:
    """The places of one map, (n,) each.

    Attributes:
        model, flight: Of whom, and where.
        disagreement: 1 - PSA.
        op: Frames that saw it.
        label: Its dominant class.
        wrong: Whether that is not the true one.
        agreeing: Frames that give it its dominant class.
        right: Frames that give it the true one.
    """

    model: str
    flight: str
    disagreement: np.ndarray
    op: np.ndarray
    label: np.ndarray
    wrong: np.ndarray
    agreeing: np.ndarray
    right: np.ndarray

    @classmethod
    def from_tables(cls, model: str, flight: str, table: VoxelTable, truth: VoxelTable) -> Places:
        """Return the places of a map with the map of its ground truth."""
        label = join_truth(table, truth).label
        some = np.flatnonzero((label >= 0) & (table.op >= 3))
        evidence = table.evidence[:][some]
        said, true = dominant(table)[some], label[some]
        row = np.arange(len(some))
        return cls(
            model, flight, 1 - np.nan_to_num(psa(table))[some], table.op[some], said, said != true,
            evidence[row, said], evidence[row, true],
        )  # fmt: skip

    @property
    def disagree(self) -> np.ndarray:
        """(n,) true where frames disagree: the place is not consistent."""
        return self.disagreement > 1 - CONSISTENT

    @property
    def auroc(self) -> float:
        """AUROC of disagreement for wrong places; NaN if all places are right, or all wrong."""
        return auroc(self.disagreement, self.wrong)


def cells_of(places: Places) -> np.ndarray:
    """Return the number (n,) of the cell of disagreement and OP that each place is in."""
    return np.searchsorted(STEPS, places.disagreement) * (len(SEEN) + 1) + np.searchsorted(SEEN, places.op, "right")


def expected(places: Places, others: Sequence[Places], *, by_class: bool) -> np.ndarray:
    """Return P(wrong | disagreement, OP, class) of each place (n,), counted on other maps; NaN without any."""
    if not others:
        return np.full(len(places.wrong), math.nan)
    cells = (len(STEPS) + 1) * (len(SEEN) + 1)
    classes = 1 + max(int(part.label.max(initial=0)) for part in [places, *others])
    cell = np.concatenate([cells_of(part) for part in others])
    label = np.concatenate([part.label for part in others])
    wrong = np.concatenate([part.wrong for part in others]).astype(float)
    count, bad = np.bincount(cell, minlength=cells), np.bincount(cell, wrong, cells)
    of_cell = (bad + wrong.mean()) / (count + 1)
    if not by_class:
        return of_cell[cells_of(places)]
    both = cell * classes + label
    count, bad = np.bincount(both, minlength=cells * classes), np.bincount(both, wrong, cells * classes)
    of_both = (bad + WEIGHT * of_cell.repeat(classes)) / (count + WEIGHT)
    return of_both[cells_of(places) * classes + places.label]


def made(scenes: int, seed: int) -> Iterator[Places]:
    """Yield the maps of the made flights: a model is a kind of errors and a rate of them."""
    for kind in KINDS[1:]:
        for rate in np.linspace(*RATES[kind], 4):
            for trial in range(scenes):
                views = scene(np.random.default_rng([seed, trial]))
                labels = predicted(views, kind, rate, trial, 0)
                yield Places.from_tables(
                    f"{kind}, {rate:.2f}", f"{trial}", fused(views, labels), fused(views, views.labels)
                )


def fused(views: OrbitViews, labels: np.ndarray) -> VoxelTable:
    """Return the map of labels (F, H, W)."""
    backend = backends.create("numba", voxel_size=VOXEL, num_classes=K)
    for frame in frames(views, labels):
        backend.integrate(frame)
    return backend.table()


def city(count: int, width: int) -> Iterator[Places]:
    """Yield the maps of the simulated models on the scenes of the city."""
    options = {"frames": count, "width": width, "height": round(width * 9 / 16)}
    settings = {
        "dataset": {"name": "city", "options": options}, "scenes": ["scene0", "scene1"], "models": list(SIMULATED),
        "statistics": True, "check": None,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        semstab.run(semstab.load_config(overrides=settings), out=folder, report=False)
        for model in semstab.load_result(folder).models:
            yield from of_run(f"{folder}:{model}")


def of_run(run: str) -> Iterator[Places]:
    """Yield the maps of a run."""
    run_files = open_run(run)
    for name, entry in run_files.scenes.items():
        record = entry.with_voxels("this")
        yield Places.from_tables(run_files.model, name, record.table(), VoxelTable.load(record.truth_file))


def rows(maps: Sequence[Places], family: Callable[[str], str], *, by_class: bool) -> Iterator[list[str]]:
    """Yield the cells of each model; `family` has in common what may not be learnt from."""
    for model in dict.fromkeys(flight.model for flight in maps):
        flights = [flight for flight in maps if flight.model == model]
        others = [flight for flight in maps if family(flight.model) != family(model)]
        area = [flight.auroc for flight in flights]
        finite = [share for share in area if not math.isnan(share)]
        same = [
            expected(flight, [another for another in flights if another is not flight], by_class=by_class)
            for flight in flights
        ]
        other = [expected(flight, others, by_class=by_class) for flight in flights]
        disagree = [flight.disagree for flight in flights]
        observations = sum(flight.op.sum() for flight in flights)
        yield [
            model, percent(flight.wrong for flight in flights),
            f"{np.mean(finite):.2f} ({min(finite):.2f} to {max(finite):.2f})" if finite else "-", percent(disagree),
            percent(flight.wrong[flight.disagree] for flight in flights),
            percent(chance[where] for chance, where in zip(same, disagree, strict=True)),
            percent(chance[where] for chance, where in zip(other, disagree, strict=True)), percent(other),
            f"{100 * (1 - sum(flight.right.sum() for flight in flights) / observations):.1f}",
            f"{100 * (1 - sum(flight.agreeing.sum() for flight in flights) / observations):.1f}",
        ]  # fmt: skip


def percent(parts: Iterable[np.ndarray]) -> str:
    """Return the mean of some values or masks, in percent."""
    values = np.concatenate([np.asarray(part, float) for part in parts])
    return f"{100 * values.mean():.1f}" if len(values) and not np.isnan(values).any() else "-"


def main(
    study: Literal["made", "city", "runs"],
    run: tuple[str, ...],
    scenes: int = 3,
    seed: int = 0,
    frames: int = 20,
    width: int = 288,
    signs: bool = False,
    scores: str | None = None,
) -> None:
    if signs:
        table_of_signs(run, scores)
        return
    if study == "made":
        maps = list(made(scenes, seed))
    elif study == "city":
        maps = list(city(frames, width))
    else:
        maps = [places for folder in run for places in of_run(folder)]
    cases.head(HEAD)
    told = list(rows(maps, lambda model: model.split(",")[0], by_class=study != "runs"))
    for cells in told:
        cases.row(cells)
    for column in ("as on its other flights", "as with other models"):
        pairs = [(cells[HEAD.index("wrong there, %")], cells[HEAD.index(column)]) for cells in told]
        off = [abs(float(chance) - float(other)) for chance, other in pairs if other != "-"]
        if off:
            print(f"\n{column}: off by {np.median(off):.1f} points in the median, {max(off):.1f} at most")
