"""What labels of single frames are worth, against cases whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import predicted_scene
import pytest

from semstab.metrics import FrameQualityMeter

SHAPE = predicted_scene.HEIGHT, predicted_scene.WIDTH


def frame(k, labels):
    """Each frame's camera is 2 pixels further to the right, before a wall."""
    return dataclasses.replace(predicted_scene.frame(k, 1), labels=np.asarray(labels, np.uint8), color=None)


def judged(filtered, model=None, truth=None, still=False):
    judge = FrameQualityMeter(3)
    for k, labels in enumerate(filtered):
        place = 0 if still else k
        others = [None if maps is None else frame(place, maps[k]) for maps in (model or filtered, truth)]
        judge.add(frame(place, labels), *others)
    return judge.result("net", "ema:0.6", 1.5)


def wall(k):
    """Columns of a wall in three classes, 5 pixels wide, as frame k sees it."""
    return np.broadcast_to((np.arange(SHAPE[1]) + 2 * k) // 5 % 3, SHAPE).astype(np.uint8)


def test_who_is_right_and_steady():
    maps = [wall(k) for k in range(5)]
    found = judged(maps, truth=maps)
    assert (found.accuracy, found.miou, found.next_frame, found.coverage) == (1, 1, 1, 1)
    assert (found.consistent_wrong, found.changes) == (0, 0)
    assert np.isnan(found.lag)
    assert (found.model, found.filters, found.milliseconds) == ("net", "ema:0.6", 1.5)


def test_what_is_stable_and_wrong_is_told_from_what_is_right():
    maps = [wall(k) for k in range(5)]
    wrong = [np.where(labels == 2, 0, labels) for labels in maps]
    found = judged(wrong, truth=maps)
    share = np.mean([labels == 2 for labels in maps])
    assert found.accuracy == pytest.approx(1 - share)
    assert found.miou == pytest.approx((1 / 2 + 1 + 0) / 3, abs=0.02)
    assert found.consistent_wrong == pytest.approx(share, abs=0.02)
    assert found.next_frame == 1


def test_the_share_of_changed_labels_is_of_those_of_the_model():
    maps = [wall(k) for k in range(4)]
    none = np.arange(SHAPE[1]) < 20
    filtered = [np.where(np.arange(SHAPE[1]) >= 70, (labels + 1) % 3, labels) for labels in maps]
    model = [np.where(none, 255, labels) for labels in maps]
    assert judged(filtered, model).changed == pytest.approx(10 / 60)
    assert judged(model, maps).changed == pytest.approx(20 / 80)
    assert judged(maps).changed == 0


def test_flicker_is_of_all_that_both_frames_see_where_the_one_before_has_no_depth():
    """A point is hidden where the frame before has another depth; one without depth there hides nothing."""

    def flight(depth_before):
        judge = FrameQualityMeter(3)
        for k, depth in enumerate((depth_before, np.full(SHAPE, 2.0))):
            labels = np.zeros(SHAPE, np.uint8)
            labels[:, 40:] = k
            judge.add(*[dataclasses.replace(frame(0, labels), depth=depth.astype(np.float32))] * 2, None)
        return judge.result("net", "", 0.0)

    left = np.arange(SHAPE[1]) < 40
    assert (flight(np.full(SHAPE, 2.0)).flicker, flight(np.full(SHAPE, 2.0)).seen) == (0.5, 0.5)
    unknown = flight(np.where(left, 2.0, 0.0) + np.zeros(SHAPE))
    assert (unknown.flicker, unknown.seen) == (0.5, 0.5)
    hidden = flight(np.where(left, 2.0, 1.0) + np.zeros(SHAPE))
    assert (hidden.flicker, hidden.seen) == (0, 0.25)


def test_labels_that_stay_behind_are_not_foreseen():
    """A filter that repeats the first frame at its pixels is steady there, and wrong of the places."""
    maps = [wall(k) for k in range(5)]
    found = judged([maps[0]] * 5, model=maps)
    moving = [np.mean(maps[0][:, 2:] == maps[k + 1][:, :-2]) for k in range(4)]
    assert found.next_frame == pytest.approx(np.mean(moving), abs=1e-9)
    np.testing.assert_allclose(found.next_frame_by_frame, moving)
    assert np.isnan(found.accuracy)
    assert found.accuracy_by_frame == ()


def test_next_frame_does_not_count_what_a_filter_repeats():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 2, SHAPE) for _ in range(9)]
    frozen = judged([noise[0]] * 9, model=noise, still=True)
    assert frozen.next_frame == pytest.approx(0.5, abs=0.03)


def test_coverage_counts_labels_left():
    maps = [wall(k) for k in range(3)]
    some = [np.where(np.arange(SHAPE[1]) < 20, 255, labels) for labels in maps]
    assert judged(some, model=maps, truth=maps).coverage == pytest.approx(0.75)
    assert judged(some, model=maps, truth=maps).accuracy == 1


@pytest.mark.parametrize("late", [0, 1, 3])
def test_lag_counts_frames_until_labels_follow(late):
    """A car of class 2 leaves a patch at frame 2; the model follows at once, the labels later."""
    truth = []
    for k in range(10):
        labels = np.ones(SHAPE, np.uint8)
        labels[10:30, 20:50] = 2 if k < 2 else 1
        truth.append(labels)
    labels = [truth[max(k - late, 0)] for k in range(10)]
    found = judged(labels, model=truth, truth=truth, still=True)
    assert found.lag == late
    assert found.changes == 18 * 28  # not the rim, where the class was within a pixel
    assert judged([truth[0]] * 10, model=truth, truth=truth, still=True).lag == 8


def test_a_moving_camera_is_no_change():
    maps = [wall(k) for k in range(4)]
    assert judged(maps, truth=maps).changes == 0


def test_where_the_model_is_late_itself_nothing_is_counted():
    truth = [np.full(SHAPE, k >= 2, np.uint8) for k in range(6)]
    model = [truth[max(k - 1, 0)] for k in range(6)]
    assert judged(model, model=model, truth=truth, still=True).changes == 0
