"""What a study found: one record a unit, and the voxel tables behind the units at its base settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from semstab.comparison_model import BackboneComparison
from semstab.json_form import INLINE, from_json, to_json
from semstab.results import Agreement, GroupResult, RunResult, Unit, UnitSummary
from semstab.statistics_model import MapStatistics
from semstab.voxels import VoxelTable

SCHEMA = 1
"""Version of the study's summary.json."""

VOXELS = "voxels"
"""Folder of the voxel tables, in the study's: SCENE__BACKBONE__BACKEND.parquet."""

OVERVIEW = "overview"
"""Folder of the frames that figures show, in the study's: SCENE__BACKBONE.npz with the arrays frame (its index), labels
(H, W) rows 0..K-1 or the ignore id, palette (K, 3) and, where the dataset has it, color (H, W, 3)."""

BASE = "base"
"""The sweep of the units at the study's own settings."""

SHARED = "shared_taxonomy"
"""The sweep of the units fused in the taxonomy that the backbones are compared in; value is None."""

REGIONS = "region_maps"
"""Not a sweep: the label sources that hold regions without classes."""

BACKENDS = "backends"
"""The sweep of the units fused by the other backends; value is None, `unit.backend` says which."""


@dataclass(frozen=True, order=True)
class Variation:
    """One point of one sweep, in one repeat: what differs from the study's base settings.

    sweep   'base', 'shared_taxonomy', 'backends', or what is swept: 'voxel_size' (metres), 'pixel_stride',
            'frame_count', 'depth_noise' (relative standard deviation), 'translation_noise' (metres), 'rotation_noise'
            (degrees), 'translation_drift' (metres a square root of frame), 'rotation_drift' (degrees likewise)
    value   of it; None for 'base', 'shared_taxonomy' and 'backends'
    repeat  counts the repeats of a random variation from 0; each has a seed of its own
    """

    sweep: str = BASE
    value: float | None = None
    repeat: int = 0


@dataclass(frozen=True)
class ImageSpace:
    """Stability in image coordinates, over the sampled frames of a unit; NaN where it is not defined.

    flicker_percent              pixels valid in both of two consecutive frames whose label differs
    compensated_flicker_percent  the same after the previous map is warped by depth and pose, occluded pixels left out
    compensated_share            co-visible share: pixels that the warped map reaches, of the valid ones, 0 to 1
    vc8, vc16                    video consistency over clips of 8 and 16 frames, 0 to 1: of the pixels whose ground
                                 truth stays the same, those whose prediction does; NaN without ground truth
    self_vc8, self_vc16          the same of all pixels that are valid in each frame of a clip, without ground truth
    """

    flicker_percent: float = math.nan
    compensated_flicker_percent: float = math.nan
    compensated_share: float = math.nan
    vc8: float = math.nan
    vc16: float = math.nan
    self_vc8: float = math.nan
    self_vc16: float = math.nan


@dataclass(frozen=True)
class Record:
    """One finished unit of a study.

    key         hash of its inputs and settings, under which it is kept
    summary     what `semstab.run` reports of it: unit (scene, backbone, backend), means, strata, classes, times, and
                what `semstab.statistics` says of the map
    image_space of the 'base' units; all NaN elsewhere
    voxels      file of its voxel table, for the 'base' and 'backends' units; None elsewhere
    """

    key: str
    variation: Variation
    summary: UnitSummary
    image_space: ImageSpace = ImageSpace()
    voxels: Path | None = None

    @property
    def statistics(self) -> MapStatistics | None:
        """What `semstab.statistics` says of the map."""
        return self.summary.statistics

    @property
    def unit(self) -> Unit:
        """Its scene, backbone and backend."""
        return self.summary.unit

    def table(self) -> VoxelTable:
        """Its voxels, read from their file."""
        if self.voxels is None:
            raise ValueError(f"{self.unit.slug}: the voxels of {self.variation} were not kept")
        return VoxelTable.load(self.voxels)


@dataclass(frozen=True)
class RegionFlicker:
    """Flicker of a label source that holds regions without classes, by matched regions; it is not fused.

    The percentages are means over pairs of sampled frames, see `semstab.metrics.matched_region_flicker`; compensated:
    after the previous map is warped by depth and pose. compensated_share is that of `ImageSpace`.
    """

    scene: str
    backbone: str
    flicker_percent: float
    compensated_flicker_percent: float
    compensated_share: float


