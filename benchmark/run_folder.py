"""The run folder: what a run leaves on disk, written unit by unit so that a killed run goes on where it was."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt
import yaml

from semstab.config import Config, read_yaml
from semstab.errors import ConfigError
from semstab.files import read_json, write_json, write_text
from semstab.json_form import from_json, to_json
from semstab.measures import dominant, measures
from semstab.results import STAGES, FrameReport, GroupResult, RunResult, Unit, slug
from semstab.voxels import Events, VoxelTable

Maps = Mapping[str, npt.NDArray[Any]]

FRAME_COLUMNS = (
    "frame", "timestamp", "points", "voxels", "new_voxels", "drift", "flicker_percent", "map_voxels", "map_vss",
    "map_entropy", "map_recurrent", "fuse_ms",
    "decode_ms", "wait_ms", "association_ms", "update_ms", "left_out",
)  # fmt: skip
"""The time series RUN/frames/*.csv: one row a frame; drift in bits; an undefined number is an empty field."""


@dataclasses.dataclass(frozen=True)
class FrameRow:
    """One row of a unit's time series: the backend's report, what the frame itself tells, and seconds by stage.

    left_out counts the pixels that were left out of fusion because what they show moves. logging_seconds is known once
    the observers have seen the row.
    """

    report: FrameReport
    timestamp: float | None
    flicker_percent: float
    decode_seconds: float = math.nan
    wait_seconds: float = math.nan
    flicker_seconds: float = math.nan
    logging_seconds: float = math.nan
    left_out: int = 0

    def stage_ms(self) -> dict[str, float]:
        """Milliseconds of each of `STAGES`; NaN where it is not known."""
        seconds = dataclasses.asdict(self.report) | dataclasses.asdict(self)
        return {stage: 1e3 * seconds[f"{stage}_seconds"] for stage in STAGES}

    def cells(self) -> dict[str, Any]:
        """The row by column name, an undefined number as None."""
        row = dataclasses.asdict(self.report) | {
            "timestamp": self.timestamp,
            "flicker_percent": self.flicker_percent,
            "left_out": self.left_out,
            "drift": self.report.drift,
            "fuse_ms": self.report.seconds * 1e3,
            **{f"{stage}_ms": value for stage, value in self.stage_ms().items()},
        }
        return {name: None if row[name] is None or row[name] != row[name] else row[name] for name in FRAME_COLUMNS}


class RunFolder:
    """RUN/: opened for one configuration, which it keeps as config.yaml.

    Raises ConfigError where the folder holds a run of another configuration, or files that are not a run's.
    """

    def __init__(self, path: str | Path, config: Config) -> None:
        self.path = Path(path)
        self._claim(config)
        write_text(self.path / "config.yaml", config.to_yaml())

    def has(self, scene: str, backbone: str) -> bool:
        """Whether an earlier start finished the group, on whatever input."""
        return self._group_path(scene, backbone).exists()

    def kept(self, scene: str, backbone: str, key: str) -> GroupResult | None:
        """The group's result from an earlier start of this run, if it was finished on the same input."""
        path = self._group_path(scene, backbone)
        if not path.exists():
            return None
        content = read_json(path)
        if not isinstance(content, dict) or content.get("key") != key:
            return None
        result = from_json(GroupResult, content, path)
        return result if all(self.voxels_path(run.unit).exists() for run in result.runs) else None

    def save_group(self, scene: str, backbone: str, key: str, result: GroupResult) -> None:
        """Mark the group as finished; from now on it is kept."""
        write_json(self._group_path(scene, backbone), {"key": key, **to_json(result)})

    def save_unit(
        self, unit: Unit, table: VoxelTable, events: Events | None, rows: list[FrameRow], maps: Maps | None = None
    ) -> None:
        """Write a unit's voxels, with further columns `maps`, its time series and, where given, its observations."""
        save_voxels(table, self.voxels_path(unit), maps)
        text = io.StringIO()
        writer = csv.DictWriter(text, FRAME_COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row.cells() for row in rows)
        write_text(self.path / "frames" / f"{unit.slug}.csv", text.getvalue())
        if events is not None:
            events.save(self.path / "events" / f"{unit.slug}.parquet")

    def save_summary(self, result: RunResult) -> None:
        """Write summary.json: what is finished so far."""
        write_json(self.path / "summary.json", result.to_dict())

    def save_manifest(self, content: Mapping[str, Any]) -> None:
        """Write manifest.json."""
        write_json(self.path / "manifest.json", content)

    def voxels_path(self, unit: Unit) -> Path:
        """Where a unit's voxel table is."""
        return self.path / "voxels" / f"{unit.slug}.parquet"

    def _group_path(self, scene: str, backbone: str) -> Path:
        return self.path / "units" / f"{slug(scene, backbone)}.json"

    def _claim(self, config: Config) -> None:
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise ConfigError(f"{self.path}: is a file; name a folder for the run")
        present = self.path / "config.yaml"
        if not present.exists():
            if any(self.path.iterdir()):
                raise ConfigError(f"{self.path}: is not empty and holds no run; choose another folder")
            return
        if changed := _first_change(read_yaml(present), yaml.safe_load(config.to_yaml())):
            raise ConfigError(f"{self.path}: holds a run with other settings ({changed}); choose another folder")


def save_voxels(table: VoxelTable, path: Path, maps: Maps | None = None) -> None:
    """Write a voxel table together with its measures, and further columns (n,) by name."""
    columns = {measure.key: measure.of(table) for measure in measures()}
    table.save(path, {**columns, "label": dominant(table), **(maps or {})})


def group_key(config: Config, scene: str, backbone: str, digest: str) -> str:
    """What a group's numbers depend on: the settings and the content of its input."""
    settings = config.model_dump(mode="json", exclude={"scenes", "backbones"})
    text = json.dumps([settings, scene, backbone, digest], sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _first_change(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> str | None:
    for key in [*new, *(key for key in old if key not in new)]:
        a, b = old.get(key), new.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            if change := _first_change(a, b, f"{prefix}{key}."):
                return change
        elif a != b:
            return f"{prefix}{key}: {a} there, {b} here"
    return None
