"""Files of all poses of a sequence: of TUM and EuRoC by time stamps, of KITTI in the order of the frames.

Sources: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012; Burri et al., The EuRoC micro
aerial vehicle datasets, IJRR 2016; Geiger et al., Are we ready for autonomous driving?, CVPR 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from semstab.core.types import Float64
from semstab.datasets.formats.disk import matrix_of, records, require_decimal_points, to_number
from semstab.datasets.geometry.cameras import Poses, at_times, from_quaternions
from semstab.errors import DataError

UNITS = {1e17: 1e9, 1e14: 1e6, 1e11: 1e3}
"""Units in a second of time stamps that are larger: since 1970 they are nano-, micro- or milliseconds."""

FORMS = "TUM: seconds x y z qx qy qz qw; EuRoC: nanoseconds,x,y,z,qw,qx,qy,qz,...; KITTI: r11 r12 r13 t1 ..."


def poses_by_name(path: Path, names: Sequence[str], max_difference: float) -> tuple[Poses, Float64 | None]:
    """Return the poses (n, 4, 4) of frames of these names, NaN without a near pose, and the seconds of their names.

    Matrices go in the order of the frames, and the frames have no time. If a file has more matrices than frames, the
    number in a frame's name is the number of its row, from 0.

    Raises:
        DataError: For a file of another form, or poses that do not belong to the frames.
    """
    rows, by_comma = _rows(path)
    if rows.shape[1] in (12, 16):
        return _in_order(path, rows, names), None
    times = rows[:, 0] / _unit(rows[:, 0])
    scalar_first = rows.shape[1] > 8 or (by_comma and _unit(rows[:, 0]) == 1e9)
    turns = rows[:, [5, 6, 7, 4]] if scalar_first else rows[:, 4:8]
    times, order = np.unique(times, return_index=True)
    poses = from_quaternions(rows[order, 1:4], turns[order], path)
    frame_times = _times_of(names, path)
    frame_poses = at_times(times, poses, frame_times, max_difference, "interpolate")
    if len(names) and not np.isfinite(frame_poses).all(axis=(1, 2)).any():
        raise DataError(
            f"{path}: no pose is within {max_difference:g} s of a frame: poses are from {times[0]:.6f} to"
            f" {times[-1]:.6f} s, the names of frames from {frame_times.min():.6f} to {frame_times.max():.6f} s; name"
            " frames by their time stamps, or set max_difference"
        )
    return frame_poses, frame_times


def _rows(path: Path) -> tuple[Float64, bool]:
    """Return the numbers (n, columns), and whether commas are between them; a line of headings is passed over."""
    rows: list[list[float]] = []
    by_comma = False
    for line, text in records(path):
        require_decimal_points(f"{path}: line {line}", text)
        words = text.replace(",", " ").split()
        if not rows and not any(character.isdecimal() for character in words[0]):
            continue
        by_comma |= "," in text
        if len(words) not in (8, 12, 16, 17) or (rows and len(words) != len(rows[0])):
            raise DataError(f"{path}: line {line} has {len(words)} values; expected a row of {FORMS}")
        rows.append([to_number(word, path, line) for word in words])
    if not rows:
        raise DataError(f"{path}: holds no pose; expected rows of {FORMS}")
    return np.array(rows, dtype=np.float64), by_comma


def _in_order(path: Path, rows: Float64, names: Sequence[str]) -> Poses:
    poses = np.stack([matrix_of(row[:12]) for row in rows])
    if len(poses) == len(names):
        return poses
    numbers = [int(name) if name.isdecimal() else -1 for name in names]
    if len(poses) < len(names) or min(numbers, default=0) < 0 or max(numbers, default=0) >= len(poses):
        raise DataError(f"{path}: has {len(poses)} poses, but there are {len(names)} frames; they must be as many")
    return np.asarray(poses[numbers])


def _times_of(names: Sequence[str], path: Path) -> Float64:
    """Return the seconds that names are.

    Raises:
        DataError: If one is no number.
    """
    try:
        times = np.array([float(name) for name in names], dtype=np.float64)
    except ValueError:
        times = np.array([np.nan])
    if not np.isfinite(times).all():
        odd = next((name for name in names if not name.replace(".", "", 1).isdecimal()), names[0])
        raise DataError(
            f"{path}: poses go by time stamps, but the frame '{odd[:60]}' is not named by one; name frames by their"
            " seconds or nanoseconds, or write a 3x4 matrix a frame, in order"
        )
    return np.asarray(times / _unit(times))


def _unit(times: Float64) -> float:
    largest = float(np.abs(times).max(initial=0))
    return next((unit for least, unit in UNITS.items() if largest > least), 1.0)
