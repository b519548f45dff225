"""Segmentation models behind one protocol: `create("segformer", model="models/segformer-b0")`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from semstab.config import validated
from semstab.core.registry import Entry, Registry
from semstab.core.types import Float32, UInt8, UInt16
from semstab.model.frames import Frame
from semstab.model.labels import IGNORE_8BIT, LabelSpace

REGISTRY = Registry(
    "backbone",
    {
        "colour-clusters": Entry(
            "semstab.backbones.colour_clusters:ColourClusters",
            "k-means of colour and texture, one codebook a sequence: a baseline without weights",
        ),
        "transformers": Entry(
            "semstab.backbones.segmenter:Segmenter",
            "any transformers checkpoint that segments: SegFormer, UPerNet, Mask2Former, OneFormer, EoMT, CLIPSeg, ...",
            install="pip install 'semstab[segformer]'",
        ),
        "segformer": Entry(
            "semstab.backbones.segmenter:Segmenter",
            "the same by its first name",
            install="pip install 'semstab[segformer]'",
        ),
        "sam-raw": Entry(
            "semstab.backbones.sam:SamRaw",
            "Segment Anything's proposals as regions without classes",
            install="pip install 'semstab[sam]'",
        ),
        "sam-heuristic": Entry(
            "semstab.backbones.sam:SamHeuristic",
            "Segment Anything's proposals with classes from rules on colour, size and shape",
            install="pip install 'semstab[sam]'",
        ),
        "sam-vote": Entry(
            "semstab.backbones.sam:SamVote",
            "another backbone's labels, by majority inside Segment Anything's proposals",
            install="pip install 'semstab[sam]'",
        ),
        "segearth-ov": Entry(
            "semstab.backbones.segearth_ov:SegEarthOV",
            "SegEarth-OV: CLIP as an open-vocabulary segmenter, for views from above, without training",
            install="pip install 'semstab[segearth]'",
        ),
        "stored": Entry(
            "semstab.predict.predictor:Stored", "labels that a scene has already, for --filter: --set source=NAME"
        ),
    },
)

Image = UInt8
"""(H, W, 3) uint8 RGB."""

Labels = UInt8 | UInt16

UNASSIGNED = 0
"""The id of a pixel without a region, in the maps of backbones without classes."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a backbone says about one image.

    labels  (H, W) uint8 or uint16: ids of its label space, 255 (65535) where it says nothing; of a backbone without
            classes, region ids from 1, `UNASSIGNED` where there is no region
    scores  (H, W, K) float32 that sum to 1 over the classes, or None where they were not asked for
    """

    labels: Labels
    scores: Float32 | None = None


@dataclass(frozen=True, eq=False)
class Streamed:
    """A prediction whose scores come class by class, so that they never are in memory at once.

    labels  as of a `Prediction`
    maps    gives the scores (H, W) float32 of each class in order, anew at each call
    """

    labels: Labels
    maps: Callable[[], Iterator[Float32]]


class Backbone(Protocol):
    """Images in, label maps or scores out. Its class has `Options`, a pydantic model, and is made with one of it.

    label_space     the classes of its labels and scores, or None where it predicts regions without classes
    gives_scores    whether `predict` can give scores
    fit_frames      how many images `fit` wants, 0 for most
    sequential      whether what it says of an image depends on the images before: it then gets the selected frames of a
                    sequence in order, all of them, from the first one after `reset`
    wants_geometry  whether `predict` is also given `geometry=`, one `Frame` an image: its depth, intrinsics and pose at
                    the image's own pixels, depth 0 where it is not known; labels are all 0, there is no colour
    streams         whether `stream` keeps less in memory than `predict`: it is asked where scores are many
    """

    label_space: LabelSpace | None = None
    gives_scores: bool = False
    fit_frames: int = 0
    sequential: bool = False
    wants_geometry: bool = False
    streams: bool = False

    def fit(self, images: Sequence[Image]) -> Backbone:
        """The backbone adapted to a sequence by its first `fit_frames` images; itself where that is nothing.

        Called once a sequence, before the first `predict`, whatever frames are predicted later.
        """
        return self

    def reset(self) -> None:
        """Forget all images: the next one is the first of a sequence. Called where it is `sequential`."""
        return

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """One prediction an image, in order, of the image's size. The images have one size.

        The result does not depend on how images are put together into batches, but for rounding.
        """
        ...

    def stream(self, image: Image) -> Streamed:
        """What `predict` says with scores, these class by class."""
        (prediction,) = self.predict([image], scores=True)
        return streamed(prediction)

    def identity(self) -> dict[str, Any]:
        """All that its output depends on beside the image, for JSON: settings, and what they name by its content.

        Predictions are kept and reused under it.
        """
        ...


def streamed(prediction: Prediction) -> Streamed:
    """A prediction whose scores, where it has any, are handed out class by class."""
    scores = prediction.scores
    if scores is None:
        return Streamed(prediction.labels, lambda: iter(()))
    return Streamed(prediction.labels, lambda: (scores[..., k] for k in range(scores.shape[2])))


def ask(
    backbone: Backbone, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
) -> list[Prediction]:
    """What a backbone says about images; it is told their geometry where it wants it."""
    more = {"geometry": geometry} if backbone.wants_geometry else {}
    return backbone.predict(images, scores=scores, **more)


def image_digest(image: Image) -> str:
    """A hash of an image's size and colours."""
    content = hashlib.blake2b(repr(image.shape).encode(), digest_size=16)
    content.update(np.ascontiguousarray(image).data)
    return content.hexdigest()


def narrowed(ids: npt.NDArray[Any], classes: int) -> Labels:
    """Class ids as the narrowest type that holds so many classes and the ignore id."""
    return ids.astype(np.uint8) if classes <= IGNORE_8BIT else ids.astype(np.uint16)


def backbone_class(name: str) -> Any:
    """What makes backbones of that name: a registered class, a user's (FILE.py:NAME, package.module:NAME), a network's
    file (net.onnx).

    It has `Options` and is called with them. Raises ConfigError, DataError, MissingDependencyError.
    """
    from semstab.backbones.custom import Own, is_code
    from semstab.backbones.network import NetworkMaker, is_network

    if is_network(name):
        return NetworkMaker(name)
    return Own(name) if is_code(name) else REGISTRY.load(name)


def options_model(name: str) -> type[BaseModel]:
    """The pydantic model of a backbone's options. Raises what `backbone_class` raises."""
    return cast("type[BaseModel]", backbone_class(name).Options)


def create(name: str, **options: Any) -> Backbone:
    """Load a backbone by name with its options.

    Raises ConfigError for an unknown name or option, DataError for a model that cannot be loaded,
    MissingDependencyError where its packages are not installed.
    """
    made_by = backbone_class(name)
    return cast(Backbone, made_by(validated(made_by.Options, options, f"backbone '{name}': ")))
