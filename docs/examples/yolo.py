"""Instances of Ultralytics, the surest on top: --predict yolo.py:Yolo,weights=yolo11n-seg.pt."""

import numpy as np
from ultralytics import YOLO


class Yolo:
    """Instances of Ultralytics, and a background."""

    def __init__(self, weights="yolo11n-seg.pt"):
        """Load the network."""
        self.model = YOLO(weights)
        self.classes = [*self.model.names.values(), "background"]

    def predict(self, image):
        """Return labels (H, W) of an image (H, W, 3)."""
        (found,) = self.model(image[..., ::-1], retina_masks=True, verbose=False)
        labels = np.full(image.shape[:2], len(self.classes) - 1)
        if found.masks is not None:
            order = found.boxes.conf.argsort()
            for mask, k in zip(found.masks.data[order], found.boxes.cls[order], strict=True):
                labels[mask.cpu().numpy() > 0.5] = int(k)
        return labels
