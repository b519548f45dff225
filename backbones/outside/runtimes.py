"""What runs a network that lies in a file: ONNX Runtime, or torch for TorchScript and exported programs."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from semstab.errors import ConfigError, DataError, MissingDependencyError, one_line

Array = npt.NDArray[Any]

ONNX_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class Network(Protocol):
    """A network of one image.

    shape  that its input must have, None for each free side; empty where nothing is known
    dtype  of its input
    """

    shape: tuple[int | None, ...]
    dtype: npt.DTypeLike

    def __call__(self, pixels: Array) -> list[Array]:
        """Its outputs, in order."""
        ...


class OnnxFile:
    """Run by ONNX Runtime on the CPU."""

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import onnxruntime
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs ONNX Runtime ({one_line(error)}); pip install 'semstab[onnx]'"
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
            raise DataError(f"{path}: ONNX Runtime cannot load it ({one_line(error)}); is it an ONNX file?") from error
        (self._input,) = _only(path, [each.name for each in self._session.get_inputs()])
        about = self._session.get_inputs()[0]
        if about.type not in ONNX_TYPES:
            raise ConfigError(f"{path}: its input is a {about.type}; a network of images takes {', '.join(ONNX_TYPES)}")
        self.dtype: npt.DTypeLike = ONNX_TYPES[about.type]
        self.shape = tuple(side if isinstance(side, int) else None for side in about.shape)

    def __call__(self, pixels: Array) -> list[Array]:
        """Its outputs, in order."""
        return [np.asarray(output) for output in self._session.run(None, {self._input: pixels})]


class TorchFile:
    """TorchScript, or with the suffix .pt2 a program that torch.export wrote; run by torch."""

    def __init__(self, path: Path, device: str, threads: int | None) -> None:
        try:
            import torch

            from semstab.backbones.pretrained.checkpoint import checked_device
        except ImportError as error:
            raise MissingDependencyError(
                f"{path}: needs torch ({one_line(error)}); pip install 'semstab[segformer]'"
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
                f" ({one_line(error)[:80]}); where it holds weights alone, name the code that loads them: FILE.py:CLASS"
            ) from error

    def __call__(self, pixels: Array) -> list[Array]:
        """Its outputs, in order."""
        with self._torch.inference_mode():
            found = self._module(self._torch.from_numpy(pixels).to(self._device))
        outputs = list(found.values()) if isinstance(found, Mapping) else found
        outputs = outputs if isinstance(outputs, list | tuple) else [outputs]
        return [output.detach().cpu().numpy() for output in outputs]

    def _script(self, path: Path) -> Any:
        module = self._torch.jit.load(  # type: ignore[no-untyped-call]
            path, map_location=self._device
        ).eval()
        _only(path, [each.name for each in module.forward.schema.arguments[1:] if not each.has_default_value()])
        return module

    def _exported(self, path: Path) -> Any:
        program: Any = self._torch.export.load(path)
        (name,) = _only(path, program.graph_signature.user_inputs)
        (pixels,) = [node.meta["val"] for node in program.graph.nodes if node.name == name]
        self.shape = tuple(side if isinstance(side, int) else None for side in pixels.shape)
        return program.module().to(self._device)


FORMATS: Mapping[str, type[OnnxFile | TorchFile]] = {".onnx": OnnxFile, ".pt": TorchFile, ".pt2": TorchFile}
"""By suffix."""


def load_network(path: Path, device: str, threads: int | None) -> Network:
    """The network of a file. Raises ConfigError, DataError or MissingDependencyError that names it."""
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
    """Without the notes of torch: that TorchScript is old, and its own log of what cannot be loaded."""
    notes = logging.getLogger("torch.export")
    level = notes.level
    notes.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        notes.setLevel(level)
