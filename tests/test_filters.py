"""Filters over a model: each against its definition, the chain, and what it says where it cannot be used."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import predicted_scene
import pytest

from semstab import Frame, Intrinsics, LabelSpace
from semstab.errors import ConfigError
from semstab.models import Model, Prediction
from semstab.pixels.warp import carry
from semstab.predict.filters import REGISTRY, Filtered, Shown, parse

K = 4
SHAPE = predicted_scene.HEIGHT, predicted_scene.WIDTH


def beliefs(n=6, seed=0):
    raw = np.random.default_rng(seed).random((n, *SHAPE, K)).astype(np.float32) ** 3
    return raw / raw.sum(axis=3, keepdims=True)


def shown_image(k=0):
    return Shown(predicted_scene.image(k), predicted_scene.frame(k, 1))


def after(text, given):
    step = parse(text)()
    return [step(belief, shown_image(k)) for k, belief in enumerate(given)]


def moved(values):
    """What the next frame's camera sees of these pixels: it is 2 of them further to the right."""
    shifted = np.zeros_like(values)
    shifted[:, :-2] = values[:, 2:]
    return shifted


# --- Each filter ------------------------------------------------------------------------------------------------------


def test_ema_is_a_weighted_mean_of_the_frames():
    given = beliefs(4)
    found = after("ema:0.6", given)
    np.testing.assert_array_equal(found[0], given[0])
    wanted = 0.6**3 * given[0] + 0.4 * (0.36 * given[1] + 0.6 * given[2] + given[3])
    np.testing.assert_allclose(found[3], wanted, atol=1e-6)


def test_ema_warped_is_that_of_the_place():
    given = beliefs(3)
    found, before = after("ema-warped:0.6", given), given[0]
    for k in (1, 2):
        wanted = 0.6 * moved(before) + 0.4 * given[k]
        wanted[:, -2:] = given[k][:, -2:]  # comes into view
        np.testing.assert_allclose(found[k], wanted, atol=1e-5)
        before = wanted


def votes(maps, now):
    """The share of each class, the newest label's where two are level."""
    counts = np.stack([sum(m == k for m in maps) for k in range(K)], axis=2)
    best = counts == counts.max(axis=2, keepdims=True)
    for newest in reversed(maps):
        leads = np.take_along_axis(best, newest.clip(0)[..., None], axis=2)[..., 0] & (newest >= 0)
        now = np.where((now < 0) & leads, newest, now)
    return now


def test_votes_count_the_last_labels():
    given = beliefs(6)
    found = [belief.argmax(axis=2) for belief in after("vote:3", given)]
    maps = [belief.argmax(axis=2) for belief in given]
    for t in range(6):
        np.testing.assert_array_equal(found[t], votes(maps[max(t - 2, 0) : t + 1], np.full(SHAPE, -1)))


def test_guided_is_a_line_in_each_window_averaged():
    (given,) = beliefs(1)
    (found,) = after("guided:3", [given])
    import cv2

    grey = cv2.cvtColor(predicted_scene.image(0), cv2.COLOR_RGB2GRAY) / 255
    H, W = SHAPE
    line = np.zeros((H, W, K, 2))
    window = lambda v, u: (slice(max(v - 3, 0), v + 4), slice(max(u - 3, 0), u + 4))  # noqa: E731
    places = list(itertools.product(range(0, 14), range(10, 24)))
    for v, u in itertools.product(range(0, 17), range(7, 27)):
        g, p = grey[window(v, u)], given[window(v, u)].astype(float)
        a = ((g[..., None] * p).mean(axis=(0, 1)) - g.mean() * p.mean(axis=(0, 1))) / (g.var() + 0.05**2)
        line[v, u] = np.stack([a, p.mean(axis=(0, 1)) - a * g.mean()], axis=1)
    for v, u in places:
        a, b = line[window(v, u)].mean(axis=(0, 1)).T
        wanted = np.maximum(a * grey[v, u] + b, 0)
        np.testing.assert_allclose(found[v, u], wanted / wanted.sum(), atol=2e-4)


@pytest.mark.parametrize("text", REGISTRY.builtin)
def test_pixels_without_depth_or_label_stay_so(text):
    """Beliefs stay shares, nothing is invented, and no depth is no error."""
    given = beliefs(3)
    given[1][:5] = 0
    step = parse(text)()
    for k, belief in enumerate(given):
        frame = predicted_scene.frame(k, 1)
        depth = frame.depth.copy()
        depth[:, :9], depth[:, 9:12], depth[3:8] = 0, np.nan, np.inf
        found = step(belief, Shown(predicted_scene.image(k), dataclasses.replace(frame, depth=depth)))
        total = found.sum(axis=2)
        assert found.min() >= 0
        assert found.dtype == np.float32
        assert (np.isclose(total, 1, atol=1e-4) | (total == 0)).all()
    np.testing.assert_array_equal(given[1][:5], 0)  # what it is given stays


# --- Carrying ---------------------------------------------------------------------------------------------------------


def looking(x=0.0, depth=2.0, at=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, 3] = np.add(at, (x, 0, 0))
    return Frame(
        0, np.full((4, 6), depth, np.float32), Intrinsics(4, 4, 2.5, 1.5), T, labels=np.zeros((4, 6), np.uint8)
    )


