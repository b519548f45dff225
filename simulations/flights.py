"""Simulated flights over a floor or a city of known errors, and the sums that semstab keeps of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from semstab.data.events import Events
from semstab.data.voxels import VoxelTable
from semstab.statistics.accumulate import cluster_sums_of
from semstab.statistics.agreement import consistency_posterior
from semstab.statistics.cluster_sums import FUNCTIONALS, ClusterSums, columns_of, parts_of
from semstab.statistics.observations import SpotObservations, Views

ROUGH = 0.5
"""How abruptly a place is one on which the model errs."""

VOXEL, PIXELS = 0.125, 16
"""Metres along the edge of a voxel, and the pixels of a frame that show it."""


@dataclass(frozen=True)
class SimulatedFlight:
    """How a model errs on a scene, and how it is flown over.

    Attributes:
        side: Of the floor in voxels.
        reach: Of errors, in voxels: the correlation of places d apart is exp(-d^2 / (2 reach^2)).
        ease: Larger means fewer errors.
        frames: Of the flight.
        observations: Frames that see a place, on average; the number of frames if every frame sees every place.
        quality: Model of the quality of frames: `alike`; 'bad' (one in ten is much worse); 'uneven' (each its own);
            'lasting' (AR(1) with 0.8); 'regimes' (good and bad stretches of 8 frames on average); 'heavy' (Student's t
            with 2 degrees of freedom); 'objects' (a square of 5 voxels errs as a whole, for 3 frames on average);
            'view' (the farther from the middle of the frame, the worse); 'direction' (each location is hard from a
            direction of its own, which neighbours have in common).
        city: Whether the floor is one of boxes with walls, in three dimensions.
        coin: Whether labels are drawn at random instead.
        K: Classes.
        soft: Whether frames give scores: the label gets more if the place is easy, and all classes share the rest.
    """

    side: int = 48
    reach: float = 2.0
    ease: float = 1.0
    frames: int = 4
    observations: int = 4
    quality: str = "alike"
    city: bool = False
    coin: bool = False
    K: int = 2
    soft: bool = False


def field(side: int, reach: float, rng: np.random.Generator) -> np.ndarray:
    """Return a Gaussian field (side, side), mean 0, variance 1, that does not know its border."""
    n = side + int(8 * reach) + 1
    wave = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)[None])
    gain = np.exp(-((np.pi * reach * wave) ** 2))
    noise = np.fft.fft2(rng.standard_normal((n, n)))
    return np.fft.ifft2(noise * gain).real[:side, :side] / np.sqrt((gain**2).mean())


def qualities(flight: SimulatedFlight, rng: np.random.Generator) -> np.ndarray:
    """Return how much worse each frame is than usual (F,)."""
    steps = rng.standard_normal(flight.frames)
    if flight.quality == "bad":
        return np.where(rng.random(flight.frames) < 0.1, 2.0, 0.0)
    if flight.quality == "uneven":
        return 0.5 * steps
    if flight.quality == "lasting":
        for t in range(1, flight.frames):
            steps[t] = 0.8 * steps[t - 1] + 0.6 * steps[t]
        return 0.5 * steps
    if flight.quality == "regimes":
        return np.where(np.cumsum(rng.random(flight.frames) < 1 / 8) % 2 == rng.integers(2), 1.0, 0.0)
    if flight.quality == "heavy":
        return 0.35 * rng.standard_t(2, flight.frames)
    return np.zeros(flight.frames)


def places(flight: SimulatedFlight) -> np.ndarray:
    """Return voxel indices (n, 3).

    A floor, or blocks of houses 12 voxels wide and up to 8 high, with streets of 8 between.
    """
    x, y = (axis.ravel() for axis in np.indices((flight.side, flight.side)))
    if not flight.city:
        return np.stack([x, y, np.zeros_like(x)], axis=1)
    house = (x % 20 < 12) & (y % 20 < 12)
    height = np.where(house, 4 + (3 * (x // 20) + 5 * (y // 20)) % 5, 0)
    edge = house & ((x % 20 % 11 == 0) | (y % 20 % 11 == 0))
    walls = [np.stack([x, y, np.full_like(x, z)], axis=1)[edge & (z < height)] for z in range(8)]
    return np.concatenate([np.stack([x, y, height], axis=1), *walls])


@dataclass(frozen=True)
class World:
    """A scene as it is.

    Attributes:
        index: (n, 3) of its voxels, truth (n,) their class.
        hard: (n,) how hard each is, turned (n,) the direction in radians from which it is hardest.
        mixed: (n,) the part of a voxel that is of the next class, as at a border.
    """

    index: np.ndarray
    truth: np.ndarray
    hard: np.ndarray
    turned: np.ndarray
    mixed: np.ndarray


def world(flight: SimulatedFlight, rng: np.random.Generator) -> World:
    """Return a scene of the kind that the flight says."""
    index = places(flight)
    x, y, z = index.T
    order = np.lexsort(index.T[::-1])
    at = ((x + z)[order] % flight.side, y[order])  # a wall continues the field of the floor
    classes = np.stack([field(flight.side, max(flight.reach, 0.5), rng)[at] for _ in range(max(flight.K - 1, 1))])
    hard = field(flight.side, flight.reach, rng)[at]
    truth = (classes[0] > 0).astype(int) if flight.K == 2 else _largest(classes)
    turned = np.pi * field(flight.side, flight.reach, rng)[at]
    return World(index[order], truth, hard, turned, np.where(np.abs(classes[0]) < 0.25, 0.3, 0.0))


def _largest(classes: np.ndarray) -> np.ndarray:
    """Return the class (n,) whose field (K - 1, n) is highest; the last one where all are low."""
    return np.where(classes.max(axis=0) > 0, classes.argmax(axis=0), len(classes))


def fly(flight: SimulatedFlight, over: World, rng: np.random.Generator, ease: float | None = None) -> np.ndarray:
    """Return labels (n, F) of a flight over a scene; -1 where a frame does not see a place."""
    n, F = len(over.index), flight.frames
    off = over.index[:, :1] - (np.arange(F) + 0.5) / F * flight.side
    width = flight.side * flight.observations / F
    visible = np.ones((n, F), bool) if flight.observations >= F else np.abs(off) <= width / 2
    voxel, frame = np.nonzero(visible)
    off = off[visible] / width
    harder = over.hard[voxel] - (flight.ease if ease is None else ease) + qualities(flight, rng)[frame]
    if flight.quality == "view":
        harder = harder + 3 * np.abs(off) - 0.7
    if flight.quality == "direction":
        harder = harder + np.cos(2 * np.pi * off - over.turned[voxel])
    chance = 0.5 if flight.coin else 0.6 * norm.cdf(harder / ROUGH)
    wrong = (_by_object(over, F, rng)[voxel, frame] if flight.quality == "objects" else rng.random(len(voxel))) < chance
    other = 1 if flight.K == 2 else 1 + rng.integers(flight.K - 1, size=len(voxel))
    labels = np.full((n, F), -1)
    labels[voxel, frame] = np.where(wrong, (over.truth[voxel] + other) % flight.K, over.truth[voxel])
    return labels


def _by_object(over: World, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return uniform numbers (n, F) that are one for a square of 5 x 5 voxels, and stay so for 3 frames on average."""
    _, of = np.unique(over.index[:, :2] // 5, axis=0, return_inverse=True)
    drawn = rng.random((of.max() + 1, frames))
    for t in range(1, frames):
        stays = rng.random(len(drawn)) < 2 / 3
        drawn[stays, t] = drawn[stays, t - 1]
    return drawn[of.ravel()]


def log_of(labels: np.ndarray, over: World, flight: SimulatedFlight, voxel_size: float = VOXEL) -> Events:
    """Return the log of labels (n, F), or of scores for them."""
    some = (labels >= 0).any(axis=1)
    voxel, frame = np.nonzero(labels[some] >= 0)
    evidence = np.eye(flight.K)[labels[some][voxel, frame]]
    if flight.soft:
        sure = norm.cdf(1.0 - over.hard[some][voxel])[:, None]
        evidence = sure * evidence + (1 - sure) / flight.K
    return Events(*over.index[some].T, voxel, frame, evidence, np.ones(len(voxel)), voxel_size)


def table_of(log: Events) -> VoxelTable:
    """Return the map of a log; nothing here asks for its drift."""
    op, scores = np.bincount(log.voxel), log.evidence[:]
    rest = {"drift_sum": np.zeros(len(op)), "frame_entropy_sum": np.zeros(len(op))}
    frames = {"first_frame": np.zeros(len(op)), "last_frame": np.zeros(len(op))}
    return VoxelTable(
        log.ix, log.iy, log.iz, op=op, evidence=np.add.reduceat(scores, log.starts, axis=0), pixels=op,
        self_sum=np.add.reduceat((scores**2).sum(axis=1), log.starts), **rest, **frames, voxel_size=log.voxel_size,
    )  # fmt: skip


def sums_of(
    labels: np.ndarray, over: World, flight: SimulatedFlight = SimulatedFlight(), rng: np.random.Generator | None = None
) -> ClusterSums:
    """Return the sums of a flight, with the truth, and with the cells that alpha is of; see `sample_of`."""
    log = log_of(labels, over, flight)
    table, truth = table_of(log), over.truth[(labels >= 0).any(axis=1)]
    observed = sample_of(labels, over, flight, rng)
    return cluster_sums_of(table, log, truth, spots=observed, consistent=consistency_posterior(table))


def sample_of(
    labels: np.ndarray, over: World, flight: SimulatedFlight, rng: np.random.Generator | None = None
) -> SpotObservations:
    """Return what a sampler takes of a flight: likeliest classes of fine cells, half as wide as a voxel.

    A frame sees one cell of a voxel, with `rng` at borders also another one, of the next class, of which it sees more
    or less. A label that errs moves both by as many classes.
    """
    voxel, frame = np.nonzero(labels >= 0)
    first, pixels = labels[voxel, frame], np.zeros(len(voxel), int)
    if rng is not None:
        mixed = over.mixed[voxel]
        part = np.where(mixed > 0, np.clip(mixed + 0.3 * rng.standard_normal(len(voxel)), 0, 1), 0.0)
        pixels = np.rint(part * PIXELS).astype(int)
    label = first if rng is None else np.where(rng.random(len(voxel)) * PIXELS < pixels, (first + 1) % flight.K, first)
    frames = labels.shape[1]
    along, middle = (np.arange(frames) + 0.5) / frames * flight.side * VOXEL, flight.side * VOXEL / 2
    centres = np.stack([along, np.full(frames, middle), np.full(frames, 10.0)], axis=1)
    views = Views(np.arange(frames), centres, np.full(frames, np.nan), np.full(frames, VOXEL))
    label, distance = label.astype(np.uint16), np.ones(len(label), np.float32)
    return SpotObservations(
        voxel.astype(np.int32), frame.astype(np.int32), label, label, label, distance, distance,
        (over.index + 0.5) * VOXEL, np.zeros(len(over.index), np.uint32), views, VOXEL, flight.K, frames=frames,
    )  # fmt: skip


def totals_of(sums: ClusterSums, key: str) -> np.ndarray:
    """Return what a number is of, (parts, C): it adds up over flights."""
    number = FUNCTIONALS[key]
    return np.stack([columns_of(part, number).sum(axis=0) for part, _ in parts_of(sums, number)])


def number_of(totals: np.ndarray, key: str) -> np.ndarray:
    """Return the number (...,) of such totals (..., parts, C), whose answers are one, so that the first part tells."""
    return FUNCTIONALS[key].of(totals[..., 0, :])
