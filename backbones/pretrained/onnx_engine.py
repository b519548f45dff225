"""ONNX Runtime in the place of torch: the same model, exported once for each image size and kept."""

from __future__ import annotations

import contextlib
import logging
import warnings
from typing import Any

import torch
import transformers

from semstab.backbones.pretrained.checkpoint import ModelOptions
from semstab.errors import ConfigError, DataError, MissingDependencyError, one_line
from semstab.runtime.files import atomic_path, cache_folder, content_key

INSTALL = "pip install 'semstab[onnx]'"


class OnnxEngine:
    """Pixels (N, 3, h, w) to logits (N, K, h', w') on the CPU in float32, an image at a time.

    What was exported of that version of a model is kept in the cache folder, where it can be written.
    Raises ConfigError for another device or dtype, MissingDependencyError without onnxruntime.
    """

    def __init__(self, model: torch.nn.Module, options: ModelOptions, revision: str) -> None:
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
        self._revision = revision
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

        said = {"revision": self._revision, "shape": list(example.shape)}
        versions = {"torch": torch.__version__, "transformers": transformers.__version__}
        file = cache_folder() / "onnx" / f"{content_key(said | versions)}.onnx"
        told = {"sess_options": self._settings, "providers": ["CPUExecutionProvider"]}
        with contextlib.suppress(Exception):  # it is not there, or damaged
            return onnxruntime.InferenceSession(file, **told)
        content = _export(self._model, example)
        with contextlib.suppress(OSError), atomic_path(file) as temporary:
            temporary.write_bytes(content)
        return onnxruntime.InferenceSession(content, **told)


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
        assert program is not None
        content: bytes = program.model_proto.SerializeToString()
    except Exception as error:  # the exporter's own; and what protobuf says of more than 2 GB
        raise DataError(f"the model cannot be exported to ONNX ({one_line(error)}); use engine torch") from error
    finally:
        notes.setLevel(level)
    return content
