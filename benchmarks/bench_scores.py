"""CPU time of one frame of soft scores, beside one read of its scores and the finding of its pixels' voxels.

    python benchmarks/bench_scores.py [--sizes 1280x720 3840x2160] [--classes 7 20 150] [--types float32 float16]
                                      [--noise 0] [--rounds 5] [--json FILE]

The frames fly along the street of bench_fusion.py: a third of the image is sky, whose scores nobody needs. 'read' is
one pass over all scores of the frame, 'keys' the voxel of each pixel, each alone and by compiled code on all cores;
'floor' is their sum, 'frame' a whole frame whose voxels are known, association and update. 'rows' reads and writes as
many dense rows of evidence as the frame sees voxels, in random order: what any map costs beside. User and system time
of all threads; the steps take turns.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import time
from collections.abc import Callable
from statistics import median
from typing import Any

from semstab.core.process import configure_process

configure_process()  # as the command line does, before anything starts threads

import flight  # noqa: E402
import numba as nb  # noqa: E402
import numpy as np  # noqa: E402
import numpy.typing as npt  # noqa: E402

import semstab  # noqa: E402
from semstab import backends  # noqa: E402
from semstab.backends.shared.pixel_keys import exact_keys_of_row  # noqa: E402
from semstab.backends.shared.score_loops import LANES, scale_eight  # noqa: E402
from semstab.core.compiled import parallel  # noqa: E402
from semstab.core.files import write_json  # noqa: E402

VOXEL = 0.2


@parallel
def read(scores, scales):
    """Each score once."""
    n = scores.shape[0] // scales.shape[0]
    for part in nb.prange(scales.shape[0]):
        scale_eight(scores, part * n, n // LANES, np.zeros(LANES, dtype=np.int64), scales[part], 0)


@parallel
def find_keys(depth, labels, ray_x, ray_y, T, size, origin, keys):
    """The voxel of each pixel."""
    for v in nb.prange(depth.shape[0]):
        exact_keys_of_row(
            depth[v], labels, ray_x, ray_y[v], T, size, float(origin[0]), float(origin[1]), float(origin[2]), 1,
            keys[nb.get_thread_id()],
        )  # fmt: skip


@parallel
def touch_rows(evidence, row):
    """Dense rows read and written."""
    for part in nb.prange(64):
        for i in range(len(row) * part // 64, len(row) * (part + 1) // 64):
            for k in range(evidence.shape[1]):
                evidence[row[i], k] += 1.0


def soft(frame: semstab.Frame, K: int, kind: str) -> semstab.Frame:
    """Scores as a softmax gives them: 0.7 for the label, the rest spread at random over all classes."""
    assert frame.labels is not None
    rng = np.random.default_rng(frame.index)
    rows, W = frame.shape
    scores = np.empty((rows, W, K), dtype=kind)
    for v in range(rows):
        part = rng.random((W, K), dtype=np.float32)
        part *= 0.3 / part.sum(axis=1, keepdims=True)
        part[np.arange(W), frame.labels[v]] += 0.7
        scores[v] = part
    return dataclasses.replace(frame, labels=None, scores=scores)


def steps(frame: semstab.Frame, K: int) -> dict[str, Callable[[], object]]:
    """What is measured, in a map that has seen the frame."""
    assert frame.scores is not None
    H, W = frame.shape
    flat: npt.NDArray[Any] = frame.scores.reshape(-1)
    flat = flat.view(np.uint16) if flat.dtype == np.float16 else flat
    ray_x = (np.arange(W) - frame.intrinsics.cx) / frame.intrinsics.fx
    ray_y = (np.arange(H) - frame.intrinsics.cy) / frame.intrinsics.fy
    depth, T = np.array(frame.depth), np.array(frame.T_wc)
    origin = np.floor(T[:3, 3] / VOXEL).astype(np.int64)
    keys, labels, scales = np.empty((64, W), dtype=np.int64), np.zeros(W, dtype=np.uint8), np.empty((64, LANES))
    map_ = backends.create("numba", voxel_size=VOXEL, num_classes=K)
    report = map_.integrate(frame)
    order = np.random.default_rng(0).permutation(report.voxels)
    evidence = np.zeros((report.voxels, K))
    return {
        "read": lambda: read(flat, scales),
        "keys": lambda: find_keys(depth, labels, ray_x, ray_y, T, VOXEL, origin, keys),
        "rows": lambda: touch_rows(evidence, order),
        "frame": lambda: map_.integrate(frame),
    }


def cpu_milliseconds(work: Callable[[], object]) -> float:
    """User and system time of one call, all threads."""
    started = time.process_time()
    work()
    return 1e3 * (time.process_time() - started)


def measured(size: str, K: int, kind: str, noise: float, rounds: int) -> dict[str, Any]:
    """Milliseconds of each step, medians."""
    width, height = map(int, size.split("x"))
    frame = soft(flight.street(0, width, height, K, noise=noise), K, kind)
    work = steps(frame, K)
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(rounds + 1):
        for name, step in work.items():
            times[name].append(cpu_milliseconds(step))
    ms = {name: median(values[1:]) for name, values in times.items()}
    floor = ms["read"] + ms["keys"]
    seen: Any = work["frame"]()
    ratios = {"of_floor": ms["frame"] / floor, "with_rows": ms["frame"] / (floor + ms["rows"])}
    return {"voxels": seen.voxels, **ms, **ratios}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["1280x720", "3840x2160"])
    parser.add_argument("--classes", nargs="+", type=int, default=[7, 20, 150])
    parser.add_argument("--types", nargs="+", default=["float32", "float16"])
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0], help="of the depth, as a share of it")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    print(
        f"{'size':>9} {'K':>3} {'type':<7} {'noise':>6} {'voxels':>7} {'read':>7} {'keys':>6} {'rows':>6} {'frame':>7}"
        f" {'of floor':>8} {'with rows':>9}"
    )
    results = []
    every = itertools.product(arguments.sizes, arguments.classes, arguments.types, arguments.noise)
    for size, K, kind, noise in every:
        row = {"size": size, "K": K, "type": kind, "noise": noise, **measured(size, K, kind, noise, arguments.rounds)}
        results.append(row)
        print(
            f"{size:>9} {K:>3} {kind:<7} {noise:6.2%} {row['voxels']:7d} {row['read']:7.1f} {row['keys']:6.1f}"
            f" {row['rows']:6.1f} {row['frame']:7.1f} {row['of_floor']:7.2f}x {row['with_rows']:8.2f}x",
            flush=True,
        )
    if arguments.json:
        write_json(arguments.json, {"rows": results})


if __name__ == "__main__":
    main()
