"""Where tests find models: tiny ones that they build, and real ones in the folder that SEMSTAB_MODELS names."""

from __future__ import annotations

import functools
import json
import os
import tempfile
from pathlib import Path

import pytest
import tiny_models
import torch

KINDS = ("tiny", "real")

torch.set_num_threads(1)  # for models this small threads cost more than they save


def folder_of(kind: str, model_type: str) -> Path:
    """A folder with a model of a transformers type ('segformer', 'sam', 'clip'); skips where there is no real one."""
    return tiny(model_type) if kind == "tiny" else real(model_type)


@functools.cache
def tiny(model_type: str) -> Path:
    """A model of random weights, built once a process."""
    folder = Path(_scratch().name) / model_type
    return getattr(tiny_models, model_type)(folder)


def real(model_type: str) -> Path:
    """A folder below SEMSTAB_MODELS whose config.json says that type; skips, saying so, where there is none."""
    root = os.environ.get("SEMSTAB_MODELS")
    if not root:
        pytest.skip("no real models: SEMSTAB_MODELS names no folder")
    for config in sorted(Path(root).glob("*/config.json")):
        if json.loads(config.read_text()).get("model_type") == model_type:
            return config.parent
    pytest.skip(f"no real model: {root} holds no folder with a {model_type}")


@functools.cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="semstab-models-")
