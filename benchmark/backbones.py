"""The module of models under its name in version 0.3, for one version: `semstab.models` is what it is called now."""

from __future__ import annotations

import warnings
from typing import Any

from semstab import models

NAMES = {"Backbone": "Model"}


def __getattr__(name: str) -> Any:
    """Return what `semstab.models` has under a name, with a warning."""
    value = getattr(models, NAMES.get(name, name))
    warnings.warn(
        f"semstab.backbones is now called semstab.models; {name} is {NAMES.get(name, name)} there",
        DeprecationWarning, stacklevel=2,
    )  # fmt: skip
    return value
