"""Where two summary.json differ: times, keys, digests and the order of units do not count."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

IGNORED = frozenset({"key", "input", "digest", "schema"})
"""Keys that are no result; so are those that hold _ms, such as `fuse_ms_per_frame`, or end in _seconds."""

NAMED_BY = ("scene", "model", "backend", "backends", "variation", "name", "rule", "measure", "a", "b")
"""Keys that tell the entries of a list apart, whatever their order."""


def differences(a: Any, b: Any, *, tolerance: float = 1e-9) -> list[str]:
    """Return one line for each path at which the contents differ; `tolerance` is relative, and absolute below 1."""
    return list(_differences(a, b, "", tolerance))


def _differences(a: Any, b: Any, path: str, tolerance: float) -> Iterator[str]:
    if isinstance(a, list) and isinstance(b, list):
        names = [_name(item) for item in a]
        if a and None not in names and len(set(names)) == len(names):
            a, b = ({f"[{_name(item)}]": item for item in items} for items in (a, b))
        else:
            if len(a) != len(b):
                yield f"{path}: {len(a)} entries and {len(b)}"
            for i, (one, other) in enumerate(zip(a, b, strict=False)):
                yield from _differences(one, other, f"{path}[{i}]", tolerance)
            return
    if isinstance(a, dict) and isinstance(b, dict):
        for key in dict.fromkeys([*a, *b]):
            below = f"{path}.{key}".removeprefix(".")
            if key in IGNORED or key.endswith("_seconds") or "_ms" in key:
                continue
            if key in a and key in b:
                yield from _differences(a[key], b[key], below, tolerance)
            else:
                yield f"{below}: only in the {'first' if key in a else 'second'}"
    elif not (_same(a, b, tolerance) or (a in (None, {}) and b in (None, {}))):  # a section that was not computed
        yield f"{path or 'content'}: {json.dumps(a)[:100]} and {json.dumps(b)[:100]}"


def _name(item: Any) -> str | None:
    if not isinstance(item, dict):
        return None
    values = [item[key] for key in NAMED_BY if key in item]
    parts = [part for value in values for part in (value.values() if isinstance(value, dict) else [value])]
    return " ".join(json.dumps(part).strip('"') for part in parts) or None


def _same(a: Any, b: Any, tolerance: float) -> bool:
    if isinstance(a, bool) or isinstance(b, bool) or not isinstance(a, int | float) or not isinstance(b, int | float):
        return bool(a == b and type(a) is type(b))
    return math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance) or (math.isnan(a) and math.isnan(b))
