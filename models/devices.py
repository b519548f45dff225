"""Devices of torch."""

from __future__ import annotations

import re

import torch

from semstab.errors import ConfigError, summarize_error


def checked_device(name: str) -> torch.device:
    """Return the device of that name.

    Raises:
        ConfigError: If torch has none.
    """
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ConfigError(f"device {name}: torch cannot use it ({first_sentence(error)}); use cpu") from error
    if device.type == "cuda":  # reduced precision flips labels
        torch.backends.cudnn.allow_tf32 = False
        torch.backends.cuda.matmul.allow_tf32 = False
    return device


def first_sentence(error: Exception) -> str:
    """Return the first sentence of an error, without the paragraphs of advice that libraries append."""
    return re.split(r"(?<=[.:;]) |\n", summarize_error(error), maxsplit=1)[0].rstrip(".:;")
