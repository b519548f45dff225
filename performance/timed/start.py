"""CPU time until the command has answered: its help, a warm run of one frame, and a run with nothing compiled.

User and system time of the whole process; other work on the machine changes little. A small frame of a posed folder is
fused by one backend; the process ends when its report is there. The `--cold` run compiles into an empty folder, and its
size is what the cache takes then.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import median
from typing import Any, Literal

import measuring
import numpy as np

from semstab import Frame, Intrinsics

SIZE = (160, 90)
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


def main(backend: Literal["numba", "open3d", "numpy"] = "numba", rounds: int = 3, cold: bool = False) -> Any:
    def seconds(*words: str | Path, **variables: str) -> float:
        return measuring.python(*words, quiet=True, **variables).cpu_s

    def first_frame(**variables: str) -> float:
        with tempfile.TemporaryDirectory() as out:
            words = ("--backend", backend, "--data", root, "--out", out, "--quiet", "--check", "none")
            return seconds("-c", UNTIL_FUSED, *words, "--rerun", "off", "--report", "off", **variables)

    table = measuring.MarkdownTable(until="", CPU_s=".2f", cache_MB=".1f")
    runs = range(rounds)
    table.add(until="help", CPU_s=median(seconds("-m", "semstab", "--help") for _ in runs))
    table.add(until=f"import {backend}", CPU_s=median(seconds("-c", f"import {backend}") for _ in runs))
    with tempfile.TemporaryDirectory() as folder:
        labels = np.indices(SIZE[::-1])[1].astype(np.uint8) % 7
        camera = Intrinsics(SIZE[0], SIZE[0], SIZE[0] / 2, SIZE[1] / 2)
        wall = [Frame(k, np.full(SIZE[::-1], 5, np.float32), camera, np.eye(4), labels=labels) for k in range(2)]
        root, cache = measuring.posed(Path(folder) / "scene", 2, wall, 7, scale=1000), Path(folder) / "cache"
        first_frame()
        table.add(until="first frame, warm", CPU_s=median(first_frame() for _ in runs))
        if cold:
            took = first_frame(NUMBA_CACHE_DIR=str(cache))
            size = sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
            table.add(until="first frame, cold", CPU_s=took, cache_MB=size / 1e6)
    return table.rows
