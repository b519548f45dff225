"""Cameras that OpenSfM exports for other programs: reconstruction.nvm of VisualSFM, bundle_rNNN.out of Bundler.

Sources: ccwu.me/vsfm/doc.html, NVM; cs.cornell.edu/~snavely/bundler, the manual; OpenSfM's actions export_visualsfm and
export_bundler. Both give a focal length in pixels, and no size of an image: the principal point is its centre.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np

from semstab.core.files import open_file
from semstab.datasets.formats.disk import numbered_lines, records, to_number
from semstab.datasets.geometry.cameras import Camera, from_quaternions
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.photographs import Shot
from semstab.errors import DataError

MOST = 10**6
"""Cameras of a file: more is a damaged number."""

Line = tuple[int, str]
SizeOf = Callable[[str], tuple[int, int]]
"""(width, height) of the image of a shot's name."""


def read_nvm(path: Path, size_of: SizeOf) -> list[Shot]:
    """Return the shots of the first model of a file, of undistorted images. Poses are from the world to the camera.

    Raises:
        DataError: For a damaged file, or a camera that distorts; the message names the line.
    """
    with _filled_lines(path) as lines:
        number, head = _next(lines, path, "NVM_V3")
        if head != "NVM_V3":
            raise DataError(f"{path}: line {number} is {head[:40]!r}, not 'NVM_V3'; run opensfm export_visualsfm again")
        number, text = _next(lines, path, "the number of cameras")
        count = _count(text, path, number)
        cameras = [_next(lines, path, "a camera") for _ in range(count)]
    words = [_nvm_camera(line, path) for line in cameras]
    rows = np.array(
        [[to_number(word, path, line) for word in fields[1:]] for (line, _), fields in zip(cameras, words, strict=True)]
    )
    if len(bent := np.flatnonzero(rows[:, 8])):
        raise DataError(
            f"{path}: line {cameras[bent[0]][0]}: the camera distorts; undistort the images (opensfm undistort)"
        )
    centres = from_quaternions(rows[:, 5:8], rows[:, [2, 3, 4, 1]], path)
    shots = []
    for (line, _), fields, row, T in zip(cameras, words, rows, centres, strict=True):
        R = T[:3, :3].copy()
        T[:3, 3] = -R @ T[:3, 3]
        name = _bare(fields[0])
        shots.append(Shot(name, T, _pinhole(row[0], size_of(name), f"{path}: line {line}"), None))
    return _all_named(shots, path)


def read_bundle(path: Path, size_of: SizeOf) -> list[Shot]:
    """Return the shots of a file, with names from list_rNNN.out next to it. Poses are from the world to the camera.

    Cameras that were not reconstructed, of focal length 0, do not count.

    Raises:
        DataError: For a damaged file, or another number of names; the message names the line.
    """
    names = _listed(path)
    cameras = list(_bundle_cameras(path))
    if len(names) != len(cameras):
        raise DataError(
            f"{path}: has {len(cameras)} cameras, and {list_beside(path).name} {len(names)} names; export both again"
        )
    shots = []
    for name, (line, rows) in zip(names, cameras, strict=True):
        if (focal := rows[0][0]) == 0:
            continue
        T = np.eye(4)
        T[:3] = np.column_stack([rows[1:4], rows[4]])
        T[1:3] = -T[1:3]  # Bundler's camera has y up and looks along -z
        size = size_of(name)
        shots.append(Shot(name, T, *_lens(focal, rows[0][1:], size, f"{path}: line {line}")))
    return _all_named(shots, path)


def bundle_distorts(path: Path) -> bool:
    """Return whether a camera of a bundle distorts, so that its images are photographs.

    Raises:
        DataError: For a damaged file.
    """
    return any(rows[0][0] and any(rows[0][1:]) for _, rows in _bundle_cameras(path))


def list_beside(path: Path) -> Path:
    """Return the file of the names of a bundle's images: list_r000.out of bundle_r000.out."""
    return path.with_name(path.name.replace("bundle", "list", 1))


@contextmanager
def _filled_lines(path: Path) -> Iterator[Iterator[Line]]:
    """Yield the lines that are neither empty nor a comment; of those with points none is read before it is wanted."""
    try:
        with open_file(path) as file:
            yield ((number, text) for number, text in numbered_lines(file) if text and not text.startswith("#"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _next(lines: Iterator[Line], path: Path, what: str) -> Line:
    line = next(lines, None)
    if line is None:
        raise DataError(f"{path}: ends before {what}; export it again")
    return line


def _count(word: str, path: Path, line: int) -> int:
    value = to_number(word, path, line)
    if not value.is_integer() or not 0 < value <= MOST:
        raise DataError(f"{path}: line {line}: {word[:40]!r} is no number of cameras; export it again")
    return int(value)


def _nvm_camera(line: Line, path: Path) -> list[str]:
    """Return the words of a camera: its image, focal length, quaternion w x y z, centre, distortion, 0."""
    words = line[1].rsplit(maxsplit=10)
    if len(words) != 11:
        raise DataError(
            f"{path}: line {line[0]} is {line[1][:60]!r}; expected IMAGE FOCAL QW QX QY QZ X Y Z RADIAL 0; export it"
            " again"
        )
    return words


def _bundle_cameras(path: Path) -> Iterator[tuple[int, Sequence[Sequence[float]]]]:
    """Yield the line at which each camera begins, and its five rows: focal and k1 k2, three of R, t."""
    with _filled_lines(path) as lines:
        number, text = _next(lines, path, "the numbers of cameras and points")
        for _ in range(_count((text.split() or [""])[0], path, number)):
            rows = [_next(lines, path, "the rows of a camera") for _ in range(5)]
            yield rows[0][0], [_three(row, path) for row in rows]


def _three(line: Line, path: Path) -> list[float]:
    numbers = [to_number(word, path, line[0]) for word in line[1].split()]
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise DataError(f"{path}: line {line[0]} is {line[1][:60]!r}; expected three numbers; export it again")
    return numbers


def _listed(path: Path) -> list[str]:
    """Return the names of a bundle's images; Bundler writes 0 and a focal length after each, OpenSfM does not."""
    lines = [re.sub(r"\s+0\s+[\d.eE+]+$", "", text) for _, text in records(list_beside(path))]
    return [_bare(text) for text in lines]


def _bare(image: str) -> str:
    """Return the name of an image's file: a path in a project leads from a folder that is not known."""
    return PurePosixPath(image.replace("\\", "/").strip('"')).name


def _pinhole(focal: float, size: tuple[int, int], where: str) -> Camera:
    return Camera.stated((focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2), size, where)


def _lens(focal: float, radial: Sequence[float], size: tuple[int, int], where: str) -> tuple[Camera, Lens | None]:
    camera = _pinhole(focal, size, where)
    return camera, Lens(camera, "brown", (radial[0], radial[1], 0.0, 0.0, 0.0)) if any(radial) else None


def _all_named(shots: list[Shot], path: Path) -> list[Shot]:
    """Return the shots, of which there is one at least, each of another name."""
    names = [shot.name for shot in shots]
    if not shots:
        raise DataError(f"{path}: holds no camera that was reconstructed; reconstruct again")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"{path}: two cameras are of an image {twice[:80]!r}; rename one")
    return shots
