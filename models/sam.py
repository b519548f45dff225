"""Models `sam-raw`, `sam-heuristic` and `sam-vote`: Segment Anything's proposals as regions, by rules, by votes.

Segment Anything (Kirillov et al. 2023) rates masks at a grid of points; the stable ones stay, each once (section 5 and
appendix B, without crops). The pipeline of transformers needs torchvision, and all masks of a batch at full size.
"""

from __future__ import annotations

import importlib.resources
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
import torch
from pydantic import BaseModel, Field, model_validator
from transformers import AutoModelForMaskGeneration

from semstab.config import Settings, read_yaml, validated
from semstab.core.files import content_key, read_arrays, write_arrays
from semstab.core.types import Float64, Mask, UInt8, UInt16
from semstab.data.frames import Frame
from semstab.data.labels import LabelSpace, ignore_id
from semstab.errors import ConfigError, DataError
from semstab.models import UNASSIGNED, Image, Labels, Model, Prediction, create, image_digest
from semstab.models.checkpoint import Checkpoint, ImageModelOptions, bilinear, load_processor
from semstab.models.validation import Checked, Wrapped

# The kinds of Segment Anything, which differ in their preprocessing.

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class EncodedImage(NamedTuple):
    """An image as the model has encoded it.

    Attributes:
        embedding: Arguments of the model.
        extent: (height, width) of the image in the pixels in which points are given.
        padded: (height, width) of these pixels with the padding, None without any.
    """

    embedding: Mapping[str, Any]
    extent: tuple[int, int]
    padded: tuple[int, int] | None


def encode_sam(model: Any, processor: Any, image: Image) -> EncodedImage:
    """Return an image as Segment Anything, or SAM-HQ, encodes it (Ke et al. 2023).

    The longer side is resized to the model's, the rest is padding.
    """
    inputs = processor(images=image, input_data_format="channels_last", return_tensors="pt")
    height, width = (int(side) for side in inputs["reshaped_input_sizes"][0])
    pixels = inputs["pixel_values"].to(model.device, model.dtype)
    encoded = model.get_image_embeddings(pixels)
    more = () if isinstance(encoded, torch.Tensor) else encoded
    names = ("image_embeddings", "intermediate_embeddings")
    embedding = dict(zip(names, more or (encoded,), strict=False))
    return EncodedImage(embedding, (height, width), (pixels.shape[-2], pixels.shape[-1]))


def encode_sam2(model: Any, settings: Mapping[str, Any], image: Image) -> EncodedImage:
    """Return an image as Segment Anything 2 encodes it (Ravi et al. 2024).

    The image is squeezed into a square; transformers needs torchvision.
    """
    side = int(model.config.prompt_encoder_config.image_size)
    try:
        mean = torch.tensor(settings.get("image_mean") or IMAGENET_MEAN).reshape(3, 1, 1)
        std = torch.tensor(settings.get("image_std") or IMAGENET_STD).reshape(3, 1, 1)
    except (TypeError, ValueError, RuntimeError) as error:
        raise DataError("preprocessor_config.json: image_mean and image_std are three numbers each") from error
    pixels = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    small = torch.nn.functional.interpolate(pixels, size=(side, side), mode="bilinear", antialias=True)
    normalised = ((small - mean) / std).to(model.device, model.dtype)
    return EncodedImage({"image_embeddings": model.get_image_embeddings(normalised)}, (side, side), None)


KINDS = ("SamModel", "SamHQModel", "Sam2Model")

# Proposals: masks at a grid of points, those that the model rates well and that are stable, each once.

MOST_REGIONS = 65535
CACHE_VERSION = 1
"""The version of the method: proposals that an earlier one left in a cache are made again."""


