"""Fuse frames that a program has in memory into a `Result`, or measure them frame by frame in a training loop."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from semstab.online.fuse import FusedResult, fuse

if TYPE_CHECKING:
    from semstab.online.metric import TemporalStability

__all__ = ["FusedResult", "TemporalStability", "fuse"]


def __getattr__(name: str) -> Any:
    """Return the metric: a `torchmetrics.Metric` if torchmetrics is installed."""
    if name != "TemporalStability":
        raise AttributeError(f"module 'semstab.online' has no attribute '{name}'")
    if find_spec("torchmetrics") is not None:
        from semstab.online import torch_metric

        return torch_metric.TemporalStability
    from semstab.online import metric

    return metric.TemporalStability
