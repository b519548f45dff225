"""Draw the charts of the page as inline SVG: lines with intervals, and dots with intervals."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semstab.core.palette import MODEL_COLORS, dash, hexadecimal, marker, model_color
from semstab.data.statistics import Estimate

WIDTH, HEIGHT = 520, 230
LEFT, RIGHT, TOP, BOTTOM = 68, 12, 12, 42
ROW = 24
"""Sizes of a chart, of its margins and of a row of dots, in units of the drawing: pixels at its own size."""

POINTS = 400
"""The largest number of points of a line; a longer line is cut into POINTS equal parts, and their means are drawn."""


@dataclass(frozen=True)
class Line:
    """A line of a chart, with its name; NaN breaks it. `ends` has an interval (low, high) for each point."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    ends: Sequence[tuple[float, float]] = ()
    color: int = 0


@dataclass(frozen=True)
class Scale:
    """A map from values between two ends to units of the drawing."""

    low: float
    high: float
    first: float
    last: float

    @classmethod
    def over(
        cls, values: Sequence[float], first: float, last: float, *, zero: bool = False, margin: float = 0.0
    ) -> Scale:
        """Build the axis over the finite values, from 0 on where `zero` says so, and a share of it beyond both ends."""
        finite = [value for value in values if math.isfinite(value)] or [0.0, 1.0]
        low, high = min(0.0, *finite) if zero else min(finite), max(finite)
        if not high - low > 1e-9 * max(abs(low), abs(high), 1e-9):
            high = low + max(abs(low), 1e-3)
        beyond = margin * (high - low)
        return cls(low - beyond, high + beyond, first, last)

    def __call__(self, value: float) -> float:
        """Return the position of a value."""
        return self.first + (value - self.low) / (self.high - self.low) * (self.last - self.first)

    def ticks(self, most: int = 5) -> list[float]:
        """Return round values between the ends: 1, 2 or 5 times a power of ten apart."""
        rough = (self.high - self.low) / most
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= 0.999 * rough)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def line_chart(
    lines: Sequence[Line], x_label: str, y_label: str, *, names: Sequence[str] = (), zero: bool = True
) -> str:
    """Return a chart of lines over x; `names` of its ticks where x counts things that have names."""
    reduced = [thinned(line) for line in lines]
    xs = [x for line in reduced for x in line.x]
    ys = [y for line in reduced for y in (*line.y, *(end for pair in line.ends for end in pair))]
    x, y = Scale.over(xs, LEFT + 8, WIDTH - RIGHT - 8), Scale.over(ys, HEIGHT - BOTTOM, TOP + 4, zero=zero)
    x_ticks = {float(k): name for k, name in enumerate(names)} or {tick: number(tick) for tick in x.ticks(8)}
    parts = [*_frame(x, y, x_ticks, {tick: number(tick) for tick in y.ticks()}, x_label, y_label)]
    for line in reduced:
        parts += _line(line, x, y)
    return _svg(parts, HEIGHT, f"{y_label} by {x_label}")


def dot_chart(rows: Mapping[str, Sequence[tuple[int, str, Estimate]]], x_label: str, guides: Sequence[float]) -> str:
    """Return a chart of rows of dots with their intervals, (colour, name, estimate) each; lines at the guides."""
    values = [v for row in rows.values() for _, _, e in row for v in (e.value, e.low, e.high)]
    left = LEFT + 6 * min(16, max(map(len, rows)))
    ends = [0, *itertools.accumulate(max(ROW, 10 * len(row) + 8) for row in rows.values())]
    middles = [(first + last) / 2 for first, last in itertools.pairwise(ends)]
    height = TOP + ends[-1] + BOTTOM
    x = Scale.over([*values, *guides], left, WIDTH - RIGHT - 6, margin=0.03)
    y = Scale(0, ends[-1], TOP, height - BOTTOM)
    short = (name if len(name) <= 22 else f"{name[:19]}..." for name in rows)
    names = dict(zip(middles, short, strict=True))
    parts = [*_frame(x, y, {tick: number(tick) for tick in x.ticks(7)}, names, x_label, "", left=left, height=height)]
    parts += [f'<path class="guide" d="M{x(g):.1f} {TOP}V{height - BOTTOM}"/>' for g in guides]
    for middle, row in zip(middles, rows.values(), strict=True):
        for j, (color, name, estimate) in enumerate(row):
            if math.isfinite(estimate.value):
                row_y = y(middle) + 10 * (j - (len(row) - 1) / 2)
                parts += _dot(x, row_y, estimate, color, name)
    return _svg(parts, height, x_label)


