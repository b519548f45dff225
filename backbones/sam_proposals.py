"""Segment Anything's proposals: masks at a grid of points, the sure and stable ones, each once (Kirillov et al. 2023).

The point grid, the stability score and the suppression of duplicates are done here, after section 5 and appendix B of
the article, without the crops of its largest setting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import Field
from transformers import AutoModelForMaskGeneration

from semstab.backbones import UNASSIGNED, Image, image_digest
from semstab.backbones.checkpoint import Checkpoint, ImageModelOptions, bilinear, load_processor
from semstab.core.files import content_key, read_arrays, write_arrays
from semstab.core.types import Float64, Int64, Mask, UInt8, UInt16
from semstab.errors import DataError

# The kinds of Segment Anything: how each sees an image, and what it says at points of it.

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


Array = Float64

MOST_REGIONS = 65535


class SamOptions(ImageModelOptions):
    """Which checkpoint, and which of its masks are kept."""

    points_per_side: int = Field(32, ge=1, le=256, description="the image is asked at a grid of so many points a side")
    points_per_batch: int = Field(64, ge=1, description="points at a time; changes speed and memory, not the masks")
    pred_iou: float = Field(0.88, ge=0, le=1, description="masks that the model itself rates lower are dropped")
    stability: float = Field(0.95, ge=0, le=1, description="masks that change more with the threshold are dropped")
    stability_offset: float = Field(1.0, ge=0, description="by how much the threshold is moved up and down, logits")
    nms_iou: float = Field(0.7, ge=0, le=1, description="of masks whose boxes overlap more the better rated one stays")
    min_area: int = Field(100, ge=0, description="masks of fewer pixels are dropped")
    cache: Path | None = Field(None, description="folder that keeps proposals, for other uses of the same ones")

    def identity(self) -> dict[str, Any]:
        """The options that the regions depend on, without those that a use of the regions adds."""
        own = set(SamOptions.model_fields) - {"cache", "points_per_batch"}
        return {name: value for name, value in super().identity().items() if name in own}


@dataclass(frozen=True, eq=False)
class Proposals:
    """Masks of one image, packed to bits.

    shape   (H, W) of the image
    packed  (n, ceil(H W / 8)) uint8
    scores  (n,) the model's own estimate of each mask's IoU
    boxes   (n, 4) x0, y0, x1, y1 of their pixels, both ends included
    """

    shape: tuple[int, int]
    packed: UInt8
    scores: Array
    boxes: Array

    def __len__(self) -> int:
        return len(self.packed)

    def mask(self, k: int) -> Mask:
        """(H, W) the pixels of one."""
        H, W = self.shape
        return np.unpackbits(self.packed[k], count=H * W).reshape(H, W).astype(np.bool_)

    @property
    def areas(self) -> Int64:
        """(n,) pixels of each."""
        areas: Int64 = np.bitwise_count(self.packed).sum(axis=1, dtype=np.int64)
        return areas

    def by_area(self, min_area: int) -> Iterator[Mask]:
        """The masks of at least that many pixels, the largest first; of equal ones the better rated first."""
        areas = self.areas
        for k in np.lexsort((-self.scores, -areas)):
            if areas[k] >= max(1, min_area):
                yield self.mask(int(k))


class SamProposer:
    """A Segment Anything model that proposes masks, and keeps them in a folder where one is named."""

    def __init__(self, options: SamOptions) -> None:
        self.options = options
        self.checkpoint = Checkpoint.find(options)
        self.model, self._eye = load_model(self.checkpoint, options)

    def identity(self) -> dict[str, Any]:
        """The checkpoint's revision and the settings."""
        return {"revision": self.checkpoint.revision, **self.options.identity()}

    def propose(self, image: Image) -> Proposals:
        """The proposals of an image; `min_area` is left to whoever uses them."""
        if self.options.cache is None:
            return self._propose(image)
        file = self.options.cache / self._key() / f"{image_digest(image)}.npz"
        if (kept := read_arrays(file)) is not None:
            return Proposals((int(kept["shape"][0]), int(kept["shape"][1])), *(kept[name] for name in KEPT))
        proposals = self._propose(image)
        write_arrays(file, {"shape": proposals.shape, **{name: getattr(proposals, name) for name in KEPT}})
        return proposals

    def _key(self) -> str:
        """Of the settings that proposals depend on."""
        settings = {name: value for name, value in self.identity().items() if name != "min_area"}
        return content_key(settings)

    @torch.inference_mode()
    def _propose(self, image: Image) -> Proposals:
        seen = self._eye.see(image)
        points = point_grid(self.options.points_per_side) * np.array(seen.extent[::-1])
        kept = [
            found
            for start in range(0, len(points), self.options.points_per_batch)
            for found in self._ask(seen, points[start : start + self.options.points_per_batch])
        ]
        return _without_duplicates(kept, (image.shape[0], image.shape[1]), self.options.nms_iou)

    def _ask(self, seen: Seen, points: Array) -> Iterator[_Found]:
        """The masks at these points that the model rates well and that are stable."""
        where = torch.as_tensor(points, dtype=self.model.dtype, device=self.model.device)
        found = self.model(**seen.embedding, input_points=where[None, :, None, :], multimask_output=True)
        scores = found.iou_scores[0].flatten().float()
        masks = found.pred_masks[0].flatten(0, 1)
        for k in torch.nonzero(scores > self.options.pred_iou).flatten().tolist():
            logits = seen.full_size(masks[k].float())
            if stability_score(logits, self.options.stability_offset) >= self.options.stability:
                mask = (logits > 0).cpu().numpy()
                if mask.any():
                    yield _Found(np.packbits(mask), float(scores[k]), _box(mask))


