"""The outcome of a check of the geometry, and how well frames agree under one way to read their files."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal

from semstab.check.conventions import Convention

MIN_POINTS = 100
MIN_SHARE = 0.03
"""A convention under which fewer points are seen again, in number or share, has no evidence for or against it."""

LEAST_OF_OTHER = 0.2
"""The least part of what the configured convention sees that an alternative must see again, too."""

BETTER = 0.75
MIN_GAIN = 0.001
"""An error is clearly lower if it is at most BETTER times the other error, and lower by MIN_GAIN (0.1 points)."""

GOOD = 0.05
"""A convention with a larger error is not proposed, and as configured it is not called sound."""

SIMPLER = 1.1
"""The factor within which errors count as equal: the explanation with the fewest changes is taken."""

State = Literal["sound", "imprecise", "unsound", "unclear"]


@dataclass(frozen=True)
class Fit:
    """The error of points that are carried into other frames under a convention.

    Attributes:
        error: Typical relative error of the points that are seen again; NaN without such points.
        share: Share of the sampled points that are seen again, 0 to 1.
        points: Number of points that are seen again.
    """

    convention: Convention
    error: float
    share: float
    points: int

    @property
    def has_evidence(self) -> bool:
        """Return whether enough points are seen again for the error to count."""
        return self.points >= MIN_POINTS and self.share >= MIN_SHARE

    def clearly_beats(self, other: Fit) -> bool:
        """Return whether its error is clearly lower; one with enough overlap beats one with too little."""
        if not other.has_evidence or other.share < LEAST_OF_OTHER * self.share:
            return True
        return self.error <= min(BETTER * other.error, other.error - MIN_GAIN)


@dataclass(frozen=True)
class Verdict:
    """The outcome of a check of the geometry.

    Attributes:
        state: Sound; imprecise, where depth agrees far worse than its noise explains; unsound; or unclear, where the
            frames do not tell.
        text: The reason, in one line.
        mend: Lines of configuration that would mend it, if known.
        error, share: Error and share of the configured convention, see `Fit`.
        frames, pairs: Numbers of frames and pairs that were looked at.
        undetermined: Parts of the convention that these frames cannot tell, because an alternative fits as well, and
            the reason, if known.
        remarks: Lines on what looks wrong but leaves the state.
        fits: The configured convention and the alternatives of interest, by name.
    """

    state: State
    text: str
    mend: tuple[str, ...] = ()
    error: float = math.nan
    share: float = 0.0
    frames: int = 0
    pairs: int = 0
    undetermined: tuple[str, ...] = ()
    reason: str = ""
    remarks: tuple[str, ...] = ()
    fits: tuple[tuple[str, Fit], ...] = ()

    def refuted(self, text: str, mend: tuple[str, ...] = ()) -> Verdict:
        """Return that the data are unsound, for this reason."""
        return dataclasses.replace(self, state="unsound", text=text, mend=mend, undetermined=(), reason="")

    def remarking(self, *lines: str) -> Verdict:
        """Return the verdict with more lines on what looks wrong."""
        return dataclasses.replace(self, remarks=(*self.remarks, *lines))

    def summary(self) -> dict[str, Any]:
        """Return the part that a run's manifest holds."""
        return {name: getattr(self, name) for name in ("state", "text", "error", "share", "frames", "pairs")}

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object."""
        rows = [{"name": name, **dataclasses.asdict(fit)} for name, fit in self.fits]
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)} | {"fits": rows}
