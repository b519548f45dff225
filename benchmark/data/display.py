"""A map as a picture in a notebook or a tracker: VSS from above, in colours that colour-blind people tell apart."""

from __future__ import annotations

import base64
import html

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float64, Int32, UInt8

WIDTH = 360
"""Pixels of a picture's longer side, about."""

ONCE, NOWHERE = (221, 221, 221), (255, 255, 255)
"""RGB of voxels that one frame saw, and of cells without a voxel."""


def from_above(index: Int32, vss: Float64, up: npt.ArrayLike | None = None) -> UInt8:
    """Return a picture (H, W, 3) RGB of the topmost voxels (n, 3): VSS from 0, dark, to 1, yellow; grey where NaN.

    Args:
        index: (n, 3) voxels.
        vss: (n,) VSS of each.
        up: Direction out of the picture; the map's shortest side where not given.
    """
    import cv2

    height = int(np.argmin(np.ptp(index, axis=0))) if up is None else int(np.argmax(np.abs(np.asarray(up, float))))
    right, ahead = (axis for axis in range(3) if axis != height)
    rank = index[:, height] if up is None or np.asarray(up)[height] > 0 else -index[:, height]
    low, high = index.min(axis=0), index.max(axis=0)
    cell = max(1, -(-int((high - low)[[right, ahead]].max() + 1) // WIDTH))
    column, row = ((index[:, axis] - low[axis]) // cell for axis in (right, ahead))
    colors = cv2.applyColorMap(np.nan_to_num(255 * vss).astype(np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    colors = np.where(np.isnan(vss)[:, None], np.array(ONCE, np.uint8), colors)
    picture = np.full((int(row.max()) + 1, int(column.max()) + 1, 3), NOWHERE, np.uint8)
    order = np.argsort(rank, kind="stable")  # the topmost is written last
    picture[row[order], column[order]] = colors[order]
    scale = max(1, WIDTH // max(picture.shape))
    return np.ascontiguousarray(picture[::-1].repeat(scale, axis=0).repeat(scale, axis=1))


def as_figure(picture: UInt8, caption: str) -> str:
    """Return a picture with its caption as HTML."""
    import cv2

    data = base64.b64encode(cv2.imencode(".png", picture[..., ::-1])[1].tobytes()).decode()
    return (
        f'<figure style="display: inline-block; margin: 1em 1em 0 0"><img src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )
