"""CPU time of a frame with what is written by hand for compiled loops, and with plain loops in its place.

tests/plain_loops.py has the plain loops, which give the same numbers. `labels` are a frame of 3840x2160 of boxes on a
plane, seen obliquely from 32 to 75 m, K = 7, voxels of 0.2 m, depth noise of 0.75 voxels; `scores` one of 1920x1080, K
= 41, float32. Times are those of later frames, most of whose voxels are known: user and system time of all threads, the
median over processes of their own; ratios are to a process without plain loops that ran just before.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

import measuring

import semstab

PERFORMANCE = Path(__file__).resolve().parents[1]
PATHS = [str(PERFORMANCE), *(str(PERFORMANCE.parent / folder) for folder in ("scripts", "tests"))]
AS_IS = "by hand"
CASES = (("numba", "labels"), ("open3d", "labels"), ("numba", "scores"))


def frames_of(kind: str) -> tuple[list[semstab.Frame], int]:
    """Return two frames, and their number of classes."""
    if kind == "scores":
        import flight
        from timed.scores import soft

        return [soft(flight.street(i, 1920, 1080, 41), 41, "float32") for i in range(2)], 41
    import scenes

    scene = scenes.SceneSettings(
        kind="boxes", width=3840, height=2160, K=7, altitude=30.0, pitch=42.0, field_of_view=65.0, far=300.0, step=0.9,
        wrong=0.12, patch=24, salt=0.0, pixels_a_voxel=10.0, seed=77,
    )  # fmt: skip
    views, _, middle = scenes.views(scene, 2)
    return [scenes.spoilt(scene, view, 0.75 * 0.2 / middle) for view in views], 7


def child(name: str, rounds: int) -> None:
    """Print the CPU milliseconds of a frame by case, with plain loops in place of what is named so."""
    import plain_loops

    from semstab.core.process import configure_process

    configure_process()
    from semstab.backends import create

    if name != AS_IS:
        for backend, _ in CASES:
            create(backend, voxel_size=1.0, num_classes=2)  # all modules are there, and nothing is compiled
        module, names, loops = plain_loops.BY_HAND[name]
        for one, loop in zip(names, loops, strict=True):
            by_hand = getattr(importlib.import_module(f"semstab.backends.shared.{module}"), one)
            for user in [user for user in sys.modules.values() if getattr(user, one, None) is by_hand]:
                setattr(user, one, loop)
    found = {}
    for backend, kind in CASES:
        frames, K = frames_of(kind)
        live = create(backend, voxel_size=0.2, num_classes=K)
        times = [measuring.cpu_ms(live.integrate, frame) for _ in range(rounds + 1) for frame in frames]
        found[f"{backend} {kind}"] = median(times[len(frames) :])
    print(json.dumps(found))


def measured(name: str, rounds: int, folder: Path) -> dict[str, float]:
    """Return what a process of its own says, with a cache of compiled code of its own."""
    code = f"import sys; sys.path[:0] = {PATHS}; from timed import by_hand; by_hand.child({name!r}, {rounds})"
    cache = {"NUMBA_CACHE_DIR": str(folder / name)}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | cache)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main(rounds: int = 3, runs: int = 3) -> Any:
    import plain_loops

    cases = [f"{backend} {kind}" for backend, kind in CASES]
    columns = {column: spec for case in cases for column, spec in ((f"{case} ms", ".1f"), (f"{case} ratio", ".2f"))}
    table = measuring.MarkdownTable(without="", **columns)
    with tempfile.TemporaryDirectory() as folder:
        for name in plain_loops.BY_HAND:
            pairs = [[measured(one, rounds, Path(folder)) for one in (AS_IS, name)] for _ in range(runs)]
            row = {f"{case} ms": median(without[case] for _, without in pairs) for case in cases}
            row |= {f"{case} ratio": median(without[case] / as_is[case] for as_is, without in pairs) for case in cases}
            table.add(without=name, **row)
    return table.rows
