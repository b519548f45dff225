"""Fused labels back in the frames: what each pixel gets, what is ignored, and what is said of it."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil

import cv2
import numpy as np
import pytest
import tiny_scene
from command_line import bench, error_of
from dataset_writers import write_labels, write_scannet
from posed_config import configure, dataset_of
from posed_scene import fails

import semstab
from semstab import Belief, Frame, Intrinsics, LabelSpace, relabel
from semstab.core.files import SEAL, write_sealed
from semstab.data.tiles import Tiles
from semstab.errors import ConfigError, DataError
from semstab.exports.fused_labels import UNSEEN, UNSTABLE, FusedLabels
from semstab.metrics import CATEGORIES, categories
from semstab.statistics import psa

R, K = 0.25, 3


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    """A scene with some depth missing, and a run of it."""
    folder = tmp_path_factory.mktemp("relabel")
    tiny_scene.write(folder / "scene", models=("a",), frames=4, noise=0.3)
    file = folder / "scene/depth/0001.png"
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    depth[0] = 0
    cv2.imwrite(str(file), depth)
    semstab.run(configure(folder / "scene", check=None), out=folder / "run", report=False)
    return folder


def maps(folder):
    return np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted(folder.glob("*.png"))])


def voxels_of(folder):
    """The voxel of each pixel of each frame: the wall is parallel to the image."""
    v, u = np.mgrid[: tiny_scene.HEIGHT, : tiny_scene.WIDTH]
    x = (u - tiny_scene.WIDTH / 2) / tiny_scene.FOCAL * 2 + 0.01
    y = (v - tiny_scene.HEIGHT / 2) / tiny_scene.FOCAL * 2 + 0.01
    return np.stack([np.floor(x / R + i) + 100 * np.floor(y / R) for i in range(4)]).astype(int)


@pytest.mark.parametrize("leave_one_out", [False, True])
def test_each_pixel_gets_what_the_frames_said_of_its_voxel(fused, leave_one_out):
    given, voxel = maps(fused / "scene/labels/a"), voxels_of(fused)
    visible = np.ones(given.shape, bool)
    visible[1, 0] = False
    expected = np.full(given.shape, 255, np.uint8)
    for t, v, u in np.argwhere(visible):
        votes = np.zeros(K)
        for other in range(4):
            said = given[other][visible[other] & (voxel[other] == voxel[t, v, u])]
            if len(said) and not (leave_one_out and other == t):
                votes += np.bincount(said, minlength=K) / len(said)
        if votes.any():
            expected[t, v, u] = votes.argmax()
    name = f"oracle-{leave_one_out}"
    report = relabel(fused / "run", fused / "out", name=name, belief=Belief(leave_one_out=leave_one_out))
    found = maps(fused / "out/labels" / name)
    np.testing.assert_array_equal(found, expected)
    truth, has = maps(fused / "scene/labels/gt"), found != 255
    assert report.pixels == given.size
    assert report.confirmed == np.count_nonzero(has & (found == given))
    assert report.changed == np.count_nonzero(has & (found != given)) > 0
    assert report.unseen == tiny_scene.WIDTH
    assert report.unstable == np.count_nonzero(visible & ~has)
    assert (report.unstable > 0) == leave_one_out
    assert report.correctness.after.accuracy == np.mean(found[has] == truth[has])
    assert report.correctness.before.accuracy == np.mean(given[has] == truth[has])
    assert report.correctness.all_before.accuracy == np.mean(given == truth)
    assert report.correctness.after.accuracy > report.correctness.before.accuracy  # the noise is independent
    assert json.loads((fused / "out/labels" / name / "relabelled.json").read_text())["changed"] == report.changed


@pytest.mark.parametrize("soft", [False, True])
def test_without_its_own_vote_a_frame_sees_the_map_of_the_others(soft):
    rng = np.random.default_rng(3)
    camera, frames = Intrinsics(8.0, 8.0, 4.0, 3.0), []
    for i in range(4):
        T = np.eye(4)
        T[:3, 3] = rng.uniform(-0.2, 0.2, 3)
        depth = rng.uniform(1.0, 1.3, (6, 8)).astype(np.float32)
        said = (
            {"scores": rng.dirichlet(np.ones(K), (6, 8))} if soft else {"labels": rng.integers(0, K, (6, 8), np.uint8)}
        )
        frames.append(Frame(i, depth, camera, T, **said))
    whole = table_of(frames)
    for i, frame in enumerate(frames):
        rest = table_of([*frames[:i], *frames[i + 1 :]])
        rest = dataclasses.replace(rest, evidence=np.round(rest.evidence, 9))  # ties are no matter of rounding
        others = labels(rest, Belief(min_op=2, min_psa=0.3)).labels_of(frame)
        without = labels(whole, Belief(min_op=2, min_psa=0.3, leave_one_out=True)).labels_of(frame)
        np.testing.assert_array_equal(np.maximum(without, UNSEEN), np.maximum(others, UNSEEN))
        assert len(np.unique(without)) > 2


def labels(table, belief):
    return FusedLabels(Tiles.from_table(table), belief, table.K)


def table_of(frames):
    backend = semstab.backends.create("numpy", voxel_size=R, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def test_pixels_of_voxels_that_are_not_believed_are_ignored(fused):
    table = semstab.load_result(fused / "run").record().table()
    frame = dataclasses.replace(tiny_scene.frame(2, np.zeros((6, 8), np.uint8)), labels=np.full((6, 8), 255, np.uint8))
    free = labels(table, Belief()).labels_of(frame)
    assert (free >= 0).all()  # whatever the frame's own labels
    kinds = {CATEGORIES[k] for k in np.unique(categories(table))}
    assert {"low persistence", "stable"} <= kinds
    for belief, believed in (
        (Belief(min_op=3), table.op >= 3),
        (Belief(min_psa=0.9), np.nan_to_num(psa(table)) >= 0.9),
        (Belief(categories=("stable", "uncertain")), categories(table) >= 2),
    ):
        found = labels(table, belief).labels_of(frame)
        assert (found[found >= 0] == free[found >= 0]).all()
        rows = labels(dataclasses.replace(table, evidence=np.eye(len(table)), classes=()), Belief()).labels_of(frame)
        np.testing.assert_array_equal(found == UNSTABLE, ~believed[rows])
        assert set(np.unique(found == UNSTABLE)) == {False, True}


def test_a_run_reads_what_was_relabelled(fused, tmp_path):
    done = bench("relabel", fused / "run", "--out", tmp_path, "--category", "stable", cwd=tmp_path)
    assert "a-fused: 4 frames" in done.stdout
    assert "accuracy ." in done.stdout
    assert "do not assess the stability of these maps" in done.stdout
    assert LabelSpace.load(tmp_path / "labels/a-fused/label_space.yaml").classes == ("wall", "door", "window")
    found = dataset_of(fused / "scene", labels_root=tmp_path, labels="labels/{model}/{name}")
    again = semstab.run(configure(fused / "scene", dataset=found, check=None))
    assert again.models == ("a-fused",)
    assert again.record().map_summary.means.value["vss"] == 1.0
    other = "holds predictions with other settings .min_op: 1 there, 2 here."
    fails(ConfigError, other, relabel, fused / "run", tmp_path, belief=Belief(min_op=2))
    changed = ("relabel", fused / "run", "--out", tmp_path, "--min-op", 2)
    assert re.search(other, error_of(*changed, cwd=tmp_path))
    assert "a-fused: 4 frames" in bench(*changed, "--overwrite", cwd=tmp_path).stdout


def test_what_cannot_be_relabelled_is_refused(fused, tmp_path):
    fails(ConfigError, "no category 'stabel'; did you mean 'stable'", Belief, categories=("stabel",))
    fails(ConfigError, "min_psa = 2", Belief, min_psa=2)
    taken = tmp_path / "labels/a-fused"
    taken.mkdir(parents=True)
    (taken / "0000.png").write_bytes(b"mine")
    fails(ConfigError, "holds maps that were not predicted here", relabel, fused / "run", tmp_path)
    shutil.copytree(fused / "run", tmp_path / "run")
    manifest = tmp_path / "run/manifest.json"
    edited = manifest.read_text().replace('"scene/a": "', '"scene/a": "other')
    manifest.write_text(edited)
    fails(DataError, "has changed since the run wrote it", relabel, tmp_path / "run", tmp_path / "out")
    write_sealed(manifest, {key: value for key, value in json.loads(edited).items() if key != SEAL})
    fails(DataError, "has changed since it was fused; run it again", relabel, tmp_path / "run", tmp_path / "out")
    # ScanNet's colour camera sees more than its depth camera, and label maps are the colour image's
    labels, color = np.arange(48, dtype=np.uint8).reshape(6, 8) % 3, np.zeros((6, 8, 3), np.uint8)
    frames = [dataclasses.replace(tiny_scene.frame(i, labels), color=color) for i in range(2)]
    names = write_scannet(tmp_path / "scene", frames)
    write_labels(tmp_path / "scene", names, frames)
    (tmp_path / "scene/intrinsic/intrinsic_color.txt").write_text("5 0 4 0\n0 5 3 0\n0 0 1 0\n0 0 0 1\n")
    options = {"root": str(tmp_path), "color_size": [8, 6], "classes": ["a", "b", "c"]}
    config = configure(tmp_path, dataset={"name": "scannet", "options": options}, check=None, check_geometry=False)
    semstab.run(config, out=tmp_path / "run", report=False, overwrite=True)
    fails(
        DataError, "have the pixels of the image, not those of the depth; convert", relabel, tmp_path / "run", tmp_path
    )
