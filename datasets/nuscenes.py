"""nuScenes lidarseg: the LiDAR's key frames with a class a point, poses and calibration in JSON tables.

Source: Caesar et al., nuScenes, CVPR 2020; Fong et al., Panoptic nuScenes, RA-L 2022; docs/schema_nuscenes.md and
eval/lidarseg of github.com/nutonomy/nuscenes-devkit.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field

from semstab.core.types import Float32, Float64, UInt16
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import SceneEntry
from semstab.datasets.files.options import inside
from semstab.datasets.files.reader import find_scenes
from semstab.datasets.files.scans import NO_ID, ScanDataset, ScanOptions, ScanSource, as_poses, floats_of, ids_of
from semstab.datasets.formats.disk import MAX_BYTES, natural, number, read_content, subfolders
from semstab.datasets.formats.images import Read
from semstab.datasets.geometry.cameras import from_quaternions
from semstab.datasets.scene import GROUND_TRUTH
from semstab.errors import ConfigError, DataError

CHALLENGE = {
    "movable_object.barrier": 1, "vehicle.bicycle": 2, "vehicle.bus.bendy": 3, "vehicle.bus.rigid": 3, "vehicle.car": 4,
    "vehicle.construction": 5, "vehicle.motorcycle": 6, "human.pedestrian.adult": 7, "human.pedestrian.child": 7,
    "human.pedestrian.construction_worker": 7, "human.pedestrian.police_officer": 7, "movable_object.trafficcone": 8,
    "vehicle.trailer": 9, "vehicle.truck": 10, "flat.driveable_surface": 11, "flat.other": 12, "flat.sidewalk": 13,
    "flat.terrain": 14, "static.manmade": 15, "static.vegetation": 16,
}  # fmt: skip
"""The challenge's class of a category; the class of all other categories is 0, which is ignored."""

OF_CHALLENGE = np.full(1 << 16, NO_ID, np.uint16)
OF_CHALLENGE[1:17] = np.arange(1, 17)
OF_CHALLENGE[[0, IGNORE_8BIT, IGNORE_16BIT]] = IGNORE_16BIT
"""The table of ids of predictions."""

MICROSECONDS = 1e6
VERSIONS = "v1.0-"
"""How the folders of tables are called: v1.0-mini, v1.0-trainval, v1.0-test."""


class NuScenesOptions(ScanOptions):
    """Options with the defaults of the format."""

    up_axis: opt.UpAxis = "z"
    version: str | None = Field(None, description="folder of the tables, v1.0-mini; the only one by default")
    channel: str = Field("LIDAR_TOP", description="the LiDAR, as in sensor.json")


