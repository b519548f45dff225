"""TC as published: equal to the official scripts, and to brute force.

The numbers of OFFICIAL are those of the scripts themselves on the videos of `video`, seeds 0 to 2: flowwarp and
Evaluator of VSPW's TC_cal.py, intersectionAndUnion of ETC's util.py with the kernel of Resample2d, and
temporal_consistency of SSP's utils/metrics.py (torchmetrics 1.9), with the flow given in place of a network's.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import datasets
from semstab.errors import ConfigError, DataError
from semstab.metrics import (
    TemporalConsistency,
    VideoConsistency,
    compensated_flicker,
    flow_by_depth,
    image_flow,
    occluded,
    warp_labels,
)

K, SHAPE = 7, (24, 37)
OFFICIAL = {"vspw": 0.42644135146742373, "etc": 0.3116925927522956, "ssp": 0.42159191185519806}


def video(seed):
    """Label maps of a texture that moves by (2, 1) pixels a frame, a tenth of them wrong, and flows that are rough."""
    rng, (H, W) = np.random.default_rng(seed), SHAPE
    base = rng.integers(0, K - 1, (H // 4 + 1, W // 4 + 1)).repeat(4, 0).repeat(4, 1)[:H, :W]
    maps = []
    for t in range(6 + seed):
        labels = np.roll(base, (t, 2 * t), (0, 1)).astype(np.uint8)
        wrong = rng.random(SHAPE) < 0.1
        labels[wrong] = rng.integers(0, K - 1, wrong.sum())
        maps.append(labels)
    still = np.stack([np.full(SHAPE, 2.0), np.full(SHAPE, 1.0)], axis=2)
    return maps, [(still + rng.normal(0, 0.7, (H, W, 2))).astype(np.float32) for _ in maps[1:]]


@pytest.mark.parametrize("form", OFFICIAL)
def test_it_is_what_the_official_script_says(form):
    metric = TemporalConsistency(K, form)
    for seed in range(3):
        maps, flows = video(seed)
        for labels, following, flow in zip(maps[:-1], maps[1:], flows, strict=True):
            metric.add(labels, warp_labels(following, flow, "etc" if form == "etc" else "vspw"))
        metric.end_video()
    assert metric.value == pytest.approx(OFFICIAL[form], abs=1e-8)


def test_vc_is_what_the_official_script_says():
    """VC_perclip.py with clips of 3 frames, all clips but the last of each video."""
    metric, clips = VideoConsistency(3), []
    for seed in range(3):
        maps, _ = video(seed)
        for t, labels in enumerate(maps):
            truth = maps[0].copy()
            truth[:, :t] = t % K
            clips.append(metric.add(labels, np.ones(SHAPE, bool), truth))
        metric.end_video()
    assert metric.published == pytest.approx(0.11825953602140238, abs=1e-12)
    assert metric.value == pytest.approx(np.nanmean(clips))
    assert metric.published != metric.value


def test_a_video_of_one_clip_counts_in_no_published_mean():
    metric, maps = VideoConsistency(3), video(0)[0]
    for labels in maps[:3]:
        metric.add(labels, np.ones(SHAPE, bool), maps[0])
    assert math.isnan(metric.published)
    metric.end_video()
    assert math.isnan(metric.published)
    assert not math.isnan(metric.value)


@given(st.integers(0, 2**32 - 1))
def test_pairs_without_a_label_are_counted_as_stated(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.choice([0, 1, 2, 255], (2, 3, 4)).astype(np.uint8)
    counted = rng.random(a.shape) < 0.8
    labelled = counted & (a != 255)
    both = labelled & (b != 255)
    ious = {k: ((a == k) & (b == k) & both).sum() / n if (n := (((a == k) | (b == k)) & both).sum()) else None
            for k in range(3)}  # fmt: skip
    there = [iou for iou in ious.values() if iou is not None]
    pair = TemporalConsistency(3, "ssp")
    assert pair.add(a, b, counted) == pytest.approx(np.mean(there) if there else math.nan, nan_ok=True)
    of_class = [ious[k] for k in range(3) if ((a == k) & both).any()]
    vspw, etc = TemporalConsistency(3, "vspw"), TemporalConsistency(3, "etc")
    for measure in (vspw, etc):
        measure.add(a, b, counted)
    assert vspw.value == pytest.approx(np.mean(of_class) if of_class else math.nan, nan_ok=True)
    union = [(((a == k) & labelled) | ((b == k) & labelled)).sum() for k in range(3)]
    hits = [((a == k) & (b == k) & labelled).sum() for k in range(3)]
    expected = np.mean([h / max(u, 1) for h, u in zip(hits, union, strict=True)]) if labelled.any() else math.nan
    assert etc.value == pytest.approx(expected, nan_ok=True)


def test_videos_count_alike_for_ssp_and_by_their_pixels_for_the_others():
    one, zero = np.zeros(SHAPE, np.uint8), np.ones(SHAPE, np.uint8)
    pairs = [(one, one), *[(one, zero)] * 3]
    values = {}
    for form in OFFICIAL:
        metric = TemporalConsistency(2, form)
        for k, (labels, warped) in enumerate(pairs):
            metric.add(labels, warped)
            if k == 0:
                metric.end_video()
        values[form] = metric.value
    assert values == {"ssp": 0.5, "vspw": 0.25, "etc": 0.125}


def test_a_flow_of_whole_pixels_moves_labels():
    labels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    flow = np.zeros((3, 4, 2), np.float32)
    flow[..., 0] = 1
    assert warp_labels(labels, flow).tolist() == [[1, 2, 3, 255], [5, 6, 7, 255], [9, 10, 11, 255]]
    assert warp_labels(labels, flow, "etc").tolist() == [[1, 2, 3, 3], [5, 6, 7, 7], [9, 10, 11, 11]]
    flow[0, 0] = np.nan
    assert warp_labels(labels, flow)[0, 0] == 255


def test_depth_and_pose_give_the_flow_that_flicker_rests_on():
    scene = datasets.open_dataset("city", {"frames": 20, "width": 96, "height": 54}).scene("scene0")
    frame, following = scene.frame(1, "sim-flicker"), scene.frame(0, "sim-flicker")
    flow, visible = flow_by_depth(frame, following)
    assert np.isfinite(flow).all(axis=2).tolist() == visible.tolist()
    warped = warp_labels(following.predicted, flow)
    both = visible & frame.valid & (warped != 255)
    changed = 100 * np.mean(warped[both] != frame.predicted[both])
    assert changed == pytest.approx(compensated_flicker(following, frame).flicker_percent)
    metric = TemporalConsistency(len(scene.label_space("sim-flicker")))
    assert 0.2 < metric.add(frame.predicted, warped, visible) < 1


def test_optical_flow_finds_a_shift():
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (180, 240)).astype(np.uint8), (0, 0), 3)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    images = [np.stack([np.roll(texture, (k, 3 * k), (0, 1))] * 3, axis=2) for k in (0, 1)]
    forward, backward = image_flow(*images), image_flow(*images[::-1])
    inner = np.s_[20:-20, 20:-20]
    np.testing.assert_allclose(np.median(forward[inner], axis=(0, 1)), (3, 1), atol=0.1)
    assert occluded(forward, backward)[inner].mean() < 0.1


def test_a_pixel_is_occluded_where_the_way_back_leads_elsewhere():
    forward, backward = np.zeros((2, 4, 6, 2), np.float32)
    forward[..., 0], backward[..., 0] = 1, -1
    backward[1, 3] = 2
    hidden = occluded(forward, backward)
    assert hidden[:, -1].all()  # leaves the image
    assert np.argwhere(hidden[:, :-1]).tolist() == [[1, 2]]
    forward, backward = (flow.transpose(1, 0, 2)[..., ::-1] for flow in (forward, backward))  # down the image
    np.testing.assert_array_equal(occluded(forward, backward), hidden.T)
    np.testing.assert_array_equal(occluded(-forward, -backward)[0], True)  # leaves the image at the top


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: TemporalConsistency(3, "mean"), ConfigError, "form 'mean' of TC: use one of vspw, etc, ssp"),
        (lambda: TemporalConsistency(0), ConfigError, "num_classes = 0"),
        (lambda: TemporalConsistency(2).add(np.zeros((2, 3), int), np.zeros((3, 2), int)), DataError, "of one size"),
        (lambda: warp_labels(np.zeros((2, 3), int), np.zeros((2, 3))), DataError, r"it is \(H, W, 2\)"),
        (lambda: warp_labels(np.zeros((2, 3), int), np.zeros((2, 3, 2)), "cubic"), ConfigError, "nearest, vspw, etc"),
    ],
)
def test_what_cannot_be_counted_is_one_line(call, error, message):
    with pytest.raises(error, match=message):
        call()
