"""Results of version 0.3 are read under the names of today, with a warning."""

from __future__ import annotations

import json
import math

import pytest
from command_line import bench

import semstab
from semstab.core.json_form import to_json
from semstab.data.earlier import KEYS
from semstab.errors import DataError
from semstab.report.tables import tables

NOW = {new: old for old, new in KEYS.items()}
GONE = ("spots", "correlogram", "outlying_frames")
"""What version 0.3 did not have."""


def as_in_0_3(value):
    """The content of a summary.json as version 0.3 wrote it."""
    if isinstance(value, list):
        return [as_in_0_3(item) for item in value]
    if not isinstance(value, dict):
        return value
    interval = "scope" in value and "low" in value
    named = {NOW.get(key, key): as_in_0_3(item) for key, item in value.items() if key not in GONE}
    if interval:
        named["places"] = named.pop("locations")
        named["question"] = {"these frames": "this map"}.get(named["question"], "the next flight")
    if "voxel_alpha" in named:  # of a map, a class, a size, reduced scores
        named["alpha"] = named.pop("voxel_alpha")
    if "kappa" in named and "psa" in named:
        named |= {"alpha_between": named["alpha"], "each_place": named["alpha"]}
    if isinstance(named.get("judged"), dict):
        named["judged"]["alpha_between"] = named["judged"]["alpha"]
        share = {
            "name": "road",
            "places": 9.0,
            "matters": True,
            "alpha": 0.5,
            "ceiling": 0.9,
            "reached": named["judged"]["psa"],
        }
        named["reach"] = {"by": "ground truth", "voxels": 9, "classes": [share]}
    if {"level", "probability", "line"} <= named.keys():
        named = {name: named[name] for name in ("level", "line")}
    if isinstance(named.get("cubes"), int) and "verdict" in named:
        named["blocks"] = {"count": named.pop("cubes"), "size": 0.5}
    return named


@pytest.fixture
def old_run(tmp_path):
    """A run whose folder is as that of version 0.3, and its result."""
    options = {"width": 48, "height": 32, "frames": 8}
    scene = {"dataset": {"options": options}, "scenes": ["scene0"], "models": ["sim-soft", "sim-steady"]}
    config = semstab.load_config(scene | {"check": None, "voxel_size": 0.8})
    out = tmp_path / "run"
    result = semstab.run(config, out=out, report=False)
    summary, settings = json.loads((out / "summary.json").read_text()), out / "config.yaml"
    (out / "summary.json").write_text(json.dumps(as_in_0_3(summary) | {"schema": 2}))
    settings.write_text(settings.read_text().replace("folder layout 4", "folder layout 3"))
    for now, before in (("observations", "looks"), ("sums", "influence")):
        (out / now).rename(out / before)
    assert '"reach"' in (out / "summary.json").read_text()
    return out, result


def test_a_run_of_version_0_3_is_read_with_a_warning(old_run, caplog):
    out, result = old_run
    old, new = semstab.load_result(out).records[0], result.records[0]
    assert "written by version 0.3" in caplog.text
    assert old.summary.table == new.summary.table
    one, other = old.statistics, new.statistics
    assert one.headline.psa.value == other.headline.psa.value
    assert to_json(one.agreement) == to_json(other.agreement)
    assert [row.voxel_alpha for row in old.summary.sizes] == [row.voxel_alpha for row in new.summary.sizes]
    assert new.summary.reduced is not None
    assert to_json(old.summary.reduced) == to_json(new.summary.reduced)
    assert one.spots is one.correlogram is None
    assert math.isnan(one.headline.alpha.value)
    assert one.verdict.level == "no verdict"
    assert math.isnan(one.verdict.probability)
    assert one.verdict.line.startswith("sim-soft: no verdict, run it again for alpha of spots")
    assert one.verdict.line.endswith(f"said {other.verdict.level}")


def test_what_is_shown_of_it_has_no_alpha(old_run):
    out, result = old_run
    done = bench("show", out, cwd=out.parent, columns=100)
    row, *_ = (line for line in done.stdout.splitlines() if line.split()[:1] == ["sim-soft"])
    assert row.split()[1:4] == ["no", "verdict", "-"]
    assert "stable than" not in done.stdout
    for table in tables(semstab.load_result(out)):
        assert bench("show", out, table.name, cwd=out.parent).stdout
    assert {table.name for table in tables(semstab.load_result(out))} <= {table.name for table in tables(result)}


def test_one_that_is_older_is_refused(old_run):
    out, _ = old_run
    settings = out / "config.yaml"
    settings.write_text(settings.read_text().replace("folder layout 3", "folder layout 2"))
    with pytest.raises(DataError, match="earlier version"):
        semstab.load_result(out)
