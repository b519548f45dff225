"""What can be named on the command line: a table from name to class, imported on first use.

Built-in entries are one line each; other packages add theirs with the entry point groups
`semstab.backends`, `semstab.datasets`, `semstab.backbones` and `semstab.filters`.
"""

from __future__ import annotations

import difflib
import functools
import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from semstab.errors import ConfigError, MissingDependencyError, one_line


@dataclass(frozen=True)
class Entry:
    """One name: where its class is ('module:Class'), what it is, and how to install what it needs."""

    target: str
    summary: str
    install: str = ""


class Registry:
    """The entries of one kind ('backend', 'dataset', ...), built in and from entry points."""

    def __init__(self, kind: str, builtin: Mapping[str, Entry]) -> None:
        self.kind = kind
        self.builtin = dict(builtin)

    def entries(self) -> dict[str, Entry]:
        """Every known entry by name; a built-in name is not replaced by a plug-in's."""
        return self._plugins | self.builtin

    @functools.cached_property
    def _plugins(self) -> dict[str, Entry]:
        """Those of other packages, read once: looking through all that are installed takes a while."""
        return {point.name: _plugin(point) for point in entry_points(group=f"semstab.{self.kind}s")}

    def entry(self, name: str) -> Entry:
        """The entry of that name. Raises ConfigError, with the nearest known name, where there is none."""
        entries = self.entries()
        if name not in entries:
            near = difflib.get_close_matches(name, entries, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(entries))}"
            raise ConfigError(f"{self.kind} '{name}' is not known; {hint}")
        return entries[name]

    def load(self, name: str) -> Any:
        """Import the class behind a name.

        Raises ConfigError where the name is not known, MissingDependencyError where its packages are not installed, or
        fail when they are imported, as those of versions that do not fit each other do.
        """
        entry = self.entry(name)
        module, _, attribute = entry.target.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except Exception as error:  # RuntimeError: torchvision of another torch; OSError: a shared library is missing
            hint = entry.install or "install what it needs"
            raise MissingDependencyError(f"{self.kind} '{name}' cannot be used ({one_line(error)}); {hint}") from error


def _plugin(point: EntryPoint) -> Entry:
    package = point.dist.name if point.dist else point.module
    return Entry(point.value, f"from the package {package}")
