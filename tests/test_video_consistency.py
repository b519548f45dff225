"""Video consistency against a loop over clips and pixels, and against what VSPW's own evaluation computes."""

import math
import weakref

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab.errors import ConfigError, DataError
from semstab.metrics import SelfConsistency, VideoConsistency
from semstab.testing import checks

SHAPE = (3, 4)


@st.composite
def videos(draw):
    """Predictions, masks and truth of a few frames that change rarely, and the length of a clip."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(0, 9))
    changes = rng.random((count, *SHAPE)) < 0.3
    labels = np.cumsum(changes, axis=0) % 3
    truth = np.cumsum(rng.random((count, *SHAPE)) < 0.1, axis=0) % 3
    valid = rng.random((count, *SHAPE)) > draw(st.sampled_from([0.0, 0.1, 0.9]))
    return labels.astype(np.uint8), valid, truth.astype(np.uint8), draw(st.integers(2, 4))


def loop_over_clips(labels, valid, truth, n):
    """The consistency of each clip in which a pixel counts, pixel by pixel."""
    clips = []
    for start in range(len(labels) - n + 1):
        frames = range(start, start + n)
        consistent = counted = 0
        for v in range(SHAPE[0]):
            for u in range(SHAPE[1]):
                if all(valid[t][v, u] for t in frames) and len({int(truth[t][v, u]) for t in frames}) == 1:
                    counted += 1
                    consistent += len({int(labels[t][v, u]) for t in frames}) == 1
        clips.append(consistent / counted if counted else math.nan)
    return clips


def mean(values):
    defined = [value for value in values if not math.isnan(value)]
    return sum(defined) / len(defined) if defined else math.nan


def close(expected):
    return pytest.approx(expected, nan_ok=True)


@checks
@given(videos())
def test_each_clip_is_a_loop_over_pixels(video):
    labels, valid, truth, n = video
    with_truth, without = VideoConsistency(n), SelfConsistency(n)
    values = [with_truth.add(*frame) for frame in zip(labels, valid, truth, strict=True)]
    by_itself = [without.add(*frame) for frame in zip(labels, valid, strict=True)]
    expected = loop_over_clips(labels, valid, truth, n)
    expected_own = loop_over_clips(labels, valid, np.zeros_like(truth), n)
    assert values == close([math.nan] * min(n - 1, len(labels)) + expected)
    assert by_itself == close([math.nan] * min(n - 1, len(labels)) + expected_own)
    assert with_truth.value == close(mean(expected))
    assert without.value == close(mean(expected_own))


@checks
@given(videos())
def test_where_nothing_is_ignored_all_clips_but_the_last_are_what_vspw_averages(video):
    """VSPW's evaluation compares each frame of a clip with the clip's first one, and stops one clip early."""
    labels, _, truth, n = video
    measured = VideoConsistency(n)
    values = [measured.add(p, np.ones(SHAPE, bool), t) for p, t in zip(labels, truth, strict=True)][n - 1 :]
    clips = []
    for start in range(len(labels) - n):
        steady = np.logical_and.reduce([truth[start] == truth[start + j] for j in range(1, n)])
        constant = np.logical_and.reduce([labels[start] == labels[start + j] for j in range(1, n)])
        clips.append((steady & constant).sum() / steady.sum() if steady.any() else math.nan)
    assert values[:-1] == close(clips)


def frames(*rows):
    return [np.array([row], dtype=np.uint8) for row in rows]


EVERYWHERE = np.ones((1, 4), bool)


def test_fewer_frames_than_a_clip_has_are_undefined():
    measured = SelfConsistency(8)
    for labels in frames(*[[0, 0, 0, 0]] * 7):
        assert math.isnan(measured.add(labels, EVERYWHERE))
    assert math.isnan(measured.value)
    measured.add(frames([0, 0, 0, 1])[0], EVERYWHERE)
    assert measured.value == 0.75


def test_a_frame_without_ground_truth_is_in_no_clip():
    """Neither is the one after it a neighbour of the one before it."""
    measured = VideoConsistency(2)
    (same, other) = frames([0, 1, 2, 3], [0, 1, 2, 9])
    values = [
        measured.skip() if labels is None else measured.add(labels, EVERYWHERE, same)
        for labels in (None, same, same, None, other, same, same)
    ]
    assert values == close([math.nan, math.nan, 1, math.nan, math.nan, 3 / 4, 1])
    assert measured.value == pytest.approx(2.75 / 3)


def test_a_change_of_size_begins_anew():
    measured = SelfConsistency(2)
    small, large = np.zeros((2, 2), np.uint8), np.zeros((3, 3), np.uint8)
    values = [measured.add(labels, np.ones(labels.shape, bool)) for labels in (small, small, large, large)]
    assert values == close([math.nan, 1, math.nan, 1])


def test_long_clips_do_not_overflow():
    measured = SelfConsistency(300)
    for _ in range(700):
        measured.add(np.zeros((1, 4), np.uint16), EVERYWHERE)
    assert measured.value == 1


def test_no_frame_is_kept():
    measured = VideoConsistency(16)
    labels = np.zeros((4, 4), np.uint8)
    reference = weakref.ref(labels)
    measured.add(labels, np.ones((4, 4), bool), labels)
    del labels
    assert reference() is None


def test_a_map_that_the_caller_reuses_is_compared_as_it_was():
    measured = SelfConsistency(2)
    labels = np.zeros((1, 4), np.uint8)
    measured.add(labels, EVERYWHERE)
    labels[:] = 1
    assert measured.add(labels, EVERYWHERE) == 0


@pytest.mark.parametrize("n", [1, 0, -3, 32768])
def test_a_clip_needs_two_frames(n):
    with pytest.raises(ConfigError, match=f"a clip of {n} frames"):
        VideoConsistency(n)


def test_sizes_must_agree():
    with pytest.raises(DataError, match=r"differ in size \(4x1 and 2x2\)"):
        SelfConsistency(2).add(np.zeros((1, 4), np.uint8), np.ones((2, 2), bool))
    with pytest.raises(DataError, match=r"differ in size \(2x2 and 4x1\)"):
        VideoConsistency(2).add(np.zeros((1, 4), np.uint8), EVERYWHERE, np.zeros((2, 2), np.uint8))
