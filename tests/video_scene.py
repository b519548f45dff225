"""A video of twenty frames with the labels of two models, one of which may flip."""

from __future__ import annotations

import cv2
import numpy as np

H, W, STEP, COUNT = 96, 128, 3, 20
CLASSES = ["left", "right", "thing"]


def texture(seed=0):
    """A wide image with something to follow at every place, and its classes, of which each column has one."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (H, W + STEP * COUNT)), (0, 0), 1.5)
    grey = np.clip(128 + 90 * noise / noise.std() / 2, 0, 255).astype(np.uint8)
    labels = np.zeros(grey.shape, np.uint8)
    labels[:, W:] = 1
    labels[30:60, 60:90] = 2
    return np.repeat(grey[..., None], 3, axis=2), labels


def views(seed=0):
    """A camera that moves to the right by STEP pixels a frame."""
    image, labels = texture(seed)
    return [(image[:, k * STEP : k * STEP + W], labels[:, k * STEP : k * STEP + W]) for k in range(COUNT)]


def write(folder, wrong=(), images="images"):
    """Images, right labels, and those of a model that gives another class to a block of some frames."""
    for k, (image, labels) in enumerate(views()):
        flipped = labels.copy()
        if k in wrong:
            flipped[10:60, 20:90] = 1
        files = {images: image, "labels/right": labels, "labels/flips": flipped}
        for name, content in files.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / name / f"{k:04d}.png"), content)
    return folder
