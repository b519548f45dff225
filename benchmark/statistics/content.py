"""From what the statistics find to content for JSON, and back: undefined numbers are NaN here, null there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.statistics.blocks import Estimate


def mean(values: npt.NDArray[Any]) -> float:
    """The mean of the values that are defined; NaN where none is."""
    defined = values[~np.isnan(values)]
    return float(defined.mean()) if defined.size else math.nan


def plain(value: Any) -> Any:
    """Data classes as mappings, tuples as lists, down to what JSON knows."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def nulls(content: Any) -> Any:
    """Content in which undefined numbers are None, as they are where it is read from a file."""
    if isinstance(content, Mapping):
        return {key: nulls(item) for key, item in content.items()}
    if isinstance(content, list):
        return [nulls(item) for item in content]
    return None if isinstance(content, float) and math.isnan(content) else content


def number_at(content: Any, *path: str) -> float:
    """The number at a path of keys; NaN where it is undefined or there is no such section."""
    for key in path:
        content = content.get(key) if isinstance(content, Mapping) else None
    return math.nan if content is None else float(content)


def estimate_at(content: Any, *path: str) -> Estimate:
    """The estimate at a path of keys, all of it NaN where it is undefined or there is no such section."""
    return Estimate(*(number_at(content, *path, part) for part in ("value", "low", "high")))
