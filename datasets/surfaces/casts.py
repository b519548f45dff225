"""Cast depth that is kept in files, so that a second run reads it."""

from __future__ import annotations

import hashlib
import logging
import os
import struct
from pathlib import Path

import deflate
import numpy as np
import numpy.typing as npt

from semstab.datasets.surfaces.casting import View
from semstab.runtime.files import atomic_path

logger = logging.getLogger("semstab")

Float32 = npt.NDArray[np.float32]

MAGIC = b"semstab cast 1\n"
HEADER = struct.Struct("<3I")
"""Height, width, checksum of the rest."""


def usual_folder() -> Path:
    """The user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "semstab" / "casts"


class Casts:
    """The casts at one surface in a folder; None keeps nothing. What cannot be written is not kept, which is said once.

    surface  what the surface is, bytes that are equal where it is
    """

    def __init__(self, folder: Path | None, surface: bytes) -> None:
        self._folder = None if folder is None else folder / hashlib.blake2b(surface, digest_size=8).hexdigest()
        self._surface = surface

    def get(self, view: View) -> Float32 | None:
        """The depth (H, W) of a view, None where it is not there or damaged."""
        if self._folder is None:
            return None
        try:
            data = self._file(view).read_bytes()
        except OSError:
            return None
        return _unpacked(data, view.shape)

    def put(self, view: View, depth: Float32) -> None:
        """Keep the depth of a view."""
        if self._folder is None:
            return
        try:
            with atomic_path(self._file(view)) as temporary:
                temporary.write_bytes(_packed(depth))
        except OSError as error:
            logger.warning("%s: cast depth cannot be kept (%s); set casts to a folder", self._folder, error.strerror)
            self._folder = None

    def _file(self, view: View) -> Path:
        assert self._folder is not None
        digest = hashlib.blake2b(self._surface, digest_size=16)
        digest.update(repr((view.intrinsics, view.shape)).encode() + view.T_wc.tobytes())
        return self._folder / f"{digest.hexdigest()}.cast"


def _packed(depth: Float32) -> bytes:
    """Exactly the depth in a fifth of its bytes: differences along rows, their bytes by significance, zstd."""
    import pyarrow as pa

    change = np.diff(depth.view(np.uint32), axis=1, prepend=np.uint32(0))
    planes = np.ascontiguousarray(change.view(np.uint8).reshape(-1, 4).T)
    content = bytes(pa.Codec("zstd", 1).compress(planes, asbytes=True))
    return MAGIC + HEADER.pack(*depth.shape, deflate.crc32(content)) + content


def _unpacked(data: bytes, shape: tuple[int, int]) -> Float32 | None:
    import pyarrow as pa

    start = len(MAGIC) + HEADER.size
    if not data.startswith(MAGIC) or len(data) < start:
        return None
    *size, checksum = HEADER.unpack(data[len(MAGIC) : start])
    content = memoryview(data)[start:]
    if tuple(size) != shape or deflate.crc32(content) != checksum:
        return None
    H, W = shape
    planes = np.frombuffer(pa.Codec("zstd").decompress(content, H * W * 4), np.uint8).reshape(4, -1)
    change = np.ascontiguousarray(planes.T).view(np.uint32).reshape(H, W)
    return np.cumsum(change, axis=1, dtype=np.uint32).view(np.float32)
