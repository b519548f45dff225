"""Tables and figures of docs/real-networks.md from results/streets.csv, for `scripts/streets.py show`.

An interval of 95 % counts networks, families and streets: 1,000 samples draw streets, families, and networks within a
drawn family, each with replacement (a two-way bootstrap; percentiles). Networks of one family have much in common, so
that drawing networks alone would make intervals too narrow. Variants are left out but where their order is asked for.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

Array = npt.NDArray[np.float64]

MEASURES = {
    "alpha": "alpha", "meaning": "alpha by meaning", "vss": "VSS (OP >= 3)", "agree": "two frames agree", "sbd": "SBD",
    "entropy": "entropy", "flicker": "flicker", "compensated": "flicker, warped", "vc": "VC", "tc": "TC",
    "softmax": "mean softmax", "flip": "mirrored image",
}  # fmt: skip
"""Columns and their names in tables."""

LESS = {"sbd", "entropy", "flicker", "compensated"}
"""Measures of which less is better: their signs are turned."""

TEXTS = ("condition", "data", "street", "network", "family", "of", "verdict", "class", "level", "merged")
"""Columns of text."""

SAMPLES = 1000
APART = 0.02
"""Accuracies that differ by this or more make a pair of networks whose order is asked for."""


def load(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file of results; texts of numbers become numbers, empty texts become NaN."""
    with path.open(newline="", encoding="utf-8") as file:
        return [{key: _number(key, text) for key, text in row.items()} for row in csv.DictReader(file)]


def _number(key: str, text: str) -> Any:
    if key in TEXTS:
        return text
    return float(text or "nan")


class StreetGrid:
    """Numbers of networks on streets: arrays (networks, streets)."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self.networks = list(dict.fromkeys(row["network"] for row in rows))
        self.streets = sorted({row["street"] for row in rows})
        self.family = [next(row["family"] for row in rows if row["network"] == name) for name in self.networks]
        self._cell = {(row["network"], row["street"]): row for row in rows}

    def column(self, name: str) -> Array:
        """Return a column (networks, streets), turned so that more is better."""
        sign = -1.0 if name in LESS else 1.0
        return np.array([[sign * self._cell[n, s][name] for s in self.streets] for n in self.networks], np.float64)

    def samples(self) -> Iterator[tuple[Any, Any]]:
        """Yield SAMPLES times drawn rows of networks and columns of streets."""
        rng, families = np.random.default_rng(0), sorted(set(self.family))
        members = {
            family: [k for k, of_network in enumerate(self.family) if of_network == family] for family in families
        }
        for _ in range(SAMPLES):
            drawn = rng.choice(families, len(families))
            networks = np.concatenate([rng.choice(members[family], len(members[family])) for family in drawn])
            yield networks, rng.choice(len(self.streets), len(self.streets))


# --- Statistics of two arrays (networks, streets) ---------------------------------------------------------------------

Statistic = Callable[[Array, Array], float]


def correlations(x: Array, y: Array) -> Array:
    """Return the rank correlation of each row of two arrays (r, n); NaN if one of the rows does not vary.

    What is NaN in x is the same in all rows, and is left out.
    """
    complete = ~np.isnan(x).any(axis=0)
    if complete.sum() < 3:
        return np.full(len(x), math.nan)
    x, y = (rankdata(values[:, complete], axis=1) for values in (x, y))
    x, y = (values - values.mean(axis=1, keepdims=True) for values in (x, y))
    scale = np.sqrt((x**2).sum(axis=1) * (y**2).sum(axis=1))
    found: Array = np.divide((x * y).sum(axis=1), scale, out=np.full(len(x), math.nan), where=scale > 0)
    return found


def spearman(x: Array, y: Array) -> float:
    """Return the rank correlation of two vectors."""
    return float(correlations(x[None], y[None])[0])


def between_networks(measure: Array, accuracy: Array) -> float:
    """Return the correlation of networks' means over streets."""
    return spearman(measure.mean(axis=1), accuracy.mean(axis=1))


def within_a_street(measure: Array, accuracy: Array) -> float:
    """Return the mean over streets of the correlation of networks."""
    return _nanmean(correlations(measure.T, accuracy.T))


