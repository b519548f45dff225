"""Model `transformers`: checkpoints that segment into classes, whatever their kind; once called `segformer`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import transformers
from pydantic import BaseModel

from semstab.core.types import Float32
from semstab.data.labels import IGNORE_8BIT, IGNORE_16BIT, LabelSpace
from semstab.errors import ConfigError
from semstab.models import Image, Model, Prediction, Streamed, narrowed
from semstab.models.checkpoint import Checkpoint, SegmenterOptions, bilinear
from semstab.models.heads import load_head

CHUNK_BYTES = 1 << 26
"""Memory for upsampled maps at a time."""


class Segmenter(Model):
    """The class of the largest value that the checkpoint gives a pixel, its maps upsampled bilinearly to the image.

    Its classes are those of the checkpoint's id2label, or the prompts. See `heads` for these values.
    """

    Options: type[BaseModel] = SegmenterOptions
    gives_scores = True
    streams = True

    def __init__(self, options: SegmenterOptions) -> None:
        self.options = options
        self.checkpoint = Checkpoint.find(options)
        kind = str(self.checkpoint.load(transformers.AutoConfig).model_type)
        if kind != "clipseg" and (options.prompts or options.threshold):
            raise ConfigError(f"prompts and threshold are for 'clipseg' models, not for '{kind}'; leave them out")
        self.head = load_head(self.checkpoint, options, kind)
        self.label_space = label_space(self.head.names, self.checkpoint.title)

    @torch.inference_mode()
    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`."""
        predictions = []
        for maps in self.head.maps(images):
            streamed = self._streamed(maps, images[0].shape[:2])
            all_scores = None
            if scores:
                all_scores = np.empty((*streamed.labels.shape, len(maps)), dtype=np.float32)
                for k, values in enumerate(streamed.maps()):
                    all_scores[..., k] = values
            predictions.append(Prediction(streamed.labels, all_scores))
        return predictions

    @torch.inference_mode()
    def stream(self, image: Image) -> Streamed:
        """See `Model`."""
        (maps,) = self.head.maps([image])
        return self._streamed(maps, image.shape[:2])

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's revision and the settings."""
        return {"revision": self.checkpoint.revision, **self.options.identity()}

    def _streamed(self, maps: torch.Tensor, size: tuple[int, ...]) -> Streamed:
        best, label = largest_upsampled(maps, size)
        sure = None
        if self.options.threshold is not None:
            sure = best.sigmoid() >= self.options.threshold
            label = torch.where(sure, label, IGNORE_8BIT if len(maps) <= IGNORE_8BIT else IGNORE_16BIT)
        labels = narrowed(label.cpu().numpy(), len(maps))
        return Streamed(labels, lambda: _shares(maps, size, best if self.head.softmax else None, sure))


def _shares(
    maps: torch.Tensor, size: tuple[int, ...], largest: torch.Tensor | None, sure: torch.Tensor | None
) -> Iterator[Float32]:
    """Yield the share (H, W) of each class's upsampled map in all: the softmax where the largest is given.

    The share is 0 at pixels that are 0 for all classes, or whose label is not sure. Each map is upsampled twice, and
    not stored.
    """

    def weight(k: int) -> torch.Tensor:
        upsampled = bilinear(maps[k : k + 1].float(), size)[0]
        return upsampled if largest is None else (upsampled - largest).exp()

    total = weight(0)
    for k in range(1, len(maps)):
        total = total + weight(k)
    labelled = total > 0 if sure is None else sure & (total > 0)
    for k in range(len(maps)):
        yield torch.where(labelled, weight(k) / total, 0.0).cpu().numpy()


def label_space(id2label: Mapping[int, str], name: str) -> LabelSpace:
    """Return the classes of a checkpoint in the order of its logits; names that repeat get their number."""
    names = [" ".join(str(id2label[k]).split()) for k in sorted(id2label)]
    keys = [name.lower() for name in names]
    distinct = [f"{name} {k}" if keys.count(keys[k]) > 1 else name for k, name in enumerate(names)]
    return LabelSpace(name, tuple(distinct))


def largest_upsampled(maps: torch.Tensor, size: tuple[int, ...]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (H, W) the largest of maps (K, h, w), upsampled bilinearly to `size`, and its index (ties: the lowest).

    Class by class in chunks: 150 classes at 3840x2160 would take 5 GB at once.
    """
    step = max(1, CHUNK_BYTES // (4 * size[0] * size[1]))
    best, label = bilinear(maps[:step].float(), size).max(dim=0)
    for start in range(step, len(maps), step):
        value, k = bilinear(maps[start : start + step].float(), size).max(dim=0)
        label = torch.where(value > best, k + start, label)
        best = torch.maximum(value, best)
    return best, label
