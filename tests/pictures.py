"""Images for models: smooth blobs of colour that move, so that neighbouring frames look alike."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt


def blobs(height: int = 48, width: int = 80, seed: int = 0, shift: int = 0) -> npt.NDArray[np.uint8]:
    """(height, width, 3) uint8 RGB; `shift` moves it by so many pixels to the left."""
    noise = np.random.default_rng(seed).normal(size=(height, width + 64, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 5)
    scaled = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)
    return np.ascontiguousarray(scaled[:, shift : shift + width].astype(np.uint8))
