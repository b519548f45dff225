"""Logs of observations from labels that a test writes down or draws."""

from __future__ import annotations

import math

import numpy as np

from semstab import Events
from semstab.statistics import SpotObservations, Views


def log_of(labels, K=3, index=None, frames=None, voxel_size=0.2):
    """One-hot observations: labels (n, F) of n voxels in F frames, -1 where a frame does not see the voxel."""
    labels = np.asarray(labels)
    return log_of_evidence(np.eye(K)[np.maximum(labels, 0)], labels >= 0, index, frames, voxel_size)


def log_of_evidence(evidence, visible=None, index=None, frames=None, voxel_size=0.2):
    """Observations s_bar (n, F, K), where (n, F) `visible` says which there are; voxels (0, 0, 0), (0, 0, 1), ..."""
    evidence = np.asarray(evidence, dtype=np.float64)
    n, F, _ = evidence.shape
    visible = np.ones((n, F), dtype=bool) if visible is None else visible
    voxel, frame = np.nonzero(visible)
    index = np.stack([np.zeros(n), np.zeros(n), np.arange(n)], axis=1) if index is None else index
    return Events(
        *np.asarray(index).T, voxel=voxel, frame=frame if frames is None else np.asarray(frames)[frame],
        evidence=evidence[visible], pixels=np.ones(len(voxel)), voxel_size=voxel_size,
    )  # fmt: skip


def grid(side):
    """Indices (side * side, 3) of a floor of voxels, sorted."""
    x, y = np.divmod(np.arange(side * side), side)
    return np.stack([x, y, np.zeros_like(x)], axis=1)


def soft(rng, n, F, K=3, alpha=0.5):
    """Random evidence (n, F, K) that is not one-hot."""
    return rng.dirichlet(np.full(K, alpha), size=(n, F))


def spots_of(labels, K=3, index=None, centres=None, spacing=0.125):
    """The same labels (n, F), -1 where there is none, of spots, one in a cell (n, 3); the three answers are one.

    The cameras at (F, 3) are 9 m above the first cell if not given.
    """
    labels = np.asarray(labels)
    n, F = labels.shape
    index = np.stack([np.zeros(n), np.zeros(n), np.arange(n)], axis=1) if index is None else np.asarray(index)
    spot, view = np.nonzero(labels >= 0)
    return spots_at(index * spacing, spot, view, labels[spot, view], F, K, centres, spacing)


def spots_at(point, spot, view, label, F, K=3, centres=None, spacing=0.125):
    """Answers of F views for spots at points (n, 3), each given once."""
    m = len(spot)
    centres = np.tile([0.0, 0.0, 9.0], (F, 1)) if centres is None else np.asarray(centres, float)
    views = Views(np.arange(F), centres, np.full(F, math.nan), np.full(F, spacing))
    label = np.asarray(label).astype(np.uint16)
    return SpotObservations(
        np.asarray(spot, np.int32), np.asarray(view, np.int32), label, label, label, np.ones(m, np.float32),
        np.ones(m, np.float32), np.asarray(point, float).reshape(-1, 3), np.zeros(len(point), np.uint32), views,
        spacing, K, frames=F,
    )  # fmt: skip
