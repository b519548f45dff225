"""Model of a network in a file: ONNX, TorchScript (`net.pt`), an exported program (`net.pt2`) or TFLite."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field, PositiveInt, field_validator

from semstab.config import Settings
from semstab.core.types import Float32, Int64
from semstab.data.labels import IGNORE_8BIT, LabelSpace
from semstab.errors import ConfigError, DataError, summarize_error
from semstab.models import Image, Labels, Model, Prediction, Streamed, content_digest, narrowed, sides
from semstab.models.engines import FORMATS, Array, Engine, Layout, load_network
from semstab.models.names import class_names


class NetworkOptions(Settings):
    """The settings of the network's input and output."""

    classes: list[str] | str | None = Field(
        None, description="names in the order of its output; or a file: a name a line, or a taxonomy's YAML"
    )
    size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = Field(
        None, description="[height, width] that it sees, or one number for a square; the image's own by default"
    )
    resize: Literal["pillow", "antialias", "bilinear"] = Field(
        "pillow",
        description="how images are brought to that size, bilinearly: by Pillow in whole numbers; the same in real ones"
        " (torch's interpolate with antialias); or each pixel of four (torch's without, OpenCV's)",
    )
    mean: tuple[float, ...] = Field((0.485, 0.456, 0.406), description="taken off each channel, of values 0 to 1")
    std: tuple[float, ...] = Field((0.229, 0.224, 0.225), description="by which each channel is then divided")
    scale: float = Field(255.0, gt=0, description="by which values 0 to 255 are divided before; 1 for mean and std so")
    channels: Literal["rgb", "bgr"] = "rgb"
    layout: Layout | None = Field(
        None, description="nchw or nhwc, of its input and of its output; nhwc of TFLite files by default, else nchw"
    )
    output: int = Field(0, ge=0, description="which of its outputs, counted from 0")
    gives: Literal["logits", "probabilities", "labels"] | None = Field(
        None, description="kind of its output; by default labels if whole numbers, else logits"
    )
    device: str = Field("cpu", description="cpu, cuda, ...; ONNX and TFLite files run on the cpu")
    threads: int | None = Field(None, ge=1, description="threads on a CPU")

    _sides = field_validator("size", mode="before")(sides)


