"""Depth that was stored as the distance along a pixel's ray, brought to the distance along the optical axis."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Intrinsics


def ray_lengths(camera: Intrinsics, u: npt.ArrayLike, v: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Length of the rays through pixels (u, v) from the camera to the plane one metre ahead, metres."""
    x = (np.asarray(u, dtype=np.float64) - camera.cx) / camera.fx
    y = (np.asarray(v, dtype=np.float64) - camera.cy) / camera.fy
    return np.sqrt(x**2 + y**2 + 1)


def planar(depth: npt.NDArray[np.float32], camera: Intrinsics) -> npt.NDArray[np.float32]:
    """Planar depth (H, W), metres, from distances along the rays; what marks a pixel invalid stays invalid."""
    H, W = depth.shape
    along_axis: npt.NDArray[np.float32] = (depth / ray_lengths(camera, np.arange(W), np.arange(H)[:, None])).astype(
        np.float32
    )
    return along_axis
