"""Segmentation models behind one protocol: `create("segformer", checkpoint="models/segformer-b0")`.

Examples:
    >>> model = semstab.models.create("colour-clusters", clusters=4)
    >>> model.gives_scores
    True
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from semstab.config import validated
from semstab.core.process import printing_aside
from semstab.core.registry import Registration, Registry
from semstab.core.types import Float32, UInt8, UInt16
from semstab.data.frames import Frame
from semstab.data.labels import IGNORE_8BIT, LabelSpace

SEGMENTER, SAM = "semstab.models.segmenter:Segmenter", "semstab.models.sam:"
NETWORKS = ("torch", "transformers")
WITH_SEGFORMER, WITH_SAM = "pip install 'semstab[segformer]'", "pip install 'semstab[sam]'"

REGISTRY = Registry(
    "model",
    {
        "colour-clusters": Registration(
            "semstab.models.colour_clusters:ColourClusters",
            "baseline without weights: k-means of colour, texture",
        ),
        "transformers": Registration(
            SEGMENTER,
            "any segmentation checkpoint of transformers",
            install=WITH_SEGFORMER,
            needs=NETWORKS,
        ),
        "segformer": Registration(SEGMENTER, "the same as transformers", install=WITH_SEGFORMER, needs=NETWORKS),
        "sam-raw": Registration(
            SAM + "SamRaw", "Segment Anything; regions without classes", install=WITH_SAM, needs=NETWORKS
        ),
        "sam-heuristic": Registration(
            SAM + "SamHeuristic",
            "Segment Anything; classes by rules on colour, size",
            install=WITH_SAM,
            needs=NETWORKS,
        ),
        "sam-vote": Registration(
            SAM + "SamVote",
            "another model's labels, by majority in SAM's regions",
            install=WITH_SAM,
            needs=NETWORKS,
        ),
        "segearth-ov": Registration(
            "semstab.models.segearth_ov:SegEarthOV",
            "SegEarth-OV: open-vocabulary CLIP for aerial views",
            install="pip install 'semstab[segearth]'",
            needs=NETWORKS,
        ),
        "smp": Registration(
            "semstab.models.smp:SmpNetwork",
            "networks of segmentation_models_pytorch, by name",
            install="pip install 'semstab[smp]'",
            needs=("torch", "segmentation_models_pytorch"),
        ),
        "stored": Registration("semstab.predict.predictor:Stored", "labels that the scene has already, for --filter"),
    },
)

Image = UInt8
"""(H, W, 3) uint8 RGB."""

Labels = UInt8 | UInt16

UNASSIGNED = 0
"""The id of a pixel without a region, in the maps of models without classes."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prediction of a model for one image.

    Attributes:
        labels: (H, W) uint8 or uint16: ids of the model's label space, 255 (65535) for pixels without a prediction. A
            model without classes gives region ids from 1, `UNASSIGNED` for pixels without a region.
        scores: (H, W, K) float32 that sum to 1 over the classes, or None if only labels are requested.
        features: (h, w, D) float16 or float32 of a grid that covers the image evenly, of a model that gives features.
    """

    labels: Labels
    scores: Float32 | None = None
    features: npt.NDArray[np.floating[Any]] | None = None


@dataclass(frozen=True, eq=False)
class Streamed:
    """A prediction whose scores come class by class, so that they never are in memory at once.

    Attributes:
        labels: Labels, as a `Prediction` has them.
        maps: A function that returns an iterator over the scores (H, W) float32 of each class, in order of the
            classes; each call returns a new iterator.
        features: Features, as a `Prediction` has them.
    """

    labels: Labels
    maps: Callable[[], Iterator[Float32]]
    features: npt.NDArray[np.floating[Any]] | None = None


class Model(Protocol):
    """Images in, label maps or scores out. Its class has `Options`, a pydantic model, and is made with one of it.

    Attributes:
        label_space: The classes of its labels and scores, or None if it predicts regions without classes.
        gives_scores: Whether `predict` can give scores.
        fit_frames: Number of images that `fit` wants, 0 for most.
        sequential: Whether its prediction on an image depends on the images before: it then gets the selected frames of
            a sequence in order, all of them, from the first one after `reset`.
        wants_geometry: Whether `predict` is also given `geometry=`, one `Frame` an image: its depth, intrinsics and
            pose at the image's own pixels, depth 0 if unknown. Labels are all 0, and there is no colour.
        gives_features: Whether its predictions have features; without labels its label space is
            `semstab.data.features.OF_FEATURES`, and all labels are 0.
        streams: Whether `stream` needs less memory than `predict`: it is called where scores are many.
    """

    label_space: LabelSpace | None = None
    gives_scores: bool = False
    fit_frames: int = 0
    sequential: bool = False
    wants_geometry: bool = False
    gives_features: bool = False
    streams: bool = False

    def fit(self, images: Sequence[Image]) -> Model:
        """Return the model adapted to a sequence by its first `fit_frames` images; itself if there is nothing to adapt.

        Called once a sequence, before the first `predict`, whatever frames are predicted later.
        """
        return self

    def reset(self) -> None:
        """Forget all images: the next image is the first of a sequence. Called if the model is `sequential`."""
        return

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """Return one prediction an image, in order, of the image's size. The images have one size.

        The result does not depend on how images are put together into batches, but for rounding.
        """
        ...

    def stream(self, image: Image) -> Streamed:
        """Return the predictions of `predict` with scores, these class by class."""
        (prediction,) = self.predict([image], scores=True)
        return streamed(prediction)

    def identity(self) -> dict[str, Any]:
        """Return what the output depends on apart from the image, for JSON: settings, and the content of named files.

        Predictions are stored and reused under it.
        """
        ...


def streamed(prediction: Prediction) -> Streamed:
    """Return the prediction with its scores, if any, as an iterator over classes."""
    scores = prediction.scores
    maps = lambda: iter(() if scores is None else np.moveaxis(scores, 2, 0))  # noqa: E731
    return Streamed(prediction.labels, maps, prediction.features)


def ask(
    model: Model, images: Sequence[Image], *, scores: bool = False, geometry: Sequence[Frame] = ()
) -> list[Prediction]:
    """Return the predictions of a model; a model that wants geometry gets the geometry of the images."""
    more = {"geometry": geometry} if model.wants_geometry else {}
    return model.predict(images, scores=scores, **more)


def content_digest(path: Path) -> str:
    """Return a hash of a file, or of the names and contents of all files in a folder.

    That of an ONNX file is also of the files that it stores weights in.
    """
    digest = hashlib.blake2b(digest_size=16)
    if path.is_file():
        files = [path, *(path.parent / name for name in external_data(path))]
    else:
        files = sorted(entry for entry in path.rglob("*") if entry.is_file())
    for file in files:
        digest.update(b"" if file == path else os.path.relpath(file, path).encode() + b"\0")
        with file.open("rb") as opened:
            hashlib.file_digest(opened, lambda: digest)
    return digest.hexdigest()


def external_data(path: Path) -> list[str]:
    """Return the files, relative to its folder, in which an ONNX file stores weights; of other files none."""
    if path.suffix != ".onnx":
        return []
    try:
        import onnx
    except ImportError:  # its usual name: without the package nothing tells others
        return [name for name in [f"{path.name}.data"] if path.with_name(name).is_file()]
    try:
        model = onnx.load(path, load_external_data=False)
    except Exception:  # noqa: BLE001 - what is no ONNX file has none; whoever loads it says so
        return []
    return sorted(
        {
            entry.value
            for tensor in _tensors(model.graph)
            for entry in tensor.external_data
            if entry.key == "location" and (path.parent / entry.value).is_file()
        }
    )


def _tensors(graph: Any) -> Iterator[Any]:
    """Yield the stored tensors of an ONNX graph and of the graphs inside its nodes."""
    yield from graph.initializer
    for attribute in (entry for node in graph.node for entry in node.attribute):
        yield from (attribute.t, *attribute.tensors)
        for inner in (attribute.g, *attribute.graphs):
            yield from _tensors(inner)


def image_digest(image: Image) -> str:
    """Return a hash of an image's size and colours."""
    content = hashlib.blake2b(repr(image.shape).encode(), digest_size=16)
    content.update(np.ascontiguousarray(image).data)
    return content.hexdigest()


