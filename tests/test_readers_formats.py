"""Every dataset's files, written from a known scene and read back: the same voxels as from the scene itself."""

from __future__ import annotations

import io
import itertools
import os
import re
import shlex
import shutil
import time
from pathlib import Path

import dataset_writers as ds
import numpy as np
import pytest
from posed_scene import fails
from pydantic import ValidationError

from semstab.config import Config, FrameSelection
from semstab.core.files import parse_yaml
from semstab.data.labels import shipped_taxonomies
from semstab.datasets import REGISTRY, open_dataset, options_model
from semstab.datasets.files.options import FileOptions, Folders
from semstab.datasets.files.scans import ScanOptions
from semstab.datasets.scene import select_frames
from semstab.errors import DataError


@pytest.fixture(scope="module", params=ds.FORMATS)
def form(request):
    return ds.FORMATS[request.param]


@pytest.fixture(scope="module")
def written(form, tmp_path_factory):
    """A root with one scene two folders deep, with labels of 'net' in its folder; nothing is changed in it."""
    folder = tmp_path_factory.mktemp("form") / "room" / "seq 1"
    folder.mkdir(parents=True)
    return folder, *ds.write_labelled(form, folder)


@pytest.fixture
def copied(written, tmp_path):
    """The same in a folder of its own."""
    shutil.copytree(written[0].parents[1], tmp_path / "copy")
    return tmp_path / "copy/room/seq 1", *written[1:]


