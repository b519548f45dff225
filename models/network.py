"""Model of a network in a file: `net.onnx`, TorchScript (`net.pt`) or an exported program (`net.pt2`)."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import PIL.Image
from pydantic import Field, PositiveInt

from semstab.config import Settings
from semstab.core.types import Float32, Int64
from semstab.data.labels import IGNORE_8BIT, LabelSpace
from semstab.errors import ConfigError, DataError, MissingDependencyError, summarize_error
from semstab.models import Image, Model, Prediction, content_digest, narrowed
from semstab.models.names import class_names

# Engines for a network in a file: ONNX Runtime, or torch for TorchScript and exported programs.

Array = npt.NDArray[Any]

ONNX_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class OnnxFile:
    """A network of one image, run by ONNX Runtime on the CPU.

    Attributes:
        shape: Shape that its input must have, None for each free side; empty where nothing is known.
        dtype: Type of its input.
    """

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs ONNX Runtime ({summarize_error(error)}); pip install 'semstab[onnx]'"
            ) from error
        if device != "cpu":
            raise ConfigError(f"{path}: ONNX files run on the cpu, not on {device}; leave device out")
        settings = onnxruntime.SessionOptions()
        settings.log_severity_level = 4
        if threads is not None:
            settings.intra_op_num_threads = threads
        try:
            self._session = onnxruntime.InferenceSession(path, settings, providers=["CPUExecutionProvider"])
        except Exception as error:  # its errors derive from nothing but Exception
            raise DataError(
                f"{path}: ONNX Runtime cannot load it ({summarize_error(error)}); is it an ONNX file?"
            ) from error
        (self._input,) = _only(path, [each.name for each in self._session.get_inputs()])
        about = self._session.get_inputs()[0]
        if about.type not in ONNX_TYPES:
            raise ConfigError(f"{path}: its input is a {about.type}; a network of images takes {', '.join(ONNX_TYPES)}")
        self.dtype: npt.DTypeLike = ONNX_TYPES[about.type]
        self.shape = tuple(side if isinstance(side, int) else None for side in about.shape)

    def __call__(self, pixels: Array) -> list[Array]:
        """Return its outputs, in order."""
        return [np.asarray(output) for output in self._session.run(None, {self._input: pixels})]


class TorchFile:
    """TorchScript, or with the suffix .pt2 a program that torch.export wrote; run by torch."""

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import torch

            from semstab.models.checkpoint import checked_device
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs torch ({summarize_error(error)}); pip install 'semstab[torch]'"
            ) from error
        self._torch, self._device = torch, checked_device(device)
        if threads is not None:
            torch.set_num_threads(threads)
        self.dtype: npt.DTypeLike = np.float32
        self.shape: tuple[int | None, ...] = ()
        try:
            with _quiet():
                self._module = self._exported(path) if path.suffix == ".pt2" else self._script(path)
        except (ConfigError, MissingDependencyError):
            raise
        except Exception as error:
            raise DataError(
                f"{path}: torch cannot load it as {'an exported program' if path.suffix == '.pt2' else 'TorchScript'}"
                f" ({summarize_error(error)[:80]}); where it holds weights alone, name the code that loads"
                f" them: FILE.py:CLASS"
            ) from error

    def __call__(self, pixels: Array) -> list[Array]:
        """Return its outputs, in order."""
        with self._torch.inference_mode():
            result = self._module(self._torch.from_numpy(pixels).to(self._device))
        outputs = list(result.values()) if isinstance(result, Mapping) else result
        outputs = outputs if isinstance(outputs, list | tuple) else [outputs]
        return [output.detach().cpu().numpy() for output in outputs]

    def _script(self, path: Path) -> Any:
        jit: Any = self._torch.jit
        module = jit.load(path, map_location=self._device).eval()
        _only(path, [each.name for each in module.forward.schema.arguments[1:] if not each.has_default_value()])
        return module

    def _exported(self, path: Path) -> Any:
        program: Any = self._torch.export.load(path)
        (name,) = _only(path, program.graph_signature.user_inputs)
        (pixels,) = [node.meta["val"] for node in program.graph.nodes if node.name == name]
        self.shape = tuple(side if isinstance(side, int) else None for side in pixels.shape)
        return program.module().to(self._device)


FORMATS: Mapping[str, type[OnnxFile | TorchFile]] = {".onnx": OnnxFile, ".pt": TorchFile, ".pt2": TorchFile}
"""The readers of network files, by suffix."""


def load_network(path: Path, device: str, threads: int | None) -> OnnxFile | TorchFile:
    """Return the network of a file.

    Raises:
        ConfigError, DataError, MissingDependencyError: If that fails; the message names it.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path}: no network is read from '{path.suffix}'; name a file of {', '.join(FORMATS)}")
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    return FORMATS[path.suffix](path, device, threads)


