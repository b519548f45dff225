"""A backend as an outside program: python -m semstab.conformance.fuse BACKEND CASE OUT.

BACKEND is a name of `semstab-bench list`, or FILE.py:NAME.
"""

from __future__ import annotations

import sys
from pathlib import Path

from semstab.backends import create
from semstab.config import BackendConfig
from semstab.conformance.files import read_case, write_rows


def fuse(backend: str, case: Path, out: Path) -> None:
    """Fuse the frames of a case and write the table."""
    voxel_size, classes, frames = read_case(case)
    made = create(BackendConfig.parse(backend).name, voxel_size=voxel_size, num_classes=classes)
    for frame in frames:
        made.integrate(frame)
    write_rows(out, made.table())


if __name__ == "__main__":
    fuse(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
