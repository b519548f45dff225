"""The hash of packed voxel keys, and how it cuts observations and maps into partitions."""

from __future__ import annotations

import numpy as np

from semstab.runtime.compiled import serial

PARTITIONS = 64


@serial
def mix(key):
    """The finaliser of splitmix64: every bit of the key moves every bit of the hash."""
    x = np.uint64(key)
    x ^= x >> np.uint64(30)
    x *= np.uint64(0xBF58476D1CE4E5B9)
    x ^= x >> np.uint64(27)
    x *= np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return x


@serial
def partition_of(key):
    """The partition of a key: the top 6 bits of its hash."""
    return np.int64(mix(key) >> np.uint64(58))
