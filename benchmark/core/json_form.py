"""Frozen dataclasses as JSON content, and back: the one place where results become text, and text becomes results.

The field types say everything: numbers, str, bool, None, Literal, Path, tuples, lists, Mapping[str, X], X | None,
nested dataclasses, Any. An undefined number (NaN, infinity) is null in JSON; a float field reads null as NaN.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import reprlib
import types
from collections.abc import Callable, Collection, Mapping
from pathlib import Path, PurePath
from typing import Any, Literal, Protocol, TypeVar, Union, cast, get_args, get_origin, get_type_hints, runtime_checkable

from semstab.errors import DataError, one_line

T = TypeVar("T")

INLINE: Mapping[str, bool] = types.MappingProxyType({"inline": True})
"""Metadata of a field whose own fields stand among those of its parent: `unit: Unit = field(metadata=INLINE)`."""

LONGEST = 300
"""Characters of a message at most, the name of the file apart."""


@runtime_checkable
class OwnForm(Protocol):
    """A class whose content is not that of its fields: it says itself how it is written and read."""

    def json_content(self) -> Any:
        """Content that `to_json` takes."""

    @classmethod
    def of_json_content(cls, content: Any) -> Any:
        """Read it, with `fields_of`; raises ValueError or TypeError where it does not fit."""


# --- To JSON ----------------------------------------------------------------------------------------------------------


def to_json(value: Any) -> Any:
    """Content that `json.dumps` takes, of dataclasses, mappings, sequences, numbers and numpy's numbers and arrays.

    >>> to_json({"a": (1.5, float("nan")), "path": Path("x/y")})
    {'a': [1.5, None], 'path': 'x/y'}
    """
    return _writer(cast(Any, type(value)))(value)


@functools.cache
def _writer(kind: Any) -> Callable[[Any], Any]:
    """What writes values of a class."""
    if kind in (str, int, bool, type(None)):
        return lambda value: value
    if kind is not float and hasattr(kind, "tolist"):  # numpy's arrays and scalars
        return lambda value: to_json(value.tolist())
    for base, write in _WRITERS.items():
        if issubclass(kind, base):
            return write
    if dataclasses.is_dataclass(kind):
        return _object_writer(kind)
    raise TypeError(f"{kind.__name__} has no JSON form")


_WRITERS: Mapping[Any, Callable[[Any], Any]] = {
    float: lambda value: float(value) if math.isfinite(value) else None,
    int: int,
    str: str.__str__,
    Mapping: lambda value: {str(key): to_json(item) for key, item in value.items()},
    tuple: lambda value: [to_json(item) for item in value],
    list: lambda value: [to_json(item) for item in value],
    PurePath: lambda value: value.as_posix(),
    OwnForm: lambda value: to_json(value.json_content()),
}


def _object_writer(kind: Any) -> Callable[[Any], Any]:
    fields = [(field.name, "inline" in field.metadata) for field in dataclasses.fields(kind)]

    def write(value: Any) -> dict[str, Any]:
        content: dict[str, Any] = {}
        for name, inline in fields:
            own = to_json(getattr(value, name))
            content |= own if inline else {name: own}
        return content

    return write


# --- From JSON --------------------------------------------------------------------------------------------------------


def from_json(cls: type[T], content: Any, where: str | Path) -> T:
    """Read what `to_json` made of a `cls`; `where` is the file, for messages.

    Unknown keys are ignored, a missing field takes its default. Raises DataError in one line that names the file and
    the field where the content is not that of a `cls`.
    """
    try:
        return cast(T, _read(cls, content))
    except _MisfitError as misfit:
        line = misfit.line()
    except RecursionError:
        line = "content: is nested too deeply"
    raise DataError(f"{where}: {line}; it is damaged, or another version's; delete it and compute it again")


class _MisfitError(Exception):
    """Content that is not what the types say; each level that it leaves adds its step to the path."""

    def __init__(self, message: str, *steps: str) -> None:
        super().__init__(message)
        self.steps = list(steps)

    def line(self) -> str:
        path = "".join(reversed(self.steps)).removeprefix(".") or "content"
        return one_line(Exception(f"{_short(path)}: {_short(str(self))}"))


def _short(text: str) -> str:
    return text if len(text) <= LONGEST // 2 else f"{text[: LONGEST // 2 - 3]}..."


def _expected(what: str, content: Any) -> _MisfitError:
    return _MisfitError(f"should be {what}, is {reprlib.repr(content)}")


def _read(hint: Any, content: Any) -> Any:
    """Content as a `hint`."""
    if hint is float:
        return _number(content)
    if hint in _EXACT:
        return _exactly(hint, content)
    origin, arguments = _parsed(hint)
    if origin in _GENERIC:
        return _GENERIC[origin](arguments, content)
    return content if hint is Any else _object(hint, content)


_parsed = functools.cache(lambda hint: (get_origin(hint), get_args(hint)))


def _at(step: str, hint: Any, content: Any) -> Any:
    """What stands at that step of the path."""
    try:
        return _read(hint, content)
    except _MisfitError as misfit:
        misfit.steps.append(step)
        raise


_EXACT: Mapping[Any, str] = {
    int: "a whole number", str: "text", bool: "true or false", type(None): "null", list: "a list", dict: "an object",
}  # fmt: skip


def _exactly(kind: Any, content: Any) -> Any:
    if type(content) is kind:
        return content
    raise _expected(_EXACT[kind], content)


def _number(content: Any) -> float:
    """An int stays as it was written."""
    if type(content) is float or (type(content) is int and abs(content) < 2**1023):
        return content
    if content is None:
        return math.nan
    raise _expected("a number", content)


def _one_of(values: tuple[Any, ...], content: Any) -> Any:
    if any(type(content) is type(value) and content == value for value in values):
        return content
    raise _expected(f"one of {', '.join(map(repr, values))}", content)


def _optional(arguments: tuple[Any, ...], content: Any) -> Any:
    """X | None."""
    (hint,) = (argument for argument in arguments if argument is not type(None))
    return None if content is None else _read(hint, content)


def _sequence(arguments: tuple[Any, ...], content: Any) -> list[Any]:
    items = _exactly(list, content)
    return [_at(f"[{i}]", arguments[0], item) for i, item in enumerate(items)]


def _tuple(arguments: tuple[Any, ...], content: Any) -> tuple[Any, ...]:
    if arguments[1:] == (...,):
        return tuple(_sequence(arguments, content))
    if len(_exactly(list, content)) != len(arguments):
        raise _expected(f"a list of {len(arguments)}", content)
    return tuple(_at(f"[{i}]", hint, item) for i, (hint, item) in enumerate(zip(arguments, content, strict=True)))


def _mapping(arguments: tuple[Any, ...], content: Any) -> dict[str, Any]:
    entries = _exactly(dict, content)
    return {key: _at(f".{key}", arguments[1], item) for key, item in entries.items()}


_GENERIC: Mapping[Any, Callable[[tuple[Any, ...], Any], Any]] = {
    Literal: _one_of, Union: _optional, types.UnionType: _optional, tuple: _tuple, list: _sequence, Mapping: _mapping,
    dict: _mapping,
}  # fmt: skip


def _object(cls: Any, content: Any) -> Any:
    """A class; that it refuses what it is made of is a misfit, too."""
    try:
        if issubclass(cls, OwnForm):
            return cls.of_json_content(content)
        if cls is Path:
            return Path(_exactly(str, content))
        own, inline, optional = _fields(cls)
        return cls(**{name: _read(hint, content) for name, hint in inline.items()}, **fields_of(content, own, optional))
    except (ValueError, TypeError) as error:
        raise _MisfitError(f"{type(error).__name__}: {error}") from error


def fields_of(content: Any, hints: Mapping[str, Any], optional: Collection[str] = ()) -> dict[str, Any]:
    """The entries of a JSON object that are asked for, each read as its type; `optional` ones may be missing."""
    entries = _exactly(dict, content)
    if missing := [name for name in hints if name not in entries and name not in optional]:
        raise _MisfitError("is missing", f".{missing[0]}")
    return {name: _at(f".{name}", hint, entries[name]) for name, hint in hints.items() if name in entries}


@functools.cache
def _fields(cls: Any) -> tuple[dict[str, Any], dict[str, Any], set[str]]:
    """The types of a dataclass's own fields and of its inline ones, and which fields may be missing."""
    types_of, known = get_type_hints(cls), [field for field in dataclasses.fields(cls) if field.init]
    inline = {field.name: types_of[field.name] for field in known if "inline" in field.metadata}
    own = {field.name: types_of[field.name] for field in known if field.name not in inline}
    missing = dataclasses.MISSING
    return own, inline, {f.name for f in known if f.default is not missing or f.default_factory is not missing}
