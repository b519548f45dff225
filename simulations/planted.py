"""Copies of a posed folder whose label source has a known fault, to see whether a gate finds it.

    python simulations/simulate.py planted SCENE OUT [--source fcn] [--class bunny_book] [--to kleenex]

Writes four folders, each with the scene's own depth, poses and ground truth:

- OUT/third: the class is labelled as another one in every third frame
- OUT/first: the same in the first third of the frames
- OUT/flip: 2 % of the pixels, drawn at random, have a random class
- OUT/blocks: in every third frame, from the first on, 15 % of the blocks of 24 x 24 pixels have another class each
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

SHARE, SEED = 0.02, 0
BLOCK, BLOCKS = 24, 0.15
"""Pixels along the edge of a block of wrong labels, and the share of the blocks."""

Fault = Callable[[int, int, np.ndarray], np.ndarray]


def plant(scene: Path, out: Path, source: str, fault: Fault) -> None:
    """A copy of the scene with this fault of (number of the frame, how many there are, its labels)."""
    labels = out / "labels" / source
    shutil.rmtree(out, ignore_errors=True)
    labels.mkdir(parents=True)
    for part in ("color", "depth", "pose", "labels/gt"):
        if (scene / part).is_dir():
            (out / part).symlink_to(os.path.relpath((scene / part).resolve(), (out / part).parent.resolve()))
    for file in (path for path in scene.iterdir() if path.suffix in (".yaml", ".txt")):
        shutil.copy(file, out)
    files = sorted((scene / "labels" / source).glob("*.png"))
    for number, file in enumerate(files):
        changed = fault(number, len(files), np.array(Image.open(file)))
        Image.fromarray(changed).save(labels / file.name)


def in_blocks(labels: np.ndarray, classes: int, rng: np.random.Generator, share: float = BLOCKS) -> np.ndarray:
    """The labels (H, W) with another class in each of a share of the blocks, where they have a class at all."""
    H, W = labels.shape
    grid = -(-H // BLOCK), -(-W // BLOCK)
    drawn = rng.permutation(grid[0] * grid[1]).reshape(grid) < round(share * grid[0] * grid[1])
    moved = np.where(drawn, rng.integers(1, classes, grid), 0)
    moved = np.repeat(np.repeat(moved, BLOCK, axis=0), BLOCK, axis=1)[:H, :W]
    return np.where(labels < classes, (labels + moved) % classes, labels).astype(labels.dtype)


def faults(names: list[str], wrong: str, to: str) -> dict[str, Fault]:
    """By name."""
    k, other = names.index(wrong), names.index(to)
    rng = np.random.default_rng(SEED)

    def relabelled(labels: np.ndarray) -> np.ndarray:
        return np.where(labels == k, other, labels).astype(labels.dtype)

    def flipped(labels: np.ndarray) -> np.ndarray:
        drawn = (rng.random(labels.shape) < SHARE) & (labels < len(names))
        return np.where(drawn, rng.integers(0, len(names), labels.shape), labels).astype(labels.dtype)

    return {
        "third": lambda number, count, labels: labels if number % 3 else relabelled(labels),
        "first": lambda number, count, labels: relabelled(labels) if number < count // 3 else labels,
        "flip": lambda number, count, labels: flipped(labels),
        "blocks": lambda number, count, labels: labels if number % 3 else in_blocks(labels, len(names), rng),
    }


def main(scene: Path, out: Path, source: str = "fcn", class_: str = "bunny_book", to: str = "kleenex") -> None:
    names = yaml.safe_load((scene / "scene.yaml").read_text())["classes"]
    for name, fault in faults(names, class_, to).items():
        plant(scene, out / name / scene.name, source, fault)
