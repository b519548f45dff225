"""True errors in the first tasks of `export --format`, and in as many regions chosen without a map.

The others are windows as large as the tasks, pixel by pixel the same budget: where the scores of a single image have
the highest entropy (without windows that overlap in one image), at random, and at random on an edge between two
classes. Wrong are pixels with depth whose label is not the truth: those in the regions, and those of all frames at the
voxels that the regions show, which a label of the place mends; wrong voxels have such a pixel.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import cv2
import measuring
import numpy as np

import semstab
from semstab.backends.shared.association import back_project
from semstab.data.information import entropy_bits
from semstab.exports.annotation import annotation_tasks
from semstab.exports.relabel import task_of
from semstab.exports.voxels import ExportedUnit
from semstab.task import read, truth_task

NONE = -1


class WrongPixels:
    """The wrong pixels of each frame, its voxels, and the entropy of its scores."""

    def __init__(self, task, scores, size):
        truth = truth_task(task)
        self.frames = list(task.indices)
        self.wrong, self.key, self.entropy, self.edge, voxels = {}, {}, {}, {}, []
        for i in self.frames:
            frame, true, soft = read(task, i), read(truth, i), read(scores, i)
            self.wrong[i] = true.valid & (frame.predicted != true.predicted) & (true.predicted != true.ignore_id)
            self.key[i] = np.where(frame.valid, 0, NONE)
            self.entropy[i] = entropy_bits(soft.scores)
            edges = cv2.morphologyEx(frame.predicted.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3)))
            self.edge[i] = np.argwhere((edges > 0) & frame.valid)
            voxels.append(np.floor(back_project(frame).T / size).astype(np.int64))
        _, key = np.unique(np.concatenate(voxels), axis=0, return_inverse=True)
        for i, keys in zip(self.frames, np.split(key.ravel(), np.cumsum([*map(len, voxels)])[:-1]), strict=True):
            self.key[i][self.key[i] != NONE] = keys
        of_wrong = {i: self.key[i][self.wrong[i] & (self.key[i] != NONE)] for i in self.frames}
        self.errors = np.bincount(np.concatenate([*of_wrong.values()]), minlength=int(key.max()) + 1)

    def held(self, masks):
        """Pixels of [(frame, mask), ...], wrong ones; voxels shown, wrong pixels of all frames there, wrong voxels."""
        pixels = sum(int(mask.sum()) for _, mask in masks)
        wrong = sum(int((mask & self.wrong[i]).sum()) for i, mask in masks)
        held_voxels = np.unique(np.concatenate([self.key[i][mask & (self.key[i] != NONE)] for i, mask in masks]))
        return (
            pixels,
            wrong,
            len(held_voxels),
            int(self.errors[held_voxels].sum()),
            int((self.errors[held_voxels] > 0).sum()),
        )


def window(shape, center, area):
    """A square of that area inside an image."""
    side = max(1, round(area**0.5))
    low = [int(np.clip(c - side // 2, 0, max(0, n - side))) for c, n in zip(center, shape, strict=True)]
    mask = np.zeros(shape, bool)
    mask[low[0] : low[0] + side, low[1] : low[1] + side] = True
    return mask


def by_entropy(images, areas):
    """Windows at the highest mean entropy, none over another one of the same image."""
    free = {i: np.ones(e.shape, bool) for i, e in images.entropy.items()}
    chosen = []
    for area in areas:
        side = max(1, round(area**0.5))
        best = None
        for i, entropy in images.entropy.items():
            mean = cv2.boxFilter(np.where(free[i], entropy, -1.0).astype(np.float32), -1, (side, side))
            at = np.unravel_index(mean.argmax(), mean.shape)
            if best is None or mean[at] > best[0]:
                best = mean[at], i, at
        _, i, at = best
        mask = window(free[i].shape, at, area)
        free[i] &= ~mask
        chosen.append((i, mask))
    return chosen


def at_random(images, areas, rng, *, edges):
    """Windows around a random pixel, or a random pixel on an edge of labels."""
    chosen = []
    for area in areas:
        i = images.frames[rng.integers(len(images.frames))]
        shape = images.wrong[i].shape
        rows = images.edge[i] if edges and len(images.edge[i]) else np.argwhere(images.key[i] != NONE)
        chosen.append((i, window(shape, rows[rng.integers(len(rows))], area)))
    return chosen


def main(run: Path, model: str = "fcn", scores: str = "fcn-scores", most: int = 50):
    result = semstab.load_result(run)
    record, soft = (result.record(model=name) for name in (model, scores))
    with contextlib.ExitStack() as open_tasks:
        task, soft_task = (
            open_tasks.enter_context(task_of(run, opened, result.manifest["inputs"]))[0] for opened in (record, soft)
        )
        tasks = annotation_tasks(ExportedUnit(result, record, columns=("op",)), task, most)
        images = WrongPixels(task, soft_task, ExportedUnit(result, record, columns=("op",)).first.table.voxel_size)
    masks = []
    for one in tasks:
        mask = np.zeros(one.size[::-1], np.uint8)
        cv2.drawContours(mask, [p.astype(np.int32) for p in one.outline], -1, 1, cv2.FILLED)
        masks.append((one.frame, mask.astype(bool)))
    areas = [int(mask.sum()) for _, mask in masks]
    rows = {
        f"{len(tasks)} tasks": images.held(masks),
        "entropy of single images": images.held(by_entropy(images, areas)),
    }
    for name, edges in (("random on an edge of labels", True), ("random", False)):
        drawn = [images.held(at_random(images, areas, np.random.default_rng(s), edges=edges)) for s in range(20)]
        rows[name] = tuple(float(np.mean(values)) for values in zip(*drawn, strict=True))
    table = measuring.MarkdownTable(
        regions="",
        pixels=",.0f",
        wrong=",.0f",
        share=".1%",
        voxels=",.0f",
        wrong_in_all_frames=",.0f",
        wrong_voxels=",.0f",
    )
    for name, (pixels, wrong, voxels, everywhere, places) in rows.items():
        table.add(regions=name, pixels=pixels, wrong=wrong, share=wrong / pixels, voxels=voxels,
                  wrong_in_all_frames=everywhere, wrong_voxels=places)  # fmt: skip
    errors = images.errors
    table.add(regions="all there are", voxels=len(errors), wrong_in_all_frames=int(errors.sum()),
              wrong_voxels=int(np.count_nonzero(errors)))  # fmt: skip
    return table.rows
