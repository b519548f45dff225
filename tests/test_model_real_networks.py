"""Published networks in a file label real frames as the code that they come with does; run where both are."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import feature_nets
import numpy as np
import pytest
import torch

from semstab import Features, LabelSpace
from semstab.core.code import Code
from semstab.datasets import open_dataset
from semstab.models import create
from semstab.predict.vocabulary import Vocabulary

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))
NETWORKS = Path(os.environ.get("SEMSTAB_NETWORKS", Path(__file__).parents[1] / "../shared/networks"))


def test_a_torchscript_file_labels_as_the_networks_own_code(tmp_path):
    if not (NETWORKS / "nets.py").is_file() or not (DATA / "livingroom").is_dir():
        pytest.skip(f"no {NETWORKS} or no {DATA / 'livingroom'}; set SEMSTAB_NETWORKS and SEMSTAB_DATA")
    dataset = open_dataset("posed_folder", {"root": str(DATA / "livingroom")})
    image = dataset.scene(dataset.scenes[0]).image(60)
    by_code = create(f"{NETWORKS / 'nets.py'}:dicenet_voc", scale=0.5)
    wrapper = Code.load(f"{NETWORKS / 'nets.py'}:dicenet_voc", "model").target(scale=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.trace(wrapper.net, torch.rand(1, 3, 384, 384), check_trace=False).save(tmp_path / "net.pt")
    classes = list(by_code.label_space.classes)
    network = create(str(tmp_path / "net.pt"), classes=classes, size=384, resize="antialias")
    ((expected,), (found,)) = by_code.predict([image]), network.predict([image])
    assert len(np.unique(expected.labels)) > 1
    np.testing.assert_array_equal(found.labels, expected.labels)


def test_a_classifiers_weights_as_a_vocabulary_give_the_networks_labels(capsys):
    """At the cells of the grid, where features are: the network's own labels are enlarged after the classifier."""
    if not (NETWORKS / "nets.py").is_file() or not (DATA / "livingroom").is_dir():
        pytest.skip(f"no {NETWORKS} or no {DATA / 'livingroom'}; set SEMSTAB_NETWORKS and SEMSTAB_DATA")
    dataset = open_dataset("posed_folder", {"root": str(DATA / "livingroom")})
    scene = dataset.scene(dataset.scenes[0])
    for name, scale in (("dicenet_voc", 0.75), ("espnetv2_voc", 2.0)):
        network = getattr(feature_nets, name)(scale=scale, networks=str(NETWORKS))
        space = LabelSpace(name, tuple(network.classes))
        weights = feature_nets.weights_of(network.network)
        words = Vocabulary(space, weights, np.arange(len(weights)), None, name)
        logits = []
        feature_nets.classifier_of(network.network).register_forward_hook(
            lambda *hook, outputs=logits: outputs.append(hook[2])
        )
        for index in (0, 60, 120):
            image = scene.image(index)
            found = words.labels(Features.over(network.predict(image)["features"], image.shape[:2]), name)
            expected = logits[-1][0].argmax(0).numpy()
            share = float((found == expected).mean())
            with capsys.disabled():
                sys.stdout.write(
                    f"\n{name} {scale}, frame {index}: {100 * share:.4f} % of {found.size} cells are equal"
                )
            assert share > 0.9999  # rounding of vectors to unit length may turn a tie
