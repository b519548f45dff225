"""Summaries of version 0.3 (schema 2), whose names are translated for one version."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

logger = logging.getLogger("semstab")

SCHEMA, SMALL = 2, 1
"""The schemas of a run's summary and of a small summary that are translated."""

KEYS: Mapping[str, str] = {
    "backbone": "model", "backbones": "models", "judged": "headline", "question": "scope", "foresight": "next_frame",
    "foresight_by_frame": "next_frame_by_frame", "wrong_of_stable": "wrong_of_consistent",
    "stable_right": "consistent_right", "stable_wrong": "consistent_wrong", "unstable_right": "inconsistent_right",
    "unstable_wrong": "inconsistent_wrong",
}  # fmt: skip
"""Keys of schema 2, and what they are called now."""

GONE = ("beyond_coin", "fusion_rules", "reach", "correlogram", "alpha_between", "each_place")
"""Keys of schema 2 that are not read any more: its looks were at voxels, and alpha is of spots."""

VOXEL_ALPHA = ({"psa", "kappa"}, {"voxel_size", "frames", "alpha"}, {"vss", "recurrent_vss"}, {"name", "kappa"})
"""Keys beside which 'alpha' was that of voxels: of a map, of a size, of reduced scores, of a class."""

JUDGED_BEFORE = (
    "{model}: no verdict, run it again for alpha of spots: version 0.3 judged alpha of voxels by a ceiling, and said"
    " {level}"
)

UNKNOWN = {"value": None, "low": None, "high": None}

SCOPES: Mapping[str, str] = {"this map": "these frames", "the next flight": "other scenes"}


def translated(content: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Return the content of a summary.json of schema 2 under the names of today, with a warning that names the file.

    It has no alpha, and therefore neither a verdict nor a comparison of models, which rested on another number.
    """
    logger.warning("%s: written by version 0.3; without alpha and verdicts, which were of voxels. Run it again", path)
    return {key: _value(value) for key, value in content.items() if key != "comparisons"}


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return [_value(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    named = {KEYS.get(key, key): _value(item) for key, item in value.items() if key not in GONE}
    if "scope" in named and "low" in named:  # an interval
        named["scope"] = SCOPES.get(named["scope"], named["scope"])
        named["locations"] = named.pop("places", 0)
    if "alpha" in named and any(names <= named.keys() for names in VOXEL_ALPHA):
        named["voxel_alpha"] = named.pop("alpha")
    if isinstance(named.get("blocks"), Mapping):  # statistics
        named["cubes"] = named.pop("blocks").get("count", 0)
        named |= {"spots": None, "correlogram": None}
        named["headline"] = {key: each for key, each in named["headline"].items() if key != "voxel_alpha"}
        named["headline"]["alpha"] = UNKNOWN
    if {"level", "line"} == named.keys():  # a verdict
        line = JUDGED_BEFORE.format(model=named["line"].partition(": ")[0], level=named["level"])
        named |= {"level": "no verdict", "probability": None, "line": line}
    return named
