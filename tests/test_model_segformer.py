"""Model `segformer` on a tiny model, and on a real one where SEMSTAB_MODELS names any."""

import shutil

import numpy as np
import pytest
import tiny_models
import torch
import transformers
from model_folders import KINDS, folder_of, tiny
from pictures import blobs
from torch.nn.functional import interpolate

from semstab.errors import ConfigError, DataError
from semstab.models import create, segmenter
from semstab.models.checkpoint import bilinear
from semstab.models.segmenter import label_space, largest_upsampled

IMAGES = [blobs(shift=k) for k in range(3)]


@pytest.fixture(params=KINDS, scope="module")
def folder(request):
    return folder_of(request.param, "segformer")


@pytest.fixture(scope="module")
def model(folder):
    return create("segformer", checkpoint=str(folder), image_size=64)


def test_a_label_a_pixel(model):
    predictions = model.predict(IMAGES)
    assert len(np.unique([prediction.labels for prediction in predictions])) > 1
    K = len(model.label_space)
    assert len(predictions) == 3
    for prediction in predictions:
        assert prediction.scores is None
        assert prediction.labels.dtype == np.uint8
        assert prediction.labels.shape == (48, 80)
        assert prediction.labels.max() < K


def test_scores_sum_to_one_and_their_largest_is_the_label(model):
    (prediction,) = model.predict(IMAGES[:1], scores=True)
    assert prediction.scores.dtype == np.float32
    assert prediction.scores.shape == (48, 80, len(model.label_space))
    np.testing.assert_allclose(prediction.scores.sum(axis=2), 1, atol=1e-5)
    np.testing.assert_array_equal(prediction.scores.argmax(axis=2), prediction.labels)


def test_it_is_what_the_checkpoint_says(folder, model):
    """Against transformers used directly, with all logits upsampled at once."""
    processor = transformers.SegformerImageProcessorPil.from_pretrained(folder)
    network = transformers.AutoModelForSemanticSegmentation.from_pretrained(folder).eval()
    pixels = processor(images=IMAGES[0], size={"height": 64, "width": 96}, return_tensors="pt")["pixel_values"]
    with torch.inference_mode():
        logits = interpolate(network(pixel_values=pixels).logits, size=(48, 80), mode="bilinear", align_corners=False)
    (prediction,) = model.predict(IMAGES[:1], scores=True)
    np.testing.assert_array_equal(prediction.labels, logits[0].argmax(dim=0))
    np.testing.assert_allclose(prediction.scores, logits[0].softmax(dim=0).permute(1, 2, 0), atol=1e-6)


def test_batches_do_not_matter(model):
    together = model.predict(IMAGES, scores=True)
    for image, prediction in zip(IMAGES, together, strict=True):
        (alone,) = model.predict([image], scores=True)
        np.testing.assert_allclose(alone.scores, prediction.scores, atol=1e-4)
        assert (alone.labels != prediction.labels).mean() < 1e-3


def test_classes_go_by_number_and_repeated_names_get_it():
    assert label_space({2: "c", 0: "a", 1: "b"}, "m").classes == ("a", "b", "c")
    assert label_space({0: "a", 1: "A ", 2: "b"}, "m").classes == ("a 0", "A 1", "b")


@pytest.mark.parametrize(("image_size", "size"), [(None, (64, 96)), (32, (32, 64)), ((32, 128), (32, 128))])
def test_the_size_that_the_model_sees(monkeypatch, image_size, size):
    model = create("segformer", checkpoint=str(tiny("segformer")), image_size=image_size)
    sizes = []
    logits = model.head.engine
    monkeypatch.setattr(model.head, "engine", lambda pixels: sizes.append(tuple(pixels.shape[2:])) or logits(pixels))
    assert model.predict(IMAGES[:1])[0].labels.shape == (48, 80)
    assert sizes == [size]


def test_upsampling_in_chunks_is_upsampling_at_once(monkeypatch):
    logits = torch.from_numpy(np.random.default_rng(0).normal(size=(7, 5, 6))).float()
    logits[4] = logits[2]  # a tie goes to the lower class, also across chunks
    whole = bilinear(logits, (20, 30)).argmax(dim=0)
    for classes in (1, 2, 3, 7):
        monkeypatch.setattr(segmenter, "CHUNK_BYTES", classes * 4 * 20 * 30)
        torch.testing.assert_close(largest_upsampled(logits, (20, 30))[1], whole)


def test_more_than_255_classes_take_16_bits(tmp_path):
    folder = tiny_models.segformer(tmp_path / "many", tuple(f"class {k}" for k in range(300)))
    labels = create("segformer", checkpoint=str(folder)).predict(IMAGES[:1])[0].labels
    assert labels.dtype == np.uint16
    assert labels.max() < 300