def test_files_give_the_voxels_of_their_source(form, written):
    folder, names, frames = written
    scene = ds.opened(form, folder.parents[1])
    assert (scene.name, len(scene), scene.models) == (f"room-seq 1{form.within}", ds.COUNT, ("net",))
    assert scene.label_space("net").classes == tuple(ds.CLASSES)
    found = [scene.frame(index, "net") for index in range(ds.COUNT)]
    for ours, theirs, name in zip(found, frames, names, strict=True):
        np.testing.assert_array_equal(ours.depth, theirs.depth)
        np.testing.assert_allclose(ours.T_wc, theirs.T_wc, rtol=0, atol=1e-12)
        np.testing.assert_allclose(ours.intrinsics.matrix, theirs.intrinsics.matrix, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(ours.labels, theirs.labels)
        assert ours.color.shape == (ds.H, ds.W, 3)
        assert np.abs(ours.color.astype(float) - theirs.color).mean() < 12  # some formats have JPEG
        assert name in ours.files["labels"]
    ds.assert_same_voxels(found, frames)
    assert scene.frame(0, "net", color=False).color is None


def test_the_scenes_folder_can_be_the_root(form, written):
    folder, _, frames = written
    scene = ds.opened(form, folder)
    assert scene.name == f"seq 1{form.within}"
    np.testing.assert_allclose(scene.T_wc(ds.COUNT - 1), frames[-1].T_wc, rtol=0, atol=1e-12)


def test_a_wrong_convention_can_be_said_and_changes_the_pose(form, written):
    """What is only recalled of a format can be overridden: axes, direction, depth scale, the pixel centre."""
    folder, _, frames = written
    scene = ds.opened(form, folder)
    asked, axes = scene.options.pose_convention, scene.options.camera_axes
    other = "world_to_camera" if asked == "camera_to_world" else "camera_to_world"
    T = scene.T_wc(1)
    inverted = ds.opened(form, folder, pose_convention=other, camera_axes="opencv").T_wc(1)
    stored_axes = ds.opened(form, folder, camera_axes="opencv").T_wc(1)
    np.testing.assert_allclose(inverted, np.linalg.inv(stored_axes), rtol=0, atol=1e-12)
    flipped = ds.opened(form, folder, camera_axes="ned" if axes != "ned" else "opencv").T_wc(1)
    assert np.abs(flipped - T).max() > 0.1
    half = ds.opened(form, folder, metres_per_unit=0.5)
    np.testing.assert_allclose(half.T_wc(1)[:3, 3], T[:3, 3] / 2, rtol=0, atol=1e-12)
    tenth = ds.opened(form, folder, depth_scale=10 * (scene.options.depth_scale or form.scale or 1))
    np.testing.assert_allclose(tenth.depth(0), frames[0].depth / 10, rtol=1e-6)
    moved = ds.opened(form, folder, pixel_centre=0.25).intrinsics(0, (ds.H, ds.W))
    assert moved.cx == pytest.approx(scene.intrinsics(0, (ds.H, ds.W)).cx + (scene.options.pixel_centre or 0) - 0.25)


def test_depth_along_the_ray_becomes_planar(form, written):
    folder, _, frames = written
    scene = ds.opened(form, folder, depth_kind="ray")
    K = frames[0].intrinsics.matrix
    v, u = np.mgrid[: ds.H, : ds.W]
    rays = np.linalg.inv(K) @ np.stack([u.ravel(), v.ravel(), np.ones(ds.H * ds.W)])
    expected = frames[0].depth / np.linalg.norm(rays, axis=0).reshape(ds.H, ds.W)
    np.testing.assert_allclose(scene.depth(0), expected, rtol=1e-6)


def test_invalid_values_and_far_depth_are_left_out(form, written):
    folder, _, frames = written
    scale = None if form.floats else form.scale
    value = float(np.rint(frames[0].depth[3, 5] * scale)) if scale else float(frames[0].depth[3, 5])
    near = ds.opened(form, folder, invalid_depth=[value], max_depth=5.0).depth(0)
    expected = np.where((frames[0].depth >= 5) | (frames[0].depth == frames[0].depth[3, 5]), 0, frames[0].depth)
    np.testing.assert_array_equal(near, expected)
    assert near[3, 5] == 0


def test_intrinsics_for_another_size_are_scaled(form, written):
    folder, _, frames = written
    K = ds.opened(form, folder, intrinsics_size=(2 * ds.W, 2 * ds.H)).intrinsics(0, (ds.H, ds.W))
    assert K.fx == pytest.approx(frames[0].intrinsics.fx / 2)
    assert K.cx == pytest.approx((frames[0].intrinsics.cx + 0.5) / 2 - 0.5)


def test_the_digest_follows_what_counts(form, copied):
    folder, names, frames = copied
    scene = ds.opened(form, folder)
    digest = scene.digest([0, 1], "net")
    for index in (0, 1):
        scene.frame(index, "net")
    assert scene.digest([0, 1], "net") == digest == ds.opened(form, folder.parents[1]).digest([0, 1], "net")
    assert scene.digest([0], "net") != digest
    assert ds.opened(form, folder, max_depth=7).digest([0, 1], "net") != digest
    assert ds.opened(form, folder, classes=[*ds.CLASSES, "more"]).digest([0, 1], "net") != digest
    ds.save(folder / f"labels/net/{names[1]}.png", frames[0].labels)
    assert ds.opened(form, folder).digest([0], "net") == scene.digest([0], "net")
    assert ds.opened(form, folder).digest([0, 1], "net") != digest


def test_a_frame_that_lacks_a_file_is_an_error_or_left_out(form, copied, caplog):
    folder, names, _ = copied
    depth = ds.opened(form, folder).frame(1, "net").files["depth"]
    lost = folder / f"labels/net/{names[2]}.png"
    lost.unlink()
    with pytest.raises(ValueError, match=r"1 missing: .*add them, or set incomplete: skip") as caught:
        select_frames(ds.opened(form, folder), FrameSelection(), ["net"])
    assert str(folder) in str(caught.value)
    assert str(lost.relative_to(folder)) in str(caught.value)
    scene = ds.opened(form, folder, incomplete="skip")
    assert select_frames(scene, FrameSelection(), ["net"]).indices == [0, 1, 3]
    assert (len(scene), scene.frame(1, "net").files["depth"]) == (ds.COUNT, depth)
    assert "1 of 4 frames left out" in caplog.text


@pytest.mark.parametrize("above", [False, True])
def test_the_camera_of_7_scenes_is_that_of_its_file(tmp_path, above):
    form, frames = ds.FORMATS["seven_scenes"], ds.source(1000)
    folder = tmp_path / "seq-01"
    form.write(folder, frames)
    usual = open_dataset("seven_scenes", {"root": folder}).scene("seq-01")
    assert usual.intrinsics(0, (480, 640)).fx == 585
    np.savetxt((folder.parent if above else folder) / "camera-intrinsics.txt", frames[0].intrinsics.matrix)
    found = open_dataset("seven_scenes", {"root": folder}).scene("seq-01").intrinsics(0, (ds.H, ds.W))
    np.testing.assert_allclose(found.matrix, frames[0].intrinsics.matrix)
    said = open_dataset("seven_scenes", {"root": folder, "intrinsics": (50, 51, 24, 16)}).scene("seq-01")
    assert said.intrinsics(0, (ds.H, ds.W)).fy == 51


# --- opening reads no image


IMAGES = {".png", ".jpg", ".jpeg", ".npy", ".tif"}


def is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGES or "depth_maps" in path.parts or path.name.endswith(".depth_meters.hdf5")


UNREAD = [name for name, form in ds.FORMATS.items() if form.dataset != "bag" and not form.sizes_in_images]


@pytest.mark.parametrize("name", UNREAD)
def test_opening_and_selecting_read_no_image(tmp_path, name, monkeypatch):
    form = ds.FORMATS[name]
    ds.write_labelled(form, tmp_path)
    images = [path for path in tmp_path.rglob("*") if path.is_file() and is_image(path)]
    assert len(images) >= 3 * ds.COUNT
    for path in images:
        path.write_bytes(b"")  # whoever reads it fails
    read = []
    for module in (io, os):  # who opens a file by either of the two is seen
        actual = module.open
        monkeypatch.setattr(
            module, "open", lambda path, *rest, to=actual, **how: (read.append(Path(path)), to(path, *rest, **how))[1]
        )
    scene = ds.opened(form, tmp_path)
    assert select_frames(scene, FrameSelection()).indices == [*range(ds.COUNT)]
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
        ds.write_lines(tmp_path / f"pose/{name}.txt", ["1 0 0 0", "0 1 0 0", "0 0 1 0"])
    for name in names[::100]:
        (tmp_path / f"labels/some/{name}.png").touch()
    ds.write_lines(tmp_path / "intrinsics.txt", ["9 0 3", "0 9 3", "0 0 1"])
    started = time.process_time()
    scene = ds.opened(ds.FORMATS["posed_folder"], tmp_path)
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


# --- docs/datasets.md


TEXT = (Path(__file__).parents[1] / "docs/datasets.md").read_text()
SECTIONS = {match[1]: match[2] for match in re.finditer(r"^## [^\n]*\(`(\w+)`\)\n(.*?)(?=^## |\Z)", TEXT, re.M | re.S)}
READERS = {
    name for name, entry in REGISTRY.builtin.items() if re.fullmatch(r"semstab\.datasets\.[\w.]+:\w+", entry.target)
}
RECORDED = {
    "transforms_json", "colmap", "odm", "metashape", "pix4d", "realitycapture", "stray_scanner", "polycam", "record3d",
    "video", "points_folder", "bag", "bag_scans",
}  # fmt: skip
"""Formats of the user's own recordings, which have no licence."""


def test_every_reader_has_a_section_with_its_terms():
    assert set(SECTIONS) == READERS - {"city", "posed_folder", "predicted"}
    for name, section in SECTIONS.items():
        assert all(f"- **{word}**" in section for word in ("Get", "Read", "Name")), name
        assert ("- **Licence**" in section) != (name in RECORDED), name


COMMANDS = [
    (name, command)
    for name, section in SECTIONS.items()
    for block in re.findall(r"```bash\n(.*?)```", section, re.S)
    for command in block.replace("\\\n", " ").strip().splitlines()
]


@pytest.mark.parametrize(("name", "command"), COMMANDS)
def test_the_sample_commands_set_what_there_is(name, command):
    words = shlex.split(command)
    assert words[words.index("--dataset") + 1] == name
    options, frames = {"root": "."}, {}
    for before, setting in itertools.pairwise(words):
        key, _, value = setting.partition("=")
        if before == "--option":
            options[key] = parse_yaml(value, key)
        elif before == "--set":
            frames[key.removeprefix("frames.")] = parse_yaml(value, key)
    try:
        model = options_model(name).model_validate(options)
    except ValidationError as error:
        pytest.fail(str(error))
    Config.build({"frames": frames})
    assert getattr(model, "taxonomy", None) in (None, *shipped_taxonomies())


def test_the_options_in_tables_are_those_of_every_reader():
    table = TEXT.split("## Options that every dataset below has")[1].split("## Frames")[0]
    options = set(
        re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in table.splitlines() if line.startswith("|")))
    )
    assert len(options) > 8
    models = {name: options_model(name) for name in SECTIONS}
    of_images = {name: model for name, model in models.items() if issubclass(model, FileOptions)}
    assert len(of_images) > 15
    for name, model in of_images.items():
        assert options <= set(model.model_fields), name


def test_the_options_of_scans_are_those_of_every_reader_of_them():
    table = TEXT.split("## Scans")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)`(?:, `(\w+)`)*", table, re.M)
    assert len(rows) > 5
    models = {name: options_model(name) for name in SECTIONS}
    of_scans = {name: model for name, model in models.items() if issubclass(model, ScanOptions)}
    assert set(of_scans) >= {"semantickitti"}
    for name, model in of_scans.items():
        assert {word for words in rows for word in words if word} <= set(model.model_fields), name


def test_the_frames_that_are_shown_are_settings():
    table = TEXT.split("## Frames")[1].split("## UAVid")[0]
    texts = re.findall(r"\| `(\{.*?\})` \|", table)
    assert len(texts) == 4
    for text in texts:
        Config.build({"frames": parse_yaml(text, "docs/datasets.md")})
