"""Cameras as datasets state them: intrinsics for images of a size."""

from __future__ import annotations

from dataclasses import dataclass

from semstab.errors import DataError
from semstab.model.frames import Intrinsics

LARGEST = 1e9


@dataclass(frozen=True)
class Camera:
    """Intrinsics as a dataset states them, and the (width, height) that they are for; None: of any image's own.

    Raises DataError for numbers that no camera has, so that nothing overflows.
    """

    intrinsics: Intrinsics
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        K = self.intrinsics
        for name, value, least in (("fx", K.fx, 1e-3), ("fy", K.fy, 1e-3), ("cx", K.cx, 0), ("cy", K.cy, 0)):
            if not least <= abs(value) <= LARGEST:
                raise DataError(f"intrinsics: {name} = {value:g} pixels is none of a camera; is the file damaged?")

    def at(self, shape: tuple[int, ...], centre: float = 0.0) -> Intrinsics:
        """Intrinsics, pixel centres at integers, of an image of the whole field of view and of that shape (H, W, ...).

        `centre` is where the dataset has the centre of the first pixel: 0, or 0.5 where it counts from the corner.
        """
        stated, size = self.intrinsics, (shape[1], shape[0])
        K = Intrinsics(stated.fx, stated.fy, stated.cx - centre, stated.cy - centre)
        return K if self.size in (None, size) else K.resized(self.size or size, size)


FxFyCxCy = tuple[float, float, float, float]


def camera_of(stated: FxFyCxCy | None, usual: FxFyCxCy, size: tuple[int, int]) -> Camera:
    """The stated intrinsics, of the depth images as they are, or else a dataset's usual ones, of images of a size."""
    return Camera(Intrinsics(*stated)) if stated is not None else Camera(Intrinsics(*usual), size)