@pytest.mark.parametrize("kind", ["SegformerFeatureExtractor", "SegformerImageProcessor"])
def test_old_and_new_names_of_the_preprocessing(tmp_path, kind):
    folder = shutil.copytree(tiny("segformer"), tmp_path / "model")
    tiny_models.set_processor(folder, kind)
    labels = create("segformer", checkpoint=str(folder)).predict(IMAGES[:1])[0].labels
    expected = create("segformer", checkpoint=str(tiny("segformer"))).predict(IMAGES[:1])[0].labels
    np.testing.assert_array_equal(labels, expected)


def test_the_image_is_not_cropped(tmp_path):
    folder = shutil.copytree(tiny("segformer"), tmp_path / "model")
    crop = {"height": 32, "width": 32}
    tiny_models.set_processor(folder, "BeitImageProcessor", do_center_crop=True, crop_size=crop)
    labels = create("segformer", checkpoint=str(folder)).predict(IMAGES[:1])[0].labels
    np.testing.assert_array_equal(
        labels, create("segformer", checkpoint=str(tiny("segformer"))).predict(IMAGES[:1])[0].labels
    )


# --- What its predictions are kept under ------------------------------------------------------------------------------


def test_identity_is_of_the_weights_wherever_they_lie(tmp_path, model, folder):
    copy = shutil.copytree(folder, tmp_path / "elsewhere")
    assert create("segformer", checkpoint=str(copy), image_size=64).identity() == model.identity()
    config = copy / "config.json"
    config.write_text(config.read_text() + "\n")
    assert create("segformer", checkpoint=str(copy), image_size=64).identity() != model.identity()


@pytest.mark.parametrize(
    ("option", "matters"),
    [({"image_size": 32}, True), ({"dtype": "bfloat16"}, True), ({"engine": "onnx"}, True), ({"threads": 1}, False)],
)
def test_identity_has_the_settings_that_change_labels(option, matters):
    threads = torch.get_num_threads()
    try:
        usual, other = (
            create("segformer", checkpoint=str(tiny("segformer")), **more).identity() for more in ({}, option)
        )
    finally:
        torch.set_num_threads(threads)
    assert (usual != other) == matters


def test_lower_precision_is_nearly_the_same(monkeypatch):
    # oneDNN errs in strided bfloat16 convolutions of few channels on CPUs with AMX (pytorch/pytorch#169688)
    monkeypatch.setattr(torch.backends.mkldnn, "enabled", False)
    labels, low = (
        create("segformer", checkpoint=str(tiny("segformer")), dtype=dtype).predict(IMAGES[:1])[0].labels
        for dtype in ("float32", "bfloat16")
    )
    assert 0.9 < (labels == low).mean() <= 1


# --- ONNX Runtime -----------------------------------------------------------------------------------------------------


def test_onnx_runtime_gives_the_same_labels_and_is_exported_once(folder, model, monkeypatch):
    onnx = create("segformer", checkpoint=str(folder), image_size=64, engine="onnx")
    for a, b in zip(model.predict(IMAGES, scores=True), onnx.predict(IMAGES, scores=True), strict=True):
        np.testing.assert_allclose(a.scores, b.scores, atol=1e-3)
        assert (a.labels != b.labels).mean() < 1e-3
    monkeypatch.delattr(torch.onnx, "export")
    again = create("segformer", checkpoint=str(folder), image_size=64, engine="onnx")
    np.testing.assert_array_equal(again.predict(IMAGES[:1])[0].labels, onnx.predict(IMAGES[:1])[0].labels)


def test_what_cannot_be_exported_is_one_line(monkeypatch, tmp_path):
    def export(model, pixels, **told):
        raise RuntimeError("\x1b[31mUnsupported\x1b[0m:\naten::odd")

    cache = tmp_path / "cache"
    monkeypatch.setenv("SEMSTAB_CACHE", str(cache))
    monkeypatch.setattr(torch.onnx, "export", export)
    model = create("segformer", checkpoint=str(tiny("segformer")), engine="onnx", image_size=32)
    with pytest.raises(DataError, match=r"cannot be exported to ONNX \(Unsupported: aten::odd\); use engine torch$"):
        model.predict(IMAGES[:1])
    assert not list(cache.rglob("*.onnx"))


@pytest.mark.parametrize("option", [{"dtype": "bfloat16"}, {"device": "meta"}])
def test_onnx_runtime_is_for_the_cpu_in_float32(option):
    with pytest.raises(ConfigError, match="engine onnx runs on the cpu in float32"):
        create("segformer", checkpoint=str(tiny("segformer")), engine="onnx", **option)
