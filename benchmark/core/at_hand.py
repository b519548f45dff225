"""What is loaded when it is asked for, the last of it at hand."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class AtHand(Generic[K, V]):
    """Loads by key, and keeps as much of what was asked for last as `most` allows, one thing at least; for threads too.

    size  of a loaded thing, in units of `most`
    """

    def __init__(self, load: Callable[[K], V], size: Callable[[V], int], most: int) -> None:
        self._load, self._size, self._most = load, size, most
        self._kept: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def __getitem__(self, key: K) -> V:
        with self._lock:
            if key not in self._kept:
                self._kept[key] = self._load(key)
            self._kept.move_to_end(key)
            while len(self._kept) > 1 and sum(map(self._size, self._kept.values())) > self._most:
                self._kept.popitem(last=False)
            return self._kept[key]
