"""Backbone `segearth-ov`: CLIP as an open-vocabulary segmenter without training (Li et al. 2025, CVPR, SegEarth-OV)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from pydantic import BaseModel, Field
from torch import nn
from transformers import AutoTokenizer, CLIPModel

from semstab.backbones import Backbone, Image, Prediction, narrowed
from semstab.backbones.pretrained.checkpoint import Checkpoint, ModelOptions, bilinear
from semstab.backbones.segearth.dense_clip import dense_features
from semstab.backbones.segearth.prompts import Prompts, read_prompts
from semstab.backbones.segearth.simfeatup import SimFeatUp
from semstab.backbones.segearth.windows import padded, slide
from semstab.errors import ConfigError, DataError

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class SegEarthOptions(ModelOptions):
    """Which CLIP, what it is asked, and how the image is shown to it."""

    model: str = Field("openai/clip-vit-base-patch16", description="a CLIP folder, or an id on the Hugging Face hub")
    prompts: Path | None = Field(None, description="YAML file like configs/backbones/segearth_uavid.yaml, the default")
    upsampler: Path | None = Field(
        None, description="a SimFeatUp checkpoint (jbu_one); where not given, features are upsampled bilinearly"
    )
    resize: int = Field(448, ge=1, description="the longer side at which the image is shown, pixels")
    window: int | None = Field(None, ge=1, description="side of a window, pixels; what CLIP was made for by default")
    stride: int | None = Field(None, ge=1, description="from window to window, pixels; half a window by default")
    bias: float = Field(-0.3, description="weight of the whole image's likeness to a class: global bias alleviation")
    sharpness: float = Field(50.0, gt=0, description="factor of the likeness before the softmax")


class SegEarthOV(Backbone):
    """Likeness of each patch's feature to each class's sentences, in windows, averaged, softmaxed, thresholded.

    Without SimFeatUp's weights patches are upsampled bilinearly, which blurs small things.
    """

    Options: type[BaseModel] = SegEarthOptions
    gives_scores = True

    def __init__(self, options: SegEarthOptions) -> None:
        self.options = options
        self.prompts = read_prompts(options.prompts)
        self.label_space = self.prompts.label_space()
        self.checkpoint = Checkpoint.find(options)
        self._model = self.checkpoint.load_model(CLIPModel, options)
        self.window = options.window or int(self._model.vision_model.config.image_size)
        self.stride = options.stride or max(1, self.window // 2)
        if self.stride > self.window:
            raise ConfigError(f"segearth-ov: stride {self.stride} leaves gaps between windows of {self.window} pixels")
        self.queries = self._text_features(self.checkpoint.load(AutoTokenizer), self.prompts)
        self._class_of_query = torch.tensor([k for k, _ in self.prompts.queries], device=self._model.device)
        self._upsampler = _load_upsampler(options.upsampler, self._model)

    @torch.inference_mode()
    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`. Scores know nothing of the threshold below which a label is background."""
        return [self._prediction(image, scores) for image in images]

    def identity(self) -> dict[str, Any]:
        """The checkpoints, the settings and the prompts."""
        upsampler = self.options.upsampler
        return {
            "revision": self.checkpoint.revision,
            **self.options.identity(),
            "window": self.window,
            "stride": self.stride,
            "prompts": self.prompts.model_dump(mode="json"),
            "upsampler": "bilinear" if upsampler is None else _file_digest(upsampler),
        }

    def _prediction(self, image: Image, scores: bool) -> Prediction:
        pixels = torch.as_tensor(normalised(image, self.options.resize)).to(self._model.device, self._model.dtype)
        logits = slide(pixels, self.window, self.stride, self.window_logits)
        full = bilinear(logits.float(), image.shape[:2])
        probability = self._class_probability((self.options.sharpness * full).softmax(dim=0))
        best, label = probability.max(dim=0)
        if self.prompts.background is not None:
            background = self.prompts.names.index(self.prompts.background)
            label = torch.where(best < self.prompts.prob_threshold, background, label)
        labels = narrowed(label.cpu().numpy(), len(probability))
        if not scores:
            return Prediction(labels)
        share = (probability / probability.sum(dim=0)).permute(1, 2, 0).contiguous()
        return Prediction(labels, share.cpu().numpy())

    def _class_probability(self, probability: torch.Tensor) -> torch.Tensor:
        """(classes, H, W): of each class its likeliest name, from (queries, H, W)."""
        rows = range(len(self.prompts.classes))
        return torch.stack([probability[self._class_of_query == k].amax(dim=0) for k in rows])

    def window_logits(self, window: torch.Tensor) -> torch.Tensor:
        """(queries, h, w) cosines of a window (3, h, w)."""
        pixels, place = padded(window[None], int(self._model.vision_model.config.patch_size))
        whole, patches = dense_features(self._model, pixels)
        if self._upsampler is not None:
            patches = self._upsampler(patches, pixels)
        cosine = torch.einsum("qd,dhw->qhw", self.queries, nn.functional.normalize(patches[0], dim=0))
        cosine = cosine + self.options.bias * (self.queries @ nn.functional.normalize(whole[0], dim=0))[:, None, None]
        return bilinear(cosine, pixels.shape[-2:])[:, *place]

    @torch.inference_mode()
    def _text_features(self, tokenizer: Any, prompts: Prompts) -> torch.Tensor:
        """(queries, D): of each name the normalised mean of the normalised features of its sentences."""
        features = []
        for _, name in prompts.queries:
            sentences = [template.format(name) for template in prompts.templates]
            tokens = tokenizer(sentences, padding=True, truncation=True, return_tensors="pt").to(self._model.device)
            found = self._model.get_text_features(**tokens)
            each = nn.functional.normalize(getattr(found, "pooler_output", found), dim=-1)
            features.append(nn.functional.normalize(each.mean(dim=0), dim=-1))
        return torch.stack(features)


def normalised(image: Image, longer: int) -> npt.NDArray[np.float32]:
    """(3, h, w) float32 with CLIP's mean and deviation; the image's shape is kept, its longer side becomes `longer`.

    Bilinear without a low-pass filter, as SegEarth-OV does it.
    """
    scale = longer / max(image.shape[:2])
    height, width = (max(1, int(side * scale + 0.5)) for side in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    mean, deviation = (np.array(values, dtype=np.float32) for values in (CLIP_MEAN, CLIP_STD))
    scaled = (small.astype(np.float32) / np.float32(255) - mean) / deviation
    return np.ascontiguousarray(scaled.transpose(2, 0, 1))


def _load_upsampler(path: Path | None, model: Any) -> SimFeatUp | None:
    if path is None:
        return None
    if not path.is_file():
        raise DataError(f"{path}: there is no SimFeatUp checkpoint; leave upsampler out for bilinear upsampling")
    return SimFeatUp.load(path, int(model.config.projection_dim), model.device, model.dtype)


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()[:32]
