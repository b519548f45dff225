"""What a kind of file is: which files, how they are damaged, how they are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import damages
from damages import Damage

Read = Callable[[Path], object]

BY_SUFFIX: dict[str, Damage] = {
    ".png": damages.of_png, ".npz": damages.of_npz, ".semstab": damages.of_npz, ".json": damages.of_json,
    ".geojson": damages.of_json, ".yaml": damages.of_yaml, ".txt": damages.of_words, ".csv": damages.of_words,
    ".tsv": damages.of_words, ".obj": damages.of_words, ".parquet": damages.of_parquet,
}  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """Files of which one at a time is damaged; `read` is called with the damaged one."""

    name: str
    files: tuple[Path, ...]
    read: Read

    def damaged(self, file: Path) -> Damage:
        """How a file of that suffix is damaged."""
        return BY_SUFFIX.get(file.suffix, damages.of_bytes)
