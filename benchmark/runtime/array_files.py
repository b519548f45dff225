"""Arrays that are kept for a later start: read as they were written, or not at all."""

from __future__ import annotations

import hashlib
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.runtime.files import atomic_path

Arrays = Mapping[str, npt.NDArray[Any]]

DIGEST = "digest"

DAMAGED = (
    OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
    struct.error, tokenize.TokenError, SyntaxError,
)  # fmt: skip
"""What numpy raises on a damaged .npz file."""


def write_arrays(path: Path, arrays: Mapping[str, Any], *, packed: bool = True) -> None:
    """Write numbers and arrays of numbers by name, atomically, with a digest of all of them; packed: compressed."""
    made: dict[str, Any] = {name: np.asarray(array) for name, array in arrays.items()}
    made[DIGEST] = _digest(made)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        (np.savez_compressed if packed else np.savez)(file, **made)


def read_arrays(path: Path) -> Arrays | None:
    """What `write_arrays` wrote; None where it is not there, or not as it was."""
    try:
        with path.open("rb") as file, np.load(file) as content:
            arrays = {name: content[name] for name in content.files}
    except DAMAGED:
        return None
    digest = arrays.pop(DIGEST, None)
    whole = all(isinstance(array, np.ndarray) for array in arrays.values())  # else bytes, where it is none
    return arrays if whole and digest is not None and np.array_equal(digest, _digest(arrays)) else None


def _digest(arrays: Arrays) -> npt.NDArray[np.uint8]:
    """Of names, types, shapes and numbers."""
    digest = hashlib.blake2b(digest_size=16)
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.dtype.str, array.shape)).encode() + np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)
