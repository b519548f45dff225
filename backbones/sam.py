"""Backbones `sam-raw`, `sam-heuristic` and `sam-vote`: Segment Anything's proposals as regions, by rules, by votes.

Segment Anything (Kirillov et al. 2023) rates masks at a grid of points; the stable ones are kept, each once. The point
grid, the stability score and the suppression of duplicates follow section 5 and appendix B of the article, without
the crops of its largest setting. The pipeline of transformers is not used: it needs torchvision, has all masks of a
batch at the image's size in memory, and reads no SAM 2 without torchvision's preprocessing.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
import torch
from pydantic import BaseModel, Field, model_validator
from transformers import AutoModelForMaskGeneration

from semstab.backbones import UNASSIGNED, Backbone, Image, Labels, Prediction, create, image_digest
from semstab.backbones.border import Checked, Wrapped
from semstab.backbones.checkpoint import Checkpoint, ImageModelOptions, bilinear, load_processor
from semstab.config import Settings, read_yaml, validated
from semstab.core.files import content_key, read_arrays, write_arrays
from semstab.core.types import Float64, Int64, Mask, UInt8, UInt16
from semstab.errors import ConfigError, DataError
from semstab.model.frames import Frame
from semstab.model.labels import LabelSpace, ignore_id

# The kinds of Segment Anything, which differ in their preprocessing.

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image as the model has encoded it.

    embedding  arguments of the model
    extent     (height, width) of the image in the pixels in which points are given
    full_size  brings mask logits (h, w) to the image's size
    """

    embedding: Mapping[str, Any]
    extent: tuple[int, int]
    full_size: Callable[[torch.Tensor], torch.Tensor]


class Sam:
    """Segment Anything (Kirillov et al. 2023), and SAM-HQ (Ke et al. 2023), which takes the same arguments."""

    def __init__(self, model: Any, checkpoint: Checkpoint, options: ImageModelOptions) -> None:
        self._model = model
        self._processor = load_processor(checkpoint, options.processor)

    def encode(self, image: Image) -> EncodedImage:
        """Encode an image: its longer side is resized to the model's, the rest is padding."""
        inputs = self._processor(images=image, input_data_format="channels_last", return_tensors="pt")
        height, width = (int(side) for side in inputs["reshaped_input_sizes"][0])
        pixels = inputs["pixel_values"].to(self._model.device, self._model.dtype)
        encoded = self._model.get_image_embeddings(pixels)
        if isinstance(encoded, torch.Tensor):
            embedding = {"image_embeddings": encoded}
        else:
            embedding = {"image_embeddings": encoded[0], "intermediate_embeddings": encoded[1]}

        def full_size(logits: torch.Tensor) -> torch.Tensor:
            square = bilinear(logits[None], tuple(pixels.shape[-2:]))
            return bilinear(square[..., :height, :width], image.shape[:2])[0]

        return EncodedImage(embedding, (height, width), full_size)


class Sam2:
    """Segment Anything 2 (Ravi et al. 2024) on single images, squeezed into the model's square.

    The preprocessing of transformers needs torchvision; this does the same in torch.
    """

    def __init__(self, model: Any, checkpoint: Checkpoint, options: ImageModelOptions) -> None:
        self._model = model
        side = int(model.config.prompt_encoder_config.image_size)
        settings = checkpoint.preprocessing()
        self._size = (side, side)
        try:
            self._mean, self._std = (
                torch.tensor(settings.get(key) or usual).reshape(3, 1, 1)
                for key, usual in (("image_mean", IMAGENET_MEAN), ("image_std", IMAGENET_STD))
            )
        except (TypeError, ValueError, RuntimeError) as error:
            raise DataError(f"{checkpoint.folder}: image_mean and image_std are three numbers each") from error

    def encode(self, image: Image) -> EncodedImage:
        """Encode an image."""
        pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        small = torch.nn.functional.interpolate(pixels, size=self._size, mode="bilinear", antialias=True)
        normalised = ((small - self._mean) / self._std).to(self._model.device, self._model.dtype)
        embedding = {"image_embeddings": self._model.get_image_embeddings(normalised)}
        return EncodedImage(embedding, self._size, lambda logits: bilinear(logits[None], image.shape[:2])[0])


KINDS: Mapping[str, type[Sam | Sam2]] = {"SamModel": Sam, "SamHQModel": Sam, "Sam2Model": Sam2}

# Proposals: masks at a grid of points, those that the model rates well and that are stable, each once.

