"""Settings of the city: the camera, the flight, and the error model of each simulated model."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import AfterValidator, Field, field_validator

from semstab.config import Settings
from semstab.core.types import Float64
from semstab.datasets import GROUND_TRUTH
from semstab.datasets.city.mesh import uavid8

CONFUSION: dict[str, dict[str, float]] = {
    "clutter": {"road": 0.45, "low vegetation": 0.35, "building": 0.2},
    "building": {"road": 0.4, "clutter": 0.45, "low vegetation": 0.15},
    "road": {"clutter": 0.5, "building": 0.3, "low vegetation": 0.2},
    "static car": {"moving car": 0.6, "clutter": 0.25, "road": 0.15},
    "tree": {"low vegetation": 0.85, "clutter": 0.15},
    "low vegetation": {"tree": 0.55, "clutter": 0.35, "road": 0.1},
    "human": {"clutter": 0.5, "road": 0.3, "low vegetation": 0.2},
    "moving car": {"static car": 0.7, "road": 0.2, "clutter": 0.1},
}
"""The classes that each true class is mistaken for, by weight, as networks confuse them in UAVid images."""

Share = Annotated[float, Field(ge=0, le=1)]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9.-]*(_[A-Za-z0-9.-]+)*")


def _known_class(name: str) -> str:
    if name not in uavid8().classes:
        raise ValueError(f"class '{name}' is not known; known: {', '.join(uavid8().classes)}")
    return name


ClassName = Annotated[str, AfterValidator(_known_class)]


Labeller = Literal[
    "", "constant", "two-class", "blur-31", "blur-81", "coarse-16", "coarse-48", "border-ignoring", "hard-ignoring",
    "world-locked", "by-row",
]  # fmt: skip


class SimulatedModel(Settings):
    """The errors of one simulated model, each with the unit that it is drawn for.

    Each draw is a function of the seed, the model's and the scene's name, and of that.

    A cell is floor(x_w / cell). View errors have the probability
    view * min(1, 2 (1 - cos a)) * min(1, d / view_distance)
    for an angle a between ray and surface normal and a distance d from camera to cell. Where several kinds strike,
    flicker goes before view, view before place, place before border. The wrong class is drawn from the true class's
    row of `confusion`.

    Soft scores (softness > 0): the predicted class scores 1 - softness * u, with u drawn from [0, 1) for each cell and
    frame; the rest goes to the true class where the prediction is wrong, else to the class's row of `confusion`.

    Attributes:
        place: The world cell: the same mistake in every view and frame (consistent but wrong).
        view: The world cell and the quantised direction and distance it is seen from.
        flicker: The world cell and the frame's index: anew in every frame.
        border: The pixel and the frame's index: a smooth random field displaces the label map.
    """

    place: Share = Field(0.0, description="share of the world cells that are wrong in every view")
    view: Share = Field(0.0, description="largest probability of an error that depends on where a cell is seen from")
    flicker: Share = Field(0.0, description="probability that a cell is wrong in a frame, independent of all others")
    border: float = Field(0.0, ge=0, le=64, description="pixels by which class borders wander from frame to frame")
    border_scale: float = Field(12.0, ge=2, le=512, description="pixels over which that displacement varies")
    cell: float = Field(0.8, ge=0.01, le=100, description="edge of the cells in metres")
    view_angle: float = Field(
        15.0, ge=0.5, le=90, description="step of the direction that a cell is seen from, degrees"
    )
    view_step: float = Field(12.0, ge=0.1, le=1000, description="step of the distance that a cell is seen from, metres")
    view_distance: float = Field(
        60.0, gt=0, le=1000, description="distance from which view errors grow no further, metres"
    )
    softness: float = Field(0.0, ge=0, le=0.49, description="largest score that goes to other classes; 0: class ids")
    labeller: Labeller = Field("", description="labeller that changes the labels so that they agree for a wrong reason")
    difficulty: dict[ClassName, Annotated[float, Field(ge=0, le=100)]] = Field(
        default_factory=dict, description="factors on place, view and flicker by true class; 1 where not given"
    )
    confusion: dict[ClassName, dict[ClassName, Annotated[float, Field(ge=0)]]] = Field(
        default_factory=dict, description="rows that replace the built-in ones: true class -> wrong class -> weight"
    )

    @field_validator("confusion")
    @classmethod
    def _real_rows(cls, rows: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
        for name, row in rows.items():
            if name in row:
                raise ValueError(f"'{name}' cannot be mistaken for itself")
            if not (math.isfinite(sum(row.values())) and sum(row.values()) > 0):
                raise ValueError(f"the weights of '{name}' must sum to more than 0")
        return rows


_SMALL_THINGS = {"human": 3.0, "static car": 1.6, "moving car": 1.6, "clutter": 1.4}

MODELS = {
    name: SimulatedModel(place=place, view=view, flicker=flicker, border=border, cell=cell, softness=softness,
                            difficulty=_SMALL_THINGS)
    for name, place, view, flicker, border, cell, softness in (
        ("sim-steady", 0.07, 0.05, 0.015, 0.8, 2.0, 0.0),
        ("sim-flicker", 0.02, 0.08, 0.11, 2.0, 1.2, 0.0),
        ("sim-soft", 0.04, 0.06, 0.05, 1.2, 1.6, 0.4),
    )
} | {
    f"trick-{name}": SimulatedModel(view=0.08, flicker=0.11, border=2.0, cell=1.2, difficulty=_SMALL_THINGS,
                                       labeller=name)
    for name in get_args(Labeller) if name
}  # fmt: skip
"""The simulated models, and labellers that a verdict must not fall for (`labellers`)."""


class CityOptions(Settings):
    """Options of the built-in city."""

    seed: int = Field(0, ge=0, lt=2**63, description="of the towns and of all errors")
    width: int = Field(384, ge=16, le=3840, description="image width in pixels")
    height: int = Field(216, ge=16, le=2160, description="image height in pixels")
    frames: int = Field(20, ge=1, le=10_000, description="frames of a scene, evenly spaced over the same flight")
    origin: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="world coordinates of the town's middle in metres, for example UTM"
    )
    altitude: float = Field(45.0, ge=30, le=120, description="of the camera above the mean ground, metres")
    field_of_view: float = Field(60.0, ge=20, le=100, description="horizontal, degrees")
    cache_megabytes: int = Field(256, ge=0, description="rendered frames that an open scene caches for its models")
    models: dict[str, SimulatedModel] = Field(
        default_factory=lambda: dict(MODELS),
        description="the simulated models by name, instead of the built-in ones",
    )

    @field_validator("origin")
    @classmethod
    def _usable_origin(cls, origin: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(math.isfinite(value) and abs(value) <= 1e8 for value in origin):
            raise ValueError("origin must be finite and within 1e8 m")
        return origin

    @field_validator("models")
    @classmethod
    def _usable_names(cls, models: dict[str, SimulatedModel]) -> dict[str, SimulatedModel]:
        for name in models:
            if name == GROUND_TRUTH or not _NAME.fullmatch(name):
                raise ValueError(
                    f"'{name}' cannot name a model: use letters, digits, '.', '-', single '_'; not '{GROUND_TRUTH}'"
                )
        return models


# The flights: five scenes whose frames overlap as differently as those of UAVid-3D in the paper's scene table.

SPEED = 10.0
"""Metres a second along the flight's axis."""

