"""Which frames of a sequence are fused."""

from __future__ import annotations

import itertools
import math
import operator
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from semstab.config.settings import Settings
from semstab.errors import ConfigError

Indices = list[int]
"""Frames of a sequence, counted from 0, in ascending order."""


def slice_of(text: str) -> dict[str, int]:
    """'START:STOP:STRIDE' as settings; each part may be empty. Raises ConfigError for anything else."""
    parts = text.split(":")
    if len(parts) > 3 or not all(re.fullmatch(r"\s*[0-9]{0,18}\s*", part) for part in parts):
        raise ConfigError(f"write START:STOP:STRIDE, for example 0:80:4 or ::4, not {text}")
    if len(parts) == 1:
        raise ConfigError(f"write {text}:{int(text or 0) + 1} for one frame, :{text} for the first {text}")
    return {key: int(part) for key, part in zip(("start", "stop", "stride"), parts, strict=False) if part.strip()}


def in_full(selection: Any) -> Any:
    """A selection of frames as settings, where it is 'START:STOP:STRIDE' or a bare list of frames."""
    if isinstance(selection, str | int):
        return slice_of(str(selection))
    return {"list": selection} if isinstance(selection, Sequence) else selection


class FrameSelection(Settings):
    """Which frames of a sequence: those of a list; or each stride-th from start to before stop, in a range of time.

    Of these at most `count`: the first ones, or with `spacing: even` evenly spaced ones, the first and last included.
    """

    start: int = Field(0, ge=0)
    stop: int | None = Field(None, ge=1)
    stride: int = Field(1, ge=1)
    count: int | None = Field(None, ge=1)
    spacing: Literal["stride", "even"] = Field(
        "stride", description="which `count` frames: stride, the first ones; even, from the first to the last one"
    )
    list: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        None, min_length=1, description="these frames, ascending from 0, and no others"
    )
    from_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock")
    to_time: float | None = Field(None, allow_inf_nan=False, description="seconds on the scene's own clock, included")

    @model_validator(mode="before")
    @classmethod
    def _a_slice_or_a_list(cls, content: Any) -> Any:
        """'START:STOP:STRIDE' and a bare list of frames are settings, too."""
        return in_full(content)

    @model_validator(mode="after")
    def _one_way_to_say_it(self) -> Self:
        said = [name for name, field in type(self).model_fields.items() if getattr(self, name) != field.default]
        if self.list is not None and said != ["list"]:
            raise ValueError(f"list says which frames; leave out {', '.join(said[:-1])}")
        if self.list is not None and any(a >= b for a, b in itertools.pairwise(self.list)):
            raise ValueError("the frames of a list must ascend, each once")
        if self.spacing == "even" and self.count is None:
            raise ValueError("spacing: even needs count, the number of frames")
        if self.from_time is not None and self.to_time is not None and self.from_time > self.to_time:
            raise ValueError("from_time lies after to_time")
        return self

    @property
    def needs_time(self) -> bool:
        """Whether frames are chosen by the time they were taken at."""
        return self.from_time is not None or self.to_time is not None

    @classmethod
    def of(cls, indices: Sequence[int]) -> Self:
        """Of exactly these frames, ascending; in a few numbers where they are a range."""
        if isinstance(indices, range):
            return cls(start=indices.start, stop=indices.stop, stride=indices.step)
        return cls(list=tuple(indices))

    def indices(self, length: int, timestamps: Sequence[float] | None = None) -> Indices:
        """The selected indices of a sequence of that length, whose frames were taken at `timestamps` (seconds).

        A frame whose time is not known (NaN) lies in no range of time. Raises ConfigError for a listed frame that is
        not there, or a range of time where the sequence has none.
        """
        if self.list is not None:
            if self.list[-1] >= length:
                raise ConfigError(f"frames.list: there is no frame {self.list[-1]}; the sequence has {length}, from 0")
            return [*self.list]
        extent = [*range(length)][self.start : self.stop]
        if self.needs_time:
            extent = self._in_time(extent, timestamps)
        chosen = extent[:: self.stride]
        return chosen[: self.count] if self.spacing == "stride" else _evenly(chosen, self.count or len(chosen))

    def _in_time(self, extent: Indices, timestamps: Sequence[float] | None) -> Indices:
        if timestamps is None:
            raise ConfigError("frames: from_time and to_time need time stamps, which this sequence has not; use start")
        first = -math.inf if self.from_time is None else self.from_time
        last = math.inf if self.to_time is None else self.to_time
        return [index for index in extent if first <= timestamps[index] <= last]


def as_range(indices: Sequence[int]) -> Sequence[int]:
    """The same as a range where they are evenly spaced: a hundred thousand numbers in lists and sets take 15 MB."""
    if len(indices) < 2:
        return indices
    even = range(indices[0], indices[-1] + 1, max(1, indices[1] - indices[0]))
    return even if len(even) == len(indices) and all(map(operator.eq, even, indices)) else indices


def _evenly(items: Indices, count: int) -> Indices:
    """At most `count` of the items, the first and the last included, at equal distances to within one."""
    count, last = min(count, len(items)), len(items) - 1
    return [items[round(k * last / max(1, count - 1))] for k in range(count)]
