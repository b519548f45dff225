"""Do two summary.json, of runs or of studies, say the same? `python tests/compare_summaries.py A B`.

One line a difference. Times, keys, digests and the order of units do not count. Exit code 1 where they differ.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TOLERANCE = 1e-9
"""Relative, and absolute for numbers below 1."""

IGNORED = frozenset({"key", "input", "digest", "schema"})
"""Keys that are no result; so are those that end in _ms or _seconds, `fuse_ms_per_frame`, and `stages_ms`."""

NOTHING = (None, {})
"""A section that was not computed."""

NAMED_BY = ("scene", "backbone", "backend", "backends", "variation", "name", "rule", "measure", "a", "b")
"""What tells the entries of a list apart, whatever their order."""


def differences(a: Any, b: Any, *, tolerance: float = TOLERANCE, added: bool = False) -> list[str]:
    """One line for each path at which the contents differ; `added` allows keys and entries that only b has."""
    return list(_differences(a, b, "", tolerance, added))


def _differences(a: Any, b: Any, path: str, tolerance: float, added: bool) -> Iterator[str]:
    if isinstance(a, dict) and isinstance(b, dict):
        yield from _of_objects(a, b, path, tolerance, added)
    elif isinstance(a, list) and isinstance(b, list):
        yield from _of_lists(a, b, path, tolerance, added)
    elif not (_same(a, b, tolerance) or (a in NOTHING and b in NOTHING)):
        yield f"{path or 'content'}: {_said(a)} and {_said(b)}"


def _of_objects(a: dict[str, Any], b: dict[str, Any], path: str, tolerance: float, added: bool) -> Iterator[str]:
    for key in [*a, *(key for key in b if key not in a)]:
        below = f"{path}.{key}".removeprefix(".")
        if _is_ignored(key):
            continue
        if key not in b:
            yield f"{below}: only in the first"
        elif key not in a:
            if not added:
                yield f"{below}: only in the second"
        else:
            yield from _differences(a[key], b[key], below, tolerance, added)


def _of_lists(a: list[Any], b: list[Any], path: str, tolerance: float, added: bool) -> Iterator[str]:
    names = [_name(item) for item in a]
    if a and None not in names and len(set(names)) == len(names):
        yield from _of_objects(
            {f"[{_name(item)}]": item for item in a}, {f"[{_name(item)}]": item for item in b}, path, tolerance, added
        )
        return
    if len(a) != len(b) and not (added and len(a) < len(b)):
        yield f"{path}: {len(a)} entries and {len(b)}"
    for i, (one, other) in enumerate(zip(a, b, strict=False)):
        yield from _differences(one, other, f"{path}[{i}]", tolerance, added)


def _name(item: Any) -> str | None:
    """What an entry is called among its neighbours."""
    if not isinstance(item, dict):
        return None
    given = [key for key in NAMED_BY if key in item and not _base(key, item)]
    found = [json.dumps(_plain(item[key]), sort_keys=True).strip('"') for key in given]
    return " ".join(found) or None


def _plain(value: Any) -> Any:
    """Whole numbers are numbers: 5 is 5.0."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return float(value) if type(value) is int else value


def _base(key: str, item: dict[str, Any]) -> bool:
    """Units at the base settings, by whatever backend, go without a variation: summaries of version 1 have none."""
    return key == "variation" and item[key]["sweep"] in ("base", "backends")


def _is_ignored(key: str) -> bool:
    return key in IGNORED or key.endswith(("_ms", "_seconds")) or "_ms_" in key


def _same(a: Any, b: Any, tolerance: float) -> bool:
    if isinstance(a, bool) or isinstance(b, bool) or not isinstance(a, int | float) or not isinstance(b, int | float):
        return bool(a == b and type(a) is type(b))
    return math.isclose(a, b, rel_tol=tolerance, abs_tol=tolerance) or (math.isnan(a) and math.isnan(b))


def _said(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 100 else f"{text[:97]}..."


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("a", type=Path, help="a summary.json, or the folder that holds it")
    parser.add_argument("b", type=Path)
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="relative (default: %(default)g)")
    parser.add_argument("--added", action="store_true", help="allow keys and entries that only the second one has")
    arguments = parser.parse_args()
    a, b = (
        json.loads((path / "summary.json" if path.is_dir() else path).read_text(encoding="utf-8"))
        for path in (arguments.a, arguments.b)
    )
    found = differences(a, b, tolerance=arguments.tolerance, added=arguments.added)
    sys.stdout.writelines(f"{line}\n" for line in found)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
