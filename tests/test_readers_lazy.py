"""Opening a sequence, of any length, lists and parses text, but reads no image."""

from __future__ import annotations

import io
import os
import time
from pathlib import Path

import pytest
from dataset_writers import COUNT, FORMATS, opened, source, write_labels, write_lines
from posed_scene import fails

from semstab.config import FrameSelection
from semstab.datasets.files.options import Folders
from semstab.datasets.scene import select_frames
from semstab.errors import DataError

IMAGES = {".png", ".jpg", ".npy", ".tif"}


def is_image(path: Path) -> bool:
    return path.suffix in IMAGES or "depth_maps" in path.parts


@pytest.mark.parametrize("name", FORMATS)
def test_opening_and_selecting_read_no_image(tmp_path, name, monkeypatch):
    form = FORMATS[name]
    names = form.write(tmp_path, source(form.scale))
    write_labels(tmp_path, names, source(form.scale))
    images = [path for path in tmp_path.rglob("*") if path.is_file() and is_image(path)]
    assert len(images) >= 3 * COUNT
    for path in images:
        path.write_bytes(b"")  # whoever reads it fails
    read = []
    for module in (io, os):  # who opens a file by either of the two is seen
        actual = module.open
        monkeypatch.setattr(
            module, "open", lambda path, *rest, to=actual, **how: (read.append(Path(path)), to(path, *rest, **how))[1]
        )
    scene = opened(form, tmp_path)
    assert select_frames(scene, FrameSelection()).indices == [*range(COUNT)]
    assert read
    assert not [path for path in read if is_image(path)]
    fails(DataError, "the file is empty", scene.frame, 0, "net")
    assert is_image(read[-1])


def test_a_posed_folder_of_thousands_of_frames_opens_at_once(tmp_path):
    """Two label sources, of which one has every hundredth frame; what is selected is all that has to be there."""
    names = [f"{k:06d}" for k in range(3000)]
    for part in ("depth", "pose", "labels/all", "labels/some"):
        (tmp_path / part).mkdir(parents=True)
    for name in names:
        (tmp_path / f"depth/{name}.png").touch()
        (tmp_path / f"labels/all/{name}.png").touch()
        write_lines(tmp_path / f"pose/{name}.txt", ["1 0 0 0", "0 1 0 0", "0 0 1 0"])
    for name in names[::100]:
        (tmp_path / f"labels/some/{name}.png").touch()
    write_lines(tmp_path / "intrinsics.txt", ["9 0 3", "0 9 3", "0 0 1"])
    started = time.process_time()
    scene = opened(FORMATS["posed_folder"], tmp_path)
    assert select_frames(scene, FrameSelection(), ["all"]).indices == [*range(3000)]
    assert select_frames(scene, FrameSelection(stride=100), ["all", "some"]).left_out == 0
    assert time.process_time() - started < 2
    fails(DataError, "2970 missing", select_frames, scene, FrameSelection(), ["some"])


def test_a_name_that_is_listed_in_a_folder_is_found_and_no_other(tmp_path):
    for name in ("b.png", "a", "é.PNG", "b.pngx"):
        (tmp_path / name).touch()
    folders = Folders()
    asked = ("b.png", "a", "é.PNG", "b.pngx", "b", "b.pn", "c", "b.pngxy")
    assert [folders.has(tmp_path / name) for name in asked] == [True] * 4 + [False] * 4
    assert folders.one_of(tmp_path / "b", (".jpg", ".png")) == tmp_path / "b.png"
    assert folders.one_of(tmp_path / "é.PNG", (".png",)) == tmp_path / "é.PNG"
    assert not folders.has(tmp_path / "nowhere/a")
