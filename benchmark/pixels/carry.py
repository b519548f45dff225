"""What was believed of one view's pixels, carried into the next view by depth and pose."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semstab.model.frames import Frame
from semstab.model.labels import fixed
from semstab.pixels.warp import DEPTH_TOLERANCE, by_rows, motion


def carry(
    belief: npt.NDArray[np.float32], source: Frame, target: Frame, *, depth_tolerance: float = DEPTH_TOLERANCE
) -> npt.NDArray[np.float32]:
    """Beliefs (H', W', K) of the source's pixels as the target's pixels see them (H, W, K), 0 where none is.

    Backward warping, linear between those of the four nearest pixels that see the same surface: their depth differs
    from the point's distance z by at most depth_tolerance * z, and they say something. Nearest pixels, carried on from
    frame to frame, would stay behind a camera that moves by less than half a pixel.
    """
    from semstab.pixels.warp_kernel import blend

    H, W = target.shape
    K, camera = target.intrinsics, source.intrinsics
    rays = ((np.arange(W) - K.cx) / K.fx, (np.arange(H) - K.cy) / K.fy)
    carried = np.zeros((H, W, belief.shape[2]), dtype=np.float32)
    blend(
        fixed(target.depth), rays, by_rows(motion(target, source)), fixed(source.depth),
        (camera.fx, camera.fy, camera.cx, camera.cy), depth_tolerance, np.ascontiguousarray(belief), carried,
    )  # fmt: skip
    return carried
