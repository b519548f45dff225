"""Model `colour-clusters`: a codebook a sequence, the same ids in every frame, the same result every time."""

import numpy as np
import pytest
from pictures import blobs

from semstab.errors import ConfigError
from semstab.models import create

IMAGES = [blobs(shift=4 * k) for k in range(4)]


@pytest.fixture(scope="module")
def fitted():
    return create("colour-clusters", clusters=6, samples=500).fit(IMAGES)


def test_a_label_and_scores_a_pixel(fitted):
    for prediction in fitted.predict(IMAGES, scores=True):
        assert (prediction.labels.dtype, prediction.labels.shape) == (np.uint8, (48, 80))
        assert prediction.labels.max() < 6
        assert (prediction.scores.dtype, prediction.scores.shape) == (np.float32, (48, 80, 6))
        np.testing.assert_allclose(prediction.scores.sum(axis=2), 1, atol=1e-5)
        np.testing.assert_array_equal(prediction.scores.argmax(axis=2), prediction.labels)


def test_flat_colours_become_clusters_by_lightness():
    colours = np.array([[250, 250, 250], [10, 10, 10], [30, 120, 60]], dtype=np.uint8)  # light, dark, green
    image = np.repeat(np.repeat(colours[[0, 1, 2]][None], 40, axis=0), 40, axis=1)
    model = create("colour-clusters", clusters=3, scale=0.5).fit([image])
    labels = model.predict([image])[0].labels
    assert [labels[20, x] for x in (20, 60, 100)] == [2, 0, 1]
    assert (labels[:, 5:35] == 2).all()
    assert (labels[:, 85:115] == 1).all()


def test_ids_stay_when_the_camera_moves(fitted):
    before, after = (prediction.labels for prediction in fitted.predict([IMAGES[0], IMAGES[1]]))
    inside = (slice(12, -12), slice(12, -12))  # away from the border, where the window sees other pixels
    np.testing.assert_array_equal(before[:, 4:][inside], after[:, :-4][inside])


def test_labels_are_the_nearest_centres(fitted):
    """Brute force over pixels and centres, from the features up."""
    from semstab.models.colour_clusters import pixel_features

    book, features = fitted.codebook, pixel_features(IMAGES[2], 2.0)
    labels = fitted.predict([IMAGES[2]])[0].labels
    for y, x in np.random.default_rng(0).integers(0, 48, (50, 2)):
        distances = [np.sum(((features[y, x] - book.mean) / book.deviation - centre) ** 2) for centre in book.centres]
        assert labels[y, x] == int(np.argmin(distances))


def test_texture_separates_what_colour_does_not():
    rng = np.random.default_rng(0)
    flat = np.full((60, 60, 3), 128, dtype=np.uint8)
    rough = np.repeat(rng.choice([68, 188], (60, 60, 1)).astype(np.uint8), 3, axis=2)
    image = np.concatenate([flat, rough], axis=1)
    labels = create("colour-clusters", clusters=2, scale=3.0).fit([image]).predict([image])[0].labels
    smooth, noisy = labels[:, 10:50], labels[:, 70:110]
    assert (smooth == smooth[0, 0]).all()
    assert (noisy == smooth[0, 0]).mean() < 0.05


@pytest.mark.parametrize("option", [{"seed": 1}, {"clusters": 5}, {"scale": 3.0}, {"samples": 600}])
def test_identity_has_the_settings_and_the_codebook(fitted, option):
    settings = {"clusters": 6, "samples": 500} | option
    assert create("colour-clusters", **settings).fit(IMAGES).identity() != fitted.identity()
    assert create("colour-clusters", clusters=6, samples=500).fit(IMAGES[1:]).identity() != fitted.identity()


def test_it_must_be_fitted():
    with pytest.raises(ConfigError, match="colour-clusters has no codebook yet; call fit"):
        create("colour-clusters").predict(IMAGES[:1])


def test_more_clusters_than_pixels_are_refused():
    with pytest.raises(ConfigError, match="4 pixels cannot make 8 clusters"):
        create("colour-clusters").fit([IMAGES[0][:2, :2]])
