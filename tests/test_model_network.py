"""Networks that lie in files: ONNX, TorchScript and exported programs."""

from __future__ import annotations

import warnings

import numpy as np
import onnx
import PIL.Image
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from pictures import blobs

from semstab.errors import ConfigError, DataError
from semstab.models import create
from semstab.models.network import resized
from semstab.predict.predictor import parse_predictor

IMAGE = blobs()
CLASSES = "a,b,c,d"
MEAN, STD = [0.4, 0.5, 0.6], [0.2, 0.3, 0.4]


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return torch.nn.Conv2d(3, 4, 3, stride=2, padding=1).eval()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, net):
    """net.onnx of any size, net.pt, net.pt2 for 32x64; each with logits at half the size."""
    folder = tmp_path_factory.mktemp("networks")
    save_onnx(folder / "net.onnx", net)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(net, torch.rand(1, 3, 8, 8)).save(folder / "net.pt")
    torch.export.save(torch.export.export(net, (torch.rand(1, 3, 32, 64),)), folder / "net.pt2")
    return folder


def save_onnx(path, net, size=("h", "w"), inputs=1, kind=TensorProto.FLOAT, after=(), gives="logits"):
    weights = [numpy_helper.from_array(p.detach().numpy(), name) for name, p in net.named_parameters()]
    conv = helper.make_node("Conv", ["image", "weight", "bias"], ["logits"], strides=[2, 2], pads=[1, 1, 1, 1])
    image = [helper.make_tensor_value_info(f"image{k or ''}", kind, [1, 3, *size]) for k in range(inputs)]
    outputs = [helper.make_empty_tensor_value_info(gives)]
    graph = helper.make_graph([conv, *after], "net", image, outputs, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return path


def expected(net, image=IMAGE, size=None, mean=MEAN, std=STD):
    """Logits (K, H, W) at the image's size, by torch and Pillow alone."""
    network_input = (
        image if size is None else np.asarray(PIL.Image.fromarray(image).resize(size[::-1], PIL.Image.BILINEAR))
    )
    pixels = (torch.from_numpy(network_input.copy()).float() / 255 - torch.tensor(mean)) / torch.tensor(std)
    with torch.inference_mode():
        logits = net(pixels.permute(2, 0, 1)[None])
        return torch.nn.functional.interpolate(logits, size=image.shape[:2], mode="bilinear")[0]


def assert_same(found, logits):
    best = logits.sort(0, descending=True).values
    clear = (best[0] - best[1] > 1e-4).numpy()
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(found.labels[clear], logits.argmax(0).numpy()[clear])
    if found.scores is not None:
        np.testing.assert_allclose(found.scores, logits.softmax(0).permute(1, 2, 0), atol=1e-4)


@pytest.mark.parametrize("name", ["net.onnx", "net.pt"])
@pytest.mark.parametrize("size", [None, [40, 72]])
def test_a_network_is_what_it_is(folder, net, name, size):
    model = create(str(folder / name), classes=CLASSES, mean=MEAN, std=STD, size=size)
    assert model.label_space.classes == ("a", "b", "c", "d")
    (found,) = model.predict([IMAGE], scores=True)
    assert len(np.unique(found.labels)) > 1
    assert_same(found, expected(net, size=size))
    assert model.predict([IMAGE])[0].scores is None


def test_an_exported_program_has_a_size(folder, net):
    (found,) = create(str(folder / "net.pt2"), classes=CLASSES, mean=MEAN, std=STD).predict([IMAGE], scores=True)
    assert_same(found, expected(net, size=(32, 64)))
    with pytest.raises(ConfigError, match=r"net.pt2: sees images of 32x64 only; leave size out"):
        create(str(folder / "net.pt2"), classes=CLASSES, size=64)


def test_an_onnx_file_may_have_a_size(tmp_path, net):
    path = save_onnx(tmp_path / "net.onnx", net, size=(40, 72))
    (found,) = create(str(path), classes=CLASSES, mean=MEAN, std=STD).predict([IMAGE], scores=True)
    assert_same(found, expected(net, size=(40, 72)))


def test_values_channels_and_scale(folder, net):
    bgr = np.ascontiguousarray(IMAGE[..., ::-1])
    usual = [255 * value for value in MEAN], [255 * value for value in STD]
    model = create(str(folder / "net.onnx"), classes=CLASSES, channels="bgr", scale=1, mean=usual[0], std=usual[1])
    (found,) = model.predict([IMAGE], scores=True)
    assert_same(found, expected(net, bgr))


def test_channels_last(tmp_path, net):
    text = """
import torch
class Last(torch.nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net
    def forward(self, image):
        return self.net(image.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
"""
    space = {}
    exec(text, space)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.trace(space["Last"](net), torch.rand(1, 8, 8, 3)).save(tmp_path / "net.pt")
    model = create(str(tmp_path / "net.pt"), classes=CLASSES, mean=MEAN, std=STD, layout="nhwc")
    (found,) = model.predict([IMAGE], scores=True)
    assert_same(found, expected(net))


def test_probabilities_and_labels(tmp_path, net):
    softmax = helper.make_node("Softmax", ["logits"], ["shares"], axis=1)
    path = save_onnx(tmp_path / "shares.onnx", net, after=[softmax], gives="shares")
    model = create(str(path), classes=CLASSES, mean=MEAN, std=STD, gives="probabilities")
    (found,) = model.predict([IMAGE], scores=True)
    np.testing.assert_allclose(found.scores.sum(2), 1, atol=1e-5)
    largest = helper.make_node("ArgMax", ["logits"], ["labels"], axis=1, keepdims=1)
    path = save_onnx(tmp_path / "labels.onnx", net, after=[largest], gives="labels")
    model = create(str(path), classes=CLASSES, mean=MEAN, std=STD)
    (found,) = model.predict([IMAGE])
    with torch.inference_mode():
        pixels = (torch.from_numpy(IMAGE).float() / 255 - torch.tensor(MEAN)) / torch.tensor(STD)
        small = net(pixels.permute(2, 0, 1)[None])[0].argmax(0).numpy()
    assert found.labels.shape == (48, 80)
    assert (found.labels[::2, ::2] == small).mean() > 0.99
    with pytest.raises(DataError, match="gives labels, no scores"):
        model.predict([IMAGE], scores=True)
    with pytest.raises(DataError, match="gave the label 3, but has 3 classes, 0 to 2"):
        create(str(path), classes="a,b,c", mean=MEAN, std=STD).predict([IMAGE])


def test_identity_is_of_the_file_and_the_settings(folder, tmp_path, net):
    usual = create(str(folder / "net.onnx"), classes=CLASSES).identity()
    (tmp_path / "other.onnx").write_bytes((folder / "net.onnx").read_bytes())
    assert create(str(tmp_path / "other.onnx"), classes=CLASSES, threads=1).identity() == usual
    assert create(str(folder / "net.onnx"), classes=CLASSES, size=64).identity() != usual
    assert create(str(folder / "net.onnx"), classes="a,b,c,e").identity() != usual


def test_a_predictor_is_called_as_its_file(folder, monkeypatch):
    monkeypatch.chdir(folder)
    found = parse_predictor("net.onnx,size=[32, 64]", {"classes": CLASSES})
    assert found.label_name == "net"
    resolved = found.resolved()
    assert (resolved.model, resolved.label_name) == (str(folder / "net.onnx"), "net")
    assert resolved.options["size"] == [32, 64]


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("nowhere.onnx", {"classes": CLASSES}, "nowhere.onnx: there is no such file"),
        ("net.onnx", {}, "net.onnx: its classes are not known; name them with --classes"),
        ("net.onnx", {"classes": CLASSES, "mean": [1, 2]}, "mean: give three numbers, or one"),
        ("net.onnx", {"classes": CLASSES, "device": "cuda"}, "ONNX files run on the cpu, not on cuda"),
        ("net.onnx", {"classes": CLASSES, "output": 1}, "output: has 1 outputs, counted from 0"),
        ("net.onnx", {"classes": "a,b,c"}, r"output of shape \(1, 4, 24, 40\) holds no 3 classes; correct classes"),
        ("net.onnx", {"classes": CLASSES, "layout": "nhwc"}, "cannot see an image of shape .*; correct size, layout"),
        ("two.onnx", {"classes": CLASSES}, r"has 2 inputs \(image, image1\); export it with the image as its only one"),
        ("words.onnx", {"classes": CLASSES}, r"its input is a tensor\(string\); a network of images takes"),
        ("text.onnx", {"classes": CLASSES}, "ONNX Runtime cannot load it .*; is it an ONNX file"),
        ("text.pt", {"classes": CLASSES}, "cannot load it as TorchScript .*; if it holds weights alone, name the"),
        ("text.pth", {"classes": CLASSES}, "cannot load it as TorchScript .*; if it holds weights alone, name the"),
        ("text.pt2", {"classes": CLASSES}, "cannot load it as an exported program"),
    ],
)
def test_files_and_options_that_cannot_be_used(folder, net, monkeypatch, name, options, message):
    monkeypatch.chdir(folder)
    save_onnx(folder / "two.onnx", net, inputs=2)
    strings = helper.make_tensor_value_info("words", TensorProto.STRING, [1])
    same = helper.make_node("Identity", ["words"], ["out"])
    graph = helper.make_graph([same], "net", [strings], [helper.make_tensor_value_info("out", TensorProto.STRING, [1])])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), "words.onnx")
    for text in ("text.onnx", "text.pt", "text.pth", "text.pt2"):
        (folder / text).write_text("no network")
    with pytest.raises((ConfigError, DataError), match=message) as caught:
        create(name, **options).predict([IMAGE])
    assert "\n" not in str(caught.value)