KEPT = ("packed", "scores", "boxes")


def region_map(proposals: Proposals, min_area: int) -> UInt16:
    """(H, W) uint16 regions 1, 2, ...: masks painted by area, the largest first; UNASSIGNED where there is none."""
    regions = np.full(proposals.shape, UNASSIGNED, dtype=np.uint16)
    for k, mask in enumerate(proposals.by_area(min_area), start=1):
        if k > MOST_REGIONS:
            break
        regions[mask] = k
    return regions


def point_grid(side: int) -> Array:
    """(side^2, 2) centres (x, y) of the cells of a grid, the image being 1 wide and 1 high.

    >>> point_grid(2).tolist()
    [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    """
    centres = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def stability_score(logits: torch.Tensor, offset: float) -> float:
    """IoU of the masks at thresholds `offset` above and below 0; 0 where the larger one is empty."""
    larger = int((logits > -offset).sum())
    return int((logits > offset).sum()) / larger if larger else 0.0


def suppress(boxes: Array, scores: Array, iou: float) -> list[int]:
    """Greedy non-maximum suppression: the rows that stay, the best first; the first one on ties.

    boxes   (n, 4) x0, y0, x1, y1
    """
    order = np.argsort(-scores, kind="stable")
    stay: list[int] = []
    while order.size:
        best, order = int(order[0]), order[1:]
        stay.append(best)
        order = order[_box_iou(boxes[best], boxes[order]) <= iou]
    return stay


def _box_iou(box: Array, others: Array) -> Array:
    """(n,) IoU of a box with each of (n, 4) others; 0 where both are empty."""
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    shared = np.maximum(sides, 0).prod(axis=1)
    whole = (box[2:] - box[:2]).prod() + (others[:, 2:] - others[:, :2]).prod(axis=1) - shared
    iou: Array = np.divide(shared, whole, out=np.zeros_like(shared), where=whole > 0)
    return iou


@dataclass(frozen=True, eq=False)
class _Found:
    """A mask, packed, before duplicates are taken out."""

    packed: UInt8
    score: float
    box: tuple[int, int, int, int]


def _without_duplicates(found: list[_Found], shape: tuple[int, int], iou: float) -> Proposals:
    boxes = np.array([mask.box for mask in found], dtype=np.float64).reshape(-1, 4)
    scores = np.array([mask.score for mask in found], dtype=np.float64)
    stay = suppress(boxes, scores, iou)
    width = -(-shape[0] * shape[1] // 8)
    packed = np.array([found[k].packed for k in stay], dtype=np.uint8).reshape(-1, width)
    return Proposals(shape, packed, scores[stay], boxes[stay])


def _box(mask: Mask) -> tuple[int, int, int, int]:
    """Of a mask that is not empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])