@dataclass(frozen=True)
class Joint:
    """A joint of a tree: two sets of leaves that become one at a height."""

    first: tuple[str, ...]
    second: tuple[str, ...]
    height: float


def tree_chart(joints: Sequence[Joint], x_label: str, guides: Sequence[float], start: float) -> str:
    """Return a tree that grows from its leaves, at `start`, to the right; a lower height is drawn at the one before."""
    place: dict[str, tuple[str, ...]] = {}
    for joint in joints:
        joined = (*place.get(joint.first[0], joint.first), *place.get(joint.second[0], joint.second))
        place |= dict.fromkeys(joined, joined)
    leaves = list(dict.fromkeys(name for leaf_names in place.values() for name in leaf_names))
    left = LEFT + 6 * min(16, max(map(len, leaves)))
    height = TOP + ROW * len(leaves) + BOTTOM
    heights = list(itertools.accumulate((joint.height for joint in joints), max, initial=start))[1:]
    x = Scale.over([start, *heights, *guides], left, WIDTH - RIGHT - 6, margin=0.03)
    y = Scale(0, len(leaves), TOP, height - BOTTOM)
    names = {row + 0.5: name if len(name) <= 22 else f"{name[:19]}..." for row, name in enumerate(leaves)}
    parts = [*_frame(x, y, {tick: number(tick) for tick in x.ticks(7)}, names, x_label, "", left=left, height=height)]
    parts += [f'<path class="guide" d="M{x(g):.1f} {TOP}V{height - BOTTOM}"/>' for g in guides]
    position = {name: (start, row + 0.5) for row, name in enumerate(leaves)}
    for joint, end in zip(joints, heights, strict=True):
        (x0, y0), (x1, y1) = position[joint.first[0]], position[joint.second[0]]
        title = html.escape(f"{' + '.join(joint.first)} and {' + '.join(joint.second)}: {joint.height:.3g}")
        way = f"M{x(x0):.1f} {y(y0):.1f}H{x(end):.1f}V{y(y1):.1f}H{x(x1):.1f}"
        parts.append(f'<path class="line c0" d="{way}"><title>{title}</title></path>')
        position |= dict.fromkeys((*joint.first, *joint.second), (end, (y0 + y1) / 2))
    return _svg(parts, height, x_label)


def thinned(line: Line) -> Line:
    """Return the line; a line of more than POINTS points is reduced to the means of its parts."""
    if len(line.x) <= POINTS:
        return line
    with np.errstate(invalid="ignore"):
        parts = [np.array_split(np.asarray(values, dtype=np.float64), POINTS) for values in (line.x, line.y)]
        x, y = (
            [float(np.nanmean(p)) if np.isfinite(p).any() else math.nan for p in coordinate] for coordinate in parts
        )
    return Line(line.name, x, y, (), line.color)


def number(value: float) -> str:
    """Return a value as the text of a tick: '0.05', '1,200'."""
    return f"{value + 0.0:,.6g}".replace("-", "\N{MINUS SIGN}")


def _line(line: Line, x: Scale, y: Scale) -> Iterator[str]:
    color, pattern = _class(line.color), dash(line.color)
    dashed = f' stroke-dasharray="{pattern}"' if pattern else ""
    points = list(zip(line.x, line.y, strict=True))
    pen, steps = "M", []
    for px, py in points:
        if math.isfinite(py):
            steps.append(f"{pen}{x(px):.1f} {y(py):.1f}")
        pen = "L" if math.isfinite(py) else "M"
    yield f'<path class="line {color}"{dashed} d="{"".join(steps)}"/>'
    for k, (px, py) in enumerate(points if len(points) <= 40 else ()):
        if math.isfinite(py):
            ends = line.ends[k] if line.ends else (math.nan, math.nan)
            if all(map(math.isfinite, ends)):
                yield f'<path class="line {color}" d="M{x(px):.1f} {y(ends[0]):.1f}V{y(ends[1]):.1f}"/>'
            yield _mark(x(px), y(py), line.color, f"{line.name}: {_with_ends(Estimate(py, *ends))}")


