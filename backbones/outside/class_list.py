"""Names of classes as a user says them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semstab.errors import ConfigError
from semstab.model.labels import LabelSpace


def class_names(said: Sequence[str] | str) -> Sequence[str] | LabelSpace:
    """'a,b,c', a list, a text file with a name a line, or a taxonomy's YAML. Raises ConfigError for an empty one."""
    if not isinstance(said, str):
        return said
    path = Path(said).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return LabelSpace.load(path)
    if path.suffix and path.is_file():
        names = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    else:
        names = [name.strip() for name in said.split(",")]
    if not (found := [name for name in names if name]):
        raise ConfigError(f"classes {said}: holds no name")
    return found
