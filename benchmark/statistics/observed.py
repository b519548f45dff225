"""The observations of some voxels in the log of all of them, which is not copied."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from semstab.core.types import Int32, Int64
from semstab.model.events import Events
from semstab.model.evidence import Evidence


class Log(Protocol):
    """The observations of voxels (n,): rows of frame and evidence, from starts (n,) to before ends (n,)."""

    @property
    def starts(self) -> Int64: ...  # noqa: D102
    @property
    def ends(self) -> Int64: ...  # noqa: D102
    @property
    def frame(self) -> Int32: ...  # noqa: D102
    @property
    def evidence(self) -> Evidence: ...  # noqa: D102
    @property
    def K(self) -> int: ...  # noqa: D102
    @property
    def voxel_size(self) -> float: ...  # noqa: D102
    @property
    def classes(self) -> tuple[str, ...]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class Observed:
    """A `Log` of some voxels (n,) of a larger one.

    events        the larger one
    starts, ends  (n,) where in it the observations of each voxel are
    """

    events: Events
    starts: Int64
    ends: Int64

    @classmethod
    def of(cls, events: Events) -> Observed:
        """All of a log."""
        return cls(events, events.starts, events.ends)

    def rows(self, rows: Any) -> Observed:
        """Of some of these voxels, by their numbers."""
        return Observed(self.events, self.starts[rows], self.ends[rows])

    @property
    def frame(self) -> Int32:
        """(m,) of all observations of the larger log, as its evidence is."""
        return self.events.frame

    @property
    def evidence(self) -> Evidence:
        """(m, K) of all of its observations."""
        return self.events.evidence

    @property
    def K(self) -> int:
        """Number of classes."""
        return self.events.K

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return self.events.voxel_size

    @property
    def classes(self) -> tuple[str, ...]:
        """The class names, where they are known."""
        return self.events.classes
