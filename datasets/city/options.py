"""Settings of the city: the camera, the flight, and the error model of each simulated model."""

from __future__ import annotations

import re
from typing import Annotated, Literal, get_args

from pydantic import AfterValidator, Field, field_validator

from semstab.config import Settings
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
Coordinate = Annotated[float, Field(ge=-1e8, le=1e8)]
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

    Each draw is a function of the seed, the model's and the scene's name, and that unit.

    A cell is floor(x_w / cell). View errors have the probability
    view * min(1, 2 (1 - cos a)) * min(1, d / 60 m)
    for an angle a between ray and surface normal and a distance d from camera to cell. Where several kinds strike,
    flicker goes before view, view before place, place before border. The wrong class is drawn from the true class's
    row of `CONFUSION`.

    Soft scores (softness > 0): the predicted class scores 1 - softness * u, with u drawn from [0, 1) for each cell and
    frame; the rest goes to the true class if the prediction is wrong, else to the class's row of `CONFUSION`.

    Attributes:
        place: The world cell: the same mistake in every view and frame (consistent but wrong).
        view: The world cell, and the direction and distance it is seen from, in steps of 15 degrees and 12 m.
        flicker: The world cell and the frame's index: independent in every frame.
        border: The pixel and the frame's index: a smooth random field displaces the label map.
    """

    place: Share = Field(0.0, description="share of the world cells that are wrong in every view")
    view: Share = Field(0.0, description="largest probability of an error that depends on where a cell is seen from")
    flicker: Share = Field(0.0, description="probability that a cell is wrong in a frame, independent of all others")
    border: float = Field(0.0, ge=0, le=64, description="pixels by which class borders wander from frame to frame")
    cell: float = Field(0.8, ge=0.01, le=100, description="edge of the cells in metres")
    softness: float = Field(0.0, ge=0, le=0.49, description="largest score that goes to other classes; 0: class ids")
    labeller: Labeller = Field("", description="labeller that changes the labels so that they agree for a wrong reason")
    difficulty: dict[ClassName, Annotated[float, Field(ge=0, le=100)]] = Field(
        default_factory=dict, description="factors on place, view and flicker by true class; 1 by default"
    )


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
    origin: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="world coordinates of the town's middle in metres, for example UTM"
    )
    light: Literal["noon", "morning", "evening", "overcast"] = Field(
        "noon", description="of the images, as of a flight at another time: labels, depth and poses stay the same"
    )
    altitude: float = Field(45.0, ge=30, le=120, description="of the camera above the mean ground, metres")
    cache_megabytes: int = Field(256, ge=0, description="rendered frames that an open scene caches for its models")
    models: dict[str, SimulatedModel] = Field(
        default_factory=lambda: dict(MODELS),
        description="the simulated models by name, instead of the built-in ones",
    )

    @field_validator("models")
    @classmethod
    def _usable_names(cls, models: dict[str, SimulatedModel]) -> dict[str, SimulatedModel]:
        for name in models:
            if name == GROUND_TRUTH or not _NAME.fullmatch(name):
                raise ValueError(
                    f"'{name}' cannot name a model: use letters, digits, '.', '-', single '_'; not '{GROUND_TRUTH}'"
                )
        return models
