"""Settings of the city: the camera, the flight, and the error model of each simulated backbone."""

from __future__ import annotations

import math
import re
from typing import Annotated

from pydantic import AfterValidator, Field, field_validator

from semstab.config import Settings
from semstab.datasets import GROUND_TRUTH
from semstab.datasets.city.classes import uavid8

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
"""For each true class, what it is mistaken for, by weight: what segmentation networks confuse in UAVid images."""

Share = Annotated[float, Field(ge=0, le=1)]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9.-]*(_[A-Za-z0-9.-]+)*")


def _known_class(name: str) -> str:
    if name not in uavid8().classes:
        raise ValueError(f"class '{name}' is not known; known: {', '.join(uavid8().classes)}")
    return name


ClassName = Annotated[str, AfterValidator(_known_class)]


class SimulatedBackbone(Settings):
    """How one simulated backbone errs. Each draw is a function of the seed, the backbone's and the scene's name, and of

    place    the world cell: the same mistake in every view and frame (stable but wrong)
    view     the world cell and the quantised direction and distance it is seen from
    flicker  the world cell and the frame's index: anew in every frame
    border   the pixel and the frame's index: a smooth random field displaces the label map

    A cell is floor(x_w / cell). View errors have the probability
    view * min(1, 2 (1 - cos a)) * min(1, d / view_distance)
    for an angle a between ray and surface normal and a distance d from camera to cell. Where several kinds strike,
    flicker goes before view, view before place, place before border. The wrong class is drawn from the true class's
    row of `confusion`.

    Soft scores (softness > 0): the predicted class scores 1 - softness * u, with u drawn from [0, 1) for each cell and
    frame; the rest goes to the true class where the prediction is wrong, else to the class's row of `confusion`.
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

BACKBONES = {
    "sim-steady": SimulatedBackbone(
        place=0.07, view=0.05, flicker=0.015, border=0.8, cell=2.0, difficulty=_SMALL_THINGS
    ),
    "sim-flicker": SimulatedBackbone(
        place=0.02, view=0.08, flicker=0.11, border=2.0, cell=1.2, difficulty=_SMALL_THINGS
    ),
    "sim-soft": SimulatedBackbone(
        place=0.04, view=0.06, flicker=0.05, border=1.2, cell=1.6, softness=0.4, difficulty=_SMALL_THINGS
    ),
}


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
    cache_megabytes: int = Field(256, ge=0, description="rendered frames that an open scene keeps for its backbones")
    backbones: dict[str, SimulatedBackbone] = Field(
        default_factory=lambda: dict(BACKBONES),
        description="the simulated backbones by name, instead of the built-in ones",
    )

    @field_validator("origin")
    @classmethod
    def _usable_origin(cls, origin: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(math.isfinite(value) and abs(value) <= 1e8 for value in origin):
            raise ValueError("origin must be finite and within 1e8 m")
        return origin

    @field_validator("backbones")
    @classmethod
    def _usable_names(cls, backbones: dict[str, SimulatedBackbone]) -> dict[str, SimulatedBackbone]:
        for name in backbones:
            if name == GROUND_TRUTH or not _NAME.fullmatch(name):
                raise ValueError(
                    f"'{name}' cannot name a backbone: use letters, digits, '.', '-', single '_'; not '{GROUND_TRUTH}'"
                )
        return backbones
