"""The compiled loop behind `Sample.matched`: points of one view in another, for several factors on depth."""

from __future__ import annotations

import numpy as np

from semstab.core.compiled import serial


@serial
def find_matches(points, R, t, factors, lens, image, power, rays, u, v, z, depth, inside, error):
    """Find the points (3, N) of a view in another, for factors (F,) on depth, and fill in `Matches`, all (F, N).

    - `R`, `t`: from the first camera's axes to the second's, metres
    - `lens`, `rays`: fx, fy, cx, cy of the second view, and of the rays along which its depth is stored
    - `image`: (H, W) the stored depth of the second view; planar depth is that times the rays' length to the `power`

    Depth times the factor and t as it is, or depth as it is and t over the factor, is the same but for the unit.
    """
    fx, fy, cx, cy = lens
    rays_fx, rays_fy, rays_cx, rays_cy = rays
    H, W = image.shape
    N = points.shape[1]
    turned = np.empty((3, N))
    for i in range(N):
        for axis in range(3):
            turned[axis, i] = R[axis, 0] * points[0, i] + R[axis, 1] * points[1, i] + R[axis, 2] * points[2, i]
    for f in range(factors.shape[0]):
        tx, ty, tz = t[0] / factors[f], t[1] / factors[f], t[2] / factors[f]
        for i in range(N):
            x, y, ahead = turned[0, i] + tx, turned[1, i] + ty, turned[2, i] + tz
            column, row = np.floor(fx * (x / ahead) + cx + 0.5), np.floor(fy * (y / ahead) + cy + 0.5)
            within = ahead > 0 and 0 <= column < W and 0 <= row < H
            u[f, i], v[f, i] = (np.int64(column), np.int64(row)) if within else (0, 0)
            image_depth = np.float64(image[v[f, i], u[f, i]])
            if power != 0:
                a, b = (u[f, i] - rays_cx) / rays_fx, (v[f, i] - rays_cy) / rays_fy
                length = np.sqrt(a * a + b * b + 1)
                image_depth = image_depth * length if power > 0 else image_depth / length
            z[f, i], depth[f, i], inside[f, i] = ahead, image_depth, within
            error[f, i] = abs(image_depth / ahead - 1) if within and 0 < image_depth < np.inf else np.inf
