"""The flights: five scenes whose overlaps of frames differ as UAVid-3D's do in the paper's scene table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semstab.core.types import Float64

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

    def pose(self, share: float, ground: float, altitude: float) -> Float64:
        """Return camera to town (4, 4), OpenCV axes, `altitude` metres above the height `ground`."""
        x, y = self.path(np.array([share]))
        rate = self.sway * 2 * np.pi * self.waves * np.cos(2 * np.pi * self.waves * share) / self.length
        heading = self.axis + 0.7 * np.arctan(rate) + self.swing * np.sin(2 * np.pi * 1.3 * share + self.number)
        wobble = np.sin(2 * np.pi * np.array([2.1, 3.3, 1.7]) * share + self.number)
        down, roll = self.pitch + np.deg2rad(2.5) * wobble[0], np.deg2rad(1.5) * wobble[1]
        ahead = np.array([np.cos(heading) * np.cos(down), np.sin(heading) * np.cos(down), -np.sin(down)])
        right = np.array([np.sin(heading), -np.cos(heading), 0.0])
        below = np.cross(ahead, right)
        c, s = np.cos(roll), np.sin(roll)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([c * right + s * below, c * below - s * right, ahead], axis=1)
        pose[:3, 3] = x[0], y[0], ground + altitude + 2.0 * wobble[2]
        return pose

    @property
    def seconds(self) -> float:
        """Duration."""
        return self.length / SPEED


FLIGHTS = {
    f"scene{number}": Flight(number, length, np.deg2rad(axis), sway, waves, np.deg2rad(swing), np.deg2rad(pitch))
    for number, (length, axis, sway, waves, swing, pitch) in enumerate(
        [(235, 12, 9, 1.0, 9, 55), (255, -20, 12, 0.8, 7, 55), (510, 8, 25, 1.3, 9, 57), (520, -12, 30, 1.0, 8, 56),
         (490, 17, 22, 1.5, 9, 57)]
    )
}  # fmt: skip
"""Scene0 and scene1 see a location in about four of 20 frames, the others in fewer than two."""
