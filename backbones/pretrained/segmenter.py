"""Backbone `transformers`: checkpoints that segment into classes, whatever their kind; once called `segformer`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from pydantic import BaseModel

from semstab.backbones import Backbone, Image, Prediction, narrowed
from semstab.backbones.pretrained.checkpoint import Checkpoint, bilinear
from semstab.backbones.pretrained.heads import load_head
from semstab.backbones.pretrained.options import SegmenterOptions
from semstab.backbones.pretrained.preprocessing import model_type
from semstab.errors import ConfigError
from semstab.model.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace

CHUNK_BYTES = 1 << 28
"""Memory for upsampled maps at a time."""


class Segmenter(Backbone):
    """The class of the largest value that the checkpoint gives a pixel, its maps upsampled bilinearly to the image.

    Its classes are those of the checkpoint's id2label, or the prompts. What the values are: see `heads`.
    """

    Options: type[BaseModel] = SegmenterOptions
    gives_scores = True

    def __init__(self, options: SegmenterOptions) -> None:
        self.options = options
        self.checkpoint = Checkpoint.find(options)
        kind = model_type(self.checkpoint)
        if kind != "clipseg" and (options.prompts or options.threshold):
            raise ConfigError(f"prompts and threshold are for 'clipseg' models, not for '{kind}'; leave them out")
        self.head = load_head(self.checkpoint, options, kind)
        self.label_space = label_space(self.head.names, self.checkpoint.title)

    @torch.inference_mode()
    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Backbone`."""
        size = images[0].shape[:2]
        return [self._prediction(maps, size, scores) for maps in self.head.maps(images)]

    def identity(self) -> dict[str, Any]:
        """The checkpoint's revision and the settings."""
        return {"revision": self.checkpoint.revision, **self.options.identity()}

    def _prediction(self, maps: torch.Tensor, size: tuple[int, ...], scores: bool) -> Prediction:
        best, label = largest_upsampled(maps, size)
        if self.options.threshold is not None:
            unsure = best.sigmoid() < self.options.threshold
            label = torch.where(unsure, IGNORE_8BIT if len(maps) <= IGNORE_8BIT else IGNORE_16BIT, label)
        labels = narrowed(label.cpu().numpy(), len(maps))
        if not scores:
            return Prediction(labels)
        shares = self.head.shares(bilinear(maps.float(), size)).permute(1, 2, 0).contiguous().cpu().numpy()
        if self.options.threshold is not None:
            shares[unsure.cpu().numpy()] = 0
        return Prediction(labels, shares)


def label_space(id2label: Mapping[int, str], name: str) -> LabelSpace:
    """The classes of a checkpoint in the order of its logits; names that repeat get their number."""
    names = [" ".join(str(id2label[k]).split()) for k in sorted(id2label)]
    keys = [name.lower() for name in names]
    distinct = [f"{name} {k}" if keys.count(keys[k]) > 1 else name for k, name in enumerate(names)]
    return LabelSpace(name, tuple(distinct))


def largest_upsampled(maps: torch.Tensor, size: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W) the largest of the maps (K, h, w) upsampled bilinearly to `size`, and whose it is, the lowest on ties.

    Class by class in chunks: 150 classes at 3840x2160 would take 5 GB at once.
    """
    step = max(1, CHUNK_BYTES // (4 * size[0] * size[1]))
    best, label = bilinear(maps[:step].float(), size).max(dim=0)
    for start in range(step, len(maps), step):
        value, k = bilinear(maps[start : start + step].float(), size).max(dim=0)
        label = torch.where(value > best, k + start, label)
        best = torch.maximum(value, best)
    return best, label
