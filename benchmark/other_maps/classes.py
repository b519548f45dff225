"""Bring the classes of another program's map, by name, id or colour, to the classes of a run."""

from __future__ import annotations

import csv
import importlib.resources
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.config import read_yaml
from semstab.core.types import Int64, UInt8
from semstab.data.labels import LabelSpace, name_key
from semstab.errors import ConfigError, DataError
from semstab.other_maps.clouds import LAS_CLOUD, Cloud

NONE = -1
"""The class of a point whose class the run does not have."""

SAME_COLOUR = 12.0
"""The largest distance of two colours, of 255 steps in each channel, that count as the same."""

MOST_NAMED = 8

UNLABELLED = {name_key(name) for name in ("unclassified", "unlabelled", "unlabeled", "unknown", "void", "none", "")}
"""The names that say that a point has no class."""


@dataclass(frozen=True, eq=False)
class RunClasses:
    """The classes of a run: their names, their ids in label maps, their colours (K, 3), and the rows by other names."""

    classes: tuple[str, ...]
    ids: tuple[int, ...]
    colors: UInt8
    taxonomy: str
    row_of: Mapping[str, int]

    @classmethod
    def from_taxonomy(cls, classes: tuple[str, ...], colors: UInt8, taxonomy: str) -> RunClasses:
        """Return the classes of a run; a taxonomy that ships has ids and members of each class."""
        row_of = {name_key(name): row for row, name in enumerate(classes)}
        try:
            space = LabelSpace.load(taxonomy)
        except ConfigError:
            space = None
        if space is None or space.classes != classes:
            return cls(classes, tuple(range(len(classes))), colors, taxonomy, row_of)
        return cls(classes, space.ids, colors, taxonomy, space.row_of | row_of)


@dataclass(frozen=True, eq=False)
class PointLabels:
    """The class (n,) of each point as a row of the run's classes, NONE without one, and what to know about them."""

    row: Int64
    notes: tuple[str, ...]


def labels_of(cloud: Cloud, target: RunClasses, classes: str | None = None, colours: Path | None = None) -> PointLabels:
    """Return the class of each point.

    Args:
        cloud: Points with ids, names or colours.
        target: The classes of the run.
        classes: A YAML file ID: NAME, a taxonomy file, or the name of a taxonomy that ships, for ids.
        colours: A YAML file NAME: [r, g, b], a taxonomy file, or a CSV file with name, red, green, blue.

    Raises:
        ConfigError: For a file that does not name classes.
        DataError: If no point has a class of the run.
    """
    if cloud.label is None or colours is not None:
        labels = _by_colour(cloud, target, colours)
    elif cloud.label.dtype.kind == "U":
        labels = _by_name(cloud.label, target)
    else:
        labels = _by_id(cloud, cloud.label, target, classes)
    if not (labels.row != NONE).any():
        raise DataError(
            f"{cloud.path}: no point has a class of the run ({', '.join(target.classes[:MOST_NAMED])}) by its"
            f" {cloud.what}; {'; '.join(labels.notes) or 'name its classes with --classes or --colours'}"
        )
    return labels


def _by_name(names: npt.NDArray[Any], target: RunClasses) -> PointLabels:
    distinct, of = np.unique(names, return_inverse=True)
    rows = np.array([target.row_of.get(name_key(str(name)), NONE) for name in distinct], np.int64)
    row = np.maximum(rows, NONE)[of]
    return PointLabels(row, _unknown(distinct, of, row))


def _unknown(distinct: npt.NDArray[Any], of: Int64, row: Int64) -> tuple[str, ...]:
    """Say which names no class of the run takes, with the most points first."""
    counts = Counter(dict(enumerate(np.bincount(of[row == NONE], minlength=len(distinct)).tolist())))
    lost = [
        (str(distinct[k]), n) for k, n in counts.most_common() if n and name_key(str(distinct[k])) not in UNLABELLED
    ]
    if not lost:
        return ()
    listed = ", ".join(f"{name} ({n / len(row):.1%})" for name, n in lost[:MOST_NAMED])
    return (f"classes that the run does not have, their points have no class: {listed}",)


