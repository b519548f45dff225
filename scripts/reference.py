"""Write the reference pages from the code: docs/reference/cli.md, of the commands, and python.md, of the public names.

    python scripts/reference.py

The repository shows them as they are, and the site has them as pages.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

import semstab

FOLDER = Path(__file__).parents[1] / "docs/reference"

OBJECT = re.compile(r"<(?:class|function|object) .*?(?: at 0x[0-9a-f]+)?>|<factory>")
"""A default that has no name."""


def pages() -> dict[str, str]:
    """Return the text of each page by its file name."""
    return {name: "\n".join(lines).rstrip() + "\n" for name, lines in (("cli.md", commands()), ("python.md", names()))}


# --- The command line -------------------------------------------------------------------------------------------------


def commands() -> Iterator[str]:
    """Yield a section a command: its synopsis, its arguments and options by panel."""
    import typer

    from semstab.cli import EXAMPLES, app

    yield "# Command line\n\nMade from the commands themselves; `semstab-bench COMMAND --help` prints the same.\n"
    group: Any = typer.main.get_command(app)
    visible = {name: command for name, command in group.commands.items() if not command.hidden}
    yield " · ".join(f"[{name}](#semstab-bench-{name})" for name in visible) + "\n"
    for name, command in visible.items():
        yield f"## semstab-bench {name}\n\n{inspect.cleandoc(command.help or '')}\n"
        yield "".join(f"    semstab-bench {line}\n" for line in EXAMPLES[name])
        panels: dict[str, list[Any]] = {}
        for parameter in command.params:
            if not getattr(parameter, "hidden", False):
                panels.setdefault(getattr(parameter, "rich_help_panel", None) or "Options", []).append(parameter)
        for panel, parameters in panels.items():
            yield f"**{panel}**\n\n| | |\n| --- | --- |"
            yield from (f"| {_option(parameter)} | {_cell(parameter.help)} |" for parameter in parameters)
            yield ""


def _option(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    return ", ".join(f"`{option}`" for option in (*parameter.opts, *parameter.secondary_opts))


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


# --- Python -----------------------------------------------------------------------------------------------------------


def names() -> Iterator[str]:
    """Yield a section a public name: its signature, its arguments with their defaults, and an example."""
    yield "# Python\n\n`import semstab` is instant: what a name needs is imported when it is first used.\n"
    yield "The examples are run by the tests, in a folder that holds a finished run `run` of the city's `scene0`.\n"
    yield " · ".join(f"[{name}](#semstab{name.lower()})" for name in semstab.__all__) + "\n"
    for name in semstab.__all__:
        yield from _section(name, getattr(semstab, name))


def _section(name: str, value: Any) -> Iterator[str]:
    yield f"## semstab.{name}\n"
    parsed = sections(value)
    for section in parsed:
        if section.kind.value == "text":
            yield f"{section.value}\n"
    if inspect.ismodule(value):
        yield from _module(name, value)
    else:
        yield from _rows(value, parsed)
    for section in parsed:
        if section.kind.value in ("returns", "raises"):
            yield f"**{section.kind.value.capitalize()}**\n"
            yield from (f"- {_of(entry)}{_cell(entry.description)}" for entry in section.value)
            yield ""
    for section in parsed:
        if section.kind.value == "examples":
            yield "```python"
            yield from (text for _, text in section.value)
            yield "```\n"


def sections(value: Any) -> list[Any]:
    """Return the parts of a docstring in Google's convention."""
    return list(griffe.Docstring(inspect.getdoc(value) or "", lineno=1).parse("google", warnings=False))


def _of(entry: Any) -> str:
    return f"`{entry.annotation}`: " if entry.annotation else ""


def _module(name: str, module: Any) -> Iterator[str]:
    """Yield what a module has: functions and classes, each with its arguments and defaults, and its first line."""
    here = [
        attribute for attribute, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__
    ]
    exported = getattr(module, "__all__", [attribute for attribute in here if not attribute.startswith("_")])
    yield "| | |\n| --- | --- |"
    for attribute in sorted(attribute for attribute in exported if callable(getattr(module, attribute))):
        text = inspect.getdoc(getattr(module, attribute)) or ""
        yield f"| `{name}.{attribute}{_call(getattr(module, attribute))}` | {_cell(text.partition(chr(10) * 2)[0])} |"
    yield ""


def _call(value: Any) -> str:
    """Return '(table, digits=3)'; nothing for what is not called: protocols, base classes, exceptions."""
    if inspect.isabstract(value) or getattr(value, "_is_protocol", False):
        return ""
    texts = [f"{name}={default}" if default else name for name, default, _ in arguments(value)]
    return f"({', '.join(texts)})"


def _rows(value: Any, parsed: list[Any]) -> Iterator[str]:
    described = {}
    for part in reversed([parsed, *(sections(base) for base in getattr(value, "__mro__", ())[1:])]):
        described |= descriptions(part)
    rows = [*arguments(value)]
    if rows:
        yield "| argument | default | |\n| --- | --- | --- |"
        yield from (
            f"| `{name}` | {f'`{default}`' if default else ''} | {_cell(text or described.get(name.lstrip('*')))} |"
            for name, default, text in rows
        )
        yield ""


def descriptions(parsed: list[Any]) -> dict[str, str]:
    """Return the text of each argument and attribute that a docstring describes: of 'fx, fy: ...' that of both."""
    found = {}
    for section in parsed:
        for entry in section.value if section.kind.value in ("parameters", "attributes") else ():
            names = f"{entry.name}{entry.annotation}" if entry.name.endswith(",") else entry.name
            found |= {name.strip(): entry.description for name in names.split(",")}
    return found


def arguments(value: Any) -> Iterator[tuple[str, str, str]]:
    """Yield each argument of a class or function: its name, its default or '', and its own description or ''."""
    if isinstance(value, type) and issubclass(value, BaseModel):
        for name, field in value.model_fields.items():
            default = field.get_default(call_default_factory=True)
            yield (
                field.alias or name,
                "" if default is PydanticUndefined else _default(default),
                field.description or "",
            )
        return
    if isinstance(value, type) and issubclass(value, semstab.SemstabError):
        return
    fields = {field.name: field for field in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else {}
    for name, parameter in inspect.signature(value).parameters.items():
        if name.startswith("_"):
            continue
        default = parameter.default
        if name in fields and fields[name].default_factory is not dataclasses.MISSING:
            default = fields[name].default_factory()
        prefix = {parameter.VAR_KEYWORD: "**", parameter.VAR_POSITIONAL: "*"}.get(parameter.kind, "")
        yield prefix + name, "" if default is inspect.Parameter.empty else _default(default), ""


def _default(value: Any) -> str:
    if isinstance(value, BaseModel):
        return "{}" if value == type(value)() else _cell(str(value.model_dump(exclude_defaults=True)))
    if isinstance(value, list | tuple) and any(isinstance(model, BaseModel) for model in value):
        return _cell(str([model.model_dump(exclude_defaults=True) for model in value]))
    return "" if OBJECT.search(repr(value)) else _cell(repr(value))


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file, text in pages().items():
        (FOLDER / file).write_text(text, encoding="utf-8")
