"""Damaged and hostile files in every format: one clear line, no traceback, no unpickling, no memory for a claim."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from dataset_writers import FORMATS, opened, write_labelled, write_lines
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from posed_scene import fails, first_frame, write_scene
from posed_scene import opened as opened_folder

from semstab.config import FrameSelection, read_yaml
from semstab.datasets.colmap import read_model
from semstab.datasets.formats.disk import read_table, records
from semstab.datasets.scannet import read_class_table
from semstab.datasets.scene import select_frames
from semstab.datasets.transforms_json import read_transforms
from semstab.errors import ConfigError, DataError, SemstabError, summarize_error
from semstab.predict.folder import PredictionFolder


def write(form, folder: Path) -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    return write_labelled(form, folder)[0]


@pytest.fixture(params=FORMATS)
def written(request, tmp_path):
    """(format, folder, names) of a whole scene."""
    return FORMATS[request.param], tmp_path, write(FORMATS[request.param], tmp_path)


def text_files(folder: Path) -> list[Path]:
    """What a reader parses beside images: text, JSON, COLMAP's binary files."""
    suffixes = (".txt", ".json", ".bin", ".nvm", ".out")
    return sorted(path for path in folder.rglob("*") if path.suffix in suffixes and "depth_maps" not in path.parts)


def promised(action) -> None:
    """It works, or says in one line what is wrong."""
    message = ""
    try:
        action()
    except SemstabError as error:
        message = str(error)
    assert "\n" not in message
    assert len(message) < 1000


def read_all(form, folder) -> None:
    scene = opened(form, folder, intrinsics_size=None)
    for index in select_frames(scene, FrameSelection()).indices:
        scene.frame(index, "net")


# --- images


# --- text


def test_a_text_file_cut_in_the_middle_is_named(written):
    form, folder, _ = written
    for path in text_files(folder):
        whole = path.read_bytes()
        for length in (0, len(whole) // 3, len(whole) // 2):
            path.write_bytes(whole[:length])
            promised(lambda: read_all(form, folder))
        path.write_bytes(b"")
        with pytest.raises(DataError, match=path.name):
            read_all(form, folder)
        path.write_bytes(whole)
    read_all(form, folder)


WORDS = [
    b"nan", b"-inf", b"1e999", b"\n", b"\n\n", b" ", b"\0", b"#", b",", b"-", b"\xff\xfe", b"../../", b"\xe2\x80\xa8",
    b"9" * 400, b"{}", b"[]", b'"', b"null", b"true", b"1_0", b"0x10", b"/etc/passwd", b"\r", b"\x85", b"1e-320",
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "file", "match"),
    [
        ("hololens", "poses.txt", r"poses\.txt: has 3 poses, but there are 4 images; they must be as many"),
        ("replica, NICE-SLAM", "traj.txt", r"traj\.txt: has 3 poses, but there are 4 depth images"),
        ("replica, Semantic-NeRF", "traj_w_c.txt", r"traj_w_c\.txt: has 3 poses, but there are 4 depth images"),
        ("tartanair", "pose_left.txt", r"pose_left\.txt: has 3 poses, but there are 4 depth maps"),
    ],
)
def test_counts_that_do_not_match_are_named(tmp_path, name, file, match):
    write(FORMATS[name], tmp_path)
    write_lines(tmp_path / file, (tmp_path / file).read_text().splitlines()[1:])
    fails(DataError, match, opened, FORMATS[name], tmp_path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("classes: [a, b]\nx: !!python/object/apply:os.system ['touch hacked']\n", "not valid YAML"),
        ("!!python/name:os.system {}", "not valid YAML"),
        ("a: &a [1]\nclasses: {<<: *a}\n", "not valid YAML|needs a list"),
        ("classes: " + "[" * 1000, "not valid YAML"),
    ],
)
def test_a_taxonomy_with_tags_makes_no_objects(tmp_path, monkeypatch, text, match):
    monkeypatch.chdir(tmp_path)
    write(FORMATS["hololens"], tmp_path)
    (tmp_path / "t.yaml").write_text(text)
    scene = opened(FORMATS["hololens"], tmp_path, classes=None, taxonomy=str(tmp_path / "t.yaml"))
    fails(SemstabError, rf"t\.yaml: .*({match})", scene.frame, 0, "net")
    assert not (tmp_path / "hacked").exists()


def test_a_cam_params_that_is_none_is_named(tmp_path):
    form = FORMATS["replica, NICE-SLAM"]
    write(form, tmp_path / "room0")
    for content, match in (
        ("[]", "expected an object"),
        ("{}", "no 'camera'"),
        ('{"camera": {"fx": 1}}', "'fy' is missing"),
        ('{"camera": {"w":1,"h":0,"fx":1,"fy":1,"cx":0,"cy":0,"scale":1}}', "w, h and scale must be positive"),
        ('{"camera": {"w":8,"h":8,"fx":0,"fy":1,"cx":0,"cy":0,"scale":1}}', "focal lengths must be positive"),
        ('{"camera": {"w":8,"h":8,"fx":NaN,"fy":1,"cx":0,"cy":0,"scale":1}}', "'fx' is nan"),
    ):
        (tmp_path / "cam_params.json").write_text(content)
        fails(DataError, match, opened, form, tmp_path)


# --- parsers by themselves

TOKENS = [b"1", b"7", b"0.5", b"PINHOLE", b"a.png", b" ", b"\n", *WORDS]
TEXTS = st.one_of(st.binary(max_size=200), st.lists(st.sampled_from(TOKENS), max_size=40).map(b" ".join))


@given(content=TEXTS)
@example(content=b"1 PINHOLE 1 1 1 1 1 1")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_text_is_read_or_refused_in_one_line(tmp_path, content):
    for name in ("cameras.txt", "images.txt", "table.txt", "transforms.json", "t.tsv"):
        (tmp_path / name).write_bytes(content)
    promised(lambda: read_model(tmp_path))
    promised(lambda: read_table(tmp_path / "table.txt", 3, "x y z"))
    promised(lambda: list(records(tmp_path / "table.txt")))
    promised(lambda: read_transforms(tmp_path / "transforms.json", tmp_path, tmp_path))
    promised(lambda: read_class_table(tmp_path / "t.tsv", "nyu40id"))


# --- as a run


# --- files that are none, aliases without end, names that lead out


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


def test_a_file_that_refers_to_itself_is_refused(tmp_path):
    folder = write_scene(tmp_path / "scene")
    (folder / "labels/net/label_space.yaml").write_text("classes: &c [*c, *c]\n")
    fails(ConfigError, r"label_space\.yaml: ", opened_folder(folder).label_space, "net")


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
    assert len(summarize_error(ValueError("v" * 9999))) < 250


def test_predictions_stay_in_their_folder(tmp_path):
    folder = PredictionFolder(tmp_path / "scene/labels/net", "labels", {}, {}, None)
    for name in ("../../../evil", "/tmp/evil"):
        fails(DataError, "leaves", folder.file, name)
    assert folder.file("cam 0/0001") == tmp_path / "scene/labels/net/cam 0/0001.png"