@dataclass(frozen=True)
class Failure:
    """A unit that could not be computed, and the one line that says why."""

    unit: Unit = field(metadata=INLINE)
    variation: Variation
    message: str


@dataclass(frozen=True)
class StudyResult:
    """Everything that tables, figures and the report are made from; records are in the order of the study's grid.

    backend    the base backend: that of every unit but those of the 'backends' sweep
    agreement  of each checked backend with the base one, on each scene and backbone
    up         (x, y, z) unit vector of the world's up axis by scene, where it is known or could be estimated
    regions    flicker of the label sources that are regions without classes
    comparisons  with `statistics`: the backbones of each scene beside each other, as `compare_backbones` says it
    """

    name: str
    backend: str
    records: tuple[Record, ...]
    failures: tuple[Failure, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    up: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    manifest: Mapping[str, Any] = field(default_factory=dict)
    regions: tuple[RegionFlicker, ...] = ()
    comparisons: tuple[BackboneComparison, ...] = ()

    def select(
        self, sweep: str = BASE, *, scene: str | None = None, backbone: str | None = None, value: float | None = None
    ) -> tuple[Record, ...]:
        """The records of a sweep, of one scene, one backbone, one value where given."""
        return tuple(
            record
            for record in self.records
            if record.variation.sweep == sweep
            and scene in (None, record.unit.scene)
            and backbone in (None, record.unit.backbone)
            and value in (None, record.variation.value)
        )

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes of the base units, in order."""
        return _distinct([record.unit.scene for record in self.select()])

    @property
    def backbones(self) -> tuple[str, ...]:
        """Names of the backbones of the base units, in order."""
        return _distinct([record.unit.backbone for record in self.select()])

    def sweeps(self) -> dict[str, tuple[float, ...]]:
        """The swept values, ascending, of each sweep that has values."""
        found: dict[str, set[float]] = {}
        for record in self.records:
            if record.variation.value is not None:
                found.setdefault(record.variation.sweep, set()).add(record.variation.value)
        return {sweep: tuple(sorted(values)) for sweep, values in found.items()}

    def base_runs(self) -> RunResult:
        """The base units, with those of the other backends beside them, as one run."""
        units = (*self.select(), *self.select(BACKENDS))
        return RunResult(
            tuple(
                GroupResult(
                    tuple(r.summary for r in units if (r.unit.scene, r.unit.backbone) == group),
                    tuple(row for row in self.agreement if (row.scene, row.backbone) == group),
                )
                for group in dict.fromkeys((r.unit.scene, r.unit.backbone) for r in self.select())
            )
        )

    def to_dict(self) -> dict[str, Any]:
        """The content of the study's summary.json; `load_study_result` reads it back."""
        content: dict[str, Any] = to_json(
            {
                "schema": SCHEMA,
                "name": self.name,
                "backend": self.backend,
                "up": self.up,
                "runs": [_record_content(record) for record in self.records],
                "failures": self.failures,
                "agreement": self.agreement,
                "regions": self.regions,
                "comparisons": self.comparisons,
            }
        )
        return content

    @classmethod
    def from_dict(cls, content: Mapping[str, Any], folder: Path, manifest: Mapping[str, Any]) -> StudyResult:
        """Read what `to_dict` wrote; voxel files lie in `folder`."""
        where = folder / "summary.json"
        return cls(
            name=content["name"],
            backend=content["backend"],
            records=tuple(_record(row, folder, where) for row in content["runs"]),
            failures=from_json(tuple[Failure, ...], content["failures"], where),
            agreement=from_json(tuple[Agreement, ...], content["agreement"], where),
            up={scene: (axis[0], axis[1], axis[2]) for scene, axis in content["up"].items()},
            manifest=manifest,
            regions=from_json(tuple[RegionFlicker, ...], content["regions"], where),
            comparisons=from_json(tuple[BackboneComparison, ...], content["comparisons"], where),
        )


def _record_content(record: Record) -> dict[str, Any]:
    return {
        **to_json(record.summary),
        "key": record.key,
        "variation": record.variation,
        "image_space": record.image_space,
        "voxels_file": None if record.voxels is None else f"{VOXELS}/{record.voxels.name}",
    }


def _record(row: Mapping[str, Any], folder: Path, where: Path) -> Record:
    return Record(
        key=row["key"],
        variation=from_json(Variation, row["variation"], where),
        summary=from_json(UnitSummary, row, where),
        image_space=from_json(ImageSpace, row["image_space"], where),
        voxels=None if row["voxels_file"] is None else folder / row["voxels_file"],
    )


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
