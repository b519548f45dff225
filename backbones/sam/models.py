"""The kinds of Segment Anything: how each sees an image, and what it says at points of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from transformers import AutoModelForMaskGeneration

from semstab.backbones import Image
from semstab.backbones.pretrained.checkpoint import Checkpoint, bilinear
from semstab.backbones.pretrained.preprocessing import ImageModelOptions, load_processor
from semstab.errors import DataError

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True, eq=False)
class Seen:
    """An image as the model has encoded it.

    embedding  what the model is told beside points
    extent     (height, width) of the image in the pixels in which points are given
    full_size  brings mask logits (h, w) to the image's size
    """

    embedding: Mapping[str, Any]
    extent: tuple[int, int]
    full_size: Callable[[torch.Tensor], torch.Tensor]


class Sam:
    """Segment Anything (Kirillov et al. 2023), and SAM-HQ (Ke et al. 2023), which is asked in the same way."""

    def __init__(self, model: Any, checkpoint: Checkpoint, options: ImageModelOptions) -> None:
        self._model = model
        self._processor = load_processor(checkpoint, options.processor)

    def see(self, image: Image) -> Seen:
        """Encode an image: its longer side brought to the model's, the rest padded."""
        inputs = self._processor(images=image, input_data_format="channels_last", return_tensors="pt")
        height, width = (int(side) for side in inputs["reshaped_input_sizes"][0])
        pixels = inputs["pixel_values"].to(self._model.device, self._model.dtype)
        found = self._model.get_image_embeddings(pixels)
        embedding = self._embedding(found)
        padded = tuple(pixels.shape[-2:])
        return Seen(
            embedding, (height, width), lambda logits: full_size(logits, padded, (height, width), image.shape[:2])
        )

    def _embedding(self, found: Any) -> dict[str, Any]:
        if isinstance(found, torch.Tensor):
            return {"image_embeddings": found}
        return {"image_embeddings": found[0], "intermediate_embeddings": found[1]}


class Sam2:
    """Segment Anything 2 (Ravi et al. 2024) on single images, squeezed into the model's square.

    The preprocessing of transformers needs torchvision; this is what it does, in torch.
    """

    def __init__(self, model: Any, checkpoint: Checkpoint, options: ImageModelOptions) -> None:
        self._model = model
        side = int(model.config.prompt_encoder_config.image_size)
        said = checkpoint.preprocessing()
        self._size = (side, side)
        try:
            self._mean, self._std = (
                torch.tensor(said.get(key) or usual).reshape(3, 1, 1)
                for key, usual in (("image_mean", IMAGENET_MEAN), ("image_std", IMAGENET_STD))
            )
        except (TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{checkpoint.folder}: image_mean and image_std are three numbers each") from error

    def see(self, image: Image) -> Seen:
        """Encode an image."""
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        small = torch.nn.functional.interpolate(pixels, size=self._size, mode="bilinear", antialias=True)
        normalised = ((small - self._mean) / self._std).to(self._model.device, self._model.dtype)
        embedding = {"image_embeddings": self._model.get_image_embeddings(normalised)}
        return Seen(embedding, self._size, lambda logits: bilinear(logits[None], image.shape[:2])[0])


KINDS: Mapping[str, type[Sam | Sam2]] = {"SamModel": Sam, "SamHQModel": Sam, "Sam2Model": Sam2}


def load_model(checkpoint: Checkpoint, options: ImageModelOptions) -> tuple[Any, Sam | Sam2]:
    """The model, and how it sees images. Raises DataError for a checkpoint of another kind."""
    model = checkpoint.load_model(AutoModelForMaskGeneration, options)
    kind = type(model).__name__
    if kind not in KINDS:
        raise DataError(
            f"{checkpoint.folder}: a '{model.config.model_type}' model; name one of sam, sam_hq, sam2 (or sam2_video)"
        )
    return model, KINDS[kind](model, checkpoint, options)


def full_size(logits: torch.Tensor, padded: Any, resized: Any, image: Any) -> torch.Tensor:
    """Mask logits (h, w) of the padded square, without the padding, at the image's size; bilinear each time."""
    square = bilinear(logits[None], padded)
    return bilinear(square[..., : resized[0], : resized[1]], image)[0]