OFF_GRID = (0.271828, -0.314159)
"""Metres by which paths miss the origin: a camera right at it would see cells along exact multiples of 45 degrees."""


@dataclass(frozen=True)
class Flight:
    """A smooth path along an axis through the town's origin, the camera looking ahead and down.

    Attributes:
        number: Number of the town that it flies over.
        length: Metres from the first frame to the last, along the axis.
        axis: Heading of the axis, radians.
        sway: Metres to each side, and how many such waves the path has.
        swing: Radians by which the camera's heading swings about the path's.
        pitch: Radians that the camera looks down, below the horizon.
    """

    number: int
    length: float
    axis: float
    sway: float
    waves: float
    swing: float
    pitch: float

    def path(self, share: Float64) -> tuple[Float64, Float64]:
        """Return the world x and y (relative to the origin) after a share 0..1 of the flight."""
        along = (share - 0.5) * self.length + OFF_GRID[0]
        across = self.sway * np.sin(2 * np.pi * self.waves * share) + OFF_GRID[1]
        c, s = np.cos(self.axis), np.sin(self.axis)
        return c * along - s * across, s * along + c * across

    def heading(self, share: float) -> float:
        """Return camera heading in radians: the path's direction and a swing about it."""
        rate = self.sway * 2 * np.pi * self.waves * np.cos(2 * np.pi * self.waves * share) / self.length
        return float(self.axis + 0.7 * np.arctan(rate) + self.swing * np.sin(2 * np.pi * 1.3 * share + self.number))

    def pose(self, share: float, ground: float, altitude: float) -> Float64:
        """Return camera-to-world (4, 4), OpenCV axes, relative to the origin.

        `altitude` metres above the height `ground`.
        """
        x, y = self.path(np.array([share]))
        wobble = np.sin(2 * np.pi * np.array([2.1, 3.3, 1.7]) * share + self.number)
        down = self.pitch + np.deg2rad(2.5) * wobble[0]
        pose = np.eye(4)
        pose[:3, :3] = look(self.heading(share), down, np.deg2rad(1.5) * wobble[1])
        pose[:3, 3] = x[0], y[0], ground + altitude + 2.0 * wobble[2]
        return pose

    @property
    def seconds(self) -> float:
        """Duration."""
        return self.length / SPEED


def look(heading: float, down: float, roll: float) -> Float64:
    """Return the rotation (3, 3) from camera axes (right, down, ahead) to the world's, for angles in radians."""
    ahead = np.array([np.cos(heading) * np.cos(down), np.sin(heading) * np.cos(down), -np.sin(down)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    below = np.cross(ahead, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * below, c * below - s * right, ahead], axis=1)


FLIGHTS = {
    f"scene{number}": Flight(number, length, np.deg2rad(axis), sway, waves, np.deg2rad(swing), np.deg2rad(pitch))
    for number, (length, axis, sway, waves, swing, pitch) in enumerate(
        [(235, 12, 9, 1.0, 9, 55), (255, -20, 12, 0.8, 7, 55), (510, 8, 25, 1.3, 9, 57), (520, -12, 30, 1.0, 8, 56),
         (490, 17, 22, 1.5, 9, 57)]
    )
}  # fmt: skip
"""Scene0 and scene1 see a location in about four of 20 frames, the others in fewer than two."""
