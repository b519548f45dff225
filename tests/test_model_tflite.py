"""Networks in TFLite files, run by LiteRT."""

from __future__ import annotations

import numpy as np
import PIL.Image
import pytest
import torch
from pictures import blobs

from semstab.errors import ConfigError, DataError
from semstab.models import create

pytest.importorskip("ai_edge_litert", reason="pip install 'semstab[tflite]'")
tiny_tflite = pytest.importorskip("tiny_tflite")

IMAGE = blobs()
CLASSES = "a,b,c,d"


def expected(image, size=(32, 64), mean=0.5, std=0.5):
    """Logits (K, H, W), by torch and Pillow alone; TFLite pads 'same' with stride 2 at the end only."""
    network_input = np.asarray(PIL.Image.fromarray(image).resize(size[::-1], PIL.Image.Resampling.BILINEAR))
    pixels = (torch.from_numpy(network_input.copy()).permute(2, 0, 1)[None].float() / 255 - mean) / std
    padded = torch.nn.functional.pad(pixels, (0, 1, 0, 1))
    weights = torch.from_numpy(tiny_tflite.WEIGHTS.transpose(0, 3, 1, 2).copy())
    logits = torch.nn.functional.conv2d(padded, weights, torch.from_numpy(tiny_tflite.BIAS), stride=2)
    return torch.nn.functional.interpolate(logits, size=image.shape[:2], mode="bilinear")[0]


@pytest.mark.parametrize("quantised", [False, True])
def test_a_network_is_what_it_is(tmp_path, quantised):
    path = tiny_tflite.write(tmp_path / "net.tflite", quantised=quantised)
    (found,) = create(str(path), classes=CLASSES, mean=[0.5], std=[0.5]).predict([IMAGE], scores=True)
    logits = expected(IMAGE)
    best = logits.sort(0, descending=True).values
    clear = (best[0] - best[1] > (0.1 if quantised else 1e-4)).numpy()
    assert clear.mean() > 0.8
    assert len(np.unique(found.labels)) > 1
    np.testing.assert_array_equal(found.labels[clear], logits.argmax(0).numpy()[clear])
    np.testing.assert_allclose(found.scores, logits.softmax(0).permute(1, 2, 0), atol=0.05 if quantised else 1e-4)


def test_its_size_is_that_of_the_file(tmp_path):
    path = tiny_tflite.write(tmp_path / "net.tflite")
    with pytest.raises(ConfigError, match=r"net.tflite: sees images of 32x64 only; leave size out"):
        create(str(path), classes=CLASSES, size=[64, 64])


@pytest.mark.parametrize(
    ("inputs", "options", "message"),
    [
        (1, {"device": "cuda"}, "TFLite files run on the cpu, not on cuda"),
        (1, {"layout": "nchw"}, r"sees images of 64x3 only|cannot see an image"),
        (2, {}, r"has 2 inputs \(.*\); export it with the image as its only one"),
        (0, {}, r"LiteRT cannot load it .*; is it a TFLite file"),
    ],
)
def test_files_and_options_that_cannot_be_used(tmp_path, inputs, options, message):
    path = tmp_path / "net.tflite"
    if inputs:
        tiny_tflite.write(path, inputs=inputs)
    else:
        path.write_text("no network")
    with pytest.raises((ConfigError, DataError), match=message) as caught:
        create(str(path), classes=CLASSES, **options).predict([IMAGE])
    assert "\n" not in str(caught.value)
