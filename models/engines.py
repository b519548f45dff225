"""Engines that run a network in a file: ONNX Runtime, torch, and LiteRT; which one, its suffix says."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import numpy.typing as npt

from semstab.core.code import require_named
from semstab.errors import ConfigError, DataError, MissingDependencyError, summarize_error

Array = npt.NDArray[Any]
Layout = Literal["nchw", "nhwc"]


class Engine(Protocol):
    """A loaded network of one image.

    Attributes:
        layout: Order of the axes of its input and output, where the user names none.
        shape: Shape that its input must have, None for each free side; empty where nothing is known.
        dtype: Type of its input; uint8 takes the values 0 to 255 as they are.
        multiple: Its input's height and width are multiples of this.
    """

    layout: ClassVar[Layout]
    shape: tuple[int | None, ...]
    dtype: npt.DTypeLike
    multiple: int

    def __call__(self, pixels: Array) -> list[Array]:
        """Return its outputs for one image, in order."""
        ...


ONNX_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


def _require_cpu(path: Path, device: str, kind: str) -> None:
    if device != "cpu":
        raise ConfigError(f"{path}: {kind} files run on the cpu, not on {device}; leave device out")


class OnnxFile:
    """A network of one image, run by ONNX Runtime on the CPU."""

    layout: ClassVar[Layout] = "nchw"
    multiple = 1

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs ONNX Runtime ({summarize_error(error)}); pip install 'semstab[onnx]'"
            ) from error
        _require_cpu(path, device, "ONNX")
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
        (self._input,) = _only(path, [tensor.name for tensor in self._session.get_inputs()])
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

    layout: ClassVar[Layout] = "nchw"
    multiple = 1

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import torch

            from semstab.models.devices import checked_device
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
                f" ({summarize_error(error)[:80]}); if it holds weights alone, name the code that loads"
                " them: FILE.py:CLASS, or smp,checkpoint=FILE for segmentation_models_pytorch"
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
        _only(
            path,
            [argument.name for argument in module.forward.schema.arguments[1:] if not argument.has_default_value()],
        )
        return module

    def _exported(self, path: Path) -> Any:
        program: Any = self._torch.export.load(path)
        (name,) = _only(path, program.graph_signature.user_inputs)
        (pixels,) = [node.meta["val"] for node in program.graph.nodes if node.name == name]
        self.shape = tuple(side if isinstance(side, int) else None for side in pixels.shape)
        return program.module().to(self._device)


class TfliteFile:
    """A network for TensorFlow Lite, run by LiteRT on the CPU; of quantised numbers, in real ones here."""

    layout: ClassVar[Layout] = "nhwc"
    multiple = 1

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs LiteRT ({summarize_error(error)}); pip install 'semstab[tflite]'"
            ) from error
        _require_cpu(path, device, "TFLite")
        try:
            self._interpreter: Any = Interpreter(model_path=str(path), num_threads=threads)
            self._interpreter.allocate_tensors()
        except Exception as error:  # ValueError, RuntimeError
            raise DataError(
                f"{path}: LiteRT cannot load it ({summarize_error(error)[:80]}); is it a TFLite file?"
            ) from error
        inputs = self._interpreter.get_input_details()
        _only(path, [tensor["name"] for tensor in inputs])
        (self._input,) = inputs
        self._outputs = self._interpreter.get_output_details()
        dtype = np.dtype(self._input["dtype"])
        if dtype not in (np.float32, np.float16, np.uint8, np.int8):
            raise ConfigError(
                f"{path}: its input is {dtype}; a network of images takes float32, float16, uint8 or int8"
            )
        self._scale, self._zero = (float(value) for value in self._input["quantization"])
        if dtype == np.int8 and not self._scale:
            raise ConfigError(f"{path}: its input is int8 without a scale; convert it with one")
        self.dtype: npt.DTypeLike = np.float32 if self._scale else dtype
        signature = self._input.get("shape_signature", self._input["shape"])
        self.shape: tuple[int | None, ...] = tuple(None if side < 0 else int(side) for side in signature)

    def __call__(self, pixels: Array) -> list[Array]:
        """Return its outputs, in order."""
        run, index = self._interpreter, self._input["index"]
        if tuple(run.get_input_details()[0]["shape"]) != pixels.shape:
            run.resize_tensor_input(index, pixels.shape, strict=True)
            run.allocate_tensors()
        run.set_tensor(index, self._quantised(pixels) if self._scale else pixels)
        run.invoke()
        return [_real(run.get_tensor(tensor["index"]), *tensor["quantization"]) for tensor in self._outputs]

    def _quantised(self, pixels: Array) -> Array:
        """Return q of real values scale (q - zero)."""
        kind = np.iinfo(self._input["dtype"])
        return np.clip(np.rint(pixels / self._scale) + self._zero, kind.min, kind.max).astype(kind.dtype)


def _real(values: Array, scale: float, zero: int) -> Array:
    """Return scale (q - zero) of quantised values q; others, whose scale is 0, as they are."""
    return np.float32(scale) * (values.astype(np.float32) - np.float32(zero)) if scale else values


FORMATS: Mapping[str, type[OnnxFile | TorchFile | TfliteFile]] = {
    ".onnx": OnnxFile, ".pt": TorchFile, ".pth": TorchFile, ".pt2": TorchFile, ".tflite": TfliteFile,
}  # fmt: skip
"""The readers of network files, by suffix."""


def load_network(path: Path, device: str, threads: int | None) -> Engine:
    """Return the network of a file.

    Raises:
        ConfigError, DataError, MissingDependencyError: If that fails; the message names it.
    """
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path}: no network is read from '{path.suffix}'; name a file of {', '.join(FORMATS)}")
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    require_named(str(path))
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
