"""A map from above, as a notebook and a tracker show it."""

from __future__ import annotations

import cv2
import numpy as np

from semstab.data.display import NOWHERE, ONCE, WIDTH, from_above

DARK, BRIGHT = (tuple(cv2.applyColorMap(np.uint8([[v]]), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1].tolist()) for v in (0, 255))


def cells(picture, rows, columns):
    height, width = picture.shape[0] // rows, picture.shape[1] // columns
    return [[tuple(picture[r * height, c * width].tolist()) for c in range(columns)] for r in range(rows)]


def test_the_topmost_voxel_of_a_column_is_seen_and_north_is_up():
    index = np.array([[0, 0, 0], [0, 0, 5], [1, 0, 0], [2, 1, 0]], np.int32)
    vss = np.array([0.0, 1.0, np.nan, 0.0])
    assert cells(from_above(index, vss, (0, 0, 1)), 2, 3) == [[NOWHERE, NOWHERE, DARK], [BRIGHT, ONCE, NOWHERE]]
    below = cells(from_above(index, vss, (0, 0, -1)), 2, 3)
    assert below[0][0] == DARK  # a map seen from below is mirrored
    assert cells(from_above(index, vss), 6, 3)[0] == [BRIGHT, NOWHERE, NOWHERE]  # along its shortest side, y


def test_a_large_map_is_a_small_picture():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 5000, (1000, 3)).astype(np.int32)
    picture = from_above(index, rng.random(1000), (0, 0, 1))
    assert WIDTH / 2 < max(picture.shape) <= WIDTH + 1
