"""Records of a run or a study, one a unit, and the voxel tables behind the units at its base settings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semstab.config import BACKENDS, BASE, nearest
from semstab.core.json_form import INLINE
from semstab.core.palette import KIND_COLORS, KINDS
from semstab.data import voxels
from semstab.data.display import as_figure
from semstab.data.frames import LeftOut
from semstab.data.georeference import Georeference
from semstab.data.image_measures import NO_IMAGES, FrameQuality, ImageSpace, PixelStatistics, VideoMeasures
from semstab.data.measures import measures
from semstab.data.results import Agreement, ReducedScores, TableSummary, UnitName, VoxelAdvice
from semstab.data.statistics import UNKNOWN, MapStatistics, OutlyingFrames
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

UNITS, VOXELS, TRUTH, EVENTS, FRAMES, OVERVIEW = "units", "voxels", "truth", "events", "frames", "overview"
OBSERVATIONS, SUMS = "observations", "sums"
"""Folders of the files of units: their numbers; the voxel tables SCENE__MODEL__BACKEND.parquet; voxel tables of the
ground truth of the same frames; logs of observations; time series; and the frames that figures show. The frames are in
SCENE__MODEL.npz with the arrays frame (its index), labels (H, W) rows 0..K-1 or the ignore id, palette (K, 3) and, if
the dataset has colour, color (H, W, 3). The last folders have sampled observations, and sums by frame and cube of
space, `ClusterSums`."""

REGIONS = "region_maps"
"""The name, not of a sweep, for the label sources that hold regions without classes."""

MAPS, LISTED = 6, 12
"""The most maps that a notebook shows of a result, and the most units that its text lists."""


@dataclass(frozen=True, order=True)
class Variation:
    """One point of one sweep, in one repeat: the difference from the base settings.

    Attributes:
        sweep: 'base', 'shared_taxonomy', 'backends', or the swept setting: 'voxel_size' (metres), 'pixel_stride',
            'frame_count', 'depth_noise' (relative standard deviation), 'translation_noise' (metres), 'rotation_noise'
            (degrees), 'translation_drift' (metres a square root of frame), 'rotation_drift' (degrees a square root of
            frame).
        value: Value of the swept setting; None for 'base', 'shared_taxonomy' and 'backends'.
        repeat: Counts the repeats of a random variation from 0; each has a seed of its own.
    """

    sweep: str = BASE
    value: float | None = None
    repeat: int = 0


@dataclass(frozen=True)
class Record:
    """Record of one finished unit: its numbers, and the names of its files.

    Attributes:
        unit: Its scene, model and backend.
        frames: Number of fused frames.
        map_summary: Means, strata and classes of its voxels.
        flicker_percent: Flicker in the images, mean over the frames.
        key: Hash of its inputs and settings, under which it is stored; '' in a small summary.
        variation: The settings in which it differs from the base units.
        stages_ms: Mean milliseconds a frame by stage, see `STAGES`.
        left_out: Pixels that were left out of fusion because what they show moves.
        frames_left_out: Selected frames without a file or a pose.
        frames_empty: Fused frames without a valid pixel.
        scores_left_out: The scores that `top_k` left out, if it is set.
        statistics: What `semstab.statistics.describe` reports of the map, if requested.
        reduced: The numbers of soft scores that are reduced to labels, for soft scores.
        image_space: Image-space measures of the 'base' units; all NaN elsewhere.
        quality: Quality of the labels of single frames, if `frame_quality` is set.
        video_measures: VC and TC as published, if `video_measures` is set.
        voxels_file: File of its voxel table, or the folder of its tiles, for the 'base' and 'backends' units; None
            elsewhere.
        truth_file: File of the ground truth's voxels of the same frames, if the statistics fused it.
        series: File of its time series, in the folder of the run.
        pixels: Statistics of the labelled pixels of a video; None for a unit with a map.
        input: Digest of its input. This and what follows stand in the unit's own file alone: a result that is loaded
            from its folder has them for all units together.
        up: The scene's up axis, if known or estimated.
        files: Digests of the unit's other files, by their path in the folder.
        checked: Agreement with the reference on a sample of its voxels, if checked.
        advice: Advice on its voxel size, if assessed.
        notes: Remarks of the check on its depth and labels, which look wrong but may be right.
    """

    unit: UnitName = field(metadata=INLINE)
    taxonomy: str
    frames: int
    map_summary: TableSummary = field(metadata=INLINE)
    flicker_percent: float
    fuse_ms_per_frame: float
    key: str = ""
    variation: Variation = Variation()
    stages_ms: Mapping[str, float] = field(default_factory=dict)
    left_out: int = 0
    frames_left_out: int = 0
    frames_empty: int = 0
    scores_left_out: LeftOut | None = None
    statistics: MapStatistics | None = None
    reduced: ReducedScores | None = None
    image_space: ImageSpace = NO_IMAGES
    quality: FrameQuality | None = None
    video_measures: VideoMeasures | None = None
    voxels_file: Path | None = None
    truth_file: Path | None = None
    series: Path | None = None
    pixels: PixelStatistics | None = None
    input: str = ""
    up: tuple[float, float, float] | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    checked: Agreement | None = None
    advice: VoxelAdvice | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        sweep, value = self.variation.sweep, self.variation.value
        varied = "" if sweep == BASE else f", {sweep}" if value is None else f", {sweep} {value:g}"
        return f"<Record {self.stated}; {self.unit.backend}{varied}>"

    @property
    def stated(self) -> str:
        """Its scene and model, the verdict and alpha: 'scene0, m: stable (p .98), alpha .93 (.92 to .95)'."""
        statistics_text = "" if self.statistics is None else f": {self.statistics.stated}"
        return f"{self.unit.scene}, {self.unit.model}{statistics_text}"

    def row(self) -> dict[str, str | int | float]:
        """Return a row: its names, the verdict and the number that it rests on, the size of its map, means of measures.

        Means are of all voxels, and of the recurrent ones. Pixels without a label count as disagreeing in the verdict.
        Without statistics the verdict is empty, and alpha is NaN.
        """
        table, unit = self.map_summary, self.unit
        alpha = UNKNOWN if self.statistics is None else self.statistics.headline.alpha
        verdict = None if self.statistics is None else self.statistics.verdict
        return {
            "scene": unit.scene, "model": unit.model, "backend": unit.backend,
            "verdict": "" if verdict is None else verdict.decisive,
            "probability": math.nan if verdict is None else verdict.decisive_probability,
            "alpha": alpha.value, "alpha_low": alpha.low, "alpha_high": alpha.high, "confidence": alpha.level,
            "agreeing": math.nan if self.statistics is None else self.statistics.agreeing,
            "taxonomy": self.taxonomy, "K": table.K, "voxel_size": table.voxel_size, "frames": self.frames,
            "points": table.points, "observations": table.observations, "voxels": table.voxels,
            "mean_op": table.mean_op,
            **{f"{key}_all": value for key, value in table.means.value.items()},
            "recurrent_share": table.recurrent.share,
            **{f"{key}_op3": value for key, value in table.recurrent.means.value.items()},
            "flicker_percent": self.flicker_percent, "fuse_ms_per_frame": self.fuse_ms_per_frame,
            "compensated_flicker_percent": self.image_space.compensated_flicker_percent,
        }  # fmt: skip

    @property
    def outlying_frames(self) -> OutlyingFrames | None:
        """The frames that stand out, in the map or, of a video, in the images."""
        if self.pixels is not None:
            return self.pixels.outlying_frames
        return None if self.statistics is None else self.statistics.outlying_frames

    def without_own(self) -> Record:
        """Return it without what stands in the unit's own file alone."""
        return replace(self, **OF_THE_UNIT)

    def without_files(self) -> Record:
        """Return its numbers alone, for a place to which its files do not go along."""
        return replace(self.without_own(), voxels_file=None, truth_file=None, series=None)

    def table(self) -> VoxelTable:
        """Return its voxels, read from their file."""
        if self.voxels_file is None:
            raise ValueError(f"{self.unit.slug}: the voxels of {self.variation} were not saved")
        return VoxelTable.load(self.voxels_file)

    @property
    def in_tiles(self) -> bool:
        """Return whether its voxels are a folder of tiles."""
        return self.voxels_file is not None and self.voxels_file.is_dir()

    def tiles(self) -> Iterator[VoxelTable]:
        """Return its voxels, tile by tile; of a map in one file all of them."""
        if self.voxels_file is None:
            raise ValueError(f"{self.unit.slug}: the voxels of {self.variation} were not saved")
        return VoxelTable.iter_tiles(self.voxels_file)

    @property
    def observations_file(self) -> Path | None:
        """File of its sampled observations, which is there where its map has statistics."""
        return self._companion(OBSERVATIONS)

    @property
    def events_file(self) -> Path | None:
        """File, or folder of tiles, of its log; the file exists if a log was requested and its backend keeps one."""
        return self._companion(EVENTS, "" if self.in_tiles else ".parquet")

    @property
    def sums_file(self) -> Path | None:
        """File of its sums by frame and cube of space, which is there where its map was assessed."""
        return self._companion(SUMS)

    def _companion(self, folder: str, suffix: str = ".parquet") -> Path | None:
        return None if self.voxels_file is None else self.voxels_file.parents[1] / folder / f"{self.unit.slug}{suffix}"


