"""What every group of settings shares: closed to unknown keys, read from YAML, explained in one line."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from semstab.errors import ConfigError, one_line
from semstab.runtime.files import MAX_YAML_BYTES, parse_yaml, read_limited

Model = TypeVar("Model", bound=BaseModel)


class Settings(BaseModel):
    """A group of settings: frozen, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def read_yaml(path: str | Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises ConfigError in one line where there is none."""
    try:
        text = read_limited(path, MAX_YAML_BYTES).decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not a text file ({error.reason} at byte {error.start})") from error
    content = parse_yaml(text, str(path))
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: expected settings ('key: value' lines), found a {type(content).__name__}")
    return content


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of `over` on top of `base`, group by group."""
    merged = dict(base)
    for key, value in over.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = merge(merged[key], value) if both else value
    return merged


def validated(model: type[Model], content: Any, where: str = "") -> Model:
    """The settings that a content holds. Raises ConfigError in one line, which begins with `where`."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{where}{explain(error, model)}") from error
    except UnicodeEncodeError as error:  # pydantic reads text as UTF-8; YAML's "\\ud800" is half a character
        raise ConfigError(f"{where}{error.object[:80]!r} is no text ({error.reason})") from error
    except TypeError as error:  # pydantic passes some groups on by name
        raise ConfigError(f"{where}a setting has a name that is no text ({one_line(error)})") from error


def explain(error: ValidationError, model: type[BaseModel]) -> str:
    """The first problem of a pydantic error as one line: the setting, what is wrong, the nearest known key."""
    problem = error.errors()[0]
    name = ".".join(" ".join(str(part).split()) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        unknown = name.rpartition(".")[2]
        known = sorted(_keys_at(model, problem["loc"][:-1]))
        near = difflib.get_close_matches(unknown, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
        return f"unknown setting '{name}'; {hint}"
    message = problem["msg"].removeprefix("Value error, ")
    if not name:  # of the settings as a whole
        return message
    return f"{name}: {message[0].lower()}{message[1:]} (got {reprlib.repr(problem['input'])})"


def _keys_at(model: type[BaseModel], path: tuple[int | str, ...]) -> Iterator[str]:
    for part in path:
        field = model.model_fields.get(str(part))
        inner = list(_models_in(field.annotation)) if field else []
        model = inner[0] if inner else model
    yield from model.model_fields


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in getattr(annotation, "__args__", ()):
        yield from _models_in(inner)
