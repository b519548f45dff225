"""Backbone `segformer`: transformers' checkpoints for semantic segmentation, with torch or with ONNX Runtime."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import torch
import transformers
from pydantic import BaseModel, Field, PositiveInt

from semstab.backbones import Backbone, Image, Prediction, narrowed
from semstab.backbones.checkpoint import Checkpoint, ModelOptions, bilinear
from semstab.model.labels import LabelSpace

Logits = Callable[[torch.Tensor], torch.Tensor]

MULTIPLE = 32
"""Images are brought to multiples of this, the stride of the deepest features."""

CHUNK_BYTES = 1 << 28
"""Memory for upsampled logits at a time."""


class SegformerOptions(ModelOptions):
    """Which checkpoint, at which image size, run by what."""

    image_size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = Field(
        None,
        description="the shorter side in pixels, the shape of the image kept; or [height, width]; where not given, the"
        " shorter side that the checkpoint was made for",
    )
    engine: Literal["torch", "onnx"] = Field("torch", description="torch, or ONNX Runtime on the CPU")


class Segformer(Backbone):
    """The checkpoint's logits, upsampled bilinearly to the image (Xie et al. 2021, NeurIPS, SegFormer).

    Its classes are those of the checkpoint's id2label.
    """

    Options: type[BaseModel] = SegformerOptions
    gives_scores = True

    def __init__(self, options: SegformerOptions) -> None:
        self.options = options
        self.checkpoint = Checkpoint.find(options)
        self.processor = _processor(self.checkpoint)
        model = self.checkpoint.load_model(transformers.AutoModelForSemanticSegmentation, options)
        self.label_space = label_space(model.config.id2label, self.checkpoint.title)
        self.engine = _engine(model, options)

    @torch.inference_mode()
    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`."""
        size = images[0].shape[:2]
        pixels = self.processor(
            images=list(images),
            size=dict(zip(("height", "width"), self._size(size), strict=True)),
            input_data_format="channels_last",
            return_tensors="pt",
        )["pixel_values"]
        return [_prediction(logits, size, scores) for logits in self.engine(pixels)]

    def identity(self) -> dict[str, Any]:
        """The checkpoint's revision and the settings."""
        return {"revision": self.checkpoint.revision, **self.options.identity()}

    def _size(self, image: tuple[int, ...]) -> tuple[int, int]:
        """(height, width) at which the model sees an image of that size."""
        wanted = self.options.image_size
        if isinstance(wanted, tuple):
            return wanted
        return working_size(image, wanted or _shorter_side(self.processor))


def working_size(image: tuple[int, ...], shorter: int) -> tuple[int, int]:
    """(height, width) of the image's shape whose shorter side is about that long, in multiples of 32 pixels.

    >>> working_size((1080, 1920), 512)
    (512, 896)
    """
    scale = shorter / min(image)
    height, width = (max(MULTIPLE, round(side * scale / MULTIPLE) * MULTIPLE) for side in image)
    return height, width


def label_space(id2label: dict[int, str], name: str) -> LabelSpace:
    """The classes of a checkpoint in the order of its logits; names that repeat get their number."""
    names = [" ".join(str(id2label[k]).split()) for k in sorted(id2label)]
    keys = [name.lower() for name in names]
    distinct = [f"{name} {k}" if keys.count(keys[k]) > 1 else name for k, name in enumerate(names)]
    return LabelSpace(name, tuple(distinct))


def argmax_upsampled(logits: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    """(H, W) the class of the largest of the logits (K, h, w) upsampled bilinearly to `size`, the lowest on ties.

    Class by class in chunks: 150 classes at 3840x2160 would take 5 GB at once.
    """
    step = max(1, CHUNK_BYTES // (4 * size[0] * size[1]))
    best, label = bilinear(logits[:step].float(), size).max(dim=0)
    for start in range(step, len(logits), step):
        value, k = bilinear(logits[start : start + step].float(), size).max(dim=0)
        label = torch.where(value > best, k + start, label)
        best = torch.maximum(value, best)
    return label


def _prediction(logits: torch.Tensor, size: tuple[int, ...], scores: bool) -> Prediction:
    labels = narrowed(argmax_upsampled(logits, size).cpu().numpy(), len(logits))
    if not scores:
        return Prediction(labels)
    probability = bilinear(logits.float(), size).softmax(dim=0).permute(1, 2, 0).contiguous()
    return Prediction(labels, probability.cpu().numpy())


def _engine(model: Any, options: SegformerOptions) -> Logits:
    """What turns pixels (N, 3, h, w) into logits (N, K, h', w')."""
    if options.engine == "onnx":
        from semstab.backbones.onnx_engine import OnnxEngine

        return OnnxEngine(model, options)
    return lambda pixels: torch.as_tensor(model(pixel_values=pixels.to(model.device, model.dtype)).logits)


def _processor(checkpoint: Checkpoint) -> Any:
    """The checkpoint's own preprocessing, without a crop.

    Checkpoints of before transformers 5 may name a 'feature extractor' that is no longer there.
    """
    file = checkpoint.folder / "preprocessor_config.json"
    old = file.is_file() and _kind(file) == "SegformerFeatureExtractor"
    processor = checkpoint.load(transformers.SegformerImageProcessorPil if old else transformers.AutoImageProcessor)
    if getattr(processor, "do_center_crop", None):
        processor.do_center_crop = False
    return processor


def _kind(file: Path) -> str | None:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except ValueError:
        return None  # the loader says it better
    kind = content.get("image_processor_type") or content.get("feature_extractor_type")
    return str(kind)


def _shorter_side(processor: Any) -> int:
    """Of the images that the checkpoint was made for, pixels."""
    size = processor.size
    return int(size.get("shortest_edge") or min(size["height"], size["width"]))
