"""How the drift that a frame caused is shown: in levels, in colours that no class wears, with a legend."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import rerun as rr

from semstab.model.labels import LabelSpace
from semstab.model.measures import SBD_MAX
from semstab.model.palette import GLOW, Color, between

NO_VOXEL, FIRST_SEEN, NO_DRIFT = 0, 1, 2
LEVELS = 24
LEVEL_EDGES = SBD_MAX * (np.arange(LEVELS + 1) / LEVELS) ** 2
"""Bits at which one level of drift ends and the next begins: finer where drift is small; the last one is open."""

RAMPS: tuple[tuple[Color, ...], ...] = (
    GLOW,
    ((0, 100, 120), (0, 160, 190), (0, 220, 240), (130, 245, 255), (215, 255, 255)),
    ((120, 0, 110), (200, 0, 190), (255, 60, 220), (255, 150, 235), (255, 220, 250)),
    ((30, 100, 0), (70, 170, 0), (130, 235, 30), (190, 255, 110), (230, 255, 200)),
)
"""What drifts lights up like a glowing body; where a taxonomy of the user's has such a colour, in another hue."""

NEAR = 40.0
"""Distance in RGB from which on two colours are told apart."""

LEGEND = (-1.0, LEVELS + 3.0), (0.0, 2.8)
"""What is seen of the legend, across and down, in squares of a level."""


def ramp(classes: LabelSpace) -> npt.NDArray[np.float64]:
    """Colours (LEVELS, 3) of the levels: the first of RAMPS that no class's colour is near, else the farthest."""
    ramps = [between(colors, LEVELS) for colors in RAMPS]
    worn = np.array(classes.colors, dtype=np.float64)
    distance = [float(np.linalg.norm(r[:, None] - worn, axis=2).min()) for r in ramps]
    clear = [number for number, least in enumerate(distance) if least >= NEAR]
    return ramps[clear[0] if clear else int(np.argmax(distance))]


def levels_of(drift: npt.NDArray[np.float32], seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint8]:
    """Picture of drift in bits (H, W), NaN where a voxel is seen for the first time; `seen` where there is a voxel."""
    level = np.searchsorted(LEVEL_EDGES[1:-1], drift, side="right") + NO_DRIFT + 1
    level[drift == 0] = NO_DRIFT
    level[np.isnan(drift)] = FIRST_SEEN
    level[~seen] = NO_VOXEL
    return level.astype(np.uint8)


def context(classes: LabelSpace) -> rr.AnnotationContext:
    """Names and colours of the levels; over the colour image only what drifts is seen, and dimly what is new."""
    names = [f"{low:.4f} to {high:.4f} bits" for low, high in itertools.pairwise(LEVEL_EDGES)]
    names[-1] = f"{LEVEL_EDGES[-2]:.4f} bits and more"
    glow = ramp(classes).astype(int)
    infos: list[tuple[int, str, tuple[int, ...]]] = [
        (NO_VOXEL, "no voxel", (0, 0, 0, 200)),
        (FIRST_SEEN, "first seen", (40, 60, 110, 170)),
        (NO_DRIFT, "no drift", (0, 0, 0, 150)),
    ]
    infos += [(NO_DRIFT + 1 + k, name, (*glow[k].tolist(), 255)) for k, name in enumerate(names)]
    return rr.AnnotationContext([rr.AnnotationInfo(*info) for info in infos])


def log_legend(stream: rr.RecordingStream, entity: str, classes: LabelSpace) -> None:
    """The levels side by side in their colours, and what they mean where that is round."""
    stream.log(entity, context(classes), static=True)
    shown = np.array([[FIRST_SEEN, NO_VOXEL, *range(NO_DRIFT + 1, NO_DRIFT + 1 + LEVELS)]], dtype=np.uint8)
    stream.log(f"{entity}/levels", rr.SegmentationImage(shown), static=True)
    ticks = [0.01, 0.05, 0.1, 0.2]
    at = [2 + LEVELS * (bits / SBD_MAX) ** 0.5 for bits in ticks]
    labels = ["first seen", *(f"{bits:g}" for bits in ticks), f"{SBD_MAX:.2f} bits"]
    points = np.array([(x, 1.2) for x in (0.5, *at, LEVELS + 1.0)])
    names = rr.Points2D(points, colors=(255, 255, 255), labels=labels, radii=0.0, show_labels=True)
    stream.log(f"{entity}/names", names, static=True)
