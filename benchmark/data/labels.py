"""Label spaces (taxonomies) and the mapping between two of them, by class name."""

from __future__ import annotations

import difflib
import functools
import importlib.resources
import re
import reprlib
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from semstab.core.files import MAX_YAML_BYTES, parse_yaml, read_limited, write_text
from semstab.core.types import Float64, Int32, Mask, UInt8, UInt16
from semstab.errors import ConfigError, DataError

# Colours of classes: as many as there are, each unlike the others, for any colour vision.

Color = tuple[int, int, int]

# Paul Tol's 'bright' and 'muted' schemes: distinguishable with any colour vision.
PALETTE: tuple[Color, ...] = (
    (68, 119, 170), (238, 102, 119), (34, 136, 51), (204, 187, 68), (102, 204, 238), (170, 51, 119), (187, 187, 187),
    (51, 34, 136), (136, 204, 238), (68, 170, 153), (17, 119, 51), (153, 153, 51), (221, 204, 119), (204, 102, 119),
    (136, 34, 85), (170, 68, 153),
)  # fmt: skip

GLOW: tuple[Color, ...] = ((150, 0, 40), (230, 30, 0), (255, 140, 0), (255, 230, 60), (255, 255, 230))
"""The colours of drift in the recording, from little to much: no class is given a colour of this fire."""

CLEAR = 45.0
"""Distance in RGB that classes keep from it; Tol's colours do."""

LEVELS = tuple(range(0, 256, 17))
"""The levels of each channel of the colours that are chosen from."""

LIGHTNESS = (0.3, 0.92)
"""The lightness of these colours, in OKLab: neither ink nor paper."""

TO_LMS = np.array(
    [[0.41222147, 0.53633254, 0.05144599], [0.2119035, 0.6806995, 0.107397], [0.0883025, 0.2817188, 0.6299787]]
)
TO_LAB = np.array(
    [[0.21045426, 0.79361779, -0.00407205], [1.9779985, -2.4285922, 0.4505937], [0.0259040, 0.7827718, -0.8086758]]
)
"""The matrices from linear RGB to OKLab (Ottosson 2020, A perceptual color space for image processing)."""

DEUTAN = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
"""The look of linear RGB without green cones (Vienot, Brettel, Mollon 1999, Color Research and Application)."""


@functools.cache
def palette(K: int) -> tuple[Color, ...]:
    """Return K colours: Tol's, and of those that are left the one farthest from all before, each by itself.

    >>> len(set(palette(150)))
    150
    """
    chosen = [*PALETTE[:K]]
    grid = np.stack(np.meshgrid(LEVELS, LEVELS, LEVELS, indexing="ij"), axis=-1).reshape(-1, 3)
    candidates, appearance = grid, _appearance_of(grid)
    fit = (appearance[:, 0] >= LIGHTNESS[0]) & (appearance[:, 0] <= LIGHTNESS[1])
    fit &= np.linalg.norm(grid[:, None] - between(GLOW, 4 * len(GLOW)), axis=2).min(axis=1) >= CLEAR
    candidates, appearance = candidates[fit], appearance[fit]
    if len(chosen) < K:
        appearances = _appearance_of(np.array(chosen))
        nearest = np.min([_distance(appearance, one) for one in appearances], axis=0)
    while len(chosen) < K:
        best = int(nearest.argmax())
        chosen.append((int(candidates[best, 0]), int(candidates[best, 1]), int(candidates[best, 2])))
        nearest = np.minimum(nearest, _distance(appearance, appearance[best]))
    return tuple(chosen)


def between(colors: Sequence[Color], n: int) -> Float64:
    """Return (n, 3) colours from the first to the last, evenly along the line through all of them."""
    at = np.linspace(0, len(colors) - 1, n)
    return np.stack([np.interp(at, np.arange(len(colors)), channel) for channel in np.transpose(colors)], axis=1)


def _appearance_of(colors: npt.NDArray[np.integer]) -> Float64:
    """Return (n, 6) OKLab of colours (n, 3), as they are and without green cones."""
    share = colors / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.concatenate([_oklab(linear), _oklab(np.clip(linear @ DEUTAN.T, 0, 1))], axis=1)