class Tables:
    """Voxel tables of records, the last few of them in memory: those that belong together are asked for together."""

    def __init__(self, most: int = 1) -> None:
        self._most = most
        self._loaded: dict[str, VoxelTable] = {}

    def table_of(self, record: Record) -> VoxelTable:
        """Return the record's table."""
        slug = record.unit.slug
        if slug not in self._loaded:
            while len(self._loaded) >= self._most:
                self._loaded.pop(next(iter(self._loaded)))
            self._loaded[slug] = record.table()
        return self._loaded[slug]


@dataclass(frozen=True)
class RegionFlicker:
    """Flicker of a label source that holds regions without classes, by matched regions; it is not fused.

    The percentages are means over pairs of sampled frames, see `semstab.metrics.matched_region_flicker`; compensated:
    after the previous map is warped by depth and pose. compensated_share is that of `ImageSpace`; input is the digest
    of what it was measured on.
    """

    scene: str
    model: str
    flicker_percent: float
    compensated_flicker_percent: float
    compensated_share: float
    input: str = ""


OF_THE_UNIT: Mapping[str, Any] = {"input": "", "up": None, "files": {}, "checked": None, "advice": None, "notes": ()}
"""Fields of a record that stand in the unit's own file alone, not in summary.json, and their values elsewhere."""