def _dot(x: Scale, y: float, estimate: Estimate, color: int, name: str) -> Iterator[str]:
    shade = _class(color)
    if math.isfinite(estimate.low) and math.isfinite(estimate.high):
        yield f'<path class="line {shade}" d="M{x(estimate.low):.1f} {y:.1f}H{x(estimate.high):.1f}"/>'
    yield _mark(x(estimate.value), y, color, f"{name}: {_with_ends(estimate)}")


def _with_ends(estimate: Estimate) -> str:
    ends = f" ({estimate.low:.3g} to {estimate.high:.3g})" if math.isfinite(estimate.low) else ""
    return f"{estimate.value:.3g}{ends}"


SHAPES = {
    "circle": "M-3.4 0a3.4 3.4 0 1 0 6.8 0a3.4 3.4 0 1 0-6.8 0z",
    "square": "M-3-3h6v6h-6z",
    "diamond": "M0-4.3L4.3 0L0 4.3L-4.3 0z",
    "triangle": "M0-4L4 3.2H-4z",
    "cross": "M-3.8-1.3h2.5v-2.5h2.6v2.5h2.5v2.6h-2.5v2.5h-2.6v-2.5h-2.5z",
}
"""The outlines of markers about their middle."""


def _mark(x: float, y: float, k: int, title: str) -> str:
    """Return the marker of the k-th model."""
    shape, text = SHAPES[marker(k)], html.escape(title)
    return (
        f'<path class="dot {_class(k)}" transform="translate({x:.1f} {y:.1f})" d="{shape}"><title>{text}</title></path>'
    )


def _class(k: int) -> str:
    return f"c{k % len(MODEL_COLORS)}"


def sample(k: int) -> str:
    """Return the line and the marker of the k-th model, as a legend shows them."""
    pattern = f' stroke-dasharray="{dash(k)}"' if dash(k) else ""
    line = f'<path class="line {_class(k)}"{pattern} d="M0 6H30"/>'
    return f'<svg class="chart sample" viewBox="0 0 30 12" width="30" height="12">{line}{_mark(15, 6, k, "")}</svg>'


def colors_css() -> str:
    """Return the rules of the style sheet for the models' colours."""
    rows = ((_class(k), hexadecimal(model_color(k))) for k in range(len(MODEL_COLORS)))
    return "\n".join(
        f".chart .line.{c} {{ stroke: {shade}; }} .chart .dot.{c} {{ fill: {shade}; }}" for c, shade in rows
    )


def _frame(
    x: Scale, y: Scale, x_ticks: Mapping[float, str], y_ticks: Mapping[float, str], x_label: str, y_label: str,
    *, left: float = LEFT, height: float = HEIGHT,
) -> Iterator[str]:  # fmt: skip
    """Yield grid, ticks and labels of both axes."""
    bottom = height - BOTTOM
    for value, text in y_ticks.items():
        if y_label:
            yield f'<path class="grid" d="M{left} {y(value):.1f}H{WIDTH - RIGHT}"/>'
        yield f'<text x="{left - 7:.0f}" y="{y(value) + 4:.1f}" text-anchor="end">{html.escape(text)}</text>'
    for value, text in x_ticks.items():
        if not y_label:
            yield f'<path class="grid" d="M{x(value):.1f} {TOP}V{bottom}"/>'
        yield f'<text x="{x(value):.1f}" y="{bottom + 16}" text-anchor="middle">{html.escape(text)}</text>'
    yield f'<path class="axis" d="M{left} {bottom}H{WIDTH - RIGHT}"/>'
    middle = (left + WIDTH - RIGHT) / 2
    yield f'<text class="label" x="{middle:.0f}" y="{height - 6}" text-anchor="middle">{html.escape(x_label)}</text>'
    if y_label:
        turned = f'transform="rotate(-90)" x="{-(TOP + bottom) / 2:.0f}" y="13"'
        yield f'<text class="label" {turned} text-anchor="middle">{html.escape(y_label)}</text>'


def _svg(parts: Sequence[str], height: float, label: str) -> str:
    box = f'viewBox="0 0 {WIDTH} {height:.0f}" width="{WIDTH}" height="{height:.0f}"'
    return f'<svg class="chart" {box} role="img" aria-label="{html.escape(label)}">{"".join(parts)}</svg>'
