"""Where the torch backend runs, and which of its kernels do the work there."""

from __future__ import annotations

from types import ModuleType

import torch

from semstab.backends.torch_parts import eager
from semstab.errors import ConfigError, MissingDependencyError, one_line


def device_of(name: str | None) -> torch.device:
    """The device of that name, as torch or Open3D writes it."""
    if name is None:
        return torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else torch.device("cpu")
    try:
        device = torch.device(name.lower())
    except RuntimeError as error:
        raise ConfigError(f"device '{name}' is not one; use CPU:0 or CUDA:0") from error
    if device.type == "cpu":
        return torch.device("cpu")
    if device.type != "cuda" or (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device '{name}': torch sees {torch.cuda.device_count()} CUDA devices here; use CPU:0")
    return torch.device("cuda", device.index or 0)


def kernels_for(name: str, device: torch.device) -> ModuleType:
    """The module that does the work on that device. Raises ConfigError or MissingDependencyError where it cannot."""
    if name not in ("auto", "torch", "triton"):
        raise ConfigError(f"kernels = '{name}': use auto, torch or triton")
    if name == "torch" or (name == "auto" and device.type == "cpu"):
        return eager
    try:
        from semstab.backends.torch_parts import triton_launch
    except ImportError as error:
        if name == "auto":
            return eager
        raise MissingDependencyError(
            f"kernels = 'triton' cannot be used ({one_line(error)}); pip install triton"
        ) from error
    if not triton_launch.runs_on(device):
        raise ConfigError(f"kernels = 'triton': they run on a CUDA device, not on {device}; use torch, or auto")
    return triton_launch
