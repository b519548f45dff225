"""What is computed of a unit in tiles at a time, and what is left of it: sums and series that add up to the unit's."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from semstab.core.files import parse_json, read_arrays, write_arrays
from semstab.core.json_form import from_json, to_json
from semstab.core.rows import Rows
from semstab.core.types import Float64
from semstab.engine.series import NUMBERS, Series
from semstab.engine.tiling.partition import Part
from semstab.engine.tiling.stretches import Stretch
from semstab.model.records import FrameQuality
from semstab.model.results import Agreement, SizeAlpha

PORTIONS = "parts"
"""Folder of what is finished of units in tiles, unit by unit, until they are whole."""

TRUE_LOOKS = ".truth.parquet"
"""What the file of looks at the ground truth ends in."""

PART, STRETCH, SIZES = "part", "stretch", "sizes"
"""Kinds of portions; the last one tells how the map hangs on the voxel size."""

SUMS = ("points", "voxels", "new_voxels", "drift_sum", "seconds")
SECONDS = ("association_seconds", "update_seconds")
"""Not known of a frame that no part fused."""

MEANS = ("map_vss", "map_entropy", "map_recurrent")


@dataclass(frozen=True)
class Portion:
    """What of a unit in tiles is computed in one go: the voxels of a part, or else what frames tell without its map.

    key      of the unit
    part     whose voxels are fused
    stretch  else the frames that are looked at; None where some of them are fused at several voxel sizes
    kept     whether the voxels are kept
    judged   whether the statistics say something of the map
    reduces  whether soft scores are also fused as labels
    """

    key: str
    part: Part | None = None
    stretch: Stretch | None = None
    kept: bool = False
    judged: bool = False
    reduces: bool = False

    @property
    def name(self) -> str:
        """Of the file of what is left of it."""
        return next((each.name for each in (self.part, self.stretch) if each is not None), SIZES)

    @property
    def kind(self) -> str:
        """PART, STRETCH or SIZES."""
        return PART if self.part is not None else STRETCH if self.stretch is not None else SIZES

    @property
    def looks_file(self) -> str:
        """Of what was sampled of a stretch, in the folder, until the unit is whole."""
        return f"{PORTIONS}/{self.key}/{self.name}.parquet"

    @property
    def true_looks_file(self) -> str:
        """The same of its ground truth."""
        return f"{PORTIONS}/{self.key}/{self.name}{TRUE_LOOKS}"

    @property
    def folder(self) -> str:
        """Of what is left of the unit until it is whole, in that of the run."""
        return f"{PORTIONS}/{self.key}"


@dataclass(frozen=True)
class About:
    """What is no array of a finished portion.

    kind     see `Portion.kind`
    files    digests of its files, by their path in the folder
    voxels   of the part, as they came
    checked  how far it agrees with the reference on a sample of its voxels
    sizes, quality  of the frames
    """

    kind: str
    files: Mapping[str, str] = field(default_factory=dict)
    voxels: int = 0
    checked: Agreement | None = None
    sizes: tuple[SizeAlpha, ...] = ()
    quality: FrameQuality | None = None


@dataclass(frozen=True, eq=False)
class Finished:
    """What is left of a portion.

    series   (F, C) a row a frame, its NUMBERS
    sums     over the voxels, by name: those of `TableSums`, or of `FirstSums` where its map is judged
    reduced  sums of the map of labels that soft scores were reduced to; empty where there are none
    poses    (F, 3, 3) down, forward and centre of the cameras, where it is of frames and up is to be estimated
    image    (F, C) what each of them tells in image coordinates, see `ImageSpaceMeter`
    """

    about: About
    series: Float64
    sums: Mapping[str, Any] = field(default_factory=dict)
    reduced: Float64 = field(default_factory=lambda: np.zeros(0))
    poses: Float64 = field(default_factory=lambda: np.zeros((0, 3, 3)))
    image: Float64 = field(default_factory=lambda: np.zeros((0, 0)))

    def save(self, path: Path) -> None:
        """Write it, atomically."""
        arrays: dict[str, Any] = {"series": self.series, "reduced": self.reduced, "poses": self.poses}
        arrays["image"] = self.image
        arrays |= {f"sums {name}": value for name, value in self.sums.items()}
        text = json.dumps(to_json(self.about)).encode()
        write_arrays(path, {"about": np.frombuffer(text, np.uint8), **arrays})

    def without_rows(self) -> Finished:
        """The same but for what it has of each frame: portions are many."""
        return replace(self, series=self.series[:0], poses=self.poses[:0], image=self.image[:0])

    @classmethod
    def load(cls, path: Path) -> Finished | None:
        """What `save` wrote; None where it is not there, or damaged. Raises DataError for that of another version."""
        arrays = read_arrays(path)
        if arrays is None or arrays["series"].shape[1:] != (len(NUMBERS),) or arrays["poses"].shape[1:] != (3, 3):
            return None
        about = from_json(About, parse_json(arrays["about"].tobytes()), path)
        sums = {name[5:]: array for name, array in arrays.items() if name.startswith("sums ")}
        return cls(about, arrays["series"], sums, arrays["reduced"], arrays["poses"], arrays["image"])


def joined_series(frames: Rows, parts: Rows, sizes: Sequence[int]) -> Series:
    """The time series of a unit from that of its frames without a map, and those of the parts of its map.

    frames  (F, C) rows of NUMBERS, of which those of the whole map become the unit's
    parts   the same of one part after the other, of so many rows each
    """
    where = {name: k for k, name in enumerate(NUMBERS)}
    frame, ends = frames.column(where["frame"]), np.cumsum([0, *sizes]).tolist()

    def of_parts(*names: str) -> Iterator[list[Float64]]:
        for first, last in itertools.pairwise(ends):
            yield [parts.column(where[name], first, last) for name in ("frame", *names)]

    for name in (*SUMS, *SECONDS):
        total = frames.column(where[name])
        for own, values in of_parts(name):
            at = np.searchsorted(frame, own)
            total[at] = (np.nan_to_num(total[at]) if name in SECONDS else total[at]) + values
        frames.put(where[name], total)
    voxels = np.zeros(len(frame))
    for own, so_far in of_parts("map_voxels"):
        voxels += _latest(frame, own, so_far)
    frames.put(where["map_voxels"], voxels)
    n = np.where(voxels > 0, voxels, math.nan)
    for name in MEANS:
        total = np.zeros(len(frame))
        for own, so_far, values in of_parts("map_voxels", name):
            total += _latest(frame, own, np.where(so_far > 0, so_far * values, 0.0))
        frames.put(where[name], total / n)
    return Series(frames)


def _latest(frame: Float64, own: Float64, values: Float64) -> Float64:
    """(F,) the value of the last of its own frames at each frame, 0 before them."""
    found: Float64 = np.concatenate([np.zeros(1), values])[np.searchsorted(own, frame, side="right")]
    return found
