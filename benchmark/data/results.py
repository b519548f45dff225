"""Reports of a run: of one fused frame, the summary of one unit, the agreement of two backends."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from semstab.core.json_form import INLINE, inline
from semstab.core.types import Float32, Int64, UInt16
from semstab.data.measures import RECURRENT, Measure, MeasureMeans

SCHEMA = 1
"""Version of summary.json."""

STAGES = ("decode", "network", "wait", "flicker", "association", "update", "logging")
"""The stages of a frame's time: decoding in a worker thread, parallel to the rest, with the part of it that a model
took to predict; waiting for it; flicker; the two
parts of fusion, where the backend measures them separately; notifying the observers."""

LONGEST_NAME = 60
"""Bytes of a name in a file's name: with three of them, and what surrounds them, it has fewer than 255."""


@dataclass(frozen=True)
class UnitName:
    """One cell of a run: a model's labels on a scene, fused by a backend."""

    scene: str
    model: str
    backend: str

    @property
    def slug(self) -> str:
        """SCENE__MODEL__BACKEND, usable as a file name."""
        return slug(self.scene, self.model, self.backend)

    @property
    def stated(self) -> str:
        """SCENE · MODEL · BACKEND, for people."""
        return f"{self.scene} · {self.model} · {self.backend}"


def slug(*names: str) -> str:
    """Join names to a file name: other names give another one.

    A name stays as it is if it consists of letters, digits, '.', '_' and '-', does not begin with '.' or '_', does not
    end with '_', holds no '__' and is at most LONGEST_NAME bytes long. Else other characters become '-', a name
    that is too long is cut, and a digest of the name follows.

    >>> slug("scene-1", "a b"), slug("scene-1", "a-b")
    ('scene-1__a-b~2847e54c57', 'scene-1__a-b')
    """
    return "__".join(map(_slug, names))


def _slug(name: str) -> str:
    readable = re.sub(r"[^\w.-]+|_{2,}|^[._]+|_$", "-", name)
    encoded = readable.encode()
    if readable == name and 0 < len(encoded) <= LONGEST_NAME:
        return name
    digest = hashlib.blake2b(name.encode(errors="surrogatepass"), digest_size=5).hexdigest()
    return f"{encoded[: LONGEST_NAME - 11].decode(errors='ignore')}~{digest}"


@dataclass(frozen=True)
class FrameReport:
    """The effect of fusing one frame.

    The map's means are the means after the frame, or NaN if a backend does not compute them.

    Parts of `seconds`, where a backend measures them: association_seconds go from pixels to voxels with their evidence,
    update_seconds into the map.

    Attributes:
        frame: The frame's index.
        points: Valid pixels ('sampled points').
        voxels: Voxels the frame touched ('observations').
        new_voxels: Voxels that were seen for the first time.
        drift_sum: Sum over the other voxels of D_JS(p^(t), p^(t-1)), bits.
        seconds: wall-clock time of integrate.
        map_voxels: Voxels in the map.
        map_vss_all: Mean VSS over them.
        map_entropy_all: Mean normalised entropy over them.
        map_recurrent: Share of them with OP >= 3.
    """

    frame: int
    points: int
    voxels: int
    new_voxels: int
    drift_sum: float
    seconds: float
    map_voxels: int
    map_vss_all: float = math.nan
    map_entropy_all: float = math.nan
    map_recurrent: float = math.nan
    association_seconds: float = math.nan
    update_seconds: float = math.nan

    @property
    def drift(self) -> float:
        """Mean drift of the frame's updates, bits a re-observed voxel; NaN without re-observed voxels."""
        updated = self.voxels - self.new_voxels
        return self.drift_sum / updated if updated else math.nan


@dataclass(frozen=True, eq=False)
class Changes:
    """The change that one frame made to each of the n voxels that it saw.

    Attributes:
        index: (n, 3) int64 index of the voxel.
        drift: (n,) float32 D_JS of its belief before and after the frame, bits; NaN for a new voxel.
        before, after: (n,) uint16 its dominant class before and after the frame; a new voxel has the latter twice.
    """

    index: Int64
    drift: Float32
    before: UInt16
    after: UInt16


@dataclass(frozen=True)
class Means:
    """Means over a group of voxels: a stratum, a class, the recurrent ones; `means[VSS]` is that of a measure.

    share is the group's part of all voxels, 0 to 1.
    """

    name: str
    share: float
    voxels: int
    means: MeasureMeans = field(metadata=INLINE)

    def __getitem__(self, measure: Measure) -> float:
        return self.means[measure]

    def defined(self, measure: Measure) -> int:
        """Return the voxels over which the measure's mean runs."""
        return self.means.voxels.get(measure.key, self.voxels)


