"""Published networks of Cityscapes for scripts/streets.py: an image (H, W, 3) uint8 RGB in, scores or labels out.

Sources, with weights:
    EdgeNets   github.com/sacmehta/EdgeNets (MIT), with scripts/nets.py in it: ESPNetv2 and DiCENet, 512x256
    ESPNet     github.com/sacmehta/ESPNet (MIT): ESPNet v1, 1024x512; BGR, normalised by its own mean and standard
               deviation and then divided by 255, as test/VisualizeResults.py does
    coral      github.com/google-coral/test_data (Apache-2.0): deeplab_mobilenet_edgetpu_slim_cityscapes_quant.tflite,
               513x513, labels only; needs the package ai-edge-litert

Variants of known order make a network worse: JPEG compression, noise, a sixth of the resolution, coarse weights.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch.nn.functional import interpolate

Image = npt.NDArray[np.uint8]
Scores = npt.NDArray[np.float32]

CLASSES = 20
"""The 19 classes of Cityscapes and the networks' 'background'."""


@dataclass(frozen=True)
class StreetNetwork:
    """A network, or a variant of one.

    Attributes:
        name: Name in tables.
        family: Architecture with its training; variants have the family of their network.
        weights: File of the weights.
        load: Returns a function from images to scores (H, W, CLASSES), or to labels (H, W) uint8.
        of: Name of the network that this is a variant of; empty for a network.
        spoil: What a variant does to an image before the network.
    """

    name: str
    family: str
    weights: Path
    load: Callable[[], Callable[[Image], Scores | Image]]
    of: str = ""
    spoil: Callable[[Image], Image] | None = None


def networks(edgenets: Path, espnet: Path, coral: Path) -> list[StreetNetwork]:
    """Return all networks, then the variants, from the folders of three repositories."""
    zoo = edgenets / "model/segmentation/model_zoo"
    found = [
        StreetNetwork(
            f"{family}-{scale}", family, zoo / family / f"{family}_s_{scale}_city_512x256.pth",
            partial(_edgenet, edgenets, f"{family}_city", scale),
        )
        for family, scales in (("espnetv2", (0.5, 1.0, 1.5, 2.0)), ("dicenet", (0.5, 0.75, 1.0, 1.25, 1.5, 1.75)))
        for scale in scales
    ]  # fmt: skip
    for q in (3, 5, 8):
        weights = espnet / f"pretrained/decoder/espnet_p_2_q_{q}.pth"
        found.append(StreetNetwork(f"espnet-{q}", "espnet", weights, partial(_espnet, espnet, q, weights)))
    weights = coral / "deeplab_mobilenet_edgetpu_slim_cityscapes_quant.tflite"
    found.append(StreetNetwork("deeplab", "deeplab", weights, partial(_deeplab, weights)))
    by_name = {network.name: network for network in found}
    for base in (by_name["espnetv2-2.0"], by_name["dicenet-1.0"]):
        for name, spoil in SPOILS.items():
            found.append(StreetNetwork(f"{base.name}/{name}", base.family, base.weights, base.load, base.name, spoil))
        coarse = partial(_edgenet, edgenets, f"{base.family}_city", float(base.name.rpartition("-")[2]), bits=BITS)
        found.append(StreetNetwork(f"{base.name}/weights", base.family, base.weights, coarse, base.name))
    return found


# --- Variants ---------------------------------------------------------------------------------------------------------

QUALITY, NOISE, BITS = 8, 25.0, 5
"""Quality of JPEG files; standard deviation of noise, of 255; bits of a weight."""


def _jpeg(image: Image) -> Image:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _noise(image: Image) -> Image:
    noise = np.random.default_rng(int(image[::16, ::16].sum())).normal(0, NOISE, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _small(image: Image) -> Image:
    height, width = image.shape[:2]
    small = cv2.resize(image, (width // 6, height // 6), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


SPOILS: dict[str, Callable[[Image], Image]] = {"jpeg": _jpeg, "noise": _noise, "small": _small}


def _coarsen(module: torch.nn.Module, bits: int) -> None:
    """Round the weights of convolutions to 2^bits levels, between minus and plus the largest of an output channel."""
    for layer in module.modules():
        if isinstance(layer, torch.nn.Conv2d):
            weight = layer.weight.data
            step = weight.abs().amax(dim=(1, 2, 3), keepdim=True).clamp_min(1e-12) / (2 ** (bits - 1) - 1)
            layer.weight.data = torch.round(weight / step) * step


# --- Networks ---------------------------------------------------------------------------------------------------------


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"street_{path.parent.name}_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _edgenet(folder: Path, name: str, scale: float, bits: int = 0) -> Callable[[Image], Scores]:
    network: Any = getattr(_module(folder / "nets.py"), name)(scale=scale, soft=True)
    if bits:
        _coarsen(network.net, bits)
    return lambda image: np.asarray(network.predict(image), np.float32)


def _espnet(folder: Path, q: int, weights: Path) -> Callable[[Image], Scores]:
    net = _module(folder / "test/Model.py").ESPNet(CLASSES, 2, q)
    net.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    net.eval()
    mean = np.array([72.3923111, 82.90893555, 73.15840149], np.float32)
    std = np.array([45.3192215, 46.15289307, 44.91483307], np.float32)

    @torch.inference_mode()
    def scores(image: Image) -> Scores:
        x = cv2.resize((image[..., ::-1].astype(np.float32) - mean) / std, (1024, 512)) / 255
        y = net(torch.from_numpy(np.ascontiguousarray(x.transpose(2, 0, 1)))[None])
        y = interpolate(y, size=image.shape[:2], mode="bilinear", align_corners=False)[0]
        return np.asarray(y.softmax(0).permute(1, 2, 0).numpy(), np.float32)

    return scores


def _deeplab(weights: Path) -> Callable[[Image], Image]:
    from ai_edge_litert.interpreter import Interpreter

    net = Interpreter(str(weights), num_threads=1)
    net.allocate_tensors()
    into, out = net.get_input_details()[0], net.get_output_details()[0]

    def labels(image: Image) -> Image:
        side = int(into["shape"][1])
        net.set_tensor(into["index"], cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)[None])
        net.invoke()
        label = net.get_tensor(out["index"])[0].astype(np.uint8)
        height, width = image.shape[:2]
        return np.asarray(cv2.resize(label, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)

    return labels
