"""Published networks in a file label real frames as the code that they come with does; run where both are."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from semstab.core.code import Code
from semstab.datasets import open_dataset
from semstab.models import create

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[1] / "../shared/data"))
NETWORKS = Path(os.environ.get("SEMSTAB_NETWORKS", Path(__file__).parents[1] / "../shared/networks"))


def test_a_torchscript_file_labels_as_the_networks_own_code(tmp_path):
    if not (NETWORKS / "nets.py").is_file() or not (DATA / "livingroom").is_dir():
        pytest.skip(f"no {NETWORKS} or no {DATA / 'livingroom'}; set SEMSTAB_NETWORKS and SEMSTAB_DATA")
    dataset = open_dataset("posed_folder", {"root": str(DATA / "livingroom")})
    image = dataset.scene(dataset.scenes[0]).image(60)
    own = create(f"{NETWORKS / 'nets.py'}:dicenet_voc", scale=0.5)
    wrapper = Code.load(f"{NETWORKS / 'nets.py'}:dicenet_voc", "model").target(scale=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.trace(wrapper.net, torch.rand(1, 3, 384, 384), check_trace=False).save(tmp_path / "net.pt")
    classes = list(own.label_space.classes)
    network = create(str(tmp_path / "net.pt"), classes=classes, size=384, resize="antialias")
    ((expected,), (found,)) = own.predict([image]), network.predict([image])
    assert len(np.unique(expected.labels)) > 1
    np.testing.assert_array_equal(found.labels, expected.labels)
