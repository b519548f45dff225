"""The tensor operations of the torch backend, on any device: pixels to voxels, evidence, and the update of a map.

Every sum over pixels is one of integers: counts of labels, and scores in units of a fixed fraction. Integer sums do not
depend on their order, so that the numbers are the same run after run, although on an accelerator the order is not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from semstab.backends.shared.keys import HALF
from semstab.backends.shared.observations import Change
from semstab.backends.torch_storage import Columns, DepthView, MapGrid, PixelLabels, Scores
from semstab.data.measures import RECURRENT

NONE, LOST = -1, -2
"""Marks instead of a voxel: the pixel has no depth, or its point is out of the map's reach."""

SCORE_BITS, SCORE_BITS_SINGLE = 48, 25
"""Scores are summed in units of 2^-48, or of 2^-(62 - b) in images of 2^b > 2^14 pixels (2^-39 at 3840x2160); shares
that were computed in float32 in units of 2^-25, half the distance of the float32 numbers below 1."""

SUMS = len(fields(Change))
"""The count of numbers that `update` returns: the fields of a `Change`, in its order."""


@dataclass(frozen=True, eq=False)
class Association:
    """The voxels of a view: keys (n,) int64, distinct; and for each pixel its voxel's index there, (H, W) int32.

    NONE or LOST stands instead of a voxel.
    """

    keys: torch.Tensor
    voxel: torch.Tensor


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """The evidence of one model for the n voxels of a view: s_bar = sums / (scale * pixels).

    Attributes:
        sums: (K, n) integer.
        pixels: (n,) int64 pixels that count; 0 in voxels that the model does not see.
        flags: (3,) int64 faults: the highest label id that a pixel which counts has, where that is no class,
            else -1 or a class; whether such a pixel is out of reach; whether a score is below 0.
    """

    sums: torch.Tensor
    pixels: torch.Tensor
    scale: float
    flags: torch.Tensor


def score_scale(pixels: int, double: bool) -> float:
    """Return units of a score of 1: a power of 2, such that the sum over all pixels fits 63 bits."""
    return 2.0 ** min(SCORE_BITS if double else SCORE_BITS_SINGLE, 62 - pixels.bit_length())


def chunk_of(device: torch.device) -> int:
    """Return numbers that are worked on at a time: few enough for a CPU's cache, enough to fill an accelerator."""
    return 1 << 16 if device.type == "cpu" else 1 << 22


def parts(total: int, size: int) -> Iterator[slice]:
    """Return the range in parts of that size, at least 1."""
    size = max(size, 1)
    return (slice(start, min(start + size, total)) for start in range(0, total, size))


# --- Pixels to voxels -------------------------------------------------------------------------------------------------