def streets_of_a_network(measure: Array, accuracy: Array) -> float:
    """Return the mean over networks of the correlation of streets."""
    complete = ~np.isnan(measure).any(axis=1)
    return _nanmean(correlations(measure[complete], accuracy[complete]))


def streets(measure: Array, accuracy: Array) -> float:
    """Return the correlation of streets' means over networks."""
    complete = ~np.isnan(measure).any(axis=1)
    if not complete.any():
        return math.nan
    return spearman(measure[complete].mean(axis=0), accuracy[complete].mean(axis=0))


def pairs_on_a_street(measure: Array, accuracy: Array) -> float:
    """Return the share of pairs of networks on one street, APART or more in accuracy, that a measure orders rightly."""
    one, other = np.tril_indices(len(measure), -1)
    gap, difference = accuracy[one] - accuracy[other], measure[one] - measure[other]
    asked = (np.abs(gap) >= APART) & ~np.isnan(difference)
    right = (gap * difference > 0) + 0.5 * (difference == 0)
    return float(right[asked].mean()) if asked.any() else math.nan


def pairs_over_streets(measure: Array, accuracy: Array) -> float:
    """Return the same of the means over streets."""
    return pairs_on_a_street(measure.mean(axis=1, keepdims=True), accuracy.mean(axis=1, keepdims=True))


QUESTIONS: dict[str, Statistic] = {
    "which network, over all streets": between_networks,
    "which network, on one street": within_a_street,
    "which street, for one network": streets_of_a_network,
    "which street, mean of networks": streets,
    "pairs in order, over all streets": pairs_over_streets,
    "pairs in order, on one street": pairs_on_a_street,
}


def _nanmean(values: Sequence[float] | Array) -> float:
    numbers = [value for value in values if not math.isnan(value)]
    return float(np.mean(numbers)) if numbers else math.nan


def with_interval(
    grid: StreetGrid, measure: Array, statistic: Statistic, accuracy: Array
) -> tuple[float, float, float]:
    """Return a statistic and the ends of its interval."""
    drawn = [statistic(measure[np.ix_(*some)], accuracy[np.ix_(*some)]) for some in grid.samples()]
    numbers = [value for value in drawn if not math.isnan(value)]
    low, high = np.quantile(numbers, [0.025, 0.975]) if numbers else (math.nan, math.nan)
    return statistic(measure, accuracy), float(low), float(high)


# --- Tables -----------------------------------------------------------------------------------------------------------


def signed(value: float) -> str:
    """Return '+.61'."""
    return "-" if math.isnan(value) else f"{value:+.2f}".replace("0.", ".", 1)


def plain(value: float) -> str:
    """Return '.61'."""
    return "-" if math.isnan(value) else f"{value:.2f}".replace("0.", ".", 1)


def row(cells: Sequence[str]) -> str:
    """Return a row of Markdown."""
    return "| " + " | ".join(cells) + " |"


def head(cells: Sequence[str]) -> list[str]:
    """Return the head of a table of Markdown."""
    return [row(cells), "|" + "---|" * len(cells)]


def networks_table(grid: StreetGrid) -> list[str]:
    """Return the networks by accuracy, with means over streets."""
    names = ("accuracy", "miou", "alpha", "meaning", "vss", "agree", "flicker", "softmax")
    lines = head(["network", "accuracy", "mIoU", "alpha", "by meaning", "VSS", "agree", "flicker, %", "softmax"])
    means = {name: grid.column(name).mean(axis=1) for name in names}
    for k in np.argsort(-means["accuracy"]):
        cells = [plain(means[name][k]) if name != "flicker" else f"{-means[name][k]:.1f}" for name in names]
        lines.append(row([grid.networks[k], *cells]))
    return lines


