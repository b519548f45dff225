"""CPU time until the command has answered: its help, a warm run of one frame, and a run with nothing compiled.

    python benchmarks/bench_start.py [--backend numba] [--rounds 3] [--cold]

User and system time of the whole process; other work on the machine changes little. A small frame of a posed folder is
fused by one backend; the process ends when its report is there. The cold run compiles into an empty folder, and its
size is what the cache takes then.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import cv2
import numpy as np

SIZE = (160, 90)
QUIET = ["--check", "none", "--rerun", "off", "--report", "off", "--quiet"]


def cpu_seconds(*arguments: str, **environment: str) -> float:
    """User and system time of a process of Python with these arguments."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, env=os.environ | environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def write_scene(root: Path) -> None:
    """Two frames of a wall."""
    for part in ("depth", "pose", "labels/net"):
        (root / part).mkdir(parents=True)
    (root / "scene.yaml").write_text("taxonomy: uavid8\n", encoding="utf-8")
    np.savetxt(root / "intrinsics.txt", [[SIZE[0], 0, SIZE[0] / 2], [0, SIZE[0], SIZE[1] / 2], [0, 0, 1]])
    for name in ("0000", "0001"):
        cv2.imwrite(str(root / "depth" / f"{name}.png"), np.full(SIZE[::-1], 5000, np.uint16))
        cv2.imwrite(str(root / "labels/net" / f"{name}.png"), np.indices(SIZE[::-1])[1].astype(np.uint8) % 7)
        np.savetxt(root / "pose" / f"{name}.txt", np.eye(4))


UNTIL_FUSED = """
import os, sys
from semstab.core.process import configure_process
configure_process()
from semstab import backends
made = backends.create
def create(*arguments, **options):
    backend = made(*arguments, **options)
    integrate = backend.integrate
    def fuse(frame):
        integrate(frame)
        os._exit(0)
    backend.integrate = fuse
    return backend
backends.create = create
from semstab.__main__ import main
main()
"""
"""The command, which ends when the first frame is fused."""


def first_frame(root: Path, backend: str, **environment: str) -> float:
    """CPU seconds of a run until its first frame is fused."""
    with tempfile.TemporaryDirectory() as out:
        command = ["--backend", backend, "--data", str(root), *QUIET, "--out", out]
        return cpu_seconds("-c", UNTIL_FUSED, *command, **environment)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cold", action="store_true")
    arguments = parser.parse_args()
    each = range(arguments.rounds)
    print(f"help {median(cpu_seconds('-m', 'semstab', '--help') for _ in each):.2f} s", flush=True)
    modules = {"numba": "numba", "open3d": "open3d", "numpy": "numpy"}[arguments.backend]
    print(f"import {modules} {median(cpu_seconds('-c', f'import {modules}') for _ in each):.2f} s", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        root, cache = Path(folder) / "scene", Path(folder) / "cache"
        write_scene(root)
        first_frame(root, arguments.backend)
        print(f"first frame, warm {median(first_frame(root, arguments.backend) for _ in each):.2f} s", flush=True)
        if arguments.cold:
            cold = first_frame(root, arguments.backend, NUMBA_CACHE_DIR=str(cache))
            size = sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
            print(f"first frame, cold {cold:.1f} s, cache {size / 1e6:.1f} MB", flush=True)


if __name__ == "__main__":
    main()
