"""The published networks of EdgeNets as models of semstab: copy this file into a clone of EdgeNets, beside model/.

    semstab-bench predict --model EdgeNets/nets.py:espnetv2_voc --set scale=2.0 --name espnetv2-2.0 --data SCENE
    semstab-bench --data SCENE --predict EdgeNets/nets.py:dicenet_voc,scale=0.75,soft=True

A file of weights belongs to one width (`scale`), one dataset and one size of image: 384x384 for PASCAL VOC, 512x256 for
Cityscapes. An image is resized to that size, whatever its shape, and normalised with ImageNet's mean and standard
deviation; logits are resized to the image's size, bilinearly.
EdgeNets: github.com/sacmehta/EdgeNets, MIT. ESPNetv2: Mehta et al., CVPR 2019. DiCENet: Mehta et al., TPAMI 2020.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

HERE = Path(__file__).parent
VOC = (
    "background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow", "diningtable",
    "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor",
)  # fmt: skip
CITY = (
    "road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation", "terrain",
    "sky", "person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle", "background",
)  # fmt: skip
MEAN, STD = (
    torch.tensor(colour)[:, None, None] for colour in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225])
)  # of ImageNet, as EdgeNets trains


class Network:
    """A network with the weights of one file.

    Args:
        scale: Width of the network, as in the name of its file of weights.
        soft: Whether it gives scores, instead of labels.
    """

    family, data, size = "", "", (0, 0)
    classes: tuple[str, ...] = ()

    def __init__(self, scale: float = 1.0, soft: bool = False) -> None:
        weights = f"{self.family}_s_{float(scale)}_{self.data}_{self.size[1]}x{self.size[0]}.pth"
        if str(HERE) not in sys.path:
            sys.path.insert(0, str(HERE))
        module = importlib.import_module(f"model.segmentation.{self.family}")
        settings = argparse.Namespace(
            classes=len(self.classes), s=float(scale), weights="", dataset=self.data, model_width=224,
            model_height=224, channels=3, num_classes=1000,
        )  # fmt: skip
        make = getattr(module, f"{self.family}_seg")
        self.net = make(settings, classes=len(self.classes)) if self.family == "dicenet" else make(settings)
        file = HERE / "model" / "segmentation" / "model_zoo" / self.family / weights
        self.net.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
        self.net.eval()
        self.soft = soft

    @torch.inference_mode()
    def predict(self, image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return labels (H, W) uint8, or scores (H, W, K) float32, of an image (H, W, 3) uint8 RGB."""
        x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float() / 255
        x = interpolate(x, size=self.size, mode="bilinear", align_corners=False, antialias=True)
        y = interpolate(self.net((x - MEAN) / STD), size=image.shape[:2], mode="bilinear", align_corners=False)[0]
        return y.softmax(0).permute(1, 2, 0).numpy() if self.soft else y.argmax(0).numpy().astype(np.uint8)


class espnetv2_voc(Network):  # noqa: N801  a name of --predict
    """ESPNetv2, PASCAL VOC 2012: scale 0.5, 1.0, 1.5, 2.0."""

    family, data, size, classes = "espnetv2", "pascal", (384, 384), VOC


class espnetv2_city(Network):  # noqa: N801
    """ESPNetv2, Cityscapes: scale 0.5, 1.0, 1.5, 2.0."""

    family, data, size, classes = "espnetv2", "city", (256, 512), CITY


class dicenet_voc(Network):  # noqa: N801
    """DiCENet, PASCAL VOC 2012: scale 0.2, 0.5, 0.75, 1.0, 1.25, 1.75."""

    family, data, size, classes = "dicenet", "pascal", (384, 384), VOC


class dicenet_city(Network):  # noqa: N801
    """DiCENet, Cityscapes: scale 0.5, 0.75, 1.0, 1.25, 1.5, 1.75."""

    family, data, size, classes = "dicenet", "city", (256, 512), CITY
