"""How often a frame of a lawn-mower flight is decoded for the parts of its map; nothing is fused.

    python benchmarks/bench_decodes.py [--side 2000] [--pitch 90 50] [--tiles 1 2 4 8] [--json FILE]

A UAV flies to and fro at 60 m over a plane, in legs 25 m apart, with a frame every 12 m (70 degrees across: 79 and 70 %
of a frame overlap with the next one, and with the next leg), and looks so many degrees below the horizon, up to 250 m
far. Tiles of 256 m; a part may take what so many of them take. One voxel a square metre stands for all.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import numpy as np

from semstab import Frame, Intrinsics
from semstab.core.files import write_json
from semstab.engine.tiling.partition import tiled
from semstab.engine.tiling.sights import Sights, seen_in, sights_of

ALTITUDE, FIELD_OF_VIEW, FAR, BESIDE, STEP = 60.0, np.radians(70), 250.0, 25.0, 12.0
WIDTH, HEIGHT, TILE, CELL = 96, 72, 256, 16


def flight(side: float, pitch: float) -> Iterator[Frame]:
    """The depth of each frame over a square field of that side."""
    f, p = WIDTH / 2 / np.tan(FIELD_OF_VIEW / 2), np.radians(pitch)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - WIDTH / 2) / f, (v - HEIGHT / 2) / f, np.ones((HEIGHT, WIDTH))], axis=-1)
    along = np.arange(0, side, STEP)
    for leg, x in enumerate(np.arange(0, side, BESIDE)):
        s = 1 if leg % 2 == 0 else -1
        R = np.array([[s, 0, 0], [0, -s * np.sin(p), s * np.cos(p)], [0, -np.cos(p), -np.sin(p)]])
        with np.errstate(divide="ignore"):
            depth = -ALTITUDE / (rays @ R.T)[..., 2]
        depth = np.where((depth > 0) & (depth < FAR), depth, 0).astype(np.float32)
        for k, y in enumerate(along[::s]):
            T_wc = np.eye(4)
            T_wc[:3, :3], T_wc[:3, 3] = R, (x, y, ALTITUDE)
            labels = np.zeros(depth.shape, np.uint8)
            camera = Intrinsics(f, f, WIDTH / 2, HEIGHT / 2)
            yield Frame(leg * len(along) + k, depth, camera, T_wc, labels=labels)


def sights(side: float, pitch: float) -> Sights:
    """What its frames see."""
    first = (0, 0, round(ALTITUDE))
    seen = (seen_in(frame, 1.0, np.array(first), CELL) for frame in flight(side, pitch))
    return sights_of(seen, first, CELL)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=float, default=2000.0)
    parser.add_argument("--pitch", nargs="+", type=float, default=[90.0, 50.0])
    parser.add_argument("--tiles", nargs="+", type=int, default=[1, 2, 4, 8])
    parser.add_argument("--json", help="also write the figures there")
    arguments = parser.parse_args()
    rows = []
    print(f"{'pitch':>6} {'frames':>7} {'tiles a part':>13} {'parts':>6} {'decodes a frame':>16}")
    for pitch in arguments.pitch:
        found = sights(arguments.side, pitch)
        for tiles in arguments.tiles:
            tiling = tiled(found, lambda voxels, _: voxels, 1.05 * tiles * TILE**2, TILE)
            decodes = tiling.decodes / found.frames
            rows.append({"pitch": pitch, "tiles": tiles, "parts": len(tiling.parts), "decodes": decodes})
            print(f"{pitch:6g} {found.frames:7} {tiles:13} {len(tiling.parts):6} {decodes:16.2f}", flush=True)
    if arguments.json:
        write_json(arguments.json, {"side": arguments.side, "rows": rows})


if __name__ == "__main__":
    main()
