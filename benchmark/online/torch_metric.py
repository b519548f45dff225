"""Make `TemporalStability` a `torchmetrics.Metric`, for MetricCollection, Lightning and several processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from semstab.data.labels import IGNORE_8BIT
from semstab.errors import MissingDependencyError

try:
    import torch
    import torch.distributed as dist
    from torchmetrics import Metric
except ImportError as missing:
    raise MissingDependencyError(
        f"semstab.online.torch_metric cannot be used ({missing}); pip install 'semstab[training]'"
    ) from missing

from semstab.online import metric
from semstab.online.metric import MOST_VOXELS, State
from semstab.online.summary import Summary


class TemporalStability(Metric):
    """A `torchmetrics.Metric` of `semstab.online.metric.TemporalStability`, whose documentation it has."""

    higher_is_better = True
    is_differentiable = False
    full_state_update = False

    def __init__(
        self,
        num_classes: int,
        voxel_size: float = 0.1,
        *,
        ignore_index: int | None = IGNORE_8BIT,
        soft: bool = False,
        alpha: bool = True,
        max_voxels: int = MOST_VOXELS,
        backend: str = "numba",
        **of_torchmetrics: Any,
    ) -> None:
        super().__init__(**of_torchmetrics)
        self.num_classes, self.voxel_size = num_classes, voxel_size
        self._options: dict[str, Any] = {
            "ignore_index": ignore_index, "soft": soft, "alpha": alpha, "max_voxels": max_voxels, "backend": backend,
        }  # fmt: skip
        self._own = self._new()
        self._all: metric.TemporalStability | None = None

    def update(
        self,
        predicted: Any,
        depth: Any,
        intrinsics: Any,
        T_wc: Any,
        sequence: str | int | Sequence[Any] = "",
        features: Any = None,
    ) -> None:
        """Fuse one frame, or a batch of frames in the order of time."""
        self._own.update(predicted, depth, intrinsics, T_wc, sequence, features)

    def compute(self) -> dict[str, torch.Tensor]:
        """Return the scalars of all frames of all processes, float64."""
        values = (self._all or self._own).compute()
        return {name: torch.tensor(value, dtype=torch.float64, device=self.device) for name, value in values.items()}

    def forward(self, *args: Any, **kwargs: Any) -> dict[str, torch.Tensor]:
        """Add a batch, and return the scalars of this batch alone."""
        self.update(*args, **kwargs)
        batch = TemporalStability(self.num_classes, self.voxel_size, **self._options)
        batch.update(*args, **kwargs)
        values = batch.compute()
        self._forward_cache = values  # type: ignore[assignment]  # torchmetrics declares it as None
        return values

    def by_sequence(self) -> dict[str, Summary]:
        """Return the numbers of each sequence that this process saw, its verdict among them."""
        return (self._all or self._own).by_sequence()

    def states(self) -> dict[str, State]:
        """Return the state of each sequence."""
        return self._own.states()

    def merge_state(self, incoming_state: Any) -> None:
        """Add the states of another metric, or its `states`."""
        states: Mapping[str, State] = incoming_state if isinstance(incoming_state, Mapping) else incoming_state.states()
        self._own.merge_state(states)
        self._update_count += 1
        self._computed = None

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._own.reset()
        self._all = None

    def unsync(self, should_unsync: bool = True) -> None:
        """Return to the frames of this process."""
        super().unsync(should_unsync)
        if should_unsync:
            self._all = None

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] | None = None, process_group: Any | None = None) -> None:
        """Gather the states of every process, and add them in the order of their ranks."""
        group = process_group or self.process_group
        gathered: list[Any] = [None] * dist.get_world_size(group)
        dist.all_gather_object(gathered, self._own.states(), group=group)
        self._all = self._new()
        for states in gathered:
            self._all.merge_state(states)

    def _new(self) -> metric.TemporalStability:
        return metric.TemporalStability(self.num_classes, self.voxel_size, **self._options)


TemporalStability.__doc__ = metric.TemporalStability.__doc__
TemporalStability.update.__doc__ = metric.TemporalStability.update.__doc__
