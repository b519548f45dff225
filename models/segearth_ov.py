"""Model `segearth-ov`: CLIP as an open-vocabulary segmenter without training (Li et al. 2025, CVPR, SegEarth-OV)."""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import torch
from pydantic import BaseModel, Field, field_validator, model_validator
from torch import nn
from transformers import AutoTokenizer, CLIPModel

from semstab.config import Settings, read_yaml, validated
from semstab.core.types import Float32
from semstab.data.labels import LabelSpace
from semstab.errors import ConfigError, DataError, summarize_error
from semstab.models import Image, Model, Prediction, content_digest, narrowed
from semstab.models.checkpoint import Checkpoint, ModelOptions, bilinear

# CLIP as a dense feature extractor: its last block lets each patch look at its like (Li et al. 2025, CVPR).


def dense_features(model: Any, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return features in the space that images and texts share.

    (N, D) of the image, (N, D, h, w) of patches, not normalised.

    All blocks but the last are CLIP's own. The last one is `self_self_attention` of its first layer norm's output, with
    neither residual nor MLP.

    Args:
        model: A transformers CLIPModel in evaluation mode.
        pixels: (N, 3, H, W) normalised; H and W are multiples of the patch size.
    """
    vision = model.vision_model
    patch, native = vision.config.patch_size, vision.config.image_size
    h, w = pixels.shape[-2] // patch, pixels.shape[-1] // patch
    other_size = pixels.shape[-2:] != (native, native)
    hidden = vision.pre_layrnorm(vision.embeddings(pixels, interpolate_pos_encoding=other_size))
    *layers, last = vision.encoder.layers
    for layer in layers:
        hidden = layer(hidden, attention_mask=None)
    tokens = self_self_attention(last.self_attn, last.layer_norm1(hidden))
    tokens = model.visual_projection(vision.post_layernorm(tokens))
    return tokens[:, 0], tokens[:, 1:].transpose(1, 2).unflatten(2, (h, w))


def self_self_attention(attention: Any, tokens: torch.Tensor) -> torch.Tensor:
    """Return (N, T, D): out_proj of (softmax(q q^T) + softmax(k k^T) + softmax(v v^T)) v, products by sqrt(d), a head.

    Args:
        attention: A transformers CLIPAttention.
        tokens: (N, T, D), the output of its block's first layer norm.
    """
    q, k, v = (
        project(tokens).view(*tokens.shape[:2], attention.num_heads, attention.head_dim).transpose(1, 2)
        for project in (attention.q_proj, attention.k_proj, attention.v_proj)
    )
    like_q, like_k, like_v = (torch.softmax(x @ x.mT * attention.scale, dim=-1) for x in (q, k, v))
    mixed = (like_q + like_k + like_v) @ v
    return torch.as_tensor(attention.out_proj(mixed.transpose(1, 2).flatten(2)))


# The prompts of an open-vocabulary model: classes, their other names, and sentences around them.

SHIPPED = importlib.resources.files("semstab.configs") / "models" / "segearth_uavid.yaml"


class Prompts(Settings):
    """The prompts of each class; see configs/models/segearth_uavid.yaml."""

    name: str = Field("prompts", description="of the taxonomy that the classes make")
    classes: list[str] = Field(min_length=2, description="a class an entry; after commas its other names")
    background: str | None = Field(None, description="the class of pixels at which every class is unlikely")
    prob_threshold: float = Field(0.0, ge=0, le=1, description="likelihood below which a pixel is background")
    templates: list[str] = Field(["a photo of a {}."], min_length=1, description="sentences; {} stands for the name")

    @field_validator("classes")
    @classmethod
    def _names_are_there(cls, value: list[str]) -> list[str]:
        if empty := [entry for entry in value if not all(part.strip() for part in entry.split(","))]:
            raise ValueError(f"'{empty[0]}' has an empty name")
        return value

    @field_validator("templates")
    @classmethod
    def _templates_hold_a_name(cls, value: list[str]) -> list[str]:
        if wrong := [template for template in value if template.count("{}") != 1]:
            raise ValueError(f"'{wrong[0]}' must hold {{}} once")
        return value

    @model_validator(mode="after")
    def _background_is_a_class(self) -> Self:
        if self.background is not None and self.background not in self.names:
            raise ValueError(f"the background '{self.background}' is not a class")
        if self.background is None and self.prob_threshold > 0:
            raise ValueError("prob_threshold needs a background class")
        return self

    @property
    def names(self) -> list[str]:
        """The classes' own names, in id order."""
        return [entry.split(",")[0].strip() for entry in self.classes]

    @property
    def queries(self) -> list[tuple[int, str]]:
        """Class id and name of each query."""
        return [(k, part.strip()) for k, entry in enumerate(self.classes) for part in entry.split(",")]

    def label_space(self) -> LabelSpace:
        """Return the classes.

        Raises:
            ConfigError: For a name that repeats.
        """
        return LabelSpace(self.name, tuple(self.names))


def read_prompts(path: Path | None) -> Prompts:
    """Return the prompts of a file, or the prompts for UAVid without a file.

    Raises:
        ConfigError: If that fails; the message names file and setting.
    """
    path = path or Path(str(SHIPPED))
    return validated(Prompts, read_yaml(path), f"{path}: ")


# SimFeatUp: features of patches upsampled 16 times, along the edges of the image (Li et al. 2025, CVPR).
#
# After FeatUp (Fu et al. 2024, ICLR); the names of the parameters are those of the public checkpoints.

KEY_DIM = 32
PREFIX = "upsampler."
DOUBLINGS = 4


class JointBilateralUpsampler(nn.Module):
    """Features at twice their resolution, or at that of the guidance: a kernel of each pixel's own over its neighbours.

    The kernel is the product of a range kernel, the softmax of the likeness of the guidance in a learned space, and a
    Gaussian of the distance; normalised, plus a learned correction.
    """

    def __init__(self, radius: int = 5) -> None:
        super().__init__()
        self.radius = radius
        self.diameter = 2 * radius + 1
        taps = self.diameter**2
        self.range_temp = nn.Parameter(torch.tensor(0.0))
        self.sigma_spatial = nn.Parameter(torch.tensor(1.0))
        self.range_proj = _two_layers(3, KEY_DIM, KEY_DIM)
        self.fixup_proj = _two_layers(3 + taps, taps, taps)

    def forward(self, source: torch.Tensor, guidance: torch.Tensor) -> torch.Tensor:
        """Return (N, C, H, W) from source (N, C, h, w) and guidance (N, 3, H, W); H and W must exceed the radius."""
        kernel = self.kernel(guidance)
        bicubic = nn.functional.interpolate(source, size=guidance.shape[-2:], mode="bicubic", align_corners=False)
        result = torch.zeros_like(bicubic)
        for tap, neighbour in enumerate(self._neighbours(bicubic)):
            result.addcmul_(kernel[:, tap, None], neighbour)
        return result

    def kernel(self, guidance: torch.Tensor) -> torch.Tensor:
        """Return (N, taps, H, W) the weight of each neighbour, row by row."""
        key = self.range_proj(guidance)
        likeness = torch.stack([(key * neighbour).sum(dim=1) for neighbour in self._neighbours(key)], dim=1)
        temperature = self.range_temp.exp().clamp(1e-4, 1e4)
        axis = torch.linspace(-1, 1, self.diameter, dtype=self.sigma_spatial.dtype, device=self.sigma_spatial.device)
        squared = axis[:, None] ** 2 + axis[None, :] ** 2  # each axis of the window is -1 to 1
        spatial = torch.exp(-squared / (2 * self.sigma_spatial**2)).reshape(1, -1, 1, 1)
        kernel = (temperature * likeness).softmax(dim=1) * spatial
        kernel = kernel / kernel.sum(dim=1, keepdim=True).clamp(min=1e-7)
        return torch.as_tensor(kernel + 0.1 * self.fixup_proj(torch.cat([kernel, guidance], dim=1)))

    def _neighbours(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Return for each tap the image (N, C, H, W), moved so that a pixel holds that neighbour; mirrored outside."""
        H, W = x.shape[-2:]
        mirrored = nn.functional.pad(x, [self.radius] * 4, mode="reflect")
        taps = range(self.diameter)
        return [mirrored[..., dy : dy + H, dx : dx + W] for dy in taps for dx in taps]


class SimFeatUp(nn.Module):
    """One upsampler, four times, and a learned correction of the channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.up = JointBilateralUpsampler()
        self.fixup_proj = nn.Sequential(nn.Dropout2d(0.2), nn.Conv2d(channels, channels, 1))

    @classmethod
    def load(cls, path: Path, channels: int, device: torch.device, dtype: torch.dtype) -> SimFeatUp:
        """Load it from a checkpoint, ready to use.

        Raises:
            DataError: If the file is none, or has other shapes.
        """
        if not path.is_file():
            raise DataError(f"{path}: there is no SimFeatUp checkpoint; leave upsampler out for bilinear upsampling")
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
            weights = content.get("state_dict", content)
            module = cls(channels)
            module.load_state_dict({key.removeprefix(PREFIX): value for key, value in weights.items()})
        except Exception as error:  # torch.load raises whatever its unpickler does
            raise DataError(
                f"{path}: no SimFeatUp weights for {channels} channels ({summarize_error(error)[:200]}); name"
                f" the checkpoint"
                " 'jbu_one' that was trained for this CLIP"
            ) from error
        return module.to(device, dtype).eval()

    def forward(self, features: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Return (N, C, 16 h, 16 w) from features (N, C, h, w) and the normalised image (N, 3, H, W) behind them.

        Raises:
            ConfigError: For fewer than 3x3 patches, over which a neighbourhood cannot be mirrored.
        """
        if 2 * min(features.shape[-2:]) <= self.up.radius:
            raise ConfigError(
                f"SimFeatUp needs 3x3 patches or more, a window has {features.shape[-2]}x{features.shape[-1]};"
                " use larger windows"
            )
        for _ in range(DOUBLINGS):
            size = (2 * features.shape[-2], 2 * features.shape[-1])
            features = self.up(features, nn.functional.adaptive_avg_pool2d(image, size))
        return torch.as_tensor(features + 0.1 * self.fixup_proj(features))


def _two_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, hidden, 1), nn.GELU(), nn.Dropout2d(0.1), nn.Conv2d(hidden, outputs, 1))


# Sliding windows: a model that sees a small square is moved over a larger image, and its logits are averaged.


def starts(length: int, window: int, stride: int) -> list[int]:
    """Return the first pixels of the windows along an axis; the last window ends at the border.

    >>> starts(448, 224, 112), starts(299, 224, 112), starts(200, 224, 112)
    ([0, 112, 224], [0, 75], [0])
    """
    last = max(0, length - window)
    return [*range(0, last, stride), last]


def slide(
    pixels: torch.Tensor, window: int, stride: int, logits_of: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """Return the mean logits (Q, H, W) of all windows over an image (3, H, W).

    Args:
        pixels: (3, H, W) image, normalised.
        window: Side of a window, pixels.
        stride: Pixels from one window to the next.
        logits_of: One window (3, h, w) to its logits (Q, h, w); h and w are `window`, or less where the image is
            smaller.
    """
    H, W = pixels.shape[1:]
    total, count = pixels.new_zeros(()), pixels.new_zeros(H, W)
    for top in starts(H, window, stride):
        for left in starts(W, window, stride):
            area = (..., slice(top, top + window), slice(left, left + window))
            logits = logits_of(pixels[area])
            total = total if total.ndim else logits.new_zeros(len(logits), H, W)
            total[area] += logits
            count[area] += 1
    return total / count


def padded(pixels: torch.Tensor, multiple: int) -> tuple[torch.Tensor, tuple[slice, ...]]:
    """Return the image (..., H, W) between zeros so that both sides are multiples, and its slices in the result."""
    H, W = pixels.shape[-2:]
    top, left = -H % multiple // 2, -W % multiple // 2
    bottom, right = -H % multiple - top, -W % multiple - left
    area = (slice(top, top + H), slice(left, left + W))
    return nn.functional.pad(pixels, (left, right, top, bottom)), area


CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class SegEarthOptions(ModelOptions):
    """The settings that name a CLIP and its prompts, and say how the image is shown to it."""

    checkpoint: str = Field(
        "openai/clip-vit-base-patch16", description="a CLIP folder, or an id on the Hugging Face hub"
    )
    prompts: Path | None = Field(None, description="YAML file like configs/models/segearth_uavid.yaml, the default")
    upsampler: Path | None = Field(
        None, description="a SimFeatUp checkpoint (jbu_one); without one, features are upsampled bilinearly"
    )
    resize: int = Field(448, ge=1, description="the longer side at which the image is shown, pixels")
    window: int | None = Field(
        None, ge=1, description="side of a window, pixels; the image size of CLIP's training by default"
    )
    stride: int | None = Field(None, ge=1, description="from window to window, pixels; half a window by default")
    bias: float = Field(-0.3, description="weight of the whole image's likeness to a class: global bias alleviation")
    sharpness: float = Field(50.0, gt=0, description="factor of the likeness before the softmax")


class SegEarthOV(Model):
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
        self._upsampler = None
        if options.upsampler is not None:
            channels, device = int(self._model.config.projection_dim), self._model.device
            self._upsampler = SimFeatUp.load(options.upsampler, channels, device, self._model.dtype)

    @torch.inference_mode()
    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`. Scores know nothing of the threshold below which a label is background."""
        return [self._prediction(image, scores) for image in images]

    def identity(self) -> dict[str, Any]:
        """Return the checkpoints, the settings and the prompts."""
        upsampler = self.options.upsampler
        return {
            "revision": self.checkpoint.revision,
            **self.options.identity(),
            "window": self.window,
            "stride": self.stride,
            "prompts": self.prompts.model_dump(mode="json"),
            "upsampler": "bilinear" if upsampler is None else content_digest(upsampler),
        }

    def _prediction(self, image: Image, scores: bool) -> Prediction:
        pixels = torch.as_tensor(normalised(image, self.options.resize)).to(self._model.device, self._model.dtype)
        logits = slide(pixels, self.window, self.stride, self.window_logits)
        full = bilinear(logits.float(), image.shape[:2])
        of_queries = (self.options.sharpness * full).softmax(dim=0)
        classes = range(len(self.prompts.classes))  # of each class its likeliest name
        probability = torch.stack([of_queries[self._class_of_query == k].amax(dim=0) for k in classes])
        best, label = probability.max(dim=0)
        if self.prompts.background is not None:
            background = self.prompts.names.index(self.prompts.background)
            label = torch.where(best < self.prompts.prob_threshold, background, label)
        labels = narrowed(label.cpu().numpy(), len(probability))
        if not scores:
            return Prediction(labels)
        share = (probability / probability.sum(dim=0)).permute(1, 2, 0).contiguous()
        return Prediction(labels, share.cpu().numpy())

    def window_logits(self, window: torch.Tensor) -> torch.Tensor:
        """Return (queries, h, w) cosines of a window (3, h, w)."""
        pixels, area = padded(window[None], int(self._model.vision_model.config.patch_size))
        global_feature, patches = dense_features(self._model, pixels)
        if self._upsampler is not None:
            patches = self._upsampler(patches, pixels)
        cosine = torch.einsum("qd,dhw->qhw", self.queries, nn.functional.normalize(patches[0], dim=0))
        cosine = (
            cosine
            + self.options.bias * (self.queries @ nn.functional.normalize(global_feature[0], dim=0))[:, None, None]
        )
        return bilinear(cosine, pixels.shape[-2:])[:, *area]

    @torch.inference_mode()
    def _text_features(self, tokenizer: Any, prompts: Prompts) -> torch.Tensor:
        """Return (queries, D): of each name the normalised mean of the normalised features of its sentences."""
        features = []
        for _, name in prompts.queries:
            sentences = [template.format(name) for template in prompts.templates]
            tokens = tokenizer(sentences, padding=True, truncation=True, return_tensors="pt").to(self._model.device)
            output = self._model.get_text_features(**tokens)
            sentence_features = nn.functional.normalize(getattr(output, "pooler_output", output), dim=-1)
            features.append(nn.functional.normalize(sentence_features.mean(dim=0), dim=-1))
        return torch.stack(features)


def normalised(image: Image, longer: int) -> Float32:
    """Return (3, h, w) float32 with CLIP's mean and deviation.

    The image's shape is kept, its longer side becomes `longer`.

    Bilinear without a low-pass filter, as SegEarth-OV does it.
    """
    scale = longer / max(image.shape[:2])
    height, width = (max(1, int(side * scale + 0.5)) for side in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
    mean, deviation = (np.array(values, dtype=np.float32) for values in (CLIP_MEAN, CLIP_STD))
    scaled = (small.astype(np.float32) / np.float32(255) - mean) / deviation
    return np.ascontiguousarray(scaled.transpose(2, 0, 1))
