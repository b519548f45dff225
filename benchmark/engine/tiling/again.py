"""The second look at the voxels of a part, once all parts have told what the whole map is like."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, eq=False)
class Again:
    """A second look at a part.

    name     of the part
    overall  what all parts tell
    tiles    files of its voxels, in the folder
    slug     of the unit
    written  whether the tiles are written once more, with what the whole map tells of their voxels
    true     whether those of the ground truth are as well
    """

    name: str
    overall: Any
    tiles: tuple[str, ...]
    slug: str
    written: bool
    true: bool


@dataclass(frozen=True, eq=False)
class SeenAgain:
    """The part's sums, and digests of the files that were written, by their path in the folder."""

    sums: Any
    files: Mapping[str, str]
