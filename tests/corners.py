"""Combinations: `make test` takes the corners, `make combinations` the parameters that walk the same code again."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest

combination = pytest.mark.combination


def corners(values: Iterable[Any], always: Collection[Any]) -> list[Any]:
    """Return the values of a parameter, or tuples of several: those that are not in `always` are combinations.

    Raises:
        ValueError: If one of `always` is no value: a name that has changed would leave nothing in `make test`.
    """
    values = list(values)
    if unknown := [value for value in always if value not in values]:
        raise ValueError(f"no such values: {unknown}")
    return [value if value in always else pytest.param(*_several(value), marks=combination) for value in values]


def _several(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)