def questions_table(grid: StreetGrid, against: str = "accuracy") -> list[str]:
    """Return each measure's answer to each question, with intervals."""
    lines = head(["measure", *QUESTIONS])
    accuracy = grid.column(against)
    for name, title in MEASURES.items():
        cells = []
        for question, statistic in QUESTIONS.items():
            form = plain if question.startswith("pairs") else signed
            value, low, high = with_interval(grid, grid.column(name), statistic, accuracy)
            cells.append("-" if math.isnan(value) else f"{form(value)} ({form(low)} to {form(high)})")
        lines.append(row([title, *cells]))
    return lines


def variants_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return how often a measure says that a variant is worse than its network, and by how much accuracy falls."""
    cell = {(r["network"], r["street"]): r for r in rows}
    kinds = list(dict.fromkeys(r["network"].rpartition("-")[2] for r in rows if r["of"]))
    lines = head(["measure", *kinds, "all"])
    pairs = [(r, cell[r["of"], r["street"]]) for r in rows if r["of"]]
    for name, title in {"accuracy": "accuracy", **MEASURES}.items():
        sign, cells = -1.0 if name in LESS else 1.0, []
        for kind in (*kinds, ""):
            gaps = [sign * (b[name] - v[name]) for v, b in pairs if v["network"].endswith(kind)]
            numbers = [gap for gap in gaps if not math.isnan(gap)]
            cells.append(f"{sum(gap > 0 for gap in numbers)} of {len(numbers)}" if numbers else "-")
        lines.append(row([title, *cells]))
    falls = [
        f"{_nanmean([b['accuracy'] - v['accuracy'] for v, b in pairs if v['network'].endswith(kind)]):.3f}"
        for kind in (*kinds, "")
    ]
    lines.append(row(["accuracy falls by", *falls]))
    return lines


def verdicts_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the accuracy of the units of each verdict."""
    lines = head(["verdict", "units", "accuracy, mean", "least", "most"])
    for level in ("stable", "usable", "undecided", "unstable", "uninformative"):
        found = [r["accuracy"] for r in rows if r["verdict"] == level]
        if found:
            lines.append(row([level, str(len(found)), *(plain(float(f(found))) for f in (np.mean, np.min, np.max))]))
    return lines


def places_table(grid: StreetGrid) -> list[str]:
    """Return the AUROC of each sign for wrong pixels, mean over networks and streets with its interval."""
    titles = {
        "auroc_disagreement": "frames disagree (1 - PSA)", "auroc_entropy": "entropy of the voxel",
        "auroc_border": "border of its own labels near", "auroc_softmax": "softmax of the frame low",
        "auroc_all": "all four together",
    }  # fmt: skip
    scored = [k for k, some in enumerate(np.isfinite(grid.column("auroc_softmax")).all(axis=1)) if some]
    lines = head(["sign", "AUROC", "least street", "most"])
    for name, title in titles.items():
        area = grid.column(name)[scored]
        drawn = []
        for networks, columns in grid.samples():
            rows = [scored.index(k) for k in networks if k in scored]
            if rows:
                drawn.append(area[np.ix_(rows, columns)].mean())
        low, high = np.quantile(drawn, [0.025, 0.975])
        by_street = area.mean(axis=0)
        cells = [
            f"{plain(area.mean())} ({plain(low)} to {plain(high)})",
            plain(by_street.min()),
            plain(by_street.max()),
        ]
        lines.append(row([title, *cells]))
    return lines


def classes_table(rows: Sequence[Mapping[str, Any]], networks: Sequence[str]) -> tuple[list[str], float]:
    """Return classes with their IoU and alpha over all networks and streets, and the mean correlation in a network."""
    correlations, table = [], []
    for network in networks:
        of_network = _by_class([r for r in rows if r["network"] == network])
        correlations.append(
            spearman(np.array([a for a, _ in of_network.values()]), np.array([i for _, i in of_network.values()]))
        )
    of_all = _by_class([r for r in rows if r["network"] in networks])
    for name, (alpha, iou) in sorted(of_all.items(), key=lambda entry: -entry[1][1]):
        pixels = sum(r["true"] for r in rows if r["class"] == name and r["network"] == networks[0])
        table.append(row([name, f"{pixels:,.0f}", plain(iou), plain(alpha)]))
    return [*head(["class", "true pixels", "IoU", "alpha"]), *table], _nanmean(correlations)


