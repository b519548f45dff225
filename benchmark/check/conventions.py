"""Conventions of a scene's files: the configured one, those that people mistake for it, and what sets them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from semstab.data.frames import Frame
from semstab.datasets import Scene
from semstab.datasets.geometry.cameras import CAMERA_AXES

Size = tuple[int, int]
Ratio = tuple[float, float]

POSES = ("camera_to_world", "world_to_camera")
AXES = tuple(CAMERA_AXES)
KINDS = ("planar", "ray")
INVERSE = "inverse"

KNOWN_SCALES = (65.535, 256.0, 1000.0, 4000.0, 5000.0, 6553.5, *(10.0**k for k in range(-6, 7)))
"""Units of depth in a metre that datasets use."""

SNAP = 0.1
"""A depth scale that was measured may be a known one that is this close to it."""

USUAL = 0.001
"""A depth scale that is this close to a known one is that."""

OPTION = "dataset.options."
"""The beginning of the path of a dataset's option."""

METRIC = (0.1, 200.0)
"""The least and the largest median of depth, metres, that cameras see."""

COARSE = (0.001, 0.01, 0.1, 10.0)
"""Units of depth in a metre that no dataset uses: where a factor leads to one, it is one on the poses."""

UNITS = {1000.0: "millimetres", 100.0: "centimetres", 10.0: "decimetres", 0.001: "kilometres"}
"""Units of poses, by how many are in a metre."""

RATIOS = (0.25, 0.5, 2.0, 4.0)
"""Sizes that intrinsics are for, relative to the depth image, where they were not scaled with it; others come from the
colour image, and from twice the principal point."""

SAME_RATIO = 0.15
"""Ratios nearer to each other, or to 1, are one: a principal point may lie off the middle."""


@dataclass(frozen=True)
class Convention:
    """One way to read a scene's files.

    Attributes:
        pose: The direction in which the pose matrices map.
        axes: The camera's axes in them.
        depth: Planar, along the optical axis; along the pixel's ray; or inverse, 1 over the first.
        factor: On depth, relative to the configured reading.
        ratio: Size of the image that the intrinsics are for, relative to the configured one: width, height.
    """

    pose: str = "camera_to_world"
    axes: str = "opencv"
    depth: str = "planar"
    factor: float = 1.0
    ratio: Ratio = (1.0, 1.0)

    def differs_in(self, other: Convention) -> tuple[str, ...]:
        """Return the names of the fields in which two conventions differ."""
        names = (field.name for field in dataclasses.fields(self))
        return tuple(name for name in names if getattr(self, name) != getattr(other, name))


def alternatives(configured: Convention, ratios: tuple[Ratio, ...]) -> Iterator[Convention]:
    """Yield every combination of pose, axes and kind of depth; with other intrinsics only the kind as configured.

    Inverse depth is tried with poses as configured.

    The configured convention comes first; factors are searched for each of them.
    """
    yield configured
    for pose, axes, depth in itertools.product(POSES, AXES, KINDS):
        changed = dataclasses.replace(configured, pose=pose, axes=axes, depth=depth)
        if changed != configured:
            yield changed
    if configured.depth != INVERSE:
        yield dataclasses.replace(configured, depth=INVERSE)
    for ratio, pose, axes in itertools.product(ratios, POSES, AXES):
        yield dataclasses.replace(configured, pose=pose, axes=axes, ratio=ratio)


