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
Reader = Callable[[Any], Any]

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
    float: lambda value: value if math.isfinite(value) else None,
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
        return cast(T, _reader(cast(Any, cls))(content))
    except _MisfitError as misfit:
        line = misfit.line()
    except RecursionError:
        line = "content: is nested too deeply"
    raise DataError(f"{where}: {line}; it is damaged, or another version's; delete it and compute it again")


class _MisfitError(Exception):
    """Content that is not what the types say; each level that it leaves adds its step to the path."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.steps: list[str] = []

    def line(self) -> str:
        path = "".join(reversed(self.steps)).removeprefix(".") or "content"
        return one_line(Exception(f"{_short(path)}: {_short(str(self))}"))


def _short(text: str) -> str:
    return text if len(text) <= LONGEST // 2 else f"{text[: LONGEST // 2 - 3]}..."


def _expected(what: str, content: Any) -> _MisfitError:
    return _MisfitError(f"should be {what}, is {reprlib.repr(content)}")


@functools.cache
def _reader(hint: Any) -> Reader:
    """What reads content as a `hint`."""
    if hint in _PLAIN:
        return _PLAIN[hint]
    if (origin := get_origin(hint)) in _GENERIC:
        return _GENERIC[origin](get_args(hint))
    if isinstance(hint, type) and issubclass(hint, OwnForm):
        return _built(hint.of_json_content)
    if dataclasses.is_dataclass(hint):
        return _dataclass(hint)
    raise TypeError(f"{hint} has no JSON form")


def _float(content: Any) -> float:
    if type(content) is float:
        return content
    if content is None:
        return math.nan
    if type(content) is int and abs(content) < 2**1023:
        return content  # as it was written
    raise _expected("a number", content)


def _exactly(kind: type[Any], what: str) -> Reader:
    def read(content: Any) -> Any:
        if type(content) is kind:
            return content
        raise _expected(what, content)

    return read


_text = _exactly(str, "text")

_PLAIN: Mapping[Any, Reader] = {
    float: _float,
    int: _exactly(int, "a whole number"),
    str: _text,
    bool: _exactly(bool, "true or false"),
    type(None): _exactly(type(None), "null"),
    Path: lambda content: Path(_text(content)),
    Any: lambda content: content,
}


def _one_of(values: tuple[Any, ...]) -> Reader:
    def read(content: Any) -> Any:
        if any(type(content) is type(value) and content == value for value in values):
            return content
        raise _expected(f"one of {', '.join(map(repr, values))}", content)

    return read


def _optional(arguments: tuple[Any, ...]) -> Reader:
    others = [argument for argument in arguments if argument is not type(None)]
    if len(others) != 1 or len(others) == len(arguments):
        raise TypeError(f"{arguments}: a union that has no JSON form")
    reader = _reader(others[0])
    return lambda content: None if content is None else reader(content)


def _list(arguments: tuple[Any, ...]) -> Reader:
    reader = _reader(arguments[0])

    def read(content: Any) -> Any:
        if type(content) is not list:
            raise _expected("a list", content)
        return _items(content, [reader] * len(content))

    return read


def _tuple(arguments: tuple[Any, ...]) -> Reader:
    if arguments[1:] == (...,):
        read_list = _list(arguments)
        return lambda content: tuple(read_list(content))
    readers = [_reader(argument) for argument in arguments]

    def read(content: Any) -> Any:
        if type(content) is not list or len(content) != len(readers):
            raise _expected(f"a list of {len(readers)}", content)
        return tuple(_items(content, readers))

    return read


def _items(content: list[Any], readers: list[Reader]) -> list[Any]:
    values: list[Any] = []
    try:
        for item, reader in zip(content, readers, strict=True):
            values.append(reader(item))
    except _MisfitError as misfit:
        misfit.steps.append(f"[{len(values)}]")
        raise
    return values


def _mapping(arguments: tuple[Any, ...]) -> Reader:
    reader = _reader(arguments[1])

    def read(content: Any) -> Any:
        values = {}
        for key, item in _entries(content).items():
            try:
                values[key] = reader(item)
            except _MisfitError as misfit:
                misfit.steps.append(f".{key}")
                raise
        return values

    return read


_GENERIC: Mapping[Any, Callable[[tuple[Any, ...]], Reader]] = {
    Literal: _one_of,
    Union: _optional,
    types.UnionType: _optional,
    tuple: _tuple,
    list: _list,
    Mapping: _mapping,
    dict: _mapping,
}


def _entries(content: Any) -> dict[str, Any]:
    if type(content) is not dict:
        raise _expected("an object", content)
    return content


def fields_of(content: Any, hints: Mapping[str, Any], optional: Collection[str] = ()) -> dict[str, Any]:
    """The entries of a JSON object that are asked for, each read as its type; `optional` ones may be missing."""
    entries, values = _entries(content), {}
    for name, hint in hints.items():
        try:
            if name in entries:
                values[name] = _reader(hint)(entries[name])
            elif name not in optional:
                raise _MisfitError("is missing")
        except _MisfitError as misfit:
            misfit.steps.append(f".{name}")
            raise
    return values


def _dataclass(cls: Any) -> Reader:
    types_of, known = get_type_hints(cls), [field for field in dataclasses.fields(cls) if field.init]
    own = {field.name: types_of[field.name] for field in known if "inline" not in field.metadata}
    inline = {field.name: types_of[field.name] for field in known if "inline" in field.metadata}
    missing = dataclasses.MISSING
    optional = {field.name for field in known if field.default is not missing or field.default_factory is not missing}
    make = _built(lambda values: cls(**values))

    def read(content: Any) -> Any:
        values = {name: _reader(hint)(content) for name, hint in inline.items()}
        return make(values | fields_of(content, own, optional))

    return read


def _built(make: Reader) -> Reader:
    """What a class makes of its content; that it refuses it is a misfit, too."""

    def read(content: Any) -> Any:
        try:
            return make(content)
        except (ValueError, TypeError) as error:
            raise _MisfitError(f"{type(error).__name__}: {error}") from error

    return read