def _only(path: Path, inputs: Sequence[str]) -> Sequence[str]:
    if len(inputs) != 1:
        what = f"{len(inputs)} inputs ({', '.join(inputs)})" if inputs else "no input"
        raise ConfigError(f"{path}: has {what}; export it with the image as its only one, or write a class around it")
    return inputs


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the notes of torch: that TorchScript is old, and its own log of parts that cannot be loaded."""
    notes = logging.getLogger("torch.export")
    level = notes.level
    notes.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        notes.setLevel(level)


class NetworkOptions(Settings):
    """The settings of the network's input and output."""

    classes: list[str] | str | None = Field(
        None, description="names in the order of its output; or a file: a name a line, or a taxonomy's YAML"
    )
    size: PositiveInt | tuple[PositiveInt, PositiveInt] | None = Field(
        None, description="[height, width] that it sees, or one number for a square; the image's own where not given"
    )
    mean: tuple[float, ...] = Field((0.485, 0.456, 0.406), description="taken off each channel, of values 0 to 1")
    std: tuple[float, ...] = Field((0.229, 0.224, 0.225), description="by which each channel is then divided")
    scale: float = Field(255.0, gt=0, description="by which values 0 to 255 are divided before; 1 for mean and std so")
    channels: Literal["rgb", "bgr"] = "rgb"
    layout: Literal["nchw", "nhwc"] = Field("nchw", description="of its input and of its output")
    output: int = Field(0, ge=0, description="which of its outputs, counted from 0")
    gives: Literal["logits", "probabilities", "labels"] | None = Field(
        None, description="kind of its output; where not given labels if whole numbers, else logits"
    )
    device: str = Field("cpu", description="cpu, cuda, ...; ONNX files run on the cpu")
    threads: int | None = Field(None, ge=1, description="threads on a CPU")


