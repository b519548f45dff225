"""Frozen dataclasses as JSON content, and back: the only module where results become text, and text becomes results.

An undefined number (NaN, infinity) is null in JSON; a float field reads null as NaN.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import reprlib
import types
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar, cast

from semstab.errors import DataError, summarize_error

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails, SchemaValidator

T = TypeVar("T")


def inline(suffix: str = "") -> Mapping[str, str]:
    """Return metadata of a field whose own fields stand among those of its parent, with a suffix to their names."""
    return types.MappingProxyType({"inline": suffix})


INLINE = inline()
"""Metadata of a field whose own fields stand among those of its parent: `unit: UnitName = field(metadata=INLINE)`."""

LONGEST = 150
"""Characters at most of a field's name in a message, and of the problem."""

EXACT = ("int", "str", "bool")
"""Types that are read as they are: no number from a text, no text from a number."""


def to_json(value: Any) -> Any:
    """Return content that `json.dumps` takes, of dataclasses, mappings, sequences, numbers, numpy's scalars and arrays.

    A class with a method `json_content` is written as the result of that method; its `of_json_content` reads it.

    >>> to_json({"a": (1.5, float("nan")), "path": Path("x/y")})
    {'a': [1.5, None], 'path': 'x/y'}
    """
    return _writer(cast(Any, type(value)))(value)


@functools.cache
def _writer(kind: Any) -> Callable[[Any], Any]:
    if kind in (str, int, bool, type(None)):
        return lambda value: value
    if kind is not float and hasattr(kind, "tolist"):  # numpy's arrays and scalars
        return lambda value: to_json(value.tolist())
    for base, write in _WRITERS.items():
        if issubclass(kind, base):
            return write
    if hasattr(kind, "json_content"):
        return lambda value: to_json(value.json_content())
    if dataclasses.is_dataclass(kind):
        return functools.partial(_fields, [(f.name, f.metadata.get("inline")) for f in dataclasses.fields(kind)])
    raise TypeError(f"{kind.__name__} has no JSON form")


_WRITERS: Mapping[Any, Callable[[Any], Any]] = {
    float: lambda value: float(value) if math.isfinite(value) else None,
    int: int,
    str: str.__str__,
    Mapping: lambda value: {str(key): to_json(item) for key, item in value.items()},
    tuple: lambda value: [to_json(item) for item in value],
    list: lambda value: [to_json(item) for item in value],
    PurePath: lambda value: value.as_posix(),
}


def _fields(fields: list[tuple[str, str | None]], value: Any) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for name, suffix in fields:
        field_json = to_json(getattr(value, name))
        content |= {name: field_json} if suffix is None else {key + suffix: item for key, item in field_json.items()}
    return content


def from_json(cls: type[T], content: Any, where: str | Path) -> T:
    """Read what `to_json` made of a `cls`; `where` is the file, for messages.

    Unknown keys are ignored, a missing field takes its default.

    Raises:
        DataError: If the content is not that of a `cls`; the message names the file and the field; the message is one
            line.
    """
    from pydantic import ValidationError

    try:
        return cast(T, _validator(cast(Any, cls)).validate_python(content))
    except ValidationError as error:
        line = _line(error.errors(include_url=False)[0])
    except RecursionError:
        line = "content: is nested too deeply"
    raise DataError(f"{where}: {line}; it is damaged, or of another version; delete it and compute it again")


def number(content: Any) -> float:
    """Return a number of JSON, NaN for null.

    Raises:
        ValueError: For other content.
    """
    if content is None:
        return math.nan
    if type(content) is float or (type(content) is int and abs(content) < 2**1023):
        return content  # an int stays as it was written
    raise ValueError(f"should be a number, is {reprlib.repr(content)}")


@functools.cache
def _validator(cls: Any) -> SchemaValidator:
    from pydantic import TypeAdapter
    from pydantic_core import SchemaValidator

    return SchemaValidator(_adapted(TypeAdapter(cls).core_schema))


def _adapted(schema: Any) -> Any:
    """Return pydantic's schema with null as NaN, exact types, inline fields, and classes of a form of their own."""
    from pydantic_core import core_schema

    if isinstance(schema, list):
        return [_adapted(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    kind, cls = schema.get("type"), cast(Any, schema.get("cls"))
    adapted = {key: _adapted(value) for key, value in schema.items()} | ({"strict": True} if kind in EXACT else {})
    inlined = {
        f.name: f.metadata["inline"]
        for f in (dataclasses.fields(cls) if kind == "dataclass" else ())
        if "inline" in f.metadata
    }

    def spread(content: Any) -> Any:
        """Show an inline field all entries of its parent that end with its suffix: it takes its own."""
        if not isinstance(content, dict):
            return content
        return content | {
            name: {key.removesuffix(end): item for key, item in content.items() if key.endswith(end)}
            if end
            else content
            for name, end in inlined.items()
        }

    if kind == "float":
        return core_schema.no_info_plain_validator_function(number)
    if kind == "dataclass" and hasattr(cls, "of_json_content"):
        return core_schema.no_info_plain_validator_function(cls.of_json_content, ref=adapted.get("ref"))
    return (
        core_schema.no_info_before_validator_function(spread, adapted, ref=adapted.pop("ref", None))
        if inlined
        else adapted
    )


def _line(problem: ErrorDetails) -> str:
    path = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in problem["loc"]).removeprefix(".")
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if problem["type"] == "missing":
        message = "is missing"
    elif problem["type"] != "value_error":
        message += f", is {reprlib.repr(problem['input'])}"
    return summarize_error(Exception(f"{path[:LONGEST] or 'content'}: {message[:LONGEST]}"))
