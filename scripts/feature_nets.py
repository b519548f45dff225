"""Features of the published networks of EdgeNets, before their classifier, and the classifier as a vocabulary.

    python scripts/feature_nets.py ../shared/networks dicenet_voc 0.75 -o voc.yaml
    NET=scripts/feature_nets.py:dicenet_voc,scale=0.75,networks=../shared/networks
    semstab-bench SCENE --predict $NET --vocabulary voc.yaml

The folder of networks is a clone of EdgeNets with scripts/nets.py in it. A feature is the input of the last layer, a
convolution 1 x 1, with a 1 at its end, which takes the bias: so the likeliest name of a cell is the class of its
largest logit. With --groups the names are the data's groups of classes, whose synonyms are the classes.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

NETWORKS = "../shared/networks"

VOC_GROUPS = {
    "nothing known": ["background"],
    "person or group": ["person"],
    "animal": ["bird", "cat", "cow", "dog", "horse", "sheep"],
    "vehicle": ["aeroplane", "bicycle", "boat", "bus", "car", "motorbike", "train"],
    "indoor": ["bottle", "chair", "diningtable", "pottedplant", "sofa", "tvmonitor"],
}
CITY_GROUPS = {
    "flat": ["road", "sidewalk"],
    "construction": ["building", "wall", "fence"],
    "object": ["pole", "traffic light", "traffic sign"],
    "nature": ["vegetation", "terrain", "sky"],
    "human": ["person", "rider"],
    "any vehicle": ["car", "truck", "bus", "train", "motorcycle", "bicycle"],
    "none of these": ["background"],
}
"""Groups of the classes, as the data sets name them; the first member's weights stand for the group's own name."""


def load(networks: str, name: str, scale: float) -> Any:
    """Return a network of a folder's nets.py."""
    file = Path(networks).expanduser().absolute() / "nets.py"
    spec = importlib.util.spec_from_file_location("edge_nets", file)
    if spec is None or spec.loader is None or not file.is_file():
        raise FileNotFoundError(f"{file} is not there: a clone of EdgeNets with scripts/nets.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)(scale=scale)


def classifier_of(network: Any) -> Any:
    """Return the last convolution, which has a channel for each class."""
    layers = [layer for layer in network.net.modules() if isinstance(layer, torch.nn.Conv2d)]
    return [layer for layer in layers if layer.out_channels == len(network.classes) and layer.kernel_size == (1, 1)][-1]


def weights_of(network: Any) -> np.ndarray[Any, Any]:
    """Return the classifier's weights and biases (K, D + 1)."""
    layer = classifier_of(network)
    weights = layer.weight.detach().numpy()[:, :, 0, 0]
    bias = np.zeros(len(weights)) if layer.bias is None else layer.bias.detach().numpy()
    return np.column_stack([weights, bias]).astype(np.float32)


class WithFeatures:
    """A network that gives its labels, and its features before the classifier.

    Args:
        scale: Width of the network.
        networks: The folder of EdgeNets.
        alone: Whether it gives features without labels.
    """

    gives_features = True
    name = ""

    def __init__(self, scale: float = 1.0, networks: str = NETWORKS, alone: bool = False) -> None:
        self.network, self._alone = load(networks, self.name, scale), alone
        self._seen: Any = None
        if not alone:
            self.classes = list(self.network.classes)
        classifier_of(self.network).register_forward_pre_hook(self._keep)

    def _keep(self, _layer: Any, inputs: tuple[Any, ...]) -> None:
        self._seen = inputs[0]

    def predict(self, image: np.ndarray[Any, Any]) -> dict[str, np.ndarray[Any, Any]]:
        """Return features (h, w, D + 1) float32, and labels (H, W), of an image (H, W, 3)."""
        labels = self.network.predict(image)
        cells = self._seen[0].permute(1, 2, 0).numpy()
        features = np.concatenate([cells, np.ones((*cells.shape[:2], 1), np.float32)], axis=2)
        return {"features": features} if self._alone else {"features": features, "labels": labels}


class espnetv2_voc(WithFeatures):  # noqa: N801  a name of --predict
    """ESPNetv2, PASCAL VOC 2012."""

    name = "espnetv2_voc"


class espnetv2_city(WithFeatures):  # noqa: N801
    """ESPNetv2, Cityscapes."""

    name = "espnetv2_city"


class dicenet_voc(WithFeatures):  # noqa: N801
    """DiCENet, PASCAL VOC 2012."""

    name = "dicenet_voc"


class dicenet_city(WithFeatures):  # noqa: N801
    """DiCENet, Cityscapes."""

    name = "dicenet_city"


def write_vocabulary(
    networks: str, name: str, scale: float, out: Path, *, groups: bool = False, models: Sequence[str] = ()
) -> None:
    """Write the classifier of a network as a vocabulary, and its embeddings next to it.

    Args:
        networks: The folder of EdgeNets.
        name: Name of the network in nets.py.
        scale: Width of the network.
        out: The vocabulary, a .yaml.
        groups: Whether names are groups of classes, not classes.
        models: Models whose features it is for; by default `name`.
    """
    network = load(networks, name, scale)
    names, order = list(network.classes), list(range(len(network.classes)))
    if groups:
        of_data = VOC_GROUPS if network.data == "pascal" else CITY_GROUPS
        names = [{"name": group, "synonyms": members} for group, members in of_data.items()]
        order = [network.classes.index(word) for members in of_data.values() for word in (members[0], *members)]
    np.save(out.with_suffix(".npy"), weights_of(network)[order])
    content = {
        "names": names, "embeddings": out.with_suffix(".npy").name, "normalise": False, "models": [*models] or [name],
    }  # fmt: skip
    out.write_text(yaml.safe_dump(content, sort_keys=False))


def main() -> None:
    """Write the classifier of a network as a vocabulary."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("networks")
    parser.add_argument("name")
    parser.add_argument("scale", type=float)
    parser.add_argument("--groups", action="store_true", help="name the groups of classes, not the classes")
    parser.add_argument("-o", "--out", type=Path, required=True, help="a .yaml; embeddings are written next to it")
    options = parser.parse_args()
    write_vocabulary(options.networks, options.name, options.scale, options.out, groups=options.groups)


if __name__ == "__main__":
    main()