@dataclass(frozen=True)
class Failure:
    """A unit that could not be computed, and the one line that says why."""

    unit: UnitName = field(metadata=INLINE)
    variation: Variation
    message: str


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a finished run or study."""
    return (folder / "summary.json").is_file() and (folder / "units").is_dir()


@dataclass(frozen=True, repr=False)
class Result:
    """The result of a run or a study; tables, figures, report and terminal are made from it.

    Attributes:
        name: The name of the run or study.
        backend: The base backend: the backend of all units outside the 'backends' variation.
        records: Records in the order of the plan.
        failures: The units that failed, with the message of each.
        agreement: Agreement of each pair of backends that must agree, on each scene and model that both fused.
        up: (x, y, z) unit vector of the world's up axis by scene, if known or estimated.
        georeference: Georeference by scene, if known.
        manifest: The content of manifest.json: versions, inputs, times.
        regions: Flicker of the label sources that are regions without classes.
        compared: The same of each other backend and the base one, which need not agree.
        advice: Advice on the voxel size, scene by scene, for data of files.
        notes: Remarks of the check, scene by scene: labels that are not registered to the depth, and the like.
        benchmark: The benchmark that it is a run of, 'NAME@VERSION (hash of the definition)'; '' for none.

    Examples:
        >>> result = semstab.load_result("run")
        >>> result.record(model="sim-steady").unit.scene
        'scene0'
    """

    name: str
    backend: str
    records: tuple[Record, ...]
    failures: tuple[Failure, ...] = ()
    agreement: tuple[Agreement, ...] = ()
    up: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    georeference: Mapping[str, Georeference] = field(default_factory=dict)
    manifest: Mapping[str, Any] = field(default_factory=dict)
    regions: tuple[RegionFlicker, ...] = ()
    compared: tuple[Agreement, ...] = ()
    advice: Mapping[str, VoxelAdvice] = field(default_factory=dict)
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    benchmark: str = ""

    def __repr__(self) -> str:
        units = f"{len(self.records)} unit{'' if len(self.records) == 1 else 's'}"
        fused = f", fused by {self.backend}" if self.maps.records else ""
        lines = [f"<{type(self).__name__} '{self.name}': {units}{fused}>"]
        lines += [f"  {run.stated}" for run in self.runs[:LISTED]]
        return "\n".join([*lines, *(["  ..."] if len(self.runs) > LISTED else [])])

    @property
    def summary(self) -> Any:
        """The data frame of `to_pandas`, a row a unit; of one map that a program fused, its numbers."""
        return self.to_pandas()

    def select(
        self, sweep: str = BASE, *, scene: str | None = None, model: str | None = None, value: float | None = None
    ) -> tuple[Record, ...]:
        """Return the records of a sweep, of one scene, one model, one value where given."""
        return tuple(
            record
            for record in self.records
            if record.variation.sweep == sweep
            and scene in (None, record.unit.scene)
            and model in (None, record.unit.model)
            and value in (None, record.variation.value)
        )

    def record(self, *, scene: str | None = None, model: str | None = None, backend: str | None = None) -> Record:
        """Return the record at the base settings of that scene, model and backend, the base backend if not given.

        Raises:
            ConfigError: If there is none, or several, with what there is.
        """
        records = (*self.select(), *self.select(BACKENDS))
        asked = {"scene": scene, "model": model, "backend": backend or self.backend}
        for what, name in asked.items():
            there = list(dict.fromkeys(getattr(record.unit, what) for record in records))
            if name is not None and name not in there:
                raise ConfigError(f"{self.name}: no {what} '{name}'; {nearest(name, there)}")
        fitting = [
            record
            for record in records
            if all(name in (None, getattr(record.unit, what)) for what, name in asked.items())
        ]
        if len(fitting) == 1:
            return fitting[0]
        units = ", ".join(f"{record.unit.scene} of {record.unit.model}" for record in fitting[:4])
        raise ConfigError(
            f"{len(fitting)} units fit"
            + (f" ({units}); choose with --scene, --model (in Python: scene=, model=)" if fitting else "")
        )

    @property
    def maps(self) -> Result:
        """The result without the units that have no map: a video has none."""
        return replace(self, records=tuple(record for record in self.records if record.pixels is None))

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes of the base units, in order."""
        return _distinct([record.unit.scene for record in self.select()])

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models of the base units, in order."""
        return _distinct([record.unit.model for record in self.select()])

    def sweeps(self) -> dict[str, tuple[float, ...]]:
        """Return the swept values, ascending, of each sweep that has values."""
        values: dict[str, set[float]] = {}
        for record in self.records:
            if record.variation.value is not None:
                values.setdefault(record.variation.sweep, set()).add(record.variation.value)
        return {sweep: tuple(sorted(values)) for sweep, values in values.items()}

    @property
    def runs(self) -> tuple[Record, ...]:
        """The units at the base settings by every backend, a scene and model after the other."""
        units = (*self.select(), *self.select(BACKENDS))
        groups = dict.fromkeys((record.unit.scene, record.unit.model) for record in units)
        return tuple(r for group in groups for r in units if (r.unit.scene, r.unit.model) == group)

    def to_arrow(self) -> pa.Table:
        """Return one row a unit: names, verdict, alpha with its interval, the map's size and means, flicker."""
        return voxels.to_arrow(self._columns())

    def to_pandas(self) -> pd.DataFrame:
        """Return the same as a data frame.

        Raises:
            MissingDependencyError: Without pandas.
        """
        return voxels.to_pandas(self._columns())

    def _columns(self) -> dict[str, Any]:
        benchmark_column: dict[str, str | int | float] = {"benchmark": self.benchmark} if self.benchmark else {}
        rows = [run.row() | benchmark_column for run in self.runs]
        return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}

    def _repr_html_(self) -> str:
        """Return the verdicts with the numbers that they rest on, the means, and maps from above, in a notebook."""
        rows: list[list[voxels.Cell]] = []
        colors = dict[str, str]()
        for run in self.runs:
            table, unit = run.map_summary, run.unit
            means = (voxels.number(table.recurrent[measure], measure.digits[0]) for measure in measures())
            numbers = voxels.number(table.mean_op, 2), *means, voxels.number(100 * table.recurrent.share, 2)
            verdict = alpha = ""
            if run.statistics is not None:
                verdict, alpha = str(run.statistics.verdict), run.statistics.headline.alpha.text()
                colors[verdict] = KIND_COLORS[KINDS.get(run.statistics.verdict.decisive, "bad")]
            rows.append([unit.scene, unit.model, unit.backend, verdict, alpha, table.voxels, *numbers])
        titles = [measure.full_title for measure in measures()]
        headers = [
            "scene",
            "model",
            "backend",
            "verdict",
            f"alpha ({UNKNOWN.interval_name})",
            "voxels",
            "mean OP",
            *titles,
            "OP>=3 %",
        ]
        base = [record for record in self.select() if record.unit.backend == self.backend]
        there = [record for record in base if record.voxels_file is not None and record.voxels_file.is_file()][:MAPS]
        maps = [
            as_figure(record.table().image(self.up.get(record.unit.scene)), f"{record.unit.scene}, {record.unit.model}")
            for record in there
        ]
        legend = f"<div>{voxels.CAPTION}</div>" if maps else ""
        return voxels.as_html(self.name, headers, rows, colors) + "".join(maps) + legend

    @property
    def agrees(self) -> bool:
        """Return whether backends that must agree do so everywhere."""
        return all(row.agrees for row in self.agreement)


def _distinct(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
