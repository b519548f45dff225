"""A network of mmsegmentation: --predict mm.py:MMSeg,config=CONFIG.py,checkpoint=WEIGHTS.pth."""

from mmseg.apis import inference_model, init_model


class MMSeg:
    """A network of mmsegmentation."""

    def __init__(self, config, checkpoint, device="cpu"):
        """Load the network."""
        self.model = init_model(config, checkpoint, device=device)
        self.classes = self.model.dataset_meta["classes"]

    def predict(self, image):
        """Return probabilities (H, W, K) of an image (H, W, 3)."""
        found = inference_model(self.model, image[..., ::-1])  # it takes BGR
        return found.seg_logits.data.softmax(0).permute(1, 2, 0)