@dataclass(frozen=True)
class Reading:
    """The configured convention, and the lines of configuration that change it.

    depth_scale is units of stored depth in a metre, or None if only the dataset's own files have it.

    Attributes:
        said: Values by name of setting, from scene.yaml and from the dataset's options.
        options: Names and values of the dataset's options.
        size: (width, height) of the depth images.
        median: Median of their depth as configured, of one of them; metres.
        ratios: Sizes that the intrinsics may be for, relative to the configured size.
        file: The scene.yaml with further settings, or None without one.
        names: Names of all settings, including settings without a value.
        in_program: Whether a program gives the frames, without files and options.
    """

    said: Mapping[str, Any]
    options: Mapping[str, Any]
    size: Size
    median: float
    ratios: tuple[Ratio, ...]
    file: str | None
    depth_scale: float | None
    names: tuple[str, ...] = ()
    in_program: bool = False

    @property
    def convention(self) -> Convention:
        """The configured convention."""
        names = {"pose": "pose_convention", "axes": "camera_axes", "depth": "depth_kind"}
        return Convention(**{field: self.said[name] for field, name in names.items() if name in self.said})

    def usual_factor(self, factor: float, kind: str = "planar") -> float:
        """Return the factor that leads to a depth scale which datasets use, if one is near.

        Otherwise the depth scale has three digits. Of inverse depth the scale grows with the factor.
        """
        if kind == INVERSE:
            return 1 / self.usual_factor(1 / factor)
        now = 1.0 if self.depth_scale is None else self.depth_scale
        near = min(KNOWN_SCALES, key=lambda usual: abs(usual * factor / now - 1))
        return now / (near if abs(near * factor / now - 1) <= SNAP else float(f"{now / factor:.3g}"))

    def is_usual(self, scale: float) -> bool:
        """Return whether datasets use this depth scale, or half of them would round to it: 1000, 5000, 6553.5, ..."""
        return any(abs(usual / scale - 1) < USUAL for usual in KNOWN_SCALES)

    def size_after(self, ratio: Ratio) -> list[int]:
        """Return [width, height] of the image of the intrinsics, `ratio` times the configured size."""
        stated_size = self.said.get("intrinsics_size", self.size)
        return [round(side * share) for side, share in zip(stated_size, ratio, strict=True)]

    def lines(self, convention: Convention) -> tuple[str, ...]:
        """Return the lines of scene.yaml, or the options, with which the files are read by that convention.

        Of a program's frames it is what they hold, in words.
        """
        if self.in_program:
            return tuple(name for name, _ in self._of_program(convention))
        settings = {
            "pose": ("pose_convention", convention.pose),
            "axes": ("camera_axes", convention.axes),
            "depth": ("depth_kind", convention.depth),
            "factor": self._of_factor(convention),
            "ratio": ("intrinsics_size", f"{self.size_after(convention.ratio)}"),
        }
        return tuple(self._line(*settings[field]) for field in convention.differs_in(self.convention))

    def _of_program(self, convention: Convention) -> Iterator[tuple[str, str]]:
        """Yield what a program's frames seem to hold instead of what `Frame` asks for, and what to do about it."""
        width, height = self.size_after(convention.ratio)
        unit = f"{1 / convention.factor:.4g}"
        texts = {
            "pose": ("T_wc that maps the world to the camera", "pass np.linalg.inv(T_wc)"),
            "axes": (f"T_wc with {convention.axes} camera axes", "turn them: x right, y down, z forward"),
            "depth": (
                ("inverse depth", "pass 1 / depth")
                if convention.depth == INVERSE
                else ("depth along the rays of the pixels", "convert it to depth along the optical axis")
            ),
            "factor": (f"depth of {unit} units a metre", f"divide it by {unit}"),
            "ratio": (f"intrinsics of an image of {width}x{height}", "scale them to the depth's size"),
        }
        yield from (texts[field] for field in convention.differs_in(self.convention))

    def of_poses(self, convention: Convention) -> bool:
        """Return whether a factor on depth is rather one on the poses: depth is metric as it is, and not with it."""
        factor, (least, most) = convention.factor, METRIC
        is_metric = "metres_per_unit" in self.said and convention.depth == self.convention.depth and not self.in_program
        if not is_metric or factor == 1 or not least <= self.median <= most:
            return False
        scale = (self.depth_scale or 1.0) / factor
        unused = any(abs(scale / coarse - 1) < USUAL for coarse in COARSE)
        return unused or not least <= factor * self.median <= most

    def _of_factor(self, convention: Convention) -> tuple[str, str]:
        """Return the setting that makes up for a factor on depth, and its value."""
        if self.of_poses(convention):
            return "metres_per_unit", f"{self.said['metres_per_unit'] / convention.factor:.4g}"
        inverse = convention.depth == INVERSE
        return "depth_scale", self._scale_after(1 / convention.factor if inverse else convention.factor)

    def _scale_after(self, factor: float) -> str:
        if self.depth_scale is None:
            return f"{1 / factor:.4g} times the present one"
        return f"{self.depth_scale / factor:.5g}"

    def advice(self, convention: Convention) -> str:
        """Return the file in which the lines belong, and the fault that they would mend."""
        if self.in_program:
            return ", ".join(text for _, text in self._of_program(convention))
        where, factor = self._where(self.lines(convention)), convention.factor
        if factor == 1 or convention.depth == INVERSE:
            return where
        if self.of_poses(convention):
            unit = UNITS.get(round(factor, 6), f"units of {1 / factor:.4g} m")
            return f"{where}; the poses are in {unit}, depth in metres"
        times = f"{factor:.4g} times too short" if factor > 1 else f"{1 / factor:.4g} times too long"
        poses = self.said.get("metres_per_unit")
        unit = "the poses are not in metres" if poses is None else f"metres_per_unit is {poses / factor:.4g}"
        return f"{where}; depth is {times}, or {unit}"

    def _where(self, lines: tuple[str, ...]) -> str:
        """Return the file in which such lines belong."""
        them = "it" if len(lines) == 1 else "them"
        names = {line.removeprefix(OPTION).partition(":")[0] for line in lines}
        if any(not line.startswith(OPTION) for line in lines):
            return f"set {them} in {self.file}"
        if names <= set(self.options):
            return f"set {them} in the configuration"
        return "the dataset has no such option: convert it, then write it into the scene.yaml"

    def change(self, name: str, value: str) -> str:
        """Return a setting with its value, and the file in which it belongs."""
        line = self._line(name, value)
        return f"{line} ({self._where((line,))})"

    def _line(self, name: str, value: str) -> str:
        in_file = self.file is not None and self.options.get(name) in (None, (), [], {})
        return f"{'' if in_file else OPTION}{name}: {value}"


