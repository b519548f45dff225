"""Charts of the page: points stand where their numbers say, ticks are round, and what is undefined leaves a gap."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semstab.data.statistics import Estimate
from semstab.report.charts import POINTS, Line, Scale, dot_chart, line_chart, thinned

NAN = math.nan


def drawn(svg, kind):
    return [e for e in ET.fromstring(svg).iter() if (e.get("class") or "").split(" ")[0] == kind]


def test_intervals_stand_where_their_estimates_say() -> None:
    rows = {
        "road": [(0, "net", Estimate(0.5, 0.4, 0.7)), (1, "other", Estimate(0.6, NAN, NAN))],
        "a & <b>": [(0, "net", Estimate(NAN, NAN, NAN))],
    }
    svg = dot_chart(rows, "alpha", (0.0,))
    places = (re.match(r"translate\(([\d.]+) [\d.]+\)", dot.get("transform")) for dot in drawn(svg, "dot"))
    first, second = (float(place[1]) for place in places)
    (bar,) = drawn(svg, "line")
    low, high = map(float, re.match(r"M([\d.]+) [\d.]+H([\d.]+)", bar.get("d")).groups())
    (guide,) = drawn(svg, "guide")
    unit = (high - low) / 0.3
    assert first - low == pytest.approx(0.1 * unit, abs=0.2)
    assert second - first == pytest.approx(0.1 * unit, abs=0.2)
    assert low - float(re.match(r"M([\d.]+)", guide.get("d"))[1]) == pytest.approx(0.4 * unit, abs=0.2)
    assert "a & <b>" in ET.fromstring(svg).itertext()
    assert [dot[0].text for dot in drawn(svg, "dot")] == ["net: 0.5 (0.4 to 0.7)", "other: 0.6"]


def test_a_line_breaks_where_a_value_is_undefined_and_long_ones_are_thinned() -> None:
    svg = line_chart([Line("net", [0, 1, 2, 3], [1.0, NAN, 2.0, 3.0])], "frame", "flicker, %")
    (line,) = drawn(svg, "line")
    assert line.get("d").count("M") == 2
    assert len(drawn(svg, "dot")) == 3
    long = thinned(Line("net", range(10_000), [*range(5000), *[NAN] * 5000]))
    assert len(long.x) == len(long.y) == POINTS
    assert sum(map(math.isfinite, long.y)) == POINTS / 2
    assert line_chart([Line("net", [0, 1], [NAN, NAN])], "frame", "drift")


@settings(max_examples=200)
@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=20), st.booleans())
def test_ticks_are_round_and_lie_between_the_ends(values, zero) -> None:
    scale = Scale.over(values, 0, 100, zero=zero)
    ticks = scale.ticks()
    assert len(ticks) <= 7
    room = 1e-6 * (scale.high - scale.low)
    assert all(scale.low - room <= tick <= scale.high + room for tick in ticks)
    assert scale(scale.low) == 0
    assert scale(scale.high) == pytest.approx(100)
