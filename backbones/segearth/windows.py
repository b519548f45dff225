"""Sliding windows: a model that sees a small square is moved over a larger image, and its logits are averaged."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn


def starts(length: int, window: int, stride: int) -> list[int]:
    """Where windows begin along an axis; the last one ends at the border.

    >>> starts(448, 224, 112), starts(299, 224, 112), starts(200, 224, 112)
    ([0, 112, 224], [0, 75], [0])
    """
    last = max(0, length - window)
    return [*range(0, last, stride), last]


def slide(
    pixels: torch.Tensor, window: int, stride: int, logits_of: Callable[[torch.Tensor], torch.Tensor]
) -> torch.Tensor:
    """Mean logits (Q, H, W) of all windows over an image (3, H, W).

    logits_of  one window (3, h, w) to its logits (Q, h, w); h and w are `window`, or less where the image is smaller
    """
    H, W = pixels.shape[1:]
    total, count = None, torch.zeros(H, W, dtype=pixels.dtype, device=pixels.device)
    for top in starts(H, window, stride):
        for left in starts(W, window, stride):
            place = (..., slice(top, top + window), slice(left, left + window))
            logits = logits_of(pixels[place])
            total = logits.new_zeros(len(logits), H, W) if total is None else total
            total[place] += logits
            count[place] += 1
    assert total is not None
    return total / count


def padded(pixels: torch.Tensor, multiple: int) -> tuple[torch.Tensor, tuple[slice, ...]]:
    """The image (..., H, W) between zeros so that both sides are multiples, and where it lies in it."""
    H, W = pixels.shape[-2:]
    top, left = -H % multiple // 2, -W % multiple // 2
    bottom, right = -H % multiple - top, -W % multiple - left
    place = (slice(top, top + H), slice(left, left + W))
    return nn.functional.pad(pixels, (left, right, top, bottom)), place
