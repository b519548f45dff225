"""Changes of a vocabulary that follow its file: 'kitchen.yaml,without=door,add=lamp,rename=shelf:rack'."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from semstab.errors import ConfigError

EACH = "each"
"""Stands for each name, one after the other: 'without=each'."""

CHANGE = re.compile(r",(without|add|rename)=")


@dataclass(frozen=True)
class VocabularyChanges:
    """Names that are taken out of a vocabulary, added to it, or renamed.

    Attributes:
        without: Names that are left out, with their synonyms.
        add: Names that are added.
        rename: Pairs of an old name and its new name.
    """

    without: tuple[str, ...] = ()
    add: tuple[str, ...] = ()
    rename: tuple[tuple[str, str], ...] = ()

    @classmethod
    def parse(cls, text: str) -> tuple[Path, Self]:
        """Return the file of a vocabulary, and the changes that follow it.

        Raises:
            ConfigError: If a change says no name, or 'without=each' is not the only one.
        """
        file, *parts = CHANGE.split(text)
        changes = [*zip(parts[::2], map(str.strip, parts[1::2]), strict=True)]
        renamed = []
        for change, value in changes:
            old, colon, new = (part.strip() for part in value.partition(":"))
            if not value or (change == "rename" and not (old and colon and new)):
                wanted = "rename=OLD:NEW" if change == "rename" else f"{change}=NAME"
                raise ConfigError(f"{text}: '{change}={value}' says no name; write {wanted}")
            renamed += [(old, new)] if change == "rename" else []
        without, add = (tuple(value for change, value in changes if change == kind) for kind in ("without", "add"))
        if EACH in without and len(changes) > 1:
            raise ConfigError(f"{text}: without=each stands alone; say other changes in a --vocabulary of their own")
        return Path(file), cls(without, add, tuple(renamed))

    def __bool__(self) -> bool:
        return bool(self.without or self.add or self.rename)

    def __str__(self) -> str:
        renamed = (f"rename={old}>{new}" for old, new in self.rename)  # ':' parts a run's folder from a model
        return ",".join((*(f"without={n}" for n in self.without), *(f"add={n}" for n in self.add), *renamed))

    @classmethod
    def of_model(cls, name: str) -> tuple[str, Self]:
        """Return the model NET@VOCABULARY of the full vocabulary, and the changes that a model's name states."""
        full, *parts = CHANGE.split(name)
        changes = [*zip(parts[::2], parts[1::2], strict=True)]
        without, add, renamed = ([v for change, v in changes if change == k] for k in ("without", "add", "rename"))
        pairs = [value.partition(">")[::2] for value in renamed]
        return full, cls(tuple(without), tuple(add), tuple(pairs))
