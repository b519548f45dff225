"""A map as a picture in a notebook or a tracker: VSS from above, in colours that colour-blind people tell apart."""

from __future__ import annotations

import base64
import html

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, UInt8
from semstab.data.topdown import EMPTY, top_down

WIDTH = 360
"""Pixels of a picture's longer side, about."""

ONCE, NOWHERE = (221, 221, 221), (255, 255, 255)
"""RGB of voxels that one frame saw, and of cells without a voxel."""


def from_above(index: Int32, vss: Float64, up: npt.ArrayLike | None = None) -> UInt8:
    """Return a picture (H, W, 3) RGB of the topmost voxels (n, 3): VSS from 0, dark, to 1, yellow; grey where NaN.

    Args:
        index: (n, 3) voxels.
        vss: (n,) VSS of each.
        up: Direction out of the picture; the map's shortest side by default.
    """
    import cv2

    shortest = np.diag([1.0, -1.0, 1.0])[int(np.argmin(np.ptp(index, axis=0)))]  # so that z is up before a wall
    away = shortest if up is None else np.asarray(up, dtype=np.float64)
    rows = top_down(index.astype(np.float64) + 0.5, 1.0, away, largest=WIDTH).rows
    colors = cv2.applyColorMap(np.nan_to_num(255 * vss).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    colors = np.where(np.isnan(vss)[:, None], np.array(ONCE, np.uint8), colors)
    picture = np.where((rows == EMPTY)[..., None], np.array(NOWHERE, np.uint8), colors[rows])
    scale = max(1, WIDTH // max(rows.shape))
    return np.ascontiguousarray(picture.repeat(scale, axis=0).repeat(scale, axis=1))


def as_figure(picture: UInt8, caption: str) -> str:
    """Return a picture with its caption as HTML."""
    import cv2

    data = base64.b64encode(cv2.imencode(".png", picture[..., ::-1])[1].tobytes()).decode()
    return (
        f'<figure style="display: inline-block; margin: 1em 1em 0 0"><img src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )
