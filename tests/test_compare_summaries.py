"""The comparison of summaries that other tests rest on finds each difference."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from compare_summaries import differences

RUN = {"scene": "street", "model": "a", "backend": "numba", "vss": 0.9, "sbd": None, "fuse_ms_per_frame": 3.0}
SUMMARY: dict[str, Any] = {
    "schema": 1,
    "runs": [
        RUN | {"strata": [{"name": "OP=1", "vss": 1.0}], "key": "x"},
        RUN | {"variation": {"sweep": "voxel_size"}, "stages_ms": {"update": 1.0}, "vss": 0.8},
    ],
    "weights": [0.5, 0.5],
}


def changed(**top: Any) -> dict[str, Any]:
    return copy.deepcopy(SUMMARY) | top


def test_times_keys_and_the_order_of_units_do_not_count() -> None:
    other = changed(schema=2, runs=copy.deepcopy(SUMMARY["runs"][::-1]))
    other["runs"][0] |= {"fuse_ms_per_frame": 9.0, "stages_ms": {"update": 7.0, "wait": 2.0}}
    other["runs"][1] |= {"key": "y", "vss": 0.9 + 1e-12}
    assert differences(SUMMARY, other) == []
    assert differences(SUMMARY, changed(weights=[0.5, 0.5 + 1e-7]), tolerance=1e-6) == []


@pytest.mark.parametrize(("change", "line"), [
    ({"vss": 0.91}, "vss: 0.9 and 0.91"), ({"sbd": 0.0}, "sbd: null and 0.0"),
    ({"sbd": False}, "sbd: null and false"),
    ({"strata": [{"name": "OP=2", "vss": 1.0}]}, "strata.[OP=1]: only in the first"),
    ({"margin": 0.5}, "margin: only in the second"),
])  # fmt: skip
def test_a_difference_is_a_line_with_its_path(change: dict[str, Any], line: str) -> None:
    other = changed()
    other["runs"][0] |= change
    assert differences(SUMMARY, other)[0] == f"runs.[street a numba].{line}"
    assert differences(SUMMARY, changed(weights=[0.5, 0.4])) == ["weights[1]: 0.5 and 0.4"]
    assert differences(SUMMARY, changed(weights=[0.5])) == ["weights: 2 entries and 1"]
