"""Names on the command line: a table from name to class, imported on first use.

Built-in entries are one line each; other packages add theirs with the entry point groups
`semstab.backends`, `semstab.datasets`, `semstab.models` and `semstab.filters`.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

from semstab.core.code import Code, is_code, may_run
from semstab.errors import ConfigError, MissingDependencyError, nearest, summarize_error

BY_RULE = "+"
"""Stands between the name of a backend and that of the rule by which it fuses: 'numba+bayes'."""

_code: dict[tuple[str, str], str] = {}
"""Code of users by kind and name; see `semstab.core.code`."""


def name_code(kind: str, name: str, text: str) -> None:
    """Give a class of a user's file or package a name that registries of that kind know in this process.

    Code that a run folder names alone gets none, so that nothing later starts it under that name.
    """
    if may_run(text):
        _code[kind, name] = text


@dataclass(frozen=True)
class Registration:
    """One name: its class ('module:Class'), a description, and how to install what it needs.

    Attributes:
        needs: Packages that a bare installation may lack, under their names of import.
    """

    target: str
    summary: str
    install: str = ""
    needs: tuple[str, ...] = ()


class Registry:
    """The entries of one kind ('backend', 'dataset', ...), built in and from entry points."""

    def __init__(self, kind: str, builtin: Mapping[str, Registration]) -> None:
        self.kind = kind
        self.builtin = dict(builtin)

    def entries(self) -> dict[str, Registration]:
        """Return every known entry by name; a built-in name is not replaced by a plug-in's."""
        return self._plugins | self.builtin

    @functools.cached_property
    def _plugins(self) -> dict[str, Registration]:
        # read once: it looks through all that is installed
        return {
            point.name: Registration(point.value, f"from the package {point.dist.name if point.dist else point.module}")
            for point in entry_points(group=f"semstab.{self.kind}s")
        }

    def entry(self, name: str) -> Registration:
        """Return the entry of that name.

        Raises:
            ConfigError: If there is none, with the nearest known name.
        """
        entries = self.entries()
        if name not in entries:
            raise ConfigError(f"{self.kind} '{name}' is not known; {nearest(name, sorted(entries))}")
        return entries[name]

    def missing(self, name: str) -> str:
        """Return the advice for packages of an entry that are not installed; empty if all are. Imports nothing.

        Raises:
            ConfigError: If the name is not known.
        """
        entry = self.entry(name)
        needs = entry.needs or (entry.target.partition(":")[0].partition(".")[0],)
        absent = [package for package in needs if importlib.util.find_spec(package) is None]
        return f"{', '.join(absent)}: not installed; {entry.install or 'install it'}" if absent else ""

    def load(self, name: str) -> Any:
        """Import the class behind a name, or a user's class by FILE.py:NAME or package.module:NAME.

        Raises:
            ConfigError: If the name is not known, or is that of a user's code and of a built-in class.
            MissingDependencyError: If its packages are not installed, or fail when they are imported, as packages of
                incompatible versions do.
        """
        if (text := _code.get((self.kind, name))) is not None:
            if name in self.builtin:
                raise ConfigError(f"{text}: a built-in {self.kind} is called '{name}'; give the class another name")
            return Code.load(text, self.kind).target
        if is_code(name):
            return Code.load(name, self.kind).target
        entry = self.entry(name)
        module, _, attribute = entry.target.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except Exception as error:  # RuntimeError: torchvision of another torch; OSError: a shared library is missing
            hint = entry.install or "install the packages that it needs"
            raise MissingDependencyError(
                f"{self.kind} '{name}' cannot be used ({summarize_error(error)}); {hint}"
            ) from error
