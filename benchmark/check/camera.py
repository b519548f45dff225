"""What is wrong with the camera where depth agrees badly: its intrinsics, or where it is mounted."""

from __future__ import annotations

from semstab.check.conventions import Reading
from semstab.check.geometry import Verdict
from semstab.check.intrinsics import or_intrinsics
from semstab.check.mounting import with_mounting
from semstab.check.reprojection import Sample


def with_camera(verdict: Verdict, sample: Sample, how: Reading) -> Verdict:
    """Return the verdict with the intrinsics, or the mounting of the camera, that explain the error, the better one."""
    other, error = or_intrinsics(verdict, sample, how)
    return with_mounting(verdict, sample, other, error)
