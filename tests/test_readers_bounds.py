"""Files that are none, names that lead out: one short line, no memory, no waiting."""

from __future__ import annotations

import os

import numpy as np
import pytest
from dataset_writers import FORMATS, opened, source, write_colmap, write_labels, write_model_text
from posed_scene import fails, first_frame, write_scene
from posed_scene import opened as opened_folder

from semstab.config import read_yaml
from semstab.datasets.formats.images import read_labels
from semstab.errors import ConfigError, DataError, one_line
from semstab.model.labels import LabelSpace
from semstab.predict.folder import PredictionFolder


def test_colours_of_a_large_label_map_are_looked_up_in_parts(tmp_path):
    from PIL import Image

    space = LabelSpace("two", ("a", "b"), colors=((1, 2, 3), (4, 5, 6)))
    ids = np.random.default_rng(0).integers(0, 2, (700, 2000)).astype(np.uint8)
    Image.fromarray(np.array(space.colors, np.uint8)[ids]).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_labels(tmp_path / "a.png", space), ids)


@pytest.mark.parametrize("file", ["intrinsics.txt", "pose/frame1.txt", "depth/frame1.png", "scene.yaml"])
def test_a_pipe_or_a_device_is_no_file(tmp_path, file):
    folder = write_scene(tmp_path / "scene")
    (folder / file).unlink()
    os.mkfifo(folder / file)
    if file != "scene.yaml" and not file.endswith(".png"):
        fails(DataError, "it is no regular file", first_frame, folder)
    (folder / file).unlink()
    (folder / file).symlink_to("/dev/zero")
    if file == "intrinsics.txt":
        fails(DataError, "it is no regular file", first_frame, folder)
    fails(ConfigError, "it is no regular file", read_yaml, folder / file)


def test_aliases_that_save_writing_are_kept(tmp_path):
    (tmp_path / "c.yaml").write_text("classes: &c [a, b]\nagain: *c\nmore: {<<: {x: 1}}\n")
    assert read_yaml(tmp_path / "c.yaml") == {"classes": ["a", "b"], "again": ["a", "b"], "more": {"x": 1}}


def test_messages_are_short_whatever_the_file_holds(tmp_path):
    folder = write_scene(tmp_path / "scene")
    for file, content in (
        ("pose/frame1.txt", "x" * 60_000),
        ("labels/net/label_space.yaml", f"classes: [{{name: {'y' * 60_000}, colour: 1}}]"),
        ("labels/net/label_space.yaml", f"{'k' * 60_000}: 1\nclasses: [a]"),
        ("labels/net/label_space.yaml", f"classes: [{{name: a, id: {'z' * 60_000}}}, b]"),
    ):
        (folder / file).write_text(content)
        with pytest.raises((ConfigError, DataError)) as caught:
            opened_folder(folder).frame(0, "net")
        assert len(str(caught.value)) < 400 + len(str(folder))
    assert len(one_line(ValueError("v" * 9999))) < 250


@pytest.mark.parametrize("name", ["../../../evil.png", "a/../../../evil.png", "/tmp/evil.png"])
def test_the_name_of_an_image_does_not_lead_out_of_the_scene(tmp_path, name):
    """The root lies so high that the paths stay in it: what the frame is called must be refused."""
    folder = tmp_path / "a/b/scene"
    frames = source(None)
    write_labels(folder, write_colmap(folder, frames), frames)
    poses = [[1, 0, 0, 0, 0, 0, 0.1 * k] for k in range(len(frames))]
    write_model_text(folder / "sparse", [40, 40, 24, 16], poses, [name, *(f"cam 0/{k:04d}.png" for k in range(1, 4))])
    fails(DataError, "leaves", opened, FORMATS["colmap, text"], tmp_path)


def test_predictions_stay_in_their_folder(tmp_path):
    folder = PredictionFolder(tmp_path / "scene/labels/net", "labels", {}, {}, None)
    for name in ("../../../evil", "/tmp/evil"):
        fails(DataError, "leaves", folder.file, name)
    assert folder.file("cam 0/0001") == tmp_path / "scene/labels/net/cam 0/0001.png"
