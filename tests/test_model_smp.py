"""Networks of segmentation_models_pytorch, by name and checkpoint; a stand-in makes them where it is not installed."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from types import ModuleType

import numpy as np
import pytest
import torch
from pictures import blobs

from semstab.errors import ConfigError, DataError
from semstab.models import create
from semstab.predict.predictor import parse_predictor

IMAGE = blobs()  # 48 x 80
CLASSES = "a,b,c,d"


class Tiny(torch.nn.Module):
    """Logits at full size, of sides that are multiples of 32 only, as networks of that package want them."""

    def __init__(self, classes):
        super().__init__()
        self.encoder = torch.nn.Conv2d(3, 8, 3, padding=1)
        self.encoder.output_stride = 32
        self.segmentation_head = torch.nn.Conv2d(8, classes, 3, padding=1)

    def forward(self, image):
        assert image.shape[2] % 32 == image.shape[3] % 32 == 0, image.shape
        return self.segmentation_head(self.encoder(image).relu())


def create_model(arch, encoder_name, encoder_weights="imagenet", classes=1):
    assert encoder_weights is None, "nothing is downloaded"
    if (arch, encoder_name) != ("unet", "resnet18"):
        raise KeyError(f"Wrong architecture or encoder {arch}, {encoder_name}")
    return Tiny(classes)


@pytest.fixture
def package(monkeypatch):
    if importlib.util.find_spec("segmentation_models_pytorch") is None:
        stand_in = ModuleType("segmentation_models_pytorch")
        stand_in.create_model = create_model
        monkeypatch.setitem(sys.modules, "segmentation_models_pytorch", stand_in)
    monkeypatch.delitem(sys.modules, "semstab.models.smp", raising=False)
    yield sys.modules.get("segmentation_models_pytorch") or importlib.import_module("segmentation_models_pytorch")
    sys.modules.pop("semstab.models.smp", None)


@pytest.fixture
def net(package):
    torch.manual_seed(0)
    return package.create_model("unet", encoder_name="resnet18", encoder_weights=None, classes=4).eval()


def expected(net, size):
    pixels = torch.nn.functional.interpolate(
        torch.from_numpy(IMAGE.copy()).permute(2, 0, 1)[None].float(), size=size, mode="bilinear", antialias=True
    )
    mean, std = (torch.tensor(v)[:, None, None] for v in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    with torch.inference_mode():
        return torch.nn.functional.interpolate(net((pixels / 255 - mean) / std), size=IMAGE.shape[:2], mode="bilinear")[
            0
        ]


@pytest.mark.parametrize("kind", ["state_dict", "lightning", "safetensors"])
@pytest.mark.parametrize("size", [None, 32])
def test_a_network_is_what_it_is(tmp_path, net, kind, size):
    path, weights = tmp_path / "net.pth", net.state_dict()
    if kind == "safetensors":
        torch_files = pytest.importorskip("safetensors.torch")
        path = tmp_path / "net.safetensors"
        torch_files.save_file(weights, path)
    else:
        lightning = {"state_dict": {f"model.{name}": tensor for name, tensor in weights.items()}, "epoch": 3}
        torch.save(weights if kind == "state_dict" else lightning, path)
    model = create(
        "smp", architecture="unet", encoder="resnet18", checkpoint=path, classes=CLASSES, resize="antialias", size=size
    )
    (found,) = model.predict([IMAGE], scores=True)
    logits = expected(net, (64, 96) if size is None else (32, 32))  # sides are rounded up to multiples of 32
    assert len(np.unique(found.labels)) > 1
    np.testing.assert_array_equal(found.labels, logits.argmax(0).numpy())
    np.testing.assert_allclose(found.scores, logits.softmax(0).permute(1, 2, 0), atol=1e-4)


def test_it_is_known_by_the_content_of_its_checkpoint(tmp_path, net):
    identities = []
    torch.save(net.state_dict(), tmp_path / "one.pth")
    shutil.copy(tmp_path / "one.pth", tmp_path / "two.pth")
    next(net.parameters()).data += 1
    torch.save(net.state_dict(), tmp_path / "three.pth")
    for name in ("one.pth", "two.pth", "three.pth"):
        identities.append(
            create("smp", encoder="resnet18", checkpoint=tmp_path / name, classes=CLASSES, threads=1).identity()
        )
    assert identities[0] == identities[1] != identities[2]


def test_a_run_takes_it(tmp_path, net, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(net.state_dict(), "net.pth")
    found = parse_predictor("smp,encoder=resnet18,checkpoint=net.pth,size=64x96", {"classes": CLASSES}).resolved()
    assert found.label_name == "smp"
    assert (found.options["checkpoint"], found.options["size"]) == (str(tmp_path / "net.pth"), [64, 96])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"checkpoint": "nowhere.pth"}, "nowhere.pth: there is no such file"),
        ({"checkpoint": "text.pth"}, "text.pth: torch cannot load weights from it"),
        ({"checkpoint": "list.pth"}, "list.pth: holds no weights by name"),
        ({"classes": None}, "net.pth: its classes are not known"),
        ({"classes": "a,b"}, "net.pth: holds no weights of unet with encoder resnet18 for 2 classes"),
        ({"encoder": "resnet99999"}, "there is no unet with encoder resnet99999 .*correct architecture or encoder"),
        ({"layout": "nhwc"}, "are nchw; leave layout out"),
    ],
)
def test_what_cannot_be_used(tmp_path, net, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    torch.save(net.state_dict(), "net.pth")
    torch.save([1, 2], "list.pth")
    (tmp_path / "text.pth").write_text("no weights")
    usual = {"encoder": "resnet18", "checkpoint": "net.pth", "classes": CLASSES}
    with pytest.raises((ConfigError, DataError), match=message) as caught:
        create("smp", **(usual | options))
    assert "\n" not in str(caught.value)