MOST_REGIONS = 65535
CACHE_VERSION = 2
"""Of the method: proposals that an earlier one left in a cache are made again."""


class SamOptions(ImageModelOptions):
    """Which checkpoint, and which of its masks are taken."""

    points_per_side: int = Field(32, ge=1, le=256, description="the image is asked at a grid of so many points a side")
    points_per_batch: int = Field(64, ge=1, description="points at a time; changes speed and memory, not the masks")
    pred_iou: float = Field(0.88, ge=0, le=1, description="masks that the model itself rates lower are dropped")
    stability: float = Field(0.95, ge=0, le=1, description="masks that change more with the threshold are dropped")
    stability_offset: float = Field(1.0, ge=0, description="by how much the threshold is moved up and down, logits")
    nms_iou: float = Field(0.7, ge=0, le=1, description="of masks whose boxes overlap more the better rated one stays")
    min_area: int = Field(100, ge=0, description="masks of fewer pixels are dropped")
    cache: Path | None = Field(None, description="folder that caches proposals, for other uses of the same ones")

    def identity(self) -> dict[str, Any]:
        """Return the options that the regions depend on, without those that a subclass adds."""
        own = set(SamOptions.model_fields) - {"cache", "points_per_batch"}
        return {name: value for name, value in super().identity().items() if name in own}


@dataclass(frozen=True, eq=False)
class Proposals:
    """Masks of one image, packed to bits.

    shape   (H, W) of the image
    packed  (n, ceil(H W / 8)) uint8
    scores  (n,) the model's own estimate of each mask's IoU
    """

    shape: tuple[int, int]
    packed: UInt8
    scores: Float64

    def __len__(self) -> int:
        return len(self.packed)

    def mask(self, k: int) -> Mask:
        """Return (H, W) the pixels of one mask."""
        H, W = self.shape
        return np.unpackbits(self.packed[k], count=H * W).reshape(H, W).astype(np.bool_)

    @property
    def areas(self) -> Int64:
        """(n,) pixels of each."""
        areas: Int64 = np.bitwise_count(self.packed).sum(axis=1, dtype=np.int64)
        return areas

    def by_area(self, min_area: int) -> Iterator[Mask]:
        """Yield the masks of at least that many pixels, the largest first; of equal ones the better rated first."""
        areas = self.areas
        for k in np.lexsort((-self.scores, -areas)):
            if areas[k] >= max(1, min_area):
                yield self.mask(int(k))