class SamOptions(ImageModelOptions):
    """The settings that name a checkpoint, and say which of its masks are taken."""

    points_per_side: int = Field(
        32, ge=1, le=256, description="points on a side of the grid at which masks are proposed"
    )
    points_per_batch: int = Field(64, ge=1, description="points at a time; it changes speed and memory, not the masks")
    pred_iou: float = Field(0.88, ge=0, le=1, description="masks that the model itself rates lower are dropped")
    stability: float = Field(0.95, ge=0, le=1, description="masks that change more with the threshold are dropped")
    stability_offset: float = Field(1.0, ge=0, description="shift of the threshold up and down, logits")
    nms_iou: float = Field(0.7, ge=0, le=1, description="of masks whose boxes overlap more the better rated one stays")
    min_area: int = Field(100, ge=0, description="masks of fewer pixels are dropped")
    cache: Path | None = Field(None, description="folder that caches proposals, for other uses of the same ones")

    def identity(self) -> dict[str, Any]:
        """Return the options that the regions depend on, without those that a subclass adds."""
        names = set(SamOptions.model_fields) - {"cache", "points_per_batch"}
        return {name: value for name, value in super().identity().items() if name in names}


@dataclass(frozen=True, eq=False)
class Proposals:
    """Masks of one image, packed to bits.

    Attributes:
        shape: (H, W) of the image.
        packed: (n, ceil(H W / 8)) uint8.
        scores: (n,) the model's own estimate of each mask's IoU.
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

    def by_area(self, min_area: int) -> Iterator[Mask]:
        """Yield the masks of at least that many pixels, the largest first; of equal ones the better rated first."""
        areas = np.bitwise_count(self.packed).sum(axis=1, dtype=np.int64)
        for k in np.lexsort((-self.scores, -areas)):
            if areas[k] >= max(1, min_area):
                yield self.mask(int(k))


class SamProposer:
    """A Segment Anything model that proposes masks, with a cache of them where a folder is given.

    Raises:
        DataError: For a checkpoint of another kind.
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
        if kind == "Sam2Model":
            self._encode = partial(encode_sam2, self.model, self.checkpoint.preprocessing())
        else:
            self._encode = partial(encode_sam, self.model, load_processor(self.checkpoint, options.processor))

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
            H, W = cached["shape"].tolist()
            return Proposals((H, W), cached["packed"], cached["scores"])
        proposals = self._propose(image)
        write_arrays(file, vars(proposals))
        return proposals

    @torch.inference_mode()
    def _propose(self, image: Image) -> Proposals:
        """Run the model at all points; of masks that it rates well and that are stable, drop duplicates."""
        encoded, options, (H, W) = self._encode(image), self.options, image.shape[:2]
        points = point_grid(options.points_per_side) * np.array(encoded.extent[::-1])
        grid = torch.as_tensor(points, dtype=self.model.dtype, device=self.model.device)
        packed: list[UInt8] = []
        scores: list[float] = []
        boxes: list[Sequence[int]] = []
        for batch in torch.split(grid, options.points_per_batch):
            output = self.model(**encoded.embedding, input_points=batch[None, :, None, :], multimask_output=True)
            ratings, logits = output.iou_scores[0].flatten().float(), output.pred_masks[0].flatten(0, 1)
            for k in torch.nonzero(ratings > options.pred_iou).flatten().tolist():  # all at full size take gigabytes
                low = logits[k : k + 1].float()
                if encoded.padded is not None:
                    low = bilinear(low, encoded.padded)[..., : encoded.extent[0], : encoded.extent[1]]
                full = bilinear(low, (H, W))[0]
                mask = (full > 0).cpu().numpy()
                if mask.any() and stability_score(full, options.stability_offset) >= options.stability:
                    packed.append(np.packbits(mask))
                    scores.append(float(ratings[k]))
                    boxes.append(cv2.boundingRect(mask.astype(np.uint8)))
        best = np.array(cv2.dnn.NMSBoxes(boxes, scores, 0.0, options.nms_iou), dtype=np.int64)
        masks = np.array(packed, np.uint8).reshape(len(packed), -(-H * W // 8))
        return Proposals((H, W), masks[best], np.array(scores, np.float64)[best])


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


# Model `sam-raw`: the proposals as regions without classes.


class SamRaw(Model):
    """Regions 1, 2, ... from the largest mask to the smallest, smaller masks over larger masks, 0 without a mask.

    Ids mean nothing across frames: `semstab.metrics.matched_region_flicker` compares such maps.
    """

    Options: type[BaseModel] = SamOptions

    def __init__(self, options: SamOptions) -> None:
        self.proposer = SamProposer(options)

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`; there are no scores."""
        min_area = self.proposer.options.min_area
        return [Prediction(self._labels(image, self.proposer.propose(image).by_area(min_area))) for image in images]

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's revision and the settings."""
        return self.proposer.identity()

    def _labels(self, image: Image, masks: Iterator[Mask]) -> Labels:
        return region_map(masks, image.shape[:2])


def region_map(masks: Iterable[Mask], shape: tuple[int, ...]) -> UInt16:
    """Return (H, W) regions 1, 2, ...: masks painted one over the other, UNASSIGNED for pixels without a mask."""
    regions = np.full(shape, UNASSIGNED, dtype=np.uint16)
    for k, mask in enumerate(itertools.islice(masks, MOST_REGIONS), start=1):
        regions[mask] = k
    return regions


# Model `sam-heuristic`: the proposals with classes from rules on colour, size and shape.

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


class MaskRule(Settings):
    """A class, and the limits of its masks' features; see configs/models/sam_heuristic.yaml."""

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
    rules: list[MaskRule] = Field(min_length=1)

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

    rules: Path | None = Field(None, description="YAML file like configs/models/sam_heuristic.yaml, the default")


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

    def _labels(self, image: Image, masks: Iterator[Mask]) -> Labels:
        hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.uint8, copy=False)
        labels = np.full(image.shape[:2], self.rules.names.index(self.rules.rest), dtype=np.uint8)
        for mask in masks:
            labels[mask] = self.rules.class_of(mask_features(hsv, mask))
        return labels


def mask_features(hsv: Image, mask: Mask) -> dict[str, float]:
    """Return the mean colour, area share and aspect of a mask that is not empty; hsv as OpenCV scales it.

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
    """Read the rules of a file, or those that ship.

    Raises:
        ConfigError: If that fails; the message names file and setting.
    """
    shipped = importlib.resources.files("semstab.configs") / "models" / "sam_heuristic.yaml"
    path = path or Path(str(shipped))
    return validated(Rules, read_yaml(path), f"{path}: ")


# Model `sam-vote`: another model's labels, made one inside each of Segment Anything's proposals by majority.


class SamVoteOptions(SamOptions):
    """The proposals, and the model that votes."""

    voter: str = Field(description="the model whose labels vote, e.g. segformer")
    voter_options: dict[str, Any] = Field(default_factory=dict, description="its options, e.g. {checkpoint: FOLDER}")


class SamVote(Wrapped):
    """Masks painted by area, the largest first, each in the label that most of its pixels have (ties: the lowest id).

    Pixels that the voter ignores do not vote; outside the masks its labels stay.

    Raises:
        ConfigError: For a voter without classes.
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
        """See `Model`; there are no scores."""
        min_area = self.proposer.options.min_area
        return [
            Prediction(majority(vote.labels, self.proposer.propose(image).by_area(min_area)))
            for image, vote in zip(images, self.ask(images, False, geometry), strict=True)
        ]

    def identity(self) -> dict[str, Any]:
        """Return the identities of the proposals and of the voter."""
        return self.proposer.identity() | {"voter": self.options.voter, "voter_options": self.inner.identity()}


def majority(labels: Labels, masks: Iterable[Mask]) -> Labels:
    """Return the labels (H, W) with each mask, one over the other, in the label that most of its pixels had."""
    voted = labels.copy()
    for mask in masks:
        inside = labels[mask]
        votes = np.bincount(inside[inside != ignore_id(labels)])
        if votes.size:
            voted[mask] = votes.argmax()
    return voted
