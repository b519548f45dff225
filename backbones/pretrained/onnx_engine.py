"""ONNX Runtime in the place of torch: the same model, exported when an image size is first seen."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import torch

from semstab.backbones.pretrained.checkpoint import ModelOptions
from semstab.errors import ConfigError, DataError, MissingDependencyError, one_line

INSTALL = "pip install 'semstab[onnx]'"


class OnnxEngine:
    """Pixels (N, 3, h, w) to logits (N, K, h', w') on the CPU in float32, an image at a time.

    Raises ConfigError for another device or dtype, MissingDependencyError without onnxruntime.
    """

    def __init__(self, model: torch.nn.Module, options: ModelOptions) -> None:
        if options.device != "cpu" or options.dtype != "float32":
            raise ConfigError(
                f"engine onnx runs on the cpu in float32, not on {options.device} in {options.dtype}; use engine torch"
            )
        try:
            import onnxruntime
            import onnxscript  # noqa: F401  torch's exporter needs it
        except ImportError as error:
            raise MissingDependencyError(f"engine onnx cannot be used ({one_line(error)}); {INSTALL}") from error
        self._settings = onnxruntime.SessionOptions()
        self._settings.log_severity_level = 3
        if options.threads is not None:
            self._settings.intra_op_num_threads = options.threads
        self._model = _Logits(model)
        self._sessions: dict[tuple[int, ...], Any] = {}

    def __call__(self, pixels: torch.Tensor) -> torch.Tensor:
        """Logits of the images. Raises DataError for a model that cannot be exported."""
        shape = tuple(pixels.shape[1:])
        if shape not in self._sessions:
            self._sessions[shape] = self._session(pixels[:1])
        session = self._sessions[shape]
        logits = [session.run(None, {"pixels": pixels[k : k + 1].numpy()})[0] for k in range(len(pixels))]
        return torch.cat([torch.from_numpy(array) for array in logits])

    def _session(self, example: torch.Tensor) -> Any:
        import onnxruntime

        return onnxruntime.InferenceSession(
            _export(self._model, example), self._settings, providers=["CPUExecutionProvider"]
        )


class _Logits(torch.nn.Module):
    """The model with one tensor in and one out, as an export needs it."""

    def __init__(self, model: torch.nn.Module) -> None:
        super().__init__()
        self.model = model
        self.eval()

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        logits: torch.Tensor = self.model(pixel_values=pixels).logits
        return logits


def _export(model: torch.nn.Module, example: torch.Tensor) -> bytes:
    notes = logging.getLogger("torch.onnx")
    level = notes.level
    notes.setLevel(logging.ERROR)  # it notes that torchvision is missing, which nothing here needs
    try:
        with warnings.catch_warnings(), torch.inference_mode(False):
            warnings.filterwarnings("ignore", message=".*LeafSpec.* is deprecated", category=FutureWarning)
            program = torch.onnx.export(
                model, (example.clone(),), input_names=["pixels"], output_names=["logits"], verbose=False
            )
    except torch.onnx.OnnxExporterError as error:
        raise DataError(f"the model cannot be exported to ONNX ({one_line(error)}); use engine torch") from error
    finally:
        notes.setLevel(level)
    assert program is not None
    content: bytes = program.model_proto.SerializeToString()
    return content
