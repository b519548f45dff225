"""One command for a folder of cases: each is a module whose docstring is its help, and whose `main` has the options.

A parameter `trials: int = 100` is `--trials`, one without a default is a positional argument, `bool` is a switch,
`tuple[str, ...]` takes several words and `Literal` one of them. A `main` without parameters reads its words by itself.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.util
import inspect
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin


def run(about: str, cases: Mapping[str, str], words: Sequence[str], *, json: bool = False) -> None:
    """Run the case that the first word names, with the others.

    Args:
        about: What the command is, for its help.
        cases: Module of each case, by the case's name.
        words: Of the command line, without the program.
        json: Whether `--json FILE` writes what the case returns.
    """
    program = Path(sys.argv[0]).name
    if not words or words[0] not in cases:
        print(about, f"\n{program} CASE [options]; {program} CASE --help tells more\n", sep="\n")
        for name, module in cases.items():
            print(f"  {name:{max(map(len, cases))}}  {_first_line(module)}")
        sys.exit(0 if words and words[0] in ("-h", "--help") else 2)
    module = importlib.import_module(cases[words[0]])
    program = f"{program} {words[0]}"
    if not inspect.signature(module.main).parameters:
        sys.argv = [program, *words[1:]]
        module.main()
        return
    parser = parser_of(module.main, program, module.__doc__ or "")
    if json:
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    options = vars(parser.parse_args(words[1:]))
    file = options.pop("json", None)
    found = module.main(**options)
    if file:
        from semstab.core.files import write_json

        write_json(file, found)


def parser_of(main: Callable[..., Any], program: str, about: str) -> argparse.ArgumentParser:
    """Return the parser of a function's parameters."""
    parser = argparse.ArgumentParser(program, None, about, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, parameter in inspect.signature(main, eval_str=True).parameters.items():
        kind, options = parameter.annotation, {}
        if get_origin(kind) in (Union, types.UnionType):
            (kind,) = (part for part in get_args(kind) if part is not types.NoneType)
        several = get_origin(kind) is tuple
        kind = get_args(kind)[0] if several else kind
        if get_origin(kind) is Literal:
            options["choices"], kind = get_args(kind), str
        positional = parameter.default is parameter.empty
        if kind is bool:
            options["action"] = "store_true"
        else:
            options |= {"type": kind} | ({"nargs": "*"} if several else {})
        if not positional:
            options["default"] = parameter.default
            options["help"] = f"default: {_text(parameter.default)}" if parameter.default not in (None, False) else None
        flag = name if positional else "--" + name.rstrip("_").replace("_", "-")
        parser.add_argument(flag, **options, **({} if positional else {"dest": name}))
    return parser


def _text(default: object) -> str:
    words = default if isinstance(default, tuple) else [default]
    return " ".join(map(str, words)).replace("%", "%%")


def _first_line(module: str) -> str:
    """The first line of a module's docstring, without importing it."""
    found = importlib.util.find_spec(module)
    assert found is not None
    assert found.origin is not None
    return (ast.get_docstring(ast.parse(Path(found.origin).read_text(encoding="utf-8"))) or "").partition("\n")[0]


def head(names: Sequence[str]) -> None:
    """Print the head of a table in Markdown."""
    row(names)
    row(["---"] * len(names))


def row(cells: Iterable[str]) -> None:
    """Print a row of a table in Markdown."""
    print("|", " | ".join(cells), "|", flush=True)