def reading(
    scene: Scene, frame: Frame, options: Mapping[str, Any], color_shape: tuple[int, ...] | None = None
) -> Reading:
    """Return how a scene is configured.

    `frame` is one of its own; the shape (H, W, 3) of its colour suggests intrinsics.
    """
    settings = {**options, **scene.settings}
    height, width = frame.shape
    depths = frame.depth[(frame.depth > 0) & (frame.depth < np.inf)]
    return Reading(
        said={name: value for name, value in settings.items() if value is not None},
        options=options,
        size=(width, height),
        median=float(np.median(depths)) if len(depths) else math.nan,
        ratios=tuple(_ratios(frame, color_shape)),
        file=None if scene.settings_file is None else str(scene.settings_file),
        depth_scale=scene.depth_scale or settings.get("depth_scale"),
        names=(*settings,),
        in_program=scene.in_program,
    )


def _ratios(frame: Frame, color_shape: tuple[int, ...] | None) -> Iterator[Ratio]:
    """Yield sizes that the intrinsics may be for, relative to the depth image's."""
    height, width = frame.shape
    camera = frame.intrinsics
    possible = [(share, share) for share in RATIOS]
    if color_shape is not None:
        possible.insert(0, (color_shape[1] / width, color_shape[0] / height))
    possible.append(((2 * camera.cx + 1) / width, (2 * camera.cy + 1) / height))
    distinct: list[Ratio] = [(1.0, 1.0)]
    for ratio in possible:
        if min(ratio) > 0 and all(_apart(ratio, other) for other in distinct):
            distinct.append(ratio)
    yield from distinct[1:]


def _apart(ratio: Ratio, other: Ratio) -> bool:
    return max(abs(a / b - 1) for a, b in zip(ratio, other, strict=True)) > SAME_RATIO