class NuScenes(ScanDataset[NuScenesOptions]):
    """{name} is the token of the LiDAR's sample_data, as in the challenge.

    Ids of predictions are the challenge's ids, 1 to 16. Ids of the ground truth become the challenge's ids by the
    names in category.json.
    """

    Options: type[BaseModel] = NuScenesOptions
    contents = "samples/LIDAR_TOP/ and v1.0-*/ with scene.json"
    labels = ("predictions/{model}/{name}_lidarseg.bin", "predictions/{model}/{name}.bin")
    taxonomy = "nuscenes16"

    def __init__(self, options: NuScenesOptions) -> None:
        self._tokens: dict[str, tuple[Path, str]] = {}
        super().__init__(options)
        self._lists = cache(self._listed)

    def find_scenes(self, root: Path) -> list[SceneEntry]:
        """Return the scenes in the tables of the folders below the root.

        Raises:
            DataError: If there is none, or a table is damaged.
            ConfigError: If one folder has several versions and none is chosen.
        """
        entries = []
        for entry in find_scenes(root, self.is_scene, self.contents):
            tables = entry.folder / self._version(entry.folder)
            for row in _rows(tables / "scene.json"):
                scene, where = _text(row, "name", tables / "scene.json"), str(tables / "scene.json")
                inside(entry.folder, entry.folder, scene, where)
                name = scene if entry.folder == root else f"{entry.name}-{scene}"
                if name in self._tokens:
                    raise DataError(f"{where}: two scenes are called '{scene}'; rename one")
                self._tokens[name] = (tables, _text(row, "token", tables / "scene.json"))
                entries.append(SceneEntry(name, entry.folder, scene))
        return sorted(entries, key=lambda entry: natural(entry.name))

    def is_scene(self, folder: Path) -> bool:
        """Return whether there are tables."""
        return (folder / "samples").is_dir() and bool(self._versions(folder))

    def scans(self, entry: SceneEntry) -> list[ScanSource]:
        """Return the LiDAR's key frames of a scene, in the order of their time stamps.

        Raises:
            DataError: If a table is damaged, or lacks what another one names.
        """
        tables, scene = self._tokens[entry.name]
        self.truth = f"lidarseg/{tables.name}/{{name}}_lidarseg.bin"
        return self._lists(tables).get(scene, [])

    def points(self, path: Path, read: Read) -> Float32:
        """Return the points of x, y, z, intensity and ring."""
        return floats_of(path, read(path), 5)[:, :3]

    def ids(self, path: Path, read: Read) -> npt.NDArray[np.integer[Any]]:
        """Return the ids of bytes, or of another file of ids."""
        return np.frombuffer(read(path), np.uint8) if path.suffix == ".bin" else ids_of(path, read(path))

    def class_ids(self, model: str) -> UInt16 | None:
        """Return the table of the challenge's ids, from those of categories for the ground truth."""
        return self._of_categories if model == GROUND_TRUTH else OF_CHALLENGE

    @cached_property
    def _of_categories(self) -> UInt16:
        table = np.full(1 << 16, NO_ID, np.uint16)
        table[IGNORE_16BIT] = IGNORE_16BIT
        for tables in {tables for tables, _ in self._tokens.values()}:
            path = tables / "category.json"
            for row in _rows(path):
                index = int(number(row, "index", f"{path}: {_text(row, 'name', path)}"))
                if not 0 <= index <= IGNORE_8BIT:
                    raise DataError(f"{path}: {row['name']}: the index {index} does not fit in a byte")
                table[index] = CHALLENGE.get(row["name"], IGNORE_16BIT)
        return table

    def _versions(self, folder: Path) -> list[str]:
        names = [name for name in subfolders(folder) if name.startswith(VERSIONS)]
        chosen = [name for name in names if self.options.version in (None, name)]
        return [name for name in chosen if (folder / name / "scene.json").is_file()]

    def _version(self, folder: Path) -> str:
        names = self._versions(folder)
        if len(names) > 1:
            raise ConfigError(
                f"{folder}: holds the tables {' and '.join(names)}; choose one (--option version={names[0]})"
            )
        return names[0]

    def _listed(self, tables: Path) -> dict[str, list[ScanSource]]:
        """Return the key frames of every scene by its token, from one pass over the tables."""
        path = tables / "sample_data.json"
        scene_of = {_text(row, "token", path): _text(row, "scene_token", path) for row in _rows(tables / "sample.json")}
        mounted = self._calibrated(tables)
        keys = [row for row in _rows(path) if row.get("is_key_frame")]
        rows = [row for row in keys if _text(row, "calibrated_sensor_token", path) in mounted]
        rows.sort(key=lambda row: number(row, "timestamp", str(path)))
        ego_tokens = {_text(row, "ego_pose_token", path) for row in rows}
        moved = _poses(tables / "ego_pose.json", ego_tokens)
        lists = dict[str, list[ScanSource]]()
        for row in rows:
            token, sample, ego = (_text(row, key, path) for key in ("token", "sample_token", "ego_pose_token"))
            if sample not in scene_of or ego not in moved:
                lost = f"sample.json: sample {sample}" if sample not in scene_of else f"ego_pose.json: pose {ego}"
                raise DataError(f"{tables / lost} is missing, which {token} in {path.name} names; get the tables again")
            points = inside(tables.parent, tables.parent, _text(row, "filename", path), str(path))
            inside(tables.parent, tables.parent, token, str(path))
            pose = moved[ego] @ mounted[row["calibrated_sensor_token"]]
            stamp = number(row, "timestamp", str(path)) / MICROSECONDS
            scan = ScanSource(token, points, pose, tables / "ego_pose.json", stamp)
            lists.setdefault(scene_of[sample], []).append(scan)
        return lists

    def _calibrated(self, tables: Path) -> Mapping[str, Float64]:
        """Return the poses of the chosen LiDAR on the vehicle, by token."""
        path, sensors = tables / "calibrated_sensor.json", tables / "sensor.json"
        channels = {_text(row, "token", sensors): _text(row, "channel", sensors) for row in _rows(sensors)}
        sensor_tokens = {token for token, channel in channels.items() if channel == self.options.channel}
        tokens = {_text(row, "token", path) for row in _rows(path) if _text(row, "sensor_token", path) in sensor_tokens}
        if not tokens:
            names = ", ".join(sorted(set(channels.values())))[:200]
            raise ConfigError(f"{sensors}: there is no channel '{self.options.channel}', only {names}")
        return _poses(path, tokens)


def _rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table; raises DataError if it holds none."""
    rows = read_content(path, MAX_BYTES)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(f"{path}: expected a list of objects, as nuScenes' tables are")
    return rows


def _text(row: Mapping[str, Any], key: str, path: Path) -> str:
    value = row.get(key)
    if not isinstance(value, str) or not value:
        raise DataError(f"{path}: '{key}' of a row is {repr(value)[:40]}; expected a text")
    return value


def _poses(path: Path, tokens: set[str]) -> dict[str, Float64]:
    """Return poses (4, 4) of the wanted rows by token: a translation, and a quaternion w x y z."""
    rows = [row for row in _rows(path) if _text(row, "token", path) in tokens]
    moved = np.array([_vector(row, "translation", 3, path) for row in rows]).reshape(-1, 3)
    turned = np.array([_vector(row, "rotation", 4, path) for row in rows]).reshape(-1, 4)
    poses = from_quaternions(moved, turned[:, [1, 2, 3, 0]], path)
    return (
        dict(zip((row["token"] for row in rows), as_poses(poses, "camera_to_world", path), strict=True)) if rows else {}
    )


def _vector(row: Mapping[str, Any], key: str, length: int, path: Path) -> list[float]:
    values, where = row.get(key), f"{path}: '{key}' of {row['token'][:40]}"
    if not isinstance(values, list) or len(values) != length:
        raise DataError(f"{where} is {repr(values)[:60]}; expected {length} numbers")
    return [number({"value": value}, "value", where) for value in values]
