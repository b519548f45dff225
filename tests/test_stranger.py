"""What a run of somebody's own data says: all of it counted, advised from the data, nothing passed over in silence."""

from __future__ import annotations

import io

import numpy as np
import pytest
import tiny_scene
from posed_config import configure
from rich.console import Console

import semstab
from semstab.outputs.terminal import print_summary


def printed(result) -> str:
    """What the terminal says of it, with single spaces."""
    text = io.StringIO()
    print_summary(result, Console(file=text, width=80))
    return " ".join(text.getvalue().split())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("data") / "scene")


def test_frames_in_which_nothing_is_seen_are_counted(tmp_path) -> None:
    folder = tiny_scene.write(tmp_path / "scene", backbones=("a",))
    (folder / "depth/0001.png").unlink()
    np.save(folder / "depth/0001.npy", np.full((tiny_scene.HEIGHT, tiny_scene.WIDTH), np.nan, np.float32))
    result = semstab.run(configure(folder))
    assert result.select()[0].summary.frames_empty == 1
    assert "scene, a: 1 of 3 frames hold no pixel with both depth and a label" in printed(result)
