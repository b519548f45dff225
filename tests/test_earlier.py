"""Results of version 0.3 are read under the names of today, with a warning."""

from __future__ import annotations

import json
import math

import pytest

import semstab
from semstab.errors import DataError
from semstab.model.earlier import KEYS

NOW = {new: old for old, new in KEYS.items()}


def as_in_0_3(value):
    """The content of a summary.json as version 0.3 wrote it."""
    if isinstance(value, list):
        return [as_in_0_3(item) for item in value]
    if not isinstance(value, dict):
        return value
    interval, share = "scope" in value and "low" in value, "counts_for_verdict" in value
    named = {
        (NOW.get(key, key) if key != "share" or "ceiling" in value else key): as_in_0_3(item)
        for key, item in value.items()
    }
    if interval or share:
        named["places"] = named.pop("locations")
    if interval:
        named["question"] = {"these frames": "this map"}.get(named["question"], "the next flight")
    if share:
        del named["unstable"]
    if {"level", "probability", "line"} == named.keys():
        del named["probability"]
    if isinstance(named.get("blocks"), int) and "verdict" in named:
        named["blocks"] = {"count": named["blocks"], "size": 0.5}
    return named


@pytest.fixture
def old_run(tmp_path):
    """A run whose folder is as that of version 0.3, and its result."""
    options = {"width": 48, "height": 32, "frames": 8}
    scene = {"dataset": {"options": options}, "scenes": ["scene0"], "backbones": ["sim-flicker"]}
    config = semstab.load_config(scene | {"check": None, "voxel_size": 0.8})
    out = tmp_path / "run"
    result = semstab.run(config, out=out, report=False)
    summary, settings = json.loads((out / "summary.json").read_text()), out / "config.yaml"
    (out / "summary.json").write_text(json.dumps(as_in_0_3(summary) | {"schema": 2}))
    settings.write_text(settings.read_text().replace("folder layout 4", "folder layout 3"))
    return out, result


def test_a_run_of_version_0_3_is_read_with_a_warning_and_an_older_one_refused(old_run, caplog):
    out, result = old_run
    (old,), (new,) = semstab.load_result(out).records, result.records
    assert "written by version 0.3" in caplog.text
    assert old.summary.table == new.summary.table
    one, other = old.statistics, new.statistics
    assert one.headline.psa.value == other.headline.psa.value
    assert one.verdict.level == other.verdict.level
    assert math.isnan(one.verdict.probability)
    assert one.agreement.voxel_weighted.locations == other.agreement.voxel_weighted.locations
    out, _ = old_run
    settings = out / "config.yaml"
    settings.write_text(settings.read_text().replace("folder layout 3", "folder layout 2"))
    with pytest.raises(DataError, match="earlier version"):
        semstab.load_result(out)
