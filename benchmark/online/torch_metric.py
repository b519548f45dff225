"""Make `TemporalStability` a `torchmetrics.Metric`, for MetricCollection, Lightning and several processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

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
from semstab.online.metric import State
from semstab.online.summary import Summary


class TemporalStability(Metric):
    """A `torchmetrics.Metric` that takes the arguments of `semstab.online.metric.TemporalStability` and its own."""

    higher_is_better = True
    is_differentiable = False
    full_state_update = False

    def __init__(self, num_classes: int, voxel_size: float = 0.1, **options: Any) -> None:
        own = ("ignore_index", "soft", "alpha", "max_voxels", "backend")
        self._options = {name: options.pop(name) for name in own if name in options}
        super().__init__(**options)
        self.num_classes, self.voxel_size = num_classes, voxel_size
        self._own = self._new()
        self._all: metric.TemporalStability | None = None

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Fuse one frame, or a batch of frames in the order of time; see `semstab.online.metric.TemporalStability`."""
        self._own.update(*args, **kwargs)

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