def associate(view: DepthView, grid: MapGrid) -> Association:
    """Return the voxels of a view, ascending by key, and the one of each pixel."""
    H, W = view.depth.shape
    terms = (camera_terms if grid.dtype == torch.float64 else camera_terms_single)(view, grid)
    rows = parts(H, chunk_of(view.depth.device) // W)
    runs = [torch.unique_consecutive(_keys(view, grid, terms, part), return_counts=True) for part in rows]
    key, length = (torch.cat(part) for part in zip(*runs, strict=True))
    keys, inverse = torch.unique(key, return_inverse=True)
    nowhere = int((keys < 0).sum())
    voxel = torch.where(key < 0, key, inverse - nowhere).to(torch.int32)
    pixels = torch.repeat_interleave(voxel, length, output_size=H * W)
    return Association(keys[nowhere:], pixels.reshape(H, W))


def _keys(view: DepthView, grid: MapGrid, terms: list[torch.Tensor], rows: slice) -> torch.Tensor:
    """Return packed keys (pixels,) int64 of some rows of a view, NONE without depth, LOST out of reach."""
    depth = view.depth[rows]
    ok = (depth > 0) & (depth < torch.inf)
    d = torch.where(ok, depth, 0).to(grid.dtype)
    if grid.dtype == torch.float64:  # by a number, not a tensor, torch divides on a CUDA device as by the reciprocal
        ray_x, ray_y, T, r, origin = terms
        x, y, z = (ray_x * d, ray_y[rows] * d, d) if view.points is None else _coordinates(view.points[rows], ok, grid)
        q = torch.floor((((T[:, 0] * x + T[:, 1] * y) + T[:, 2] * z) + T[:, 3]) / r) - origin
    elif view.points is None:
        a, b, start, origin = terms
        q = torch.floor(d * (a + b[:, rows]) + start) + origin
    else:
        R, start, origin = terms
        x, y, z = _coordinates(view.points[rows], ok, grid)
        q = torch.floor(((R[:, 0] * x + R[:, 1] * y) + R[:, 2] * z) + start) + origin
    near = ((q >= -HALF) & (q < HALF)).all(dim=0)
    i, j, k = torch.where(near, q, 0).to(torch.int64) + HALF
    key = torch.where(near, (i << 42) | (j << 21) | k, LOST)
    return torch.where(ok, key, NONE).reshape(-1)


def _coordinates(points: torch.Tensor, ok: torch.Tensor, grid: MapGrid) -> tuple[torch.Tensor, ...]:
    """Return x, y and z (H, W) of points (H, W, 3); 0 where they do not count."""
    return torch.where(ok[..., None], points, 0).to(grid.dtype).unbind(dim=-1)


def camera_terms(view: DepthView, grid: MapGrid) -> list[torch.Tensor]:
    """Return rays (W,), (H, 1), the pose (3, 4, 1, 1), voxel size (1,) and origin (3, 1, 1), in float64."""
    ray_x, ray_y = view.rays
    T = view.camera.T_wc[:3, :, None, None]
    origin = np.array(grid.origin)[:, None, None]
    return _uploaded([ray_x, ray_y[:, None], T, np.array([grid.voxel_size]), origin], grid.dtype, view.depth.device)


def camera_terms_single(view: DepthView, grid: MapGrid) -> list[torch.Tensor]:
    """Return a (3, 1, W), b (3, H, 1), start and offset (3, 1, 1), float32: x_w / r = d (a + b) + start.

    Units are voxels. Integers hold the whole voxels of the camera's position, so float32 holds no more than the
    distance from the camera, and gives the same voxels in UTM-sized coordinates. A scan has R (3, 3, 1, 1), start and
    offset: x_w / r = R p + start.
    """
    ray_x, ray_y = view.rays
    R, t = view.camera.T_wc[:3, :3] / grid.voxel_size, view.camera.T_wc[:3, 3] / grid.voxel_size
    camera = np.floor(t)
    start, offset = (t - camera)[:, None, None], (camera - grid.origin)[:, None, None]
    if view.points is not None:
        return _uploaded([R[:, :, None, None], start, offset], grid.dtype, view.depth.device)
    a = (R[:, :1] * ray_x)[:, None, :]
    b = (R[:, 1:2] * ray_y + R[:, 2:])[:, :, None]
    return _uploaded([a, b, start, offset], grid.dtype, view.depth.device)


def _uploaded(terms: list[npt.NDArray[Any]], dtype: torch.dtype, device: torch.device) -> list[torch.Tensor]:
    """Return the arrays as tensors on the device, behind one another, in one copy."""
    flat = torch.tensor(np.concatenate([term.ravel() for term in terms]), dtype=dtype, device=device)
    parts_of = torch.split_with_sizes(flat, [term.size for term in terms])
    return [part.reshape(term.shape) for part, term in zip(parts_of, terms, strict=True)]


# --- Evidence ---------------------------------------------------------------------------------------------------------


def count_labels(association: Association, predicted: PixelLabels, num_classes: int) -> ViewEvidence:
    """Return pixels of each class in each voxel."""
    n, K, voxels = len(association.keys), num_classes, association.voxel.reshape(-1)
    sums = voxels.new_zeros(K * n)
    flags = association.keys.new_tensor([-1, 0, 0])
    for part in parts(len(voxels), chunk_of(sums.device)):
        voxel, label = voxels[part], predicted.ids[part].to(torch.int64)
        labelled = (label >= 0) & (label != predicted.ignore) & (voxel != NONE)
        wrong = (torch.where(labelled, label, -1).max(), (labelled & (voxel == LOST)).any(), flags[2])
        flags = torch.maximum(flags, torch.stack([flag.to(torch.int64) for flag in wrong]))
        cells = (label * n + voxel)[labelled & (voxel >= 0) & (label < K)]
        sums.index_add_(0, cells, sums.new_ones(()).expand(len(cells)))
    sums = sums.reshape(K, n)
    return ViewEvidence(sums, sums.sum(dim=0), 1.0, flags)


def sum_scores(association: Association, predicted: Scores, num_classes: int) -> ViewEvidence:
    """Return sums of the normalised scores in each voxel."""
    n, K, voxels = len(association.keys), num_classes, association.voxel.reshape(-1)
    scale = score_scale(len(voxels), double=predicted.values.dtype == torch.float64 or not predicted.softmax)
    sums, pixels = association.keys.new_zeros(K * n), association.keys.new_zeros(n)
    flags = association.keys.new_tensor([-1, 0, 0])
    classes = torch.arange(K, device=sums.device)[:, None]
    for part in parts(len(voxels), chunk_of(sums.device) // K):
        voxel, values = voxels[part], predicted.values[:, part]
        s, usable = shares(values, softmax=predicted.softmax)
        usable &= voxel != NONE
        below = (values < 0) & torch.isfinite(values) & (not predicted.softmax)
        wrong = (flags[0], (usable & (voxel == LOST)).any(), below.any())
        flags = torch.maximum(flags, torch.stack([flag.to(torch.int64) for flag in wrong]))
        usable &= voxel != LOST
        rows, units = voxel[usable].to(torch.int64), torch.floor(s[:, usable] * scale + 0.5).to(torch.int64)
        sums.index_add_(0, (classes * n + rows).reshape(-1), units.reshape(-1))
        pixels.index_add_(0, rows, torch.ones_like(rows))
    return ViewEvidence(sums.reshape(K, n), pixels, scale, flags)


def shares(values: torch.Tensor, softmax: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores or logits (K, P) as shares that sum to 1, and which pixels (P,) have such."""
    if softmax:
        s = torch.softmax(values if values.dtype == torch.float64 else values.to(torch.float32), dim=0)
        return s, torch.isfinite(s[0])
    values = values.to(torch.float64)
    total = values.sum(dim=0)
    return values / total, torch.isfinite(total) & (total > 0)


# --- The map ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Update:
    """The change of a map by a frame, on the device.

    Attributes:
        sums: (SUMS,) float64 a `Change`.
        observed: (n,) numbers of the frame's voxels that were updated.
        changed: (n, 3) float64 of each: drift in bits, NaN for a new voxel; dominant class before and after.
    """

    sums: torch.Tensor
    observed: torch.Tensor
    changed: torch.Tensor


def update(columns: Columns, rows: torch.Tensor, evidence: ViewEvidence, frame: int) -> Update:
    """Add one observation to the rows (n,) of the voxels that the evidence sees."""
    observed = torch.nonzero(evidence.pixels)[:, 0]
    sums = torch.zeros(SUMS, dtype=torch.float64, device=observed.device)
    changed = sums.new_empty((len(observed), 3))
    for part in parts(len(observed), 4 * chunk_of(observed.device) // columns.num_classes):
        voxels = observed[part]
        pixels = evidence.pixels[voxels]
        sums_of = evidence.sums[:, voxels].T.to(torch.float64).contiguous()
        s_bar = sums_of / (pixels.to(torch.float64) * evidence.scale)[:, None]
        sums += _observe(columns, rows[voxels], s_bar, pixels, frame, changed[part])
    return Update(sums, observed, changed)


def _observe(
    columns: Columns, rows: torch.Tensor, s_bar: torch.Tensor, pixels: torch.Tensor, frame: int, changed: torch.Tensor
) -> torch.Tensor:
    held = columns.values
    op = held["op"][rows]
    new = op == 0
    before = held["evidence"][rows].to(torch.float64)
    after = (before + s_bar).to(held["evidence"].dtype)
    p = before / op.clamp(min=1)[:, None]
    q = after.to(torch.float64) / (op + 1)[:, None]
    entropy_p, entropy_q = _entropy_bits(p), _entropy_bits(q)
    divergence = _entropy_bits((p + q) / 2) - (entropy_p + entropy_q) / 2  # Jensen-Shannon, by entropies
    drift = torch.where(new, 0, divergence.clamp(0, 1))
    held["evidence"][rows] = after
    held["op"][rows] = op + 1
    held["pixels"][rows] += pixels
    held["drift_sum"][rows] += drift
    held["self_sum"][rows] += (s_bar * s_bar).sum(dim=1)
    held["frame_entropy_sum"][rows] += _entropy_bits(s_bar)
    held["first_frame"][rows] = torch.where(new, frame, held["first_frame"][rows].clamp(max=frame))
    held["last_frame"][rows] = torch.where(new, frame, held["last_frame"][rows].clamp(min=frame))
    (top_p, dominant_p), (top_q, dominant_q) = p.max(dim=1), q.max(dim=1)
    changed[:, 0] = torch.where(new, math.nan, drift)
    changed[:, 1], changed[:, 2] = torch.where(new, dominant_q, dominant_p), dominant_q
    vss, entropy = top_q - top_p, entropy_q - entropy_p
    sums = (
        pixels.sum(), pixels.new_tensor(len(rows)), new.sum(), drift.sum(), vss.sum(), entropy.sum(),
        (op + 1 == RECURRENT).sum(),
    )  # fmt: skip
    return torch.stack([value.to(torch.float64) for value in sums])


def _entropy_bits(p: torch.Tensor) -> torch.Tensor:
    """Return Shannon entropy of distributions (n, K), in bits."""
    return torch.xlogy(p, p).sum(dim=1) * (-1 / math.log(2))
