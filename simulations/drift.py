"""How often does the interval of the trend in time exclude zero, where errors are of eight kinds, and where they grow?

    python simulations/drift.py [--trials 40]

A camera goes once around a floor of 24 x 24 voxels of four classes, in 30 frames, each of which sees eight in ten of
the voxels, by about 6 pixels at all times, or by more and more, 1 to 20. A model errs by one of these kinds, about a
quarter of the time, and in one pixel of twenty anyhow; it changes in the last kind only. Prints a table in Markdown:
the mean trend, and the shares of the flights whose interval lies above zero, and below.

    pixel       each pixel by itself                        block       4 x 4 voxels as one, anew in each frame
    persistent  the same places in all frames               view        each place from its own directions
    class       half of the blocks, of one class            boundary    labels shift by a voxel, anew in each frame
    burst       one frame in eight, by most of its pixels   lasting     a pattern that fades over six frames
    ramp        each pixel by itself, at a rate that grows from 15 to 35 %: drift
"""

from __future__ import annotations

import argparse

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.stats import norm

from semstab.data.events import Events
from semstab.data.statistics import Interval
from semstab.statistics.accumulate import Cubes
from semstab.statistics.agreement import ratio_of
from semstab.statistics.drift import trends

KINDS = ("pixel", "block", "persistent", "view", "class", "boundary", "burst", "lasting", "ramp")
SIDE, FRAMES, K, RATE = 24, 30, 4, 0.25


def field(rng: np.random.Generator, reach: float) -> npt.NDArray[np.float64]:
    """Normal numbers (SIDE, SIDE), alike within about `reach` voxels."""
    smooth = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), reach, mode="wrap")
    normal: npt.NDArray[np.float64] = (smooth - smooth.mean()) / smooth.std()
    return normal


def blocks(rng: np.random.Generator, rate: float) -> npt.NDArray[np.float64]:
    """1.0 in that share of the blocks of 4 x 4 voxels, which begin anywhere."""
    drawn = np.kron(rng.random((SIDE // 4 + 1, SIDE // 4 + 1)) < rate, np.ones((4, 4)))
    first = rng.integers(4, size=2)
    return drawn[first[0] : first[0] + SIDE, first[1] : first[1] + SIDE]


def flight(kind: str, growing: bool, rng: np.random.Generator) -> Events:
    """The log of a flight: the share of each class among the pixels of each voxel and frame."""
    truth = np.argmax([field(rng, 3) for _ in range(K)], axis=0)
    places, towards, state = field(rng, 2), np.pi * field(rng, 4), field(rng, 2)
    shares, pixels = np.zeros((SIDE, SIDE, FRAMES, K)), np.zeros((SIDE, SIDE, FRAMES), int)
    for t in range(FRAMES):
        shown, wrong = truth, np.zeros((SIDE, SIDE))
        if kind == "pixel":
            wrong += RATE
        elif kind == "block":
            wrong = blocks(rng, RATE)
        elif kind == "persistent":
            wrong[places > norm.isf(RATE)] = 1
        elif kind == "view":
            wrong[np.cos(towards - 2 * np.pi * t / FRAMES) > np.cos(np.pi * RATE)] = 1
        elif kind == "class":
            wrong = blocks(rng, 0.5) * (truth == 0)
        elif kind == "boundary":
            shown = np.roll(truth, rng.integers(-1, 2, size=2), axis=(0, 1))
        elif kind == "burst":
            wrong += 0.6 if rng.random() < 1 / 8 else 0
        elif kind == "lasting":
            state = 0.85 * state + np.sqrt(1 - 0.85**2) * field(rng, 2)
            wrong[state > norm.isf(RATE)] = 1
        else:
            wrong += 0.15 + 0.2 * t / (FRAMES - 1)
        anyhow = (np.eye(K)[(shown + 1) % K] * wrong[..., None] + np.eye(K)[shown] * (1 - wrong)[..., None]) * 0.95
        pixels[:, :, t] = 1 + rng.poisson(19 * t / (FRAMES - 1) if growing else 5, (SIDE, SIDE))
        shares[:, :, t] = rng.multinomial(pixels[:, :, t], anyhow + 0.05 / K) / pixels[:, :, t, None]
    seen = rng.random((SIDE * SIDE, FRAMES)) < 0.8
    seen[:, 0] = True
    voxel, frame = np.nonzero(seen)
    x, y = np.divmod(np.arange(SIDE * SIDE), SIDE)
    shares, pixels = shares.reshape(-1, FRAMES, K)[seen], pixels.reshape(-1, FRAMES)[seen]
    return Events(x, y, np.zeros_like(x), voxel, frame, shares, pixels, voxel_size=0.125)


def trend_of(log: Events) -> Interval:
    """The trend of a log, as `describe` gives it."""
    found = trends(log)
    both = np.nan_to_num(np.stack([found.common, found.variation], axis=1))
    return Cubes.of(log.table()).estimate(both, ratio_of, (-1.0, 1.0))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=40)
    trials = parser.parse_args().trials
    print("| errors | pixels | trend, % | above zero | below |\n|---|---|---:|---:|---:|")
    for kind in KINDS:
        for growing in (False, True):
            rng = np.random.default_rng([KINDS.index(kind), growing])
            found = [trend_of(flight(kind, growing, rng)) for _ in range(trials)]
            pixels = "growing" if growing else "alike"
            mean = 100 * np.mean([own.value for own in found])
            above, below = np.mean([(own.low > 0, own.high < 0) for own in found], axis=0)
            print(f"| {kind} | {pixels} | {mean:.1f} | {above:.3f} | {below:.3f} |", flush=True)


if __name__ == "__main__":
    main()