def _by_class(rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Return alpha, weighed by pixels, and IoU of each class with at least a thousand true pixels."""
    found = {}
    for name in dict.fromkeys(r["class"] for r in rows):
        of_class = [r for r in rows if r["class"] == name]
        true, said, right = (sum(r[key] for r in of_class) for key in ("true", "said", "right"))
        weights = [(r["said"], r["alpha"]) for r in of_class if not math.isnan(r["alpha"]) and r["said"]]
        if true >= 1000 and weights:
            alpha = sum(w * a for w, a in weights) / sum(w for w, _ in weights)
            found[name] = (alpha, right / (true + said - right))
    return found


def beyond_softmax(grid: StreetGrid) -> list[str]:
    """Return what a measure adds to the mean softmax: the error of accuracy predicted for a street left out."""
    lines = head(["accuracy predicted from", "mean error, points", "partial correlation given softmax"])
    scored = np.isfinite(grid.column("softmax")).all(axis=1)
    accuracy, softmax = grid.column("accuracy")[scored], grid.column("softmax")[scored]
    lines.append(row(["nothing (the mean of other streets)", f"{100 * _left_out(accuracy, []):.1f}", ""]))
    lines.append(row(["mean softmax", f"{100 * _left_out(accuracy, [softmax]):.1f}", ""]))
    for name in ("alpha", "meaning", "vss", "agree", "compensated", "flip"):
        measure = grid.column(name)[scored]
        error = _left_out(accuracy, [softmax, measure])
        ranks = [rankdata(values.ravel()) for values in (measure, accuracy, softmax)]
        lines.append(row([f"softmax and {MEASURES[name]}", f"{100 * error:.1f}", signed(_partial(*ranks))]))
    return lines


def _left_out(accuracy: Array, measures: Sequence[Array]) -> float:
    """Return the mean absolute error of a linear prediction for each street from all others."""
    errors = []
    for street in range(accuracy.shape[1]):
        rest = np.arange(accuracy.shape[1]) != street
        design = [np.ones(accuracy[:, rest].size), *(m[:, rest].ravel() for m in measures)]
        fitted, *_ = np.linalg.lstsq(np.stack(design, axis=1), accuracy[:, rest].ravel(), rcond=None)
        here = np.stack([np.ones(len(accuracy)), *(m[:, street] for m in measures)], axis=1)
        errors.append(np.abs(here @ fitted - accuracy[:, street]).mean())
    return float(np.mean(errors))


def _partial(x: Array, y: Array, given: Array) -> float:
    """Return the correlation of x and y after what a line through `given` explains is taken away."""
    design = np.stack([np.ones(len(given)), given], axis=1)
    rest = [values - design @ np.linalg.lstsq(design, values, rcond=None)[0] for values in (x, y)]
    return float(np.corrcoef(*rest)[0, 1])


def choices_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the correlations of alpha and of VSS in each condition."""
    questions = ("which network, over all streets", "which network, on one street", "which street, mean of networks")
    lines = head(["condition", *(f"{m}: {q}" for m in ("alpha", "VSS") for q in questions)])
    main = StreetGrid([r for r in rows if r["condition"] == "main" and not r["of"]])
    for condition in dict.fromkeys(r["condition"] for r in rows):
        grid = StreetGrid([r for r in rows if r["condition"] == condition and not r["of"]])
        cells = []
        for name in ("alpha", "vss"):
            measure = grid.column(name)
            cells += [signed(QUESTIONS[q](measure, main.column("accuracy"))) for q in questions]
        lines.append(row([condition, *cells]))
    of_main = [r for r in rows if r["condition"] == "main" and not r["of"]]
    some = StreetGrid([r for r in of_main if r["family"] in ("espnetv2", "dicenet")])
    for title, grid, names in (
        ("VSS of OP >= 2", main, ("", "vss2")),
        ("ESPNetv2 and DiCENet", some, ("alpha", "vss")),
    ):
        values = [
            signed(QUESTIONS[q](grid.column(name), grid.column("accuracy"))) if name else ""
            for name in names
            for q in questions
        ]
        lines.append(row([title, *values]))
    return lines