class Network(Model):
    """A network of one image: the class of its largest output, upsampled bilinearly to the image."""

    gives_scores = True
    streams = True

    def __init__(self, engine: Engine, options: NetworkOptions, path: Path, digest: str) -> None:
        self._network, self._options, self._path, self._digest = engine, options, path, digest
        self._layout = options.layout or engine.layout
        if options.classes is None:
            raise ConfigError(f"{path}: its classes are not known; name them with --classes a,b,c or a file of names")
        names = class_names(options.classes)
        self.label_space = names if isinstance(names, LabelSpace) else LabelSpace(path.stem, tuple(names))
        self.gives_scores = options.gives != "labels"
        self.streams = self.gives_scores
        for what in ("mean", "std"):
            if len(getattr(options, what)) not in (1, 3) or (what == "std" and 0 in options.std):
                raise ConfigError(f"{path}: {what}: give three numbers, or one; std above 0")
        self._size = self._seen_size()

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`.

        Raises:
            DataError: For an output that does not fit these classes.
        """
        return [self._prediction(image, scores) for image in images]

    def stream(self, image: Image) -> Streamed:
        """See `Model`."""
        output, gives = self._output(image)
        if gives == "labels":
            raise DataError(f"{self._path}: gives labels, no scores; leave scores out")
        maps = self._maps(output, gives)
        best, labels = largest(maps, image.shape[:2])
        return Streamed(
            narrowed(labels, len(maps)),
            lambda: shares(maps, image.shape[:2], best if gives == "logits" else None),
        )

    def identity(self) -> dict[str, Any]:
        """Return the file's content and the settings."""
        assert self.label_space is not None
        settings = self._options.model_dump(mode="json", exclude={"classes", "threads"})
        return {"file": self._digest, **settings, "layout": self._layout, "classes": list(self.label_space.classes)}

    def _seen_size(self) -> tuple[int, int] | None:
        stated, shape = self._options.size, self._network.shape
        stated = (stated, stated) if isinstance(stated, int) else stated
        fixed_sides = shape[2:4] if self._layout == "nchw" else shape[1:3]
        if len(fixed_sides) != 2 or fixed_sides[0] is None or fixed_sides[1] is None:
            return stated
        fixed = (fixed_sides[0], fixed_sides[1])
        if stated not in (None, fixed):
            raise ConfigError(f"{self._path}: sees images of {fixed[0]}x{fixed[1]} only; leave size out")
        return fixed

    def _prediction(self, image: Image, scores: bool) -> Prediction:
        if scores:
            streamed, shape = self.stream(image), image.shape[:2]
            full = np.empty((*shape, len(self.label_space or ())), dtype=np.float32)
            for k, share in enumerate(streamed.maps()):
                full[..., k] = share
            return Prediction(streamed.labels, full)
        output, gives = self._output(image)
        if gives == "labels":
            return Prediction(self._labels(output, image.shape[:2]))
        maps = self._maps(output, gives)
        return Prediction(narrowed(largest(maps, image.shape[:2])[1], len(maps)))

    def _output(self, image: Image) -> tuple[Array, str]:
        """Return the output that is wanted, and its kind."""
        output = self._run(self._pixels(image))
        return output, self._options.gives or ("labels" if output.dtype.kind in "iu" else "logits")

    def _labels(self, output: Array, shape: tuple[int, ...]) -> Labels:
        K = len(self.label_space or ())
        labels = self._map(output, ()).astype(np.int64)
        wrong = ((labels < 0) | (labels >= K)) & (labels != IGNORE_8BIT)
        if wrong.any():
            raise DataError(f"{self._path}: gave the label {labels[wrong][0]}, but has {K} classes, 0 to {K - 1}")
        small = np.ascontiguousarray(labels.astype(np.uint16))
        return narrowed(np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)), K)

    def _maps(self, output: Array, gives: str) -> Float32:
        """Return the output (K, h, w) float32 of numbers."""
        maps = np.asarray(self._map(output, (len(self.label_space or ()),)), dtype=np.float32)
        if np.isnan(maps).any():
            raise DataError(f"{self._path}: gave {gives} that are NaN; correct scale, mean, std or precision")
        return maps

    def _pixels(self, image: Image) -> Array:
        """Return (1, 3, h, w) or (1, h, w, 3) as the network takes it."""
        options, raw = self._options, np.dtype(self._network.dtype) == np.uint8
        step = self._network.multiple
        size = self._size or (-(-image.shape[0] // step) * step, -(-image.shape[1] // step) * step)
        resized_image = resized(image, size, "pillow" if raw else options.resize)
        resized_image = resized_image if options.channels == "rgb" else resized_image[..., ::-1]
        if raw:
            values: Array = resized_image
        else:
            mean, std = (np.array(constant, np.float32) for constant in (options.mean, options.std))
            values = (resized_image.astype(np.float32) / np.float32(options.scale) - mean) / std
        laid = values[None] if self._layout == "nhwc" else values.transpose(2, 0, 1)[None]
        return np.ascontiguousarray(laid, dtype=self._network.dtype)

    def _run(self, pixels: Array) -> Array:
        try:
            outputs = self._network(pixels)
        except Exception as error:  # whatever the runtime has
            raise DataError(
                f"{self._path}: cannot see an image of shape {pixels.shape} ({summarize_error(error)});"
                " correct size, layout"
            ) from error
        if self._options.output >= len(outputs):
            raise ConfigError(f"{self._path}: output: has {len(outputs)} outputs, counted from 0")
        return outputs[self._options.output]

    def _map(self, output: Array, classes: tuple[int, ...]) -> Array:
        """Return the output of one image as (K, h, w), of labels as (h, w).

        Raises:
            DataError: If it is none.
        """
        values = output[0] if output.ndim > 2 and output.shape[0] == 1 else output
        if not classes and values.ndim == 3 and 1 in (values.shape[0], values.shape[-1]):
            values = values[0] if values.shape[0] == 1 else values[..., 0]
        if classes and values.ndim == 3 and self._layout == "nhwc":
            values = values.transpose(2, 0, 1)
        if values.ndim != 2 + len(classes) or values.shape[: len(classes)] != classes:
            what = f"{classes[0]} classes" if classes else "labels"
            raise DataError(
                f"{self._path}: its output of shape {output.shape} holds no {what}; correct classes or output"
            )
        return values


class NetworkFile(Network):
    """A network in a file, run by the engine that the suffix names."""

    def __init__(self, path: Path, options: NetworkOptions) -> None:
        engine = load_network(path, options.device, options.threads)
        super().__init__(engine, options, path, content_digest(path))


def is_network(name: str) -> bool:
    """Return whether a model's name is a network's file."""
    return Path(name).suffix in FORMATS


def resized(image: Image, size: tuple[int, int], how: str) -> Array:
    """Return an image (H, W, 3) at (h, w), bilinear, pixel areas aligned; see `NetworkOptions.resize`."""
    if image.shape[:2] == size:
        return image
    if how == "bilinear":
        return np.asarray(cv2.resize(image.astype(np.float32), size[::-1], interpolation=cv2.INTER_LINEAR))
    import PIL.Image

    if how == "antialias":
        planes = (PIL.Image.fromarray(np.ascontiguousarray(image[..., c], dtype=np.float32)) for c in range(3))
        return np.dstack([np.asarray(plane.resize(size[::-1], PIL.Image.Resampling.BILINEAR)) for plane in planes])
    return np.asarray(PIL.Image.fromarray(image).resize(size[::-1], PIL.Image.Resampling.BILINEAR))


def upsampled(values: Float32, shape: tuple[int, ...]) -> Float32:
    """Return a map (h, w) at (H, W), bilinear, pixel areas aligned."""
    return np.asarray(cv2.resize(np.ascontiguousarray(values), shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def largest(maps: Float32, shape: tuple[int, ...]) -> tuple[Float32, Int64]:
    """Return (H, W) the largest of the maps (K, h, w), upsampled, and its index, the lowest on ties; one at a time."""
    best, label = upsampled(maps[0], shape), np.zeros(shape, dtype=np.int64)
    for k in range(1, len(maps)):
        value = upsampled(maps[k], shape)
        label[value > best] = k
        np.maximum(value, best, out=best)
    return best, label


def shares(maps: Float32, shape: tuple[int, ...], best: Float32 | None) -> Iterator[Float32]:
    """Yield the share (H, W) of each upsampled map in their sum, of logits the softmax: `best` is then their largest.

    It is 0 where all are 0. Each map is upsampled twice, and none is stored.
    """

    def weight(k: int) -> Float32:
        logits = upsampled(maps[k], shape)
        return logits if best is None else np.exp(logits - best)

    total = weight(0)
    for k in range(1, len(maps)):
        total += weight(k)
    for k in range(len(maps)):
        yield np.divide(weight(k), total, out=np.zeros(shape, dtype=np.float32), where=total > 0)