def narrowed(ids: npt.NDArray[Any], classes: int) -> Labels:
    """Return the class ids in the narrowest type that holds this number of classes and the ignore id."""
    return ids.astype(np.uint8) if classes <= IGNORE_8BIT else ids.astype(np.uint16)


def sides(value: Any) -> Any:
    """Return the text HEIGHTxWIDTH as two numbers, and all else as it is; for options of sizes."""
    match = re.fullmatch(r"\s*(\d{1,9})\s*x\s*(\d{1,9})\s*", value, re.IGNORECASE) if isinstance(value, str) else None
    return value if match is None else [int(side) for side in match.groups()]


def maker(name: str) -> tuple[type[BaseModel], Callable[[Any], Model]]:
    """Return the options of models of that name, and their constructor, which takes them.

    A name is that of a registered class, of a user's code (FILE.py:NAME, package.module:NAME), or of a network's file
    (net.onnx).

    Raises:
        ConfigError, DataError, MissingDependencyError: If it cannot be loaded.
    """
    from semstab.core.code import is_code
    from semstab.models.custom import own_maker
    from semstab.models.network import NetworkFile, NetworkOptions, is_network

    if is_network(name):
        return NetworkOptions, partial(NetworkFile, Path(name).expanduser())
    if is_code(name):
        return own_maker(name)
    registered = REGISTRY.load(name)
    return registered.Options, registered


def options_model(name: str) -> type[BaseModel]:
    """Return the pydantic model of a model's options. Raises what `maker` raises."""
    return maker(name)[0]


def create(name: str, **options: Any) -> Model:
    """Load a model by name with its options.

    Raises:
        ConfigError: For an unknown name or option.
        DataError: For a model that cannot be loaded.
        MissingDependencyError: If its packages are not installed.
    """
    model, make = maker(name)
    with printing_aside():
        return make(validated(model, options, f"model '{name}': "))
