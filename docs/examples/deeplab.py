"""DeepLabV3 of torchvision: semstab-bench --data SCENE --predict deeplab.py:DeepLab."""

import torch
from torch.nn.functional import interpolate
from torchvision.models.segmentation import DeepLabV3_ResNet50_Weights, deeplabv3_resnet50


class DeepLab:
    """DeepLabV3 of torchvision."""

    def __init__(self):
        """Load weights and classes."""
        weights = DeepLabV3_ResNet50_Weights.DEFAULT
        self.classes = weights.meta["categories"]
        self.prepared = weights.transforms()
        self.net = deeplabv3_resnet50(weights=weights).eval()

    @torch.inference_mode()
    def predict(self, image):
        """Return probabilities (H, W, K) of an image (H, W, 3)."""
        pixels = self.prepared(torch.from_numpy(image).permute(2, 0, 1))[None]
        logits = interpolate(self.net(pixels)["out"], size=image.shape[:2], mode="bilinear")
        return logits[0].softmax(0).permute(1, 2, 0)