@dataclass(frozen=True)
class Recurrent(Means):
    """Means over the voxels with OP >= 3: JSON has them as in `Record.row`, `vss_op3`."""

    means: MeasureMeans = field(metadata=inline(f"_op{RECURRENT}"))


@dataclass(frozen=True)
class TableSummary:
    """The summary of a voxel table: one row of the paper's scene table, its strata and its classes.

    `summary[VSS]` is the mean of a measure over all voxels with a defined value, `vss_all` in JSON. `well_seen` is the
    last stratum in finer steps of OP. `categories` has the share of the voxels in each stability category,
    `confused_with` for each dominant class the one that most of the other evidence in its voxels is for.
    """

    K: int
    voxel_size: float
    points: int
    observations: int
    voxels: int
    mean_op: float
    means: MeasureMeans = field(metadata=inline("_all"))
    strata: tuple[Means, ...]
    recurrent: Recurrent
    classes: tuple[Means, ...]
    well_seen: tuple[Means, ...] = ()
    categories: Mapping[str, float] = field(default_factory=dict)
    confused_with: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, measure: Measure) -> float:
        return self.means[measure]

    def without_classes(self) -> TableSummary:
        """Return the summary of the map of a model without labels: no measure of classes is defined."""

        def unknown(means: MeasureMeans) -> MeasureMeans:
            return MeasureMeans(dict.fromkeys(means.value, math.nan), dict.fromkeys(means.voxels, 0))

        strata, well_seen, classes = (
            tuple(replace(row, means=unknown(row.means)) for row in rows)
            for rows in (self.strata, self.well_seen, self.classes)
        )
        recurrent = replace(self.recurrent, means=unknown(self.recurrent.means))
        return replace(
            self, means=unknown(self.means), strata=strata, recurrent=recurrent, classes=classes, well_seen=well_seen,
            categories={}, confused_with={},
        )  # fmt: skip


@dataclass(frozen=True)
class ReducedScores:
    """The result of soft scores with each pixel reduced to its likeliest class, to be compared with hard labels.

    Attributes:
        vss_all, vss_op3: Over all voxels, and over those with OP >= 3.
        voxel_alpha_op2: Krippendorff's alpha of the voxels with OP >= 2.
    """

    vss_all: float
    vss_op3: float
    voxel_alpha_op2: float


@dataclass(frozen=True)
class VoxelAdvice:
    """The assessment of a voxel size, by the depth of a few frames reprojected into each other.

    Attributes:
        voxel_size: Metres.
        stays: Share of the points that fall into the same voxel when another frame sees them.
        suggested: The smallest size at which half of the points do, metres, or None if the data do not tell.
        chosen: Whether the suggestion was chosen, and no size was given.
    """

    voxel_size: float
    stays: float
    suggested: float | None
    chosen: bool


@dataclass(frozen=True)
class Deviation:
    """Largest and mean absolute difference of one quantity over the voxels that two tables share."""

    max: float
    mean: float


@dataclass(frozen=True)
class Mismatch:
    """The first voxel of a map whose number in a column is another one than expected.

    Attributes:
        voxel: Its index ix, iy, iz.
        column: A column of the voxel table, a class's evidence (`evidence_3`), or a measure.
        got: Its value in the map; OP is 0 where the map lacks the voxel.
        expected: Its value in the map that is right, or in the other one.
        voxels: Number of voxels that differ in this column.
    """

    voxel: tuple[int, int, int]
    column: str
    got: float
    expected: float
    voxels: int = 1

    def __str__(self) -> str:
        if self.column == "op" and not self.got:
            what = f"the voxel {self.voxel} is missing"
        elif self.column == "op" and not self.expected:
            what = f"the voxel {self.voxel} should not be there"
        else:
            what = f"{self.column} of the voxel {self.voxel} is {self.got!r}, expected {self.expected!r}"
        return what + (f" (and {self.voxels - 1:,} more)" if self.voxels > 1 else "")


@dataclass(frozen=True)
class Agreement:
    """The agreement of two backends' maps of the same frames; one entry of 'agreement' in summary.json.

    Attributes:
        differences: Differences of every column of the voxel table, of every measure, and of the label (1 for another
            label), by their keys; evidence is one key.
        one_in: Number of voxels of which one, drawn at random, was compared.
        first: The first number that differs too much, where the maps do not agree.
    """

    scene: str
    model: str
    backends: tuple[str, str]
    voxels: tuple[int, int]
    only_in: tuple[int, int]
    differences: Mapping[str, Deviation]
    agrees: bool
    one_in: int = 1
    first: Mismatch | None = None

    def difference(self, key: str) -> Deviation:
        """Return the differences of a quantity, NaN of a measure that was declared later."""
        return self.differences.get(key, Deviation(math.nan, math.nan))
