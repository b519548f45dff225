"""Wall-clock seconds by stage."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


class Stopwatch:
    """Adds up wall-clock seconds by stage."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[Lap]:
        """Time the block; the yielded lap has its own seconds once it is over."""
        lap = Lap()
        started = time.perf_counter()
        try:
            yield lap
        finally:
            lap.seconds = time.perf_counter() - started
            self.seconds[stage] += lap.seconds


@dataclass
class Lap:
    """What one timed block took."""

    seconds: float = math.nan