class NetworkFile(Model):
    """The class of the largest output, upsampled bilinearly to the image; images are resized by Pillow, bilinearly."""

    gives_scores = True

    def __init__(self, path: Path, options: NetworkOptions) -> None:
        self._path, self._options = path, options
        self._network = load_network(path, options.device, options.threads)
        if options.classes is None:
            raise ConfigError(f"{path}: its classes are not known; name them with --classes a,b,c or a file of names")
        names = class_names(options.classes)
        self.label_space = names if isinstance(names, LabelSpace) else LabelSpace(path.stem, tuple(names))
        self.gives_scores = options.gives != "labels"
        for what in ("mean", "std"):
            if len(getattr(options, what)) not in (1, 3) or (what == "std" and 0 in options.std):
                raise ConfigError(f"{path}: {what}: give three numbers, or one; std above 0")
        self._size = self._seen_size()
        self._digest = content_digest(path)

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`.

        Raises:
            DataError: For an output that is none of these classes.
        """
        return [self._prediction(image, scores) for image in images]

    def identity(self) -> dict[str, Any]:
        """Return the file's content and the settings."""
        assert self.label_space is not None
        settings = self._options.model_dump(mode="json", exclude={"classes", "threads"})
        return {"file": self._digest, **settings, "classes": list(self.label_space.classes)}

    def _seen_size(self) -> tuple[int, int] | None:
        wanted, shape = self._options.size, self._network.shape
        wanted = (wanted, wanted) if isinstance(wanted, int) else wanted
        sides = shape[2:4] if self._options.layout == "nchw" else shape[1:3]
        if len(sides) != 2 or sides[0] is None or sides[1] is None:
            return wanted
        own = (sides[0], sides[1])
        if wanted not in (None, own):
            raise ConfigError(f"{self._path}: sees images of {own[0]}x{own[1]} only; leave size out")
        return own

    def _prediction(self, image: Image, scores: bool) -> Prediction:
        shape = (image.shape[0], image.shape[1])
        output = self._run(self._pixels(image))
        K = len(self.label_space or ())
        gives = self._options.gives or ("labels" if output.dtype.kind in "iu" else "logits")
        if gives == "labels":
            if scores:
                raise DataError(f"{self._path}: gives labels, no scores; leave scores out")
            labels = self._map(output, ()).astype(np.int64)
            wrong = ((labels < 0) | (labels >= K)) & (labels != IGNORE_8BIT)
            if wrong.any():
                raise DataError(f"{self._path}: gave the label {labels[wrong][0]}, but has {K} classes, 0 to {K - 1}")
            small = np.ascontiguousarray(labels.astype(np.uint16))
            full = cv2.resize(small, shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
            return Prediction(narrowed(np.asarray(full), K))
        maps = np.asarray(self._map(output, (K,)), dtype=np.float32)
        if np.isnan(maps).any():
            raise DataError(f"{self._path}: gave {gives} that are NaN; correct scale, mean, std or precision")
        labels = largest(maps, shape)
        if not scores:
            return Prediction(narrowed(labels, K))
        full = np.dstack([upsampled(each, shape) for each in maps]).reshape(*shape, K)
        if gives == "logits":
            full = np.exp(full - full.max(axis=2, keepdims=True))
        total = full.sum(axis=2, keepdims=True)
        return Prediction(narrowed(labels, K), np.divide(full, total, out=np.zeros_like(full), where=total > 0))

    def _pixels(self, image: Image) -> Array:
        """Return (1, 3, h, w) or (1, h, w, 3) as the network takes it."""
        size = self._size or image.shape[:2]
        seen = image if image.shape[:2] == size else np.asarray(PIL.Image.fromarray(image).resize(size[::-1], 2))
        seen = seen if self._options.channels == "rgb" else seen[..., ::-1]
        if np.dtype(self._network.dtype) == np.uint8:
            values: Array = seen
        else:
            mean, std = (np.array(each, np.float32) for each in (self._options.mean, self._options.std))
            values = (seen.astype(np.float32) / np.float32(self._options.scale) - mean) / std
        laid = values[None] if self._options.layout == "nhwc" else values.transpose(2, 0, 1)[None]
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
        if classes and values.ndim == 3 and self._options.layout == "nhwc":
            values = values.transpose(2, 0, 1)
        if values.ndim != 2 + len(classes) or values.shape[: len(classes)] != classes:
            what = f"{classes[0]} classes" if classes else "labels"
            raise DataError(
                f"{self._path}: its output of shape {output.shape} holds no {what}; correct classes or output"
            )
        return values


def is_network(name: str) -> bool:
    """Return whether a model's name is a network's file."""
    return Path(name).suffix in FORMATS


def upsampled(values: Float32, shape: tuple[int, int]) -> Float32:
    """Return a map (h, w) at (H, W), bilinear, pixel areas aligned."""
    return np.asarray(cv2.resize(np.ascontiguousarray(values), shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def largest(maps: Float32, shape: tuple[int, int]) -> Int64:
    """Return (H, W) the index of the largest of the maps (K, h, w), upsampled, the lowest on ties; one at a time."""
    best, label = upsampled(maps[0], shape), np.zeros(shape, dtype=np.int64)
    for k in range(1, len(maps)):
        value = upsampled(maps[k], shape)
        label[value > best] = k
        np.maximum(value, best, out=best)
    return label