def _oklab(linear: Float64) -> Float64:
    lab: Float64 = np.cbrt(linear @ TO_LMS.T) @ TO_LAB.T
    return lab


def _distance(appearance: Float64, one: Float64) -> Float64:
    """Return (n,) how far colours look from one: to all eyes, and half as much to those without green cones."""
    difference = appearance - one
    separation = np.linalg.norm(difference[:, :3], axis=1) + 0.5 * np.linalg.norm(difference[:, 3:], axis=1)
    distance: Float64 = separation
    return distance


IGNORE_8BIT = 255
IGNORE_16BIT = 65535
LEFT_OUT = -1
"""The row of a name that a label space ignores."""
UNKNOWN = -1
"""The mark in a mapping's table for an id that the source label space does not have."""


def is_line(name: str) -> bool:
    """Return whether a name is text of one line that every file format can hold: without control characters."""
    return not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in "\ufffe\uffff" for c in name)


@dataclass(frozen=True)
class LabelSpace:
    """The classes of a label map: ids, names and colours, without the ignore id.

    Attributes:
        name: Name of the taxonomy.
        classes: K >= 2 distinct names; evidence vectors follow their order.
        ids: The id of each class in label maps; 0..K-1 unless given.
        colors: RGB of each class.
        members: Names, for each class, of other taxonomies that fall into it.
        ignored: Names of other taxonomies that are left out.
        groups: The group of each class, 'vehicle/two wheels', from which distances between classes follow; '' for none.

    Raises:
        ConfigError: If these contradict each other.

    Examples:
        >>> space = semstab.LabelSpace("field", classes=("road", "tree"))
        >>> space.ids
        (0, 1)
    """

    name: str
    classes: tuple[str, ...]
    ids: tuple[int, ...] = ()
    colors: tuple[Color, ...] = ()
    members: tuple[tuple[str, ...], ...] = ()
    ignored: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        K = len(self.classes)
        for name in (self.name, *self.classes, *(m for ms in self.members for m in ms), *self.ignored):
            if not is_line(name):
                raise ConfigError(f"taxonomy {self.name}: the name {name!r} holds a control character; rename it")
        if K < 2:
            raise ConfigError(f"taxonomy {self.name}: {K} class; stability needs at least 2 (entropy divides by log K)")
        object.__setattr__(self, "ids", self.ids or tuple(range(K)))
        object.__setattr__(self, "colors", self.colors or palette(K))
        object.__setattr__(self, "members", self.members or ((),) * K)
        object.__setattr__(self, "groups", self.groups or ("",) * K)
        for what in ("ids", "colors", "members", "groups"):
            if len(getattr(self, what)) != K:
                raise ConfigError(f"taxonomy {self.name}: {len(getattr(self, what))} {what} for {K} classes")
        if len(set(self.ids)) != K or min(self.ids) < 0 or max(self.ids) >= IGNORE_16BIT:
            raise ConfigError(
                f"taxonomy {self.name}: ids must be distinct, 0 to {IGNORE_16BIT - 1}, got {list(self.ids)}"
            )
        if IGNORE_8BIT in self.ids and max(self.ids) == IGNORE_8BIT:
            raise ConfigError(f"taxonomy {self.name}: id 255 means 'ignore'; give the class another id")
        names = [name_key(name) for name in (*self.classes, *(m for ms in self.members for m in ms), *self.ignored)]
        if repeated := sorted(name for name, times in Counter(names).items() if times > 1):
            raise ConfigError(f"taxonomy {self.name}: '{repeated[0]}' is named twice")

    def __len__(self) -> int:
        return len(self.classes)

    @classmethod
    def load(cls, name_or_path: str | Path) -> LabelSpace:
        """Return a taxonomy that ships with semstab, by name (`uavid7`), or from a YAML file.

        Raises:
            ConfigError: If there is no such taxonomy or the file is not one.
        """
        text, where = _taxonomy_text(str(name_or_path))
        return cls.from_dict(parse_yaml(text, where), where)

    @classmethod
    def from_dict(cls, content: Any, where: str = "taxonomy") -> LabelSpace:
        """Read the content of a taxonomy file: name, classes (names, or name, id, color, members), ignored."""
        if not isinstance(content, dict) or not isinstance(content.get("classes"), list):
            raise ConfigError(f"{where}: a taxonomy needs a list 'classes'")
        allowed_keys = ("name", "classes", "ignored")
        if unknown := [key for key in content if key not in allowed_keys]:
            raise ConfigError(f"{where}: unknown key {reprlib.repr(unknown[0])}; known: {', '.join(allowed_keys)}")
        entries = [entry if isinstance(entry, dict) else {"name": entry} for entry in content["classes"]]
        for entry in entries:
            known_keys = {"name", "id", "color", "members", "group"}
            texts = (entry.get("name"), entry.get("group", ""))
            if not all(isinstance(text, str) for text in texts) or set(entry) - known_keys:
                got = reprlib.repr(entry)
                raise ConfigError(f"{where}: a class needs a name, and may have id, color, members, group; got {got}")
        return cls(
            name=str(content.get("name", Path(where).stem)),
            classes=tuple(entry["name"] for entry in entries),
            ids=_ids(entries, where),
            colors=tuple(
                _color(entry.get("color", palette(len(entries))[k]), where) for k, entry in enumerate(entries)
            ),
            members=tuple(_names(entry.get("members", []), where) for entry in entries),
            ignored=_names(content.get("ignored", []), where),
            groups=tuple(entry.get("group", "") for entry in entries),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a taxonomy file; `from_dict` reads it back."""
        rows = zip(self.classes, self.ids, self.colors, self.members, self.groups, strict=True)
        classes: list[dict[str, Any]] = [
            {"name": n, "id": i, "color": list(c), "members": list(m)} | ({"group": g} if g else {})
            for n, i, c, m, g in rows
        ]
        return {"name": self.name, "classes": classes, "ignored": list(self.ignored)}

    @property
    def row_of(self) -> dict[str, int]:
        """The row of each class by `name_key` of it and its members; LEFT_OUT for what the space ignores."""
        rows = {name_key(name): LEFT_OUT for name in self.ignored}
        for row, (name, members) in enumerate(zip(self.classes, self.members, strict=True)):
            rows |= {name_key(key): row for key in (name, *members)}
        return rows

    def text(self) -> str:
        """Return the text of a taxonomy file."""
        return str(yaml.safe_dump(self.to_dict(), sort_keys=False, allow_unicode=True))

    def save(self, path: str | Path) -> None:
        """Write a taxonomy file."""
        write_text(path, self.text())

    def mapping_to(self, target: LabelSpace) -> LabelMapping:
        """Map each class of this space to the class of `target` with its name, or among whose members it is.

        Raises:
            ConfigError: If classes are mapped nowhere and are not listed as ignored, naming them.
        """
        row_of = target.row_of
        if lost := [name for name in self.classes if name_key(name) not in row_of]:
            raise ConfigError(
                f"taxonomy {target.name}: no class takes '{', '.join(lost)}' of {self.name};"
                " add the name to a class's members, or to ignored"
            )
        rows = (row_of[name_key(name)] for name in self.classes)
        return LabelMapping(self, target, tuple(None if row == LEFT_OUT else row for row in rows))


@dataclass(frozen=True)
class LabelMapping:
    """A mapping from the ids of one label space to rows 0..K-1 of another; `rows` has None for an ignored class."""

    source: LabelSpace
    target: LabelSpace
    rows: tuple[int | None, ...]

    def __post_init__(self) -> None:
        if all(row is None for row in self.rows):
            raise ConfigError(
                f"taxonomy {self.target.name}: every class of {self.source.name} is ignored; nothing is left"
            )

    def positions_of(self, names: Iterable[str]) -> tuple[int, ...]:
        """Return positions of the source classes that have one of these names, or become a class that has."""
        keys = {name_key(name) for name in names}
        rows = {row for row, name in enumerate(self.target.classes) if name_key(name) in keys}
        pairs = zip(self.source.classes, self.rows, strict=True)
        return tuple(k for k, (name, row) in enumerate(pairs) if name_key(name) in keys or row in rows)

    def labels(self, labels: UInt8 | UInt16, where: str) -> UInt8 | UInt16:
        """Map a label map of any shape; the ignore id stays one.

        Raises:
            DataError: For an id that the source space does not have, with `where` (the file).
        """
        if self._keeps(labels):
            return labels
        table = self._table(labels.dtype.itemsize)
        unknown = (table == UNKNOWN) & _present(labels)
        if unknown.any():
            ids = np.flatnonzero(unknown)
            listed = ", ".join(str(i) for i in ids[:5]) + (", ..." if ids.size > 5 else "")
            raise DataError(
                f"{where}: label id {listed} ({np.count_nonzero(unknown[labels])} pixels) is outside the taxonomy"
                f" {self.source.name} ({len(self.source)} classes,"
                f" ids {min(self.source.ids)} to {max(self.source.ids)}); name the class in it, or leave the id out"
                " (option void_ids)"
            )
        return _look_up(table.astype(np.uint8 if len(self.target) <= IGNORE_8BIT else np.uint16), labels)

    def _keeps(self, labels: npt.NDArray[Any]) -> bool:
        """Return whether the map stays as it is: its 8-bit ids are the rows already, or the ignore id."""
        from semstab.data.kernels import has_other

        K = len(self.target)
        same = self.source.ids == self.rows == tuple(range(K)) and labels.dtype == np.uint8 and K < IGNORE_8BIT
        return same and not has_other(flat(labels), K, IGNORE_8BIT)

    def scores(self, scores: npt.NDArray[np.floating[Any]], where: str) -> npt.NDArray[np.floating[Any]]:
        """Map soft scores (H, W, K of the source): classes that fall together are summed, ignored ones dropped.

        If an ignored class has the largest score, all scores are 0, as a label map has the ignore id there.

        Raises:
            DataError: If the number of classes differs from the source space's.
        """
        if scores.shape[2] != len(self.source):
            raise DataError(
                f"{where}: scores hold {scores.shape[2]} classes, {self.source.name} has {len(self.source)}"
            )
        if self.rows == tuple(range(len(self.target))):
            return scores
        mapped = np.zeros((*scores.shape[:2], len(self.target)), dtype=np.result_type(scores.dtype, np.float32))
        for k, row in enumerate(self.rows):
            if row is not None:
                mapped[..., row] += scores[..., k]
        ignored = np.array([row is None for row in self.rows])
        if ignored.any():
            mapped[ignored[scores.argmax(axis=2)]] = 0
        return mapped

    def _table(self, itemsize: int) -> Int32:
        """Return the target row for each id a map can hold.

        The target's ignore id for ignored ones, UNKNOWN for the rest.
        """
        ignore = IGNORE_8BIT if len(self.target) <= IGNORE_8BIT else IGNORE_16BIT
        table = np.full(1 << (8 * itemsize), UNKNOWN, dtype=np.int32)
        for class_id, row in zip(self.source.ids, self.rows, strict=True):
            if class_id < len(table):
                table[class_id] = ignore if row is None else row
        table[-1] = ignore
        if itemsize == 2 and max(self.source.ids) < IGNORE_8BIT:
            table[IGNORE_8BIT] = ignore  # no class can have this id: an 8-bit map saved with 16 bits
        return table


def shipped_taxonomies() -> tuple[str, ...]:
    """Return the names of the taxonomies that ship with semstab."""
    folder = importlib.resources.files("semstab.configs") / "taxonomies"
    return tuple(sorted(item.name.removesuffix(".yaml") for item in folder.iterdir() if item.name.endswith(".yaml")))


def ignore_id(labels: npt.NDArray[Any]) -> int:
    """Return the id of a pixel without a label in a map of that type: 255, or 65535 in 16-bit maps."""
    return IGNORE_8BIT if labels.dtype == np.uint8 else IGNORE_16BIT


def fixed(array: Any) -> Any:
    """Return the array contiguous and read-only, so that numba compiles one version for all."""
    array = np.ascontiguousarray(array).view()
    array.flags.writeable = False
    return array


def flat(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the image's values (n,), fixed."""
    values: npt.NDArray[Any] = fixed(image).reshape(-1)
    return values


def _present(labels: npt.NDArray[Any]) -> Mask:
    """Return for each id that the type can hold whether the map has it."""
    if labels.dtype == np.uint8 and labels.ndim == 2 and labels.size:
        import cv2

        return cv2.calcHist([labels], [0], None, [256], [0, 256]).ravel() > 0  # eight times as fast as np.bincount
    present = np.zeros(1 << (8 * labels.dtype.itemsize), dtype=np.bool_)
    present[labels] = True
    return present


def _look_up(table: npt.NDArray[Any], labels: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return table[labels]."""
    if labels.dtype == np.uint8 and labels.ndim == 2 and labels.size:
        import cv2

        return np.asarray(cv2.LUT(labels, table))  # ten times as fast as indexing
    mapped: npt.NDArray[Any] = table[labels]
    return mapped


def _taxonomy_text(name: str) -> tuple[str, str]:
    if name in shipped_taxonomies():
        resource = importlib.resources.files("semstab.configs") / "taxonomies" / f"{name}.yaml"
        return resource.read_text(encoding="utf-8"), f"{name}.yaml"
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        near = difflib.get_close_matches(name, shipped_taxonomies(), n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(shipped_taxonomies())}, or a .yaml file"
        raise ConfigError(f"taxonomy '{name}' is not known; {hint}")
    try:
        return read_limited(path, MAX_YAML_BYTES).decode("utf-8"), str(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: the taxonomy cannot be read ({error})") from error


def sharing_classes(classes: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """Return the models that can be compared: those with the classes that most of them have, if two or more have."""
    ((most, count),) = Counter(classes.values()).most_common(1) or [((), 0)]
    return tuple(model for model, names in classes.items() if names == most) if count > 1 else ()


MOVING = frozenset({
    "aeroplane", "aircraft", "airplane", "animal", "bicycle", "bicyclist", "bike", "bird", "boat", "bus", "car",
    "caravan", "cat", "cow", "cyclist", "deer", "dog", "drone", "elephant", "helicopter", "horse", "human", "minibike",
    "motorbike", "motorcycle", "motorcyclist", "pedestrian", "people", "person", "rider", "scooter", "sheep", "ship",
    "tractor", "trailer", "train", "tram", "truck", "van", "vehicle",
})  # fmt: skip
"""Last words of the names of classes that move."""


def moving(classes: Sequence[str]) -> tuple[int, ...]:
    """Return the numbers of the classes that move, by their names; what is said to be static or parked does not."""
    return tuple(k for k, name in enumerate(classes) if _moves(name.lower()))


def _moves(name: str) -> bool:
    parts = [words for part in re.split("[,;/()]", name) if (words := re.findall("[a-z]+", part))]
    last = {words[-1] for words in parts}
    still = any(word in ("static", "parked") for words in parts for word in words)
    return not still and not MOVING.isdisjoint(last | {word.removesuffix("s") for word in last})


def name_key(name: str) -> str:
    """Return a name as names compare: without case, surrounding space, and the choice between space, '_' and '-'."""
    return " ".join(name.replace("_", " ").replace("-", " ").lower().split())


def _ids(entries: list[dict[str, Any]], where: str) -> tuple[int, ...]:
    ids = [entry.get("id", k) for k, entry in enumerate(entries)]
    if not all(isinstance(i, int) and not isinstance(i, bool) for i in ids):
        raise ConfigError(f"{where}: class ids must be whole numbers, got {reprlib.repr(ids)}")
    return tuple(ids)


def _color(value: Any, where: str) -> Color:
    if isinstance(value, list | tuple) and len(value) == 3 and all(isinstance(c, int) and 0 <= c <= 255 for c in value):
        return (value[0], value[1], value[2])
    raise ConfigError(f"{where}: a colour is three whole numbers from 0 to 255, got {reprlib.repr(value)}")


def _names(value: Any, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise ConfigError(f"{where}: members and ignored are lists of names, got {reprlib.repr(value)}")
    return tuple(value)
