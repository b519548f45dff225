import copy
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import compare_summaries
import pytest
from compare_summaries import differences

RUN = {"scene": "street", "backbone": "a", "backend": "numba", "vss": 0.9, "sbd": None, "fuse_ms_per_frame": 3.0}
SUMMARY: dict[str, Any] = {
    "schema": 1,
    "runs": [
        RUN | {"variation": {"sweep": "base", "value": None}, "strata": [{"name": "OP=1", "vss": 1.0}], "key": "x"},
        RUN | {"variation": {"sweep": "voxel_size", "value": 0.4}, "stages_ms": {"update": 1.0}, "vss": 0.8},
    ],
    "agreement": [],
    "weights": [0.5, 0.5],
}


def changed(**top: Any) -> dict[str, Any]:
    return copy.deepcopy(SUMMARY) | top


def test_times_keys_and_the_order_of_units_do_not_count() -> None:
    other = changed(schema=2, runs=copy.deepcopy(SUMMARY["runs"][::-1]))
    other["runs"][0] |= {"fuse_ms_per_frame": 9.0, "stages_ms": {"update": 7.0, "wait": 2.0}}
    other["runs"][1] |= {"key": "y", "vss": 0.9 + 1e-12}
    assert differences(SUMMARY, other) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"vss": 0.91}, "vss: 0.9 and 0.91"),
        ({"sbd": 0.0}, "sbd: null and 0.0"),
        ({"sbd": False}, "sbd: null and false"),
        ({"strata": [{"name": "OP=2", "vss": 1.0}]}, "strata.[OP=1]: only in the first"),
        ({"margin": 0.5}, "margin: only in the second"),
    ],
)
def test_a_difference_is_a_line_with_its_path(change: dict[str, Any], line: str) -> None:
    other = changed()
    other["runs"][0] |= change
    found = differences(SUMMARY, other)
    assert found
    assert found[0] == f"runs.[street a numba].{line}"


def test_added_keys_and_entries_can_be_allowed() -> None:
    other = changed(margin=1.0)
    other["runs"].append(RUN | {"backend": "numpy", "variation": {"sweep": "backends", "value": None}})
    assert len(differences(SUMMARY, other)) == 2
    assert differences(SUMMARY, other, added=True) == []
    assert len(differences(other, SUMMARY, added=True)) == 2


def test_lists_without_names_go_by_place() -> None:
    assert differences(SUMMARY, changed(weights=[0.5, 0.4])) == ["weights[1]: 0.5 and 0.4"]
    assert differences(SUMMARY, changed(weights=[0.5])) == ["weights: 2 entries and 1"]
    assert differences(SUMMARY, changed(weights=[0.5, 0.5 + 1e-7]), tolerance=1e-6) == []


def test_the_script_exits_with_1_where_they_differ(tmp_path: Path) -> None:
    paths = []
    for name, content in (("a", SUMMARY), ("b", changed(weights=[0.5, 0.4]))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps(content), encoding="utf-8")
        paths.append(str(tmp_path / name))
    script = str(Path(compare_summaries.__file__))
    for a, b, code in ((paths[0], f"{paths[0]}/summary.json", 0), (*paths, 1)):
        done = subprocess.run([sys.executable, script, a, b], capture_output=True, text=True, check=False)
        assert done.returncode == code, done.stderr
        assert done.stdout == ("weights[1]: 0.5 and 0.4\n" if code else "")