class SamProposer:
    """A Segment Anything model that proposes masks, with a cache of them where a folder is given.

    Raises DataError for a checkpoint of another kind.
    """

    def __init__(self, options: SamOptions) -> None:
        self.options = options
        self.checkpoint = Checkpoint.find(options)
        self.model = self.checkpoint.load_model(AutoModelForMaskGeneration, options)
        kind = type(self.model).__name__
        if kind not in KINDS:
            raise DataError(
                f"{self.checkpoint.folder}: a '{self.model.config.model_type}' model; name one of sam, sam_hq, sam2 (or"
                " sam2_video)"
            )
        self._encoder = KINDS[kind](self.model, self.checkpoint, options)

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's revision and the settings."""
        return {"revision": self.checkpoint.revision, **self.options.identity()}

    def propose(self, image: Image) -> Proposals:
        """Return the proposals of an image, of any area."""
        if self.options.cache is None:
            return self._propose(image)
        settings = {name: value for name, value in self.identity().items() if name != "min_area"}
        key = content_key({**settings, "version": CACHE_VERSION})
        file = self.options.cache / key / f"{image_digest(image)}.npz"
        if (cached := read_arrays(file)) is not None:
            return Proposals((int(cached["shape"][0]), int(cached["shape"][1])), cached["packed"], cached["scores"])
        proposals = self._propose(image)
        write_arrays(file, {"shape": proposals.shape, "packed": proposals.packed, "scores": proposals.scores})
        return proposals

    @torch.inference_mode()
    def _propose(self, image: Image) -> Proposals:
        """Ask the model at all points, and drop duplicates."""
        encoded, options = self._encoder.encode(image), self.options
        points = point_grid(options.points_per_side) * np.array(encoded.extent[::-1])
        packed: list[UInt8] = []
        scores: list[float] = []
        boxes: list[Sequence[int]] = []
        for start in range(0, len(points), options.points_per_batch):
            for mask, score in self._masks_at(points[start : start + options.points_per_batch], encoded):
                packed.append(np.packbits(mask))
                scores.append(score)
                boxes.append(cv2.boundingRect(mask.astype(np.uint8)))
        best = np.array(cv2.dnn.NMSBoxes(boxes, scores, 0.0, options.nms_iou), dtype=np.int64)
        (H, W), width = image.shape[:2], -(-image.shape[0] * image.shape[1] // 8)
        return Proposals(
            (H, W), np.array(packed, np.uint8).reshape(-1, width)[best], np.array(scores, np.float64)[best]
        )

    def _masks_at(self, points: Float64, encoded: EncodedImage) -> Iterator[tuple[Mask, float]]:
        """Yield the masks (H, W) at points that the model rates well and that are stable, with their scores.

        One at a time: all of them at the size of a large image would take gigabytes.
        """
        grid = torch.as_tensor(points, dtype=self.model.dtype, device=self.model.device)
        output = self.model(**encoded.embedding, input_points=grid[None, :, None, :], multimask_output=True)
        scores = output.iou_scores[0].flatten().float()
        logits = output.pred_masks[0].flatten(0, 1)
        for k in torch.nonzero(scores > self.options.pred_iou).flatten().tolist():
            full = encoded.full_size(logits[k].float())
            if stability_score(full, self.options.stability_offset) >= self.options.stability:
                mask = (full > 0).cpu().numpy()
                if mask.any():
                    yield mask, float(scores[k])


def point_grid(side: int) -> Float64:
    """Return (side^2, 2) centres (x, y) of the cells of a grid, the image being 1 wide and 1 high.

    >>> point_grid(2).tolist()
    [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]
    """
    centres = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def stability_score(logits: torch.Tensor, offset: float) -> float:
    """Return the IoU of the masks at thresholds `offset` above and below 0; 0 where the larger one is empty."""
    larger = int((logits > -offset).sum())
    return int((logits > offset).sum()) / larger if larger else 0.0


# Backbone `sam-raw`: the proposals as regions without classes.


class SamRaw(Backbone):
    """Regions 1, 2, ... from the largest mask to the smallest, smaller ones over larger ones, 0 where there is none.

    Ids mean nothing across frames: `semstab.metrics.matched_region_flicker` compares such maps.
    """

    Options: type[BaseModel] = SamOptions

    def __init__(self, options: SamOptions) -> None:
        self.proposer = SamProposer(options)

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`; there are no scores."""
        return [Prediction(self._labels(image)) for image in images]

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's revision and the settings."""
        return self.proposer.identity()

    def _labels(self, image: Image) -> Labels:
        return region_map(self.proposer.propose(image), self.proposer.options.min_area)


def region_map(proposals: Proposals, min_area: int) -> UInt16:
    """Return (H, W) regions 1, 2, ...: masks painted by area, the largest first; UNASSIGNED where there is none."""
    regions = np.full(proposals.shape, UNASSIGNED, dtype=np.uint16)
    for k, mask in enumerate(proposals.by_area(min_area), start=1):
        if k > MOST_REGIONS:
            break
        regions[mask] = k
    return regions


# Backbone `sam-heuristic`: the proposals with classes from rules on colour, size and shape.

HUES = 180
"""OpenCV's hue runs from 0 to 180."""


class Range(Settings):
    """Limits of a value."""

    min: float | None = None
    max: float | None = None
    above: float | None = None
    below: float | None = None
    outside: tuple[float, float] | None = None

    def holds(self, value: float) -> bool:
        """Return whether the value is within the limits."""
        return (
            (self.min is None or value >= self.min)
            and (self.max is None or value <= self.max)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
            and (self.outside is None or not self.outside[0] <= value <= self.outside[1])
        )


class Rule(Settings):
    """A class, and the limits of its masks' features; see configs/backbones/sam_heuristic.yaml."""

    name: str
    hue: Range = Range()
    saturation: Range = Range()
    value: Range = Range()
    area: Range = Range()
    aspect: Range = Range()

    def holds(self, features: dict[str, float]) -> bool:
        """Return whether a mask with these features is of this class."""
        return all(getattr(self, name).holds(value) for name, value in features.items())


class Rules(Settings):
    """The rules in their order, the classes in the order of their ids, and the class of the rest."""

    classes: list[str] = Field(min_length=1)
    rest: str
    rules: list[Rule] = Field(min_length=1)

    @model_validator(mode="after")
    def _classes_are_known(self) -> Self:
        if unknown := [rule.name for rule in self.rules if rule.name not in self.names]:
            raise ValueError(f"the rule '{unknown[0]}' has no class of that name; add it to classes")
        return self

    @property
    def names(self) -> list[str]:
        """All classes."""
        return [*self.classes, self.rest] if self.rest not in self.classes else self.classes

    def class_of(self, features: dict[str, float]) -> int:
        """Return the id of the first rule that holds."""
        return self.names.index(next((rule.name for rule in self.rules if rule.holds(features)), self.rest))


class SamHeuristicOptions(SamOptions):
    """The proposals and the rules."""

    rules: Path | None = Field(
        None, description="YAML file like configs/backbones/sam_heuristic.yaml, which is the default"
    )


class SamHeuristic(SamRaw):
    """Masks painted by area, the largest first, each in the class of the first rule that holds for it."""

    Options: type[BaseModel] = SamHeuristicOptions

    def __init__(self, options: SamHeuristicOptions) -> None:
        self.rules = read_rules(options.rules)
        self.label_space = LabelSpace("sam heuristic", tuple(self.rules.names))
        super().__init__(options)

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's revision, the settings and the rules."""
        return self.proposer.identity() | {"rules": self.rules.model_dump(mode="json")}

    def _labels(self, image: Image) -> Labels:
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.uint8, copy=False)
        labels = np.full(image.shape[:2], self.rules.names.index(self.rules.rest), dtype=np.uint8)
        for mask in self.proposer.propose(image).by_area(self.proposer.options.min_area):
            labels[mask] = self.rules.class_of(mask_features(hsv, mask))
        return labels


def mask_features(hsv: Image, mask: Mask) -> dict[str, float]:
    """Return mean colour, area share and aspect of a mask that is not empty; hsv as OpenCV scales it.

    The mean hue is that of the summed unit vectors: of 179 and 3 it is 1.
    """
    hue, saturation, value = hsv[mask].astype(np.float64).T
    angle = 2 * np.pi / HUES * hue
    mean = np.arctan2(np.sin(angle).sum(), np.cos(angle).sum()) * HUES / (2 * np.pi)
    *_, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return {
        "hue": float(mean % HUES),
        "saturation": float(saturation.mean()),
        "value": float(value.mean()),
        "area": len(hue) / mask.size,
        "aspect": max(width, height) / min(width, height),
    }


def read_rules(path: Path | None) -> Rules:
    """Read the rules of a file, or those that ship. Raises ConfigError that names file and setting."""
    shipped = importlib.resources.files("semstab.configs") / "backbones" / "sam_heuristic.yaml"
    path = path or Path(str(shipped))
    return validated(Rules, read_yaml(path), f"{path}: ")


# Backbone `sam-vote`: another backbone's labels, made one inside each of Segment Anything's proposals by majority.


class SamVoteOptions(SamOptions):
    """The proposals, and who votes."""

    voter: str = Field(description="the backbone whose labels vote, e.g. segformer")
    voter_options: dict[str, Any] = Field(default_factory=dict, description="its options, e.g. {model: FOLDER}")


class SamVote(Wrapped):
    """Masks painted by area, the largest first, each in the label that most of its pixels have (ties: the lowest id).

    Pixels that the voter ignores do not vote; outside the masks its labels stay.
    Raises ConfigError for a voter without classes.
    """

    Options: type[BaseModel] = SamVoteOptions

    def __init__(self, options: SamVoteOptions) -> None:
        super().__init__(Checked(create(options.voter, **options.voter_options), options.voter))
        self.options = options
        if self.label_space is None:
            raise ConfigError(f"sam-vote: the voter '{options.voter}' has no classes; choose one that has")
        self.gives_scores = False
        self.proposer = SamProposer(options)

    def predict(
        self, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
    ) -> list[Prediction]:
        """See `Backbone`; there are no scores."""
        min_area = self.proposer.options.min_area
        return [
            Prediction(majority(vote.labels, self.proposer.propose(image), min_area))
            for image, vote in zip(images, self.ask(images, False, geometry), strict=True)
        ]

    def identity(self) -> dict[str, Any]:
        """Return the identities of the proposals and of the voter."""
        return self.proposer.identity() | {"voter": self.options.voter, "voter_options": self.inner.identity()}


def majority(labels: Labels, proposals: Proposals, min_area: int) -> Labels:
    """Return the labels (H, W) with each mask in the label that most of its pixels had, the largest mask first."""
    voted = labels.copy()
    for mask in proposals.by_area(min_area):
        inside = labels[mask]
        votes = np.bincount(inside[inside != ignore_id(labels)])
        if votes.size:
            voted[mask] = votes.argmax()
    return voted
