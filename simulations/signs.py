"""Signs that the label of a voxel is wrong, each larger where that is likelier: for `risk.py runs --signs`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cases
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.stats import mannwhitneyu

import semstab
from semstab.backends.shared.association import back_project, voxel_index
from semstab.comparison.opening import open_run
from semstab.config import Exclusion
from semstab.data.frames import Frame
from semstab.data.measures import dominant
from semstab.data.voxels import VoxelTable
from semstab.statistics.agreement import psa
from semstab.statistics.correctness import join_truth
from semstab.task import Task, open_scenes, read, tasks_of

DISAGREE, IN_MAP = "frames disagree", "border near in the map"
NEAR, UNSURE = "border near in the image", "score low"
SIGNS = (DISAGREE, IN_MAP, f"{NEAR}: one frame", f"{NEAR}: all", f"{UNSURE}: one frame", f"{UNSURE}: all")

SEEN = 3
"""Frames that saw a place, at least."""


def auroc(sign: np.ndarray, wrong: np.ndarray) -> float:
    """Return the probability that a sign is larger at a wrong place than at a right one; NaN if all are one of both."""
    here, elsewhere = sign[wrong], sign[~wrong]
    if not (len(here) and len(elsewhere)) or np.isnan(sign).any():
        return math.nan
    return float(mannwhitneyu(here, elsewhere).statistic / (len(here) * len(elsewhere)))


def to_border(labels: np.ndarray) -> np.ndarray:
    """Return how far each pixel (H, W) is from the next border between labels (H, W), pixels: 0 on both sides of it."""
    inside = np.ones(labels.shape, bool)
    for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        same = labels[one] == labels[other]
        inside[one] &= same
        inside[other] &= same
    if inside.all():
        return np.full(labels.shape, math.hypot(*labels.shape))
    distance: np.ndarray = ndimage.distance_transform_edt(inside)
    return distance


def unsure(scores: np.ndarray) -> np.ndarray:
    """Return 1 minus the largest of the normalised scores (H, W, K) of each pixel."""
    total = scores.sum(axis=2, dtype=np.float64)
    return 1 - scores.max(axis=2) / np.where(total > 0, total, 1)


def to_border_in_map(table: VoxelTable) -> np.ndarray:
    """Return how far each voxel (n,) is from the nearest one with another dominant class, metres; inf if none has."""
    label, centers = dominant(table), table.centers
    distance = np.full(len(table), np.inf)
    for k in np.unique(label):
        of_class = label == k
        if not of_class.all():
            distance[of_class] = cKDTree(centers[~of_class]).query(centers[of_class])[0]
    return distance


class VoxelRows:
    """The rows of a table's voxels."""

    def __init__(self, table: VoxelTable) -> None:
        self.low, self.size = table.index.min(axis=0).astype(int), np.ptp(table.index, axis=0).astype(int) + 1
        key = np.ravel_multi_index(tuple((table.index - self.low).T), self.size)
        self.order = np.argsort(key)
        self.key = key[self.order]

    def find(self, index: np.ndarray) -> np.ndarray:
        """Return the rows (n,) of voxels (n, 3), all of which the table has."""
        key = np.ravel_multi_index(tuple((index - self.low).T), self.size)
        return self.order[np.searchsorted(self.key, key)]


def in_frames(task: Task, scored: Task | None, table: VoxelTable, stride: int) -> dict[str, np.ndarray]:
    """Return signs (n,) of a table's voxels that images give: in the middle frame of those that see it, and in all.

    Each frame counts with the mean over its pixels in the voxel.
    """
    rows, found = VoxelRows(table), []
    for index in task.indices:
        frame = read(task, index, stride)
        signs = of_pixels(task, scored, index, stride)
        voxel = rows.find(voxel_index(back_project(frame), table.voxel_size, frame).T)
        row, inverse, pixels = np.unique(voxel, return_inverse=True, return_counts=True)
        means = [np.bincount(inverse, sign[frame.valid]) / pixels for sign in signs]
        found.append((row, np.stack(means, axis=1)))
    row = np.concatenate([row for row, _ in found])
    order = np.argsort(row, kind="stable")
    row, signs_of = row[order], np.concatenate([means for _, means in found])[order]
    visible, first, frames = np.unique(row, return_index=True, return_counts=True)
    result = {}
    for k, name in enumerate((NEAR, UNSURE)):
        one, every = np.full((2, len(table)), math.nan)
        one[visible] = signs_of[first + frames // 2, k]
        every[visible] = np.add.reduceat(signs_of[:, k], first) / frames
        result |= {f"{name}: one frame": one, f"{name}: all": every}
    return result


def of_pixels(task: Task, scored: Task | None, index: int, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how near a border is, and how unsure the model, at the pixels (H, W); NaN without scores.

    Things that move are left out of fusion, but border on nothing for that.
    """
    whole = _whole(task, index, stride)
    scores = whole.scores if scored is None else _whole(scored, index, stride).scores
    return -to_border(whole.predicted), np.full(whole.shape, math.nan) if scores is None else unsure(scores)


def _whole(task: Task, index: int, stride: int) -> Frame:
    return read(replace(task, exclude=Exclusion(masks=False)), index, stride)


def of_run(run: str, scores: str | None) -> tuple[str, list[Mapping[str, float]]]:
    """Return the model of a run, and for each scene its places, the share that is wrong, and the AUROC of each sign.

    Args:
        run: FOLDER:MODEL.
        scores: The label source of the same folder whose scores tell how sure the model is; by default its own.
    """
    opened, numbers = open_run(run), []
    assert opened.source is not None
    folder = Path(opened.source)
    config = semstab.load_config(folder / "config.yaml")
    for name, scene in open_scenes(config, folder).items():
        tasks = {task.model: task for task in tasks_of(scene, config)}
        record = opened.scenes[name].with_voxels("this")
        table = record.table()
        true = join_truth(table, VoxelTable.load(record.truth_file)).label
        some = (true >= 0) & (table.op >= SEEN)
        wrong = dominant(table)[some] != true[some]
        signs = {DISAGREE: 1 - np.nan_to_num(psa(table)), IN_MAP: -to_border_in_map(table)}
        signs |= in_frames(tasks[opened.model], tasks[scores] if scores else None, table, config.pixel_stride)
        areas = {sign: auroc(signs[sign][some], wrong) for sign in SIGNS}
        numbers.append({"places": len(wrong), "wrong": wrong.mean(), **areas})
    return opened.model, numbers


def table(runs: Sequence[str], scores: str | None) -> None:
    """Print a row for each run: the AUROC of each sign, mean (least to most) of its scenes."""
    cases.head(["model", "places", "wrong, %", *SIGNS])
    for run in runs:
        model, numbers = of_run(run, scores)
        places = sum(counts["places"] for counts in numbers)
        wrong = sum(counts["places"] * counts["wrong"] for counts in numbers) / places
        cells = [
            model,
            f"{places:.0f}",
            f"{100 * wrong:.1f}",
            *(_over([counts[sign] for counts in numbers]) for sign in SIGNS),
        ]
        cases.row(cells)


def _over(values: Sequence[float]) -> str:
    """Return 'mean (least to most)' of the scenes that have a value."""
    numbers = [value for value in values if not math.isnan(value)]
    if not numbers:
        return "-"
    return f"{np.mean(numbers):.2f}" + (f" ({min(numbers):.2f} to {max(numbers):.2f})" if len(values) > 1 else "")
