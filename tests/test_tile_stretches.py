"""What tasks find of stretches of frames, side by side, is what one finds of all of them."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.engine.tiling import collected
from semstab.engine.tiling.collected import Collected, Seen
from semstab.engine.tiling.partition import tiled
from semstab.engine.tiling.sights import Sights, sights_of
from semstab.engine.tiling.stretches import stretches_of
from semstab.statistics.sampler import Sampler, merged_observations
from semstab.testing import random_frames

ORIGIN = (0, 0, 0)


@pytest.mark.parametrize(("width", "whole", "count"), [(1, False, 1), (2, False, 4), (99, False, 5), (2, True, 1)])
def test_stretches_share_no_frame_and_begin_a_clip_early(width, whole, count) -> None:
    frames = list(range(0, 620, 2))
    found = stretches_of(frames, ORIGIN, lead=15, width=width, whole=whole)
    assert len(found) == count
    assert [index for each in found for index in each.frames[each.lead :]] == frames
    assert [each.lead for each in found] == [0] + [15] * (count - 1)
    assert len({each.name for each in found}) == count


def test_a_long_sequence_is_cut_also_for_one_task() -> None:
    """A kill costs what was not finished."""
    assert len(stretches_of(range(100_000), ORIGIN, lead=15)) == 25


def looks(rng: np.random.Generator, frame: int) -> Seen:
    """Of a frame: some cells, and some of a few voxels."""
    cell = np.unique(rng.integers(-40, 40, (20, 2)), axis=0)
    rows = np.column_stack([np.full(len(cell), frame), cell]).astype(np.int32)
    key = np.unique(rng.integers(0, 4000, 500))
    drawn = (key * 2654435761) % collected.SHARE
    return Seen(64, collected.SHARE, 1, rows, key, drawn, np.ones(len(key), np.int64))


def test_what_stretches_see_adds_up_though_cells_grow_and_voxels_go(monkeypatch) -> None:
    monkeypatch.setattr(collected, "MOST_ROWS", 200)
    monkeypatch.setattr(collected, "BUDGET", 700)
    rng = np.random.default_rng(0)
    frames = [looks(rng, frame) for frame in range(30)]
    stretches = []
    for some in (frames[:4], frames[4:21], frames[21:]):
        own = Collected(64)
        for each in some:
            own.add(each)
        stretches.append(own.seen())
    assert len({each.size for each in stretches}) > 1
    one, other = sights_of(frames, ORIGIN), sights_of(stretches, ORIGIN)
    assert one.size > 64
    for name in ("place", "voxels", "observations", "size", "frames"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(*(np.unique(np.column_stack([s.frame, s.cell]), axis=0) for s in (one, other)))


def test_samplers_of_stretches_keep_what_one_keeps(tmp_path) -> None:
    """Though each lets voxels go at a moment of its own, and the frames of one begin elsewhere."""
    frames = random_frames(1, count=9, K=4)
    whole = Sampler(0.4, 4, budget=300)
    origin = tuple(np.floor(frames[0].T_wc[:3, 3] / 0.4).astype(int).tolist())
    stretches = []
    for frame in frames:
        whole.add(frame)
    for some in (frames[:2], frames[2:7], frames[7:]):
        own = Sampler(0.4, 4, budget=300, origin=origin)
        for frame in some:
            own.add(frame)
        stretches.append(own.looks(("a", "b", "c", "d")))
    expected, found = whole.looks(("a", "b", "c", "d")), merged_observations(stretches, budget=300)
    assert 0 < len(expected) <= 300
    assert expected.share < max(each.share for each in stretches)
    for name in ("cell", "view", "label", "weight", "drawn", "share", "soft", "classes"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    np.testing.assert_array_equal(found.views.rows(), expected.views.rows())


def test_parts_are_cut_where_few_frames_see_both_sides() -> None:
    """Frames that see far ahead along y, and little beside it: the cut goes along, not across."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(8), np.arange(8), indexing="ij"))
    place = np.stack([x, y], axis=1).astype(np.int32)
    rows = [(k, k // 4, row) for k in range(32) for row in range(2 * (k % 4), min(2 * (k % 4) + 5, 8))]
    frame, *cell = np.array(rows, np.int32).T
    ones = np.ones(64)
    sights = Sights(64, frame, np.stack(cell, axis=1), place, ones, ones, 32, np.zeros(3, np.int64))
    tiling = tiled(sights, lambda voxels, _: voxels, 32, 64)
    assert [(part.extent.low[1], part.extent.high[1]) for part in tiling.parts] == [(0, 512)] * 2
    assert tiling.decodes == 32
