"""Random numbers that are a function of integers: the same cell, view or frame always draws the same number."""

from __future__ import annotations

import hashlib

import numpy as np

from semstab.core.types import Float64, Int64, UInt64


def splitmix64(x: UInt64) -> UInt64:
    """Return the output function of splitmix64 (Steele, Lea, Flood 2014) for states x, an array with an axis."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    for bits, odd in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x ^= x >> np.uint64(bits)
        x *= np.uint64(odd)
    return x ^ (x >> np.uint64(31))


def salt(*parts: str | int) -> int:
    """Return a 64-bit number that stands for names and numbers; the same in every process, unlike `hash`."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def hash_integers(seed: int, *coordinates: Int64) -> UInt64:
    """Hash integer coordinates, arrays of one shape, one after the other into 64 bits."""
    state = np.full(coordinates[0].shape, seed, dtype=np.uint64)
    for coordinate in coordinates:
        state = splitmix64(state ^ coordinate.astype(np.int64, copy=False).view(np.uint64))
    return state


def rehash(state: UInt64, seed: int) -> UInt64:
    """Return a second, independent hash of the numbers behind the hash `state`."""
    return splitmix64(state ^ np.uint64(seed))


def uniform(state: UInt64) -> Float64:
    """Return hashes as numbers in [0, 1), from their upper 53 bits."""
    numbers: Float64 = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers
