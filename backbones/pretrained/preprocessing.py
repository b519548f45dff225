"""A checkpoint's own preprocessing: how images become what the model was made for."""

from __future__ import annotations

import importlib.util
from typing import Any, Literal

import transformers
from pydantic import Field
from transformers import AutoImageProcessor, SegformerImageProcessorPil

from semstab.backbones.pretrained.checkpoint import Checkpoint, ModelOptions
from semstab.errors import ConfigError, DataError

Processing = Literal["pil", "torchvision"]


class ImageModelOptions(ModelOptions):
    """Which pretrained model, how it runs, and by which library images are resized for it."""

    processor: Processing = Field(
        "pil", description="pil or torchvision: they resize differently, which changes up to 2 % of the labels"
    )


def load_processor(checkpoint: Checkpoint, processing: Processing, **settings: Any) -> Any:
    """The checkpoint's own preprocessing, without a crop, done by the library that is asked for and no other.

    Checkpoints of before transformers 5 may name a 'feature extractor' that is no longer there. Raises ConfigError
    where that library is not installed, DataError where the checkpoint's preprocessing cannot be done by it.
    """
    if processing == "torchvision" and importlib.util.find_spec("torchvision") is None:
        raise ConfigError("processor: torchvision is not installed; leave it out, or pip install torchvision")
    said = checkpoint.preprocessing()
    kind = said.get("image_processor_type") or said.get("feature_extractor_type")
    if processing == "pil" and kind == "SegformerFeatureExtractor":
        processor = checkpoint.load(SegformerImageProcessorPil, **settings)
    else:
        processor = checkpoint.load(AutoImageProcessor, backend=processing, **settings)
    if type(processor).__name__.endswith("Pil") != (processing == "pil"):
        other = "torchvision" if processing == "pil" else "pil"
        raise DataError(
            f"{checkpoint.folder}: its {type(processor).__name__} cannot do its work by {processing}; set processor:"
            f" {other}"
        )
    if getattr(processor, "do_center_crop", None):
        processor.do_center_crop = False
    return processor


def model_type(checkpoint: Checkpoint) -> str:
    """What transformers calls the checkpoint's kind: 'segformer', 'mask2former', ..."""
    return str(checkpoint.load(transformers.AutoConfig).model_type)