def test_torch_says_nothing_of_a_program_that_cannot_be_loaded(folder, caplog):
    (folder / "text.pt2").write_text("no network")
    with pytest.raises(DataError, match="cannot load it as an exported program"):
        create(str(folder / "text.pt2"), classes=CLASSES)
    assert not caplog.records


@pytest.mark.parametrize("scores", [True, False])
def test_logits_that_are_no_numbers_are_named(tmp_path, net, scores):
    path = save_onnx(tmp_path / "logs.onnx", net, after=[helper.make_node("Log", ["logits"], ["logs"])], gives="logs")
    model = create(str(path), classes=CLASSES, mean=MEAN, std=STD)
    with pytest.raises(DataError, match=r"logs.onnx: gave logits that are NaN"):
        model.predict([IMAGE], scores=scores)


def test_weights_that_an_onnx_file_stores_beside_it_are_part_of_its_digest(tmp_path, net):
    whole = onnx.load(save_onnx(tmp_path / "whole.onnx", net))
    usual = {"save_as_external_data": True, "all_tensors_to_one_file": True, "size_threshold": 0}
    onnx.save_model(whole, tmp_path / "net.onnx", location="net.onnx.data", **usual)
    before = create(str(tmp_path / "net.onnx"), classes=CLASSES).identity()
    with torch.no_grad():
        net.weight += 1
    changed = onnx.load(save_onnx(tmp_path / "whole.onnx", net))
    with torch.no_grad():
        net.weight -= 1
    graph = (tmp_path / "net.onnx").read_bytes()
    (tmp_path / "net.onnx.data").unlink()  # else it is appended to
    onnx.save_model(changed, tmp_path / "net.onnx", location="net.onnx.data", **usual)
    assert (tmp_path / "net.onnx").read_bytes() == graph  # only the weights differ, and they lie in the other file
    assert create(str(tmp_path / "net.onnx"), classes=CLASSES).identity() != before


