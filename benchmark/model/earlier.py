"""Summaries of version 0.3 (schema 2), whose names are translated for one version."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

logger = logging.getLogger("semstab")

SCHEMA = 2
"""The schema that is translated."""

KEYS: Mapping[str, str] = {
    "judged": "headline", "reach": "ceiling_share", "each_place": "voxel_weighted", "question": "scope",
    "matters": "counts_for_verdict", "reached": "share", "foresight": "next_frame",
    "foresight_by_frame": "next_frame_by_frame",
}  # fmt: skip
"""Keys of schema 2, and what they are called now."""

GONE = ("beyond_coin", "fusion_rules")
"""Keys of schema 2 that are not read any more."""

SCOPES: Mapping[str, str] = {"this map": "these frames", "the next flight": "other scenes"}


def translated(content: Mapping[str, Any], path: str | Path) -> dict[str, Any]:
    """Return the content of a summary.json of schema 2 under the names of today, with a warning that names the file."""
    logger.warning("%s: written by version 0.3; its names are translated. Run it again before the next version", path)
    return {key: _value(value) for key, value in content.items()}


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return [_value(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    named = {KEYS.get(key, key): _value(item) for key, item in value.items() if key not in GONE}
    if "scope" in named and "low" in named:  # an interval
        named["scope"] = SCOPES.get(named["scope"], named["scope"])
        named["locations"] = named.pop("places", 0)
    if {"paired", "looks"} <= named.keys():  # a comparison of backbones
        named["observations"] = named.pop("looks")
    if "counts_for_verdict" in named:  # a class
        named |= {"locations": named.pop("places", 0), "unstable": None}
    if isinstance(named.get("blocks"), Mapping):  # statistics
        named["blocks"] = named["blocks"].get("count", 0)
    if {"level", "line"} == named.keys():  # a verdict
        level = named["level"]
        named |= {"level": "stable" if level == "partly stable" else level, "probability": None}
    return named
