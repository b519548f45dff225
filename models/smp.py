"""Model `smp`: a network of segmentation_models_pytorch by the names of its parts, with the weights of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import segmentation_models_pytorch
import torch
from pydantic import Field

from semstab.errors import ConfigError, DataError, summarize_error
from semstab.models import content_digest
from semstab.models.devices import checked_device
from semstab.models.engines import Array, Layout
from semstab.models.names import class_names
from semstab.models.network import Network, NetworkOptions

MULTIPLE = 32
"""Divisor of height and width for an encoder that does not state one: the stride of the deepest features."""

PREFIXES = ("module.", "model.", "net.", "network.")
"""Prefixes that trainers put before the names of weights: DataParallel, Lightning, ..."""


class SmpOptions(NetworkOptions):
    """The settings of a network of segmentation_models_pytorch."""

    architecture: str = Field("unet", description="unet, unetplusplus, fpn, deeplabv3plus, segformer, upernet, ...")
    encoder: str = Field("resnet34", description="its encoder: resnet34, mit_b0, ...; tu-NAME is timm's")
    checkpoint: Path = Field(description="weights: a state_dict that torch.save wrote, or .safetensors")


class SmpNetwork(Network):
    """The network, its encoder without weights of its own, with all weights from the checkpoint."""

    Options = SmpOptions

    def __init__(self, options: SmpOptions) -> None:
        path = options.checkpoint.expanduser()
        if options.classes is None:
            raise ConfigError(f"{path}: its classes are not known; name them with --classes a,b,c or a file of names")
        engine = _Module(options, path, len(class_names(options.classes)))
        super().__init__(engine, options, path, content_digest(path))

    def identity(self) -> dict[str, Any]:
        """Return the checkpoint's content and the settings."""
        return {key: value for key, value in super().identity().items() if key != "checkpoint"}


class _Module:
    layout: ClassVar[Layout] = "nchw"
    dtype: npt.DTypeLike = np.float32
    shape: tuple[int | None, ...] = ()

    def __init__(self, options: SmpOptions, path: Path, classes: int) -> None:
        if options.layout == "nhwc":
            raise ConfigError(f"{path}: networks of segmentation_models_pytorch are nchw; leave layout out")
        device, weights = checked_device(options.device), _weights(path)
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        network = f"{options.architecture} with encoder {options.encoder}"
        try:
            module: Any = segmentation_models_pytorch.create_model(
                options.architecture, encoder_name=options.encoder, encoder_weights=None, classes=classes
            )
        except Exception as error:  # KeyError, ValueError, RuntimeError of timm
            raise ConfigError(
                f"model 'smp': there is no {network} ({summarize_error(error)[:120]}); correct architecture or encoder"
            ) from error
        try:
            module.load_state_dict(weights)
        except RuntimeError as error:
            raise DataError(
                f"{path}: holds no weights of {network} for {classes} classes ({summarize_error(error)[:160]}); correct"
                " architecture, encoder or classes"
            ) from error
        self.multiple = int(getattr(getattr(module, "encoder", None), "output_stride", MULTIPLE))
        self._module, self._device = module.to(device).eval(), device

    def __call__(self, pixels: Array) -> list[Array]:
        """Return its logits (1, K, h, w)."""
        with torch.inference_mode():
            return [self._module(torch.from_numpy(pixels).to(self._device)).float().cpu().numpy()]


def _weights(path: Path) -> Mapping[str, torch.Tensor]:
    """Return the weights of a file by name; no code that it may hold is run.

    Raises:
        DataError: If it holds none.
    """
    if not path.is_file():
        raise DataError(f"{path}: there is no such file")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            content: Any = load_file(path)
        else:
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the parsers raise
        raise DataError(
            f"{path}: torch cannot load weights from it ({summarize_error(error)[:120]}); write it by"
            " torch.save(net.state_dict(), FILE)"
        ) from error
    for key in ("state_dict", "model_state_dict", "model"):
        content = content.get(key, content) if isinstance(content, Mapping) else content
    if not isinstance(content, Mapping) or not all(isinstance(tensor, torch.Tensor) for tensor in content.values()):
        raise DataError(f"{path}: holds no weights by name; write it by torch.save(net.state_dict(), FILE)")
    weights: Mapping[str, torch.Tensor] = content
    for prefix in PREFIXES:
        if weights and all(name.startswith(prefix) for name in weights):
            weights = {name.removeprefix(prefix): tensor for name, tensor in weights.items()}
    return weights
