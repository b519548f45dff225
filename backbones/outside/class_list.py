"""Names of classes as a user says them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from semstab.errors import ConfigError, one_line
from semstab.model.labels import LabelSpace
from semstab.runtime.files import MAX_YAML_BYTES, read_limited


def class_names(said: Sequence[str] | str) -> Sequence[str] | LabelSpace:
    """'a,b,c', a list, a text file with a name a line, or a taxonomy's YAML.

    Raises ConfigError where they are none, or cannot be read.
    """
    if not isinstance(said, str):
        return said
    path = Path(said).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return LabelSpace.load(path)
    if path.suffix and path.is_file():
        try:
            text = read_limited(path, MAX_YAML_BYTES).decode("utf-8")
        except (OSError, ValueError) as error:
            raise ConfigError(f"classes {said}: cannot be read ({one_line(error)})") from error
        names = [line.strip() for line in text.splitlines()]
    else:
        names = [name.strip() for name in said.split(",")]
    if not (found := [name for name in names if name]):
        raise ConfigError(f"classes {said}: holds no name")
    return found