def _by_id(cloud: Cloud, ids: npt.NDArray[Any], target: RunClasses, classes: str | None) -> PointLabels:
    """Name ids by the file of classes, else by what the cloud states, else by ASPRS codes, else as the run's own."""
    notes: tuple[str, ...] = ()
    name_of_id: Mapping[int, str]
    if classes is not None:
        name_of_id = names_by_id(classes)
    elif cloud.stated.names:
        name_of_id = cloud.stated.names
    elif cloud.what == "classification" and cloud.path.suffix.lower() in LAS_CLOUD:
        name_of_id = _of_asprs(target)
        if not name_of_id:
            raise ConfigError(f"{cloud.path}: no ASPRS codes ship for {target.taxonomy}; name codes with --classes")
        notes = ("ASPRS codes by the table of the taxonomy (--classes names others)",)
    else:
        name_of_id = dict(zip(target.ids, target.classes, strict=True))
        first = ", ".join(f"{k} {name}" for k, name in [*name_of_id.items()][:3])
        notes = (f"its ids have no names, so they are the run's: {first} ... (--classes names others)",)
    distinct, of = np.unique(ids, return_inverse=True)
    texts = np.array([name_of_id.get(int(k), "" if k < 0 else f"id {k}") for k in distinct], dtype=np.str_)
    labels = _by_name(texts[of], target)
    return PointLabels(labels.row, (*notes, *labels.notes))


def names_by_id(classes: str) -> dict[int, str]:
    """Return the names in a YAML file ID: NAME, in a taxonomy file, or in a taxonomy that ships.

    Raises:
        ConfigError: For anything else.
    """
    if Path(classes).is_file():
        content = read_yaml(classes)
        if "classes" not in content:
            wrong = next((k for k, v in content.items() if not isinstance(k, int) or not isinstance(v, str)), None)
            if wrong is not None or not content:
                raise ConfigError(f"{classes}: a line of classes is 'ID: NAME', as '3: road'; got {wrong!r}")
            return content  # type: ignore[return-value]  # as just checked
    space = LabelSpace.load(classes)
    return dict(zip(space.ids, space.classes, strict=True))


def _of_asprs(target: RunClasses) -> dict[int, str]:
    """Return the class of each ASPRS code that one class of the taxonomy alone has."""
    shipped = read_yaml(str(importlib.resources.files("semstab.configs") / "asprs.yaml")).get(target.taxonomy, {})
    shared = Counter(shipped.values())
    return {code: name for name, code in shipped.items() if shared[code] == 1}


def _by_colour(cloud: Cloud, target: RunClasses, colours: Path | None) -> PointLabels:
    if cloud.colors is None:
        raise ConfigError(f"{cloud.path}: its points have no colour; leave out --colours")
    from scipy.spatial import cKDTree

    palette = dict(zip(target.classes, target.colors.tolist(), strict=True)) if colours is None else palette_of(colours)
    names, palette_rgb = [*palette], np.array([*palette.values()], dtype=np.float64)
    distinct, of = np.unique(cloud.colors @ (np.array([2**16, 2**8, 1])), return_inverse=True)
    rgb = np.stack([distinct >> 16, (distinct >> 8) & 255, distinct & 255], axis=1).astype(np.float64)
    apart, nearest_class = cKDTree(palette_rgb).query(rgb)
    near = apart <= SAME_COLOUR
    rows = np.array([target.row_of.get(name_key(name), NONE) for name in names], np.int64)
    row = np.where(near, np.maximum(rows, NONE)[nearest_class], NONE)[of]
    texts = np.array([*names, ""], dtype=np.str_)[np.where(near, nearest_class, len(names))]
    notes = _unknown(texts, of, row)
    if strange := float(np.mean(~near[of])):
        whose = "the run's palette" if colours is None else colours.name
        notes = (f"{strange:.1%} of the points have a colour of no class of {whose} (--colours names others)", *notes)
    return PointLabels(row, notes)


def palette_of(file: Path) -> dict[str, Sequence[int]]:
    """Return the colour of each class in a YAML file NAME: [r, g, b], a taxonomy file, or a CSV file.

    The CSV file has the columns name, red, green, blue, as Kimera-Semantics reads them.

    Raises:
        ConfigError: For any other file.
    """
    if not file.is_file():
        raise ConfigError(f"{file}: there is no such file")
    if file.suffix.lower() == ".csv":
        with file.open(newline="", encoding="utf-8-sig") as lines:
            rows = [{str(key).strip(): value for key, value in row.items()} for row in csv.DictReader(lines)]
        try:
            return {row["name"].strip(): [int(row[k]) for k in ("red", "green", "blue")] for row in rows}
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise ConfigError(f"{file}: a table of colours has the columns name, red, green, blue ({error})") from error
    content: dict[str, Any] = read_yaml(file)
    if "classes" in content:
        space = LabelSpace.from_dict(content, str(file))
        return dict(zip(space.classes, space.colors, strict=True))
    for name, value in content.items():
        right = isinstance(value, list) and len(value) == 3 and all(isinstance(v, int) and 0 <= v < 256 for v in value)
        if not right:
            raise ConfigError(f"{file}: {name}: {value!r} is no colour; write [red, green, blue], 0 to 255")
    if not content:
        raise ConfigError(f"{file}: names no colour; a line is 'road: [128, 64, 128]'")
    return {str(name): value for name, value in content.items()}