def test_between_pixels_it_is_linear():
    belief = np.zeros((4, 6, 2), np.float32)
    belief[..., 0] = np.arange(6) / 5
    belief[..., 1] = 1 - belief[..., 0]
    carried = carry(belief, looking(), looking(x=0.125))  # a quarter of a pixel
    np.testing.assert_allclose(carried[:, :5, 0], belief[:, :5, 0] + 0.05, atol=1e-6)
    np.testing.assert_allclose(carried.sum(axis=2), 1, atol=1e-6)
    far = (5e5, 6e6, 100.0)
    np.testing.assert_allclose(carry(belief, looking(at=far), looking(0.125, at=far)), carried, atol=1e-5)


def test_what_is_hidden_or_says_nothing_is_not_carried():
    belief = np.zeros((4, 6, 2), np.float32)
    belief[..., 0] = 1
    belief[0, 0] = 0
    source = looking()
    depth = source.depth.copy()
    depth[1] = 1.5  # something stands in front
    carried = carry(belief, dataclasses.replace(source, depth=depth), source)
    assert not carried[1].any()
    assert not carried[0, 0].any()
    assert (carried[2:, :, 0] == 1).all()


# --- The chain --------------------------------------------------------------------------------------------------------


class Fixed(Model):
    """Says what it is given, in ids of its own."""

    label_space = LabelSpace("four", ("a", "b", "c", "d"), ids=(3, 5, 7, 9))

    def __init__(self, given, scores=True):
        self.given, self.gives_scores, self.asked = list(given), scores, []

    def predict(self, images, *, scores=False):
        self.asked.append(scores)
        found = [self.given.pop(0) for _ in images]
        ids = np.array([3, 5, 7, 9, 255], np.uint8)
        rows = [np.where(belief.any(axis=2), belief.argmax(axis=2), 4) for belief in found]
        return [Prediction(ids[r], b if scores else None) for r, b in zip(rows, found, strict=True)]

    def identity(self):
        return {"fixed": 1}


def filtered(given, *texts, scores=True):
    return Filtered(Fixed(given, scores), [parse(text) for text in texts], "fixed")


def predict(model, n, **options):
    images = [predicted_scene.image(k) for k in range(n)]
    return model.predict(images, geometry=[predicted_scene.frame(k, 1) for k in range(n)], **options)


def test_filters_work_in_their_order_on_scores():
    given = beliefs(3)
    model = filtered(given, "ema:0.5", "vote:3")
    found = predict(model, 3, scores=True)
    wanted = after("vote:3", after("ema:0.5", given))
    for prediction, belief in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(prediction.scores, belief)
        ids = np.where(belief.any(axis=2), np.array([3, 5, 7, 9])[belief.argmax(axis=2)], 255)
        np.testing.assert_array_equal(prediction.labels, ids)
    assert model.identity() == {"fixed": 1, "filters": ["ema:0.5", "vote:3"]}
    assert (model.sequential, model.wants_geometry, model.gives_scores) == (True, False, True)
    assert predict(filtered(given, "ema:0.5"), 3)[0].scores is None


def test_labels_alone_count_as_certain():
    given = beliefs(5)
    model = filtered(given, "ema:0.3", scores=False)
    certain = [np.eye(4, dtype=np.float32)[belief.argmax(axis=2)] for belief in given]
    for prediction, belief in zip(predict(model, 5), after("ema:0.3", certain), strict=True):
        np.testing.assert_array_equal(prediction.labels, np.array([3, 5, 7, 9])[belief.argmax(axis=2)])
    assert model.inner.asked == [False]


@pytest.mark.parametrize("text", REGISTRY.builtin)
def test_where_the_model_says_nothing_nothing_is_said(text):
    given = beliefs(3)
    given[:, 7:20, 30:50] = 0
    for prediction in predict(filtered(given, text), 3):
        assert (prediction.labels[7:20, 30:50] == 255).all()


@pytest.mark.parametrize("text", REGISTRY.builtin)
def test_a_sequence_begins_without_memory(text):
    given = beliefs(4)
    model = filtered([*given, *given], text)
    first = [p.labels for p in predict(model, 4)]
    model = model.fit([])
    model.reset()
    np.testing.assert_array_equal([p.labels for p in predict(model, 4)], first)


# --- What cannot be ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("emma:0.6", r"filter 'emma' is not known; did you mean 'ema'\?"),
        ("ema:1.5", r"filter 'ema:1.5': the share of the previous belief is a number from 0 to 0.999; got"),
        ("ema:x", r"got 'x'"),
        ("ema:nan", r"got 'nan'"),
        ("vote:2.5", r"filter 'vote:2.5': the number of labels that vote is a whole number from 2 to 1000; got '2.5'"),
        ("vote:1", r"from 2 to 1000"),
        ("guided:0", r"the radius of the windows in pixels is a whole number from 1 to 500"),
    ],
)
def test_filters_that_there_are_not(text, said):
    with pytest.raises(ConfigError, match=said):
        parse(text)


def test_regions_have_no_classes_to_filter():
    model = Fixed([])
    model.label_space = None
    with pytest.raises(ConfigError, match="'fixed' finds regions without classes"):
        Filtered(model, [parse("ema")], "fixed")


def test_each_filter_looks_at_what_it_needs():
    looks = ("sequential", "wants_geometry", "wants_color", "warps")
    found = {name: {look for look in looks if getattr(REGISTRY.load(name), look)} for name in REGISTRY.entries()}
    assert found == {
        "ema": {"sequential"},
        "ema-warped": {"sequential", "wants_geometry", "warps"},
        "vote": {"sequential"},
        "guided": {"wants_color"},
    }
