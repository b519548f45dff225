"""Files that are none, aliases without end, names that lead out: one short line, no memory, no waiting."""

from __future__ import annotations

import os

import pytest
from posed_scene import fails, first_frame, write_scene
from posed_scene import opened as opened_folder

from semstab.config import read_yaml
from semstab.errors import ConfigError, DataError, one_line
from semstab.model.labels import LabelSpace
from semstab.predict.folder import PredictionFolder


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


BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize("content", [BOMB + "classes: *i\n", "classes: &c [*c, *c]\n"])
def test_aliases_that_stand_for_a_billion_values_are_refused(tmp_path, content):
    folder = write_scene(tmp_path / "scene")
    (folder / "labels/net/label_space.yaml").write_text(content)
    fails(ConfigError, r"label_space\.yaml: its aliases", opened_folder(folder).label_space, "net")
    (folder / "scene.yaml").write_text(content)
    fails(ConfigError, r"scene\.yaml: its aliases", opened_folder, folder)


def test_aliases_that_save_writing_are_kept(tmp_path):
    (tmp_path / "c.yaml").write_text("classes: &c [a, b]\nagain: *c\nmore: {<<: {x: 1}}\n")
    assert read_yaml(tmp_path / "c.yaml") == {"classes": ["a", "b"], "again": ["a", "b"], "more": {"x": 1}}


def test_many_classes_are_no_bomb(tmp_path, monkeypatch):
    monkeypatch.setattr("semstab.core.files.MAX_ALIASED", 10)
    classes = "".join(f"- {{name: class {k}, id: {k}, color: [1, 2, 3]}}\n" for k in range(100))
    (tmp_path / "many.yaml").write_text(f"classes:\n{classes}")
    assert len(LabelSpace.load(tmp_path / "many.yaml")) == 100


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


def test_predictions_stay_in_their_folder(tmp_path):
    folder = PredictionFolder(tmp_path / "scene/labels/net", "labels", {}, {}, None)
    for name in ("../../../evil", "/tmp/evil"):
        fails(DataError, "leaves", folder.file, name)
    assert folder.file("cam 0/0001") == tmp_path / "scene/labels/net/cam 0/0001.png"