def test_how_an_image_is_resized_is_an_option(folder):
    pixels = torch.from_numpy(IMAGE.copy()).permute(2, 0, 1)[None].float()
    usual = {"classes": CLASSES, "size": "24x44", "mean": MEAN, "std": STD}
    for how, antialias in (("antialias", True), ("bilinear", False)):
        small = torch.nn.functional.interpolate(pixels, size=(24, 44), mode="bilinear", antialias=antialias)
        np.testing.assert_allclose(resized(IMAGE, (24, 44), how).transpose(2, 0, 1), small[0], atol=1e-3, err_msg=how)
    found = [create(str(folder / "net.onnx"), resize=how, **usual) for how in ("pillow", "bilinear")]
    first, second = (model.predict([IMAGE], scores=True)[0].scores for model in found)
    assert np.abs(first - second).max() > 1e-3
    assert found[0].identity() != found[1].identity()


def test_scores_come_class_by_class_too(folder):
    model = create(str(folder / "net.onnx"), classes=CLASSES, mean=MEAN, std=STD)
    (whole,) = model.predict([IMAGE], scores=True)
    streamed = model.stream(IMAGE)
    np.testing.assert_array_equal(np.dstack(list(streamed.maps())), whole.scores)
    np.testing.assert_array_equal(streamed.labels, whole.labels)
