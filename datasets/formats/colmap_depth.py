"""COLMAP's dense depth maps: the text 'width&height&channels&', then float32 values, x fastest."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semstab.datasets.formats.codecs import MAX_PIXELS
from semstab.datasets.formats.disk import AGAIN, read_bytes
from semstab.datasets.formats.images import Read
from semstab.errors import DataError

HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")


def read_depth_map(path: Path, scale: float | None = None, read: Read = read_bytes) -> npt.NDArray[np.float32]:
    """Depth (H, W) float32 in metres; `scale` is units per metre, 1 where not given.

    Raises DataError for a normal map, another format, or a file of another size than it says.
    """
    data = read(path)
    header = HEADER.match(data)
    if header is None:
        raise DataError(f"{path}: not a depth map of COLMAP (it begins with {data[:12]!r}); {AGAIN}")
    width, height, channels = (int(number) for number in header.groups())
    if channels != 1:
        raise DataError(f"{path}: has {channels} channels (a normal map?); set depth to the depth maps")
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError(f"{path}: claims {width}x{height} pixels (at most {MAX_PIXELS} are read); is it damaged?")
    found, needed = len(data) - header.end(), 4 * width * height
    if found != needed:
        raise DataError(f"{path}: {width}x{height} pixels need {needed} bytes, the file has {found}; {AGAIN}")
    stored = np.frombuffer(data, "<f4", offset=header.end()).reshape(height, width)
    with np.errstate(all="ignore"):  # beyond float32 becomes inf: invalid, as it should
        metres: npt.NDArray[np.float32] = np.divide(stored, scale or 1, dtype=np.float32)
    return metres
