"""Things that move are left out of fusion: by class, by mask, counted, and everything else stays."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest
import tiny_scene
from hypothesis import given
from hypothesis import strategies as st
from posed_config import configure

import semstab
from semstab import Frame, Intrinsics, LabelSpace
from semstab.configure import load_config
from semstab.data.measures import dominant
from semstab.engine.units import make_plan
from semstab.errors import ConfigError, DataError
from semstab.pixels.preparation import leave_out
from semstab.statistics import describe
from semstab.task import read

CAMERA = Intrinsics(4, 4, 2, 2)


def frame_of(labels=None, **fields) -> Frame:
    shape = np.shape(labels) if labels is not None else np.shape(fields["scores"])[:2]
    depth = fields.pop("depth", np.ones(shape, dtype=np.float32))
    return Frame(index=0, depth=depth, intrinsics=CAMERA, T_wc=np.eye(4), labels=labels, **fields)


@pytest.fixture
def root(tmp_path):
    return tiny_scene.write(tmp_path / "wall", models=("a",))


def write_masks(root, mask) -> None:
    (root / "mask").mkdir()
    for path in sorted((root / "depth").iterdir()):
        cv2.imwrite(str(root / "mask" / path.name), mask)


def test_a_class_is_left_out_and_counted_where_it_was_valid() -> None:
    labels = np.array([[0, 1, 1, 255]], dtype=np.uint8)
    depth = np.array([[1, 1, 0, 1]], dtype=np.float32)
    still = leave_out(frame_of(labels, depth=depth), [1])
    assert still.labels.tolist() == [[0, 255, 255, 255]]
    assert still.left_out.tolist() == [[False, True, False, False]]
    assert still.left_out_pixels == 1


def test_soft_scores_are_left_out_by_their_largest_class() -> None:
    scores = np.array([[[0.6, 0.4], [0.4, 0.6], [0.0, 0.0]]], dtype=np.float32)
    still = leave_out(frame_of(scores=scores), [1])
    assert still.valid.tolist() == [[True, False, False]]
    assert still.left_out.tolist() == [[False, True, False]]


def test_a_mask_is_applied_unless_it_is_not_wanted() -> None:
    frame = frame_of(np.zeros((1, 3), dtype=np.uint8), mask=np.array([[True, False, True]]))
    assert leave_out(frame).valid.tolist() == [[False, True, False]]
    assert leave_out(frame, masks=False) is frame


@given(st.integers(0, 2**32 - 1), st.sets(st.integers(0, 4)))
def test_valid_pixels_are_either_left_out_or_kept(seed, classes) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.choice([0, 1, 2, 3, 255], (5, 7)).astype(np.uint8)
    frame = frame_of(labels, depth=rng.choice([0, 1], (5, 7)).astype(np.float32), mask=rng.random((5, 7)) < 0.3)
    still = leave_out(frame, sorted(classes))
    np.testing.assert_array_equal(frame.valid, still.valid ^ still.left_out)
    np.testing.assert_array_equal(still.labels[still.valid], labels[still.valid])
    strided = still.every(2)
    np.testing.assert_array_equal(strided.left_out, still.left_out[::2, ::2])


def test_a_mask_of_another_size_or_type_is_refused() -> None:
    with pytest.raises(DataError, match="mask"):
        frame_of(np.zeros((2, 3), dtype=np.uint8), mask=np.zeros((3, 3), dtype=np.bool_))
    with pytest.raises(DataError, match="use bool"):
        frame_of(np.zeros((2, 3), dtype=np.uint8), mask=np.zeros((2, 3), dtype=np.uint8))


def test_a_run_leaves_out_a_class_and_says_how_many_pixels(root, tmp_path) -> None:
    everything = semstab.run(configure(root), report=False).runs[0]
    out = tmp_path / "run"
    still = semstab.run(configure(root, exclude={"predicted_classes": ["Door"]}), out=out, report=False).runs[0]
    assert still.left_out > 0
    assert still.map_summary.points + still.left_out == everything.map_summary.points
    classes = {group.name: group.voxels for group in still.map_summary.classes}
    assert classes["door"] == 0
    (path,) = (out / "frames").iterdir()
    assert sum(int(row["left_out"]) for row in csv.DictReader(path.read_text().splitlines())) == still.left_out
    assert json.loads((out / "summary.json").read_text())["runs"][0]["left_out"] == still.left_out


@pytest.mark.parametrize("tile_size", [None, 16])
def test_locations_of_a_class_are_left_out_and_errors_elsewhere_stay(root, tmp_path, tile_size) -> None:
    """Frames that miss the door elsewhere, or see one where there is none, count as before."""

    def map_of(name, **settings):
        config = configure(root, statistics=True, tile_size=tile_size, **settings)
        return semstab.run(config, out=tmp_path / name, report=False).runs[0]

    whole, some = map_of("whole"), map_of("some", exclude={"classes": ["door"]})
    tables = [semstab.load(tmp_path / name).table() for name in ("whole", "some")]
    keep = dominant(tables[0]) != tables[0].classes.index("door")
    assert 0 < keep.sum() < len(keep)
    np.testing.assert_array_equal(tables[1].index, tables[0].index[keep])
    np.testing.assert_array_equal(tables[1].evidence[:], tables[0].evidence[:][keep])
    assert some.left_out == whole.left_out == 0
    assert (tables[1].evidence[:][:, tables[1].classes.index("door")] > 0).any()
    expected = describe(tables[0].rows(keep)).agreement.psa_op2.value
    assert some.statistics.agreement.psa_op2.value == pytest.approx(expected)
    assert some.statistics.spots.spots < whole.statistics.spots.spots


def test_the_masks_of_a_posed_folder(root) -> None:
    before = make_plan(configure(root)).tasks[0].digest
    mask = np.full((tiny_scene.HEIGHT, tiny_scene.WIDTH), 255, dtype=np.uint8)
    mask[:2] = 0
    write_masks(root, mask)
    task = make_plan(configure(root)).tasks[0]
    assert read(task, 0).valid.sum() == (mask > 0).sum()
    assert read(task, 0, pixel_stride=2).left_out_pixels == (mask[::2, ::2] == 0).sum()
    assert task.digest != before
    unmasked = make_plan(configure(root, exclude={"masks": False})).tasks[0]
    assert read(unmasked, 0).valid.all()


def test_a_name_of_the_run_s_own_taxonomy_leaves_out_all_that_becomes_it(tmp_path) -> None:
    source = LabelSpace(name="s", classes=("static car", "moving car", "road"))
    target = LabelSpace(name="t", classes=("car", "road"), members=(("static car", "moving car"), ()), ids=(0, 1))
    mapping = source.mapping_to(target)
    assert mapping.positions_of(["car"]) == (0, 1)
    assert mapping.positions_of(["Moving_Car"]) == (1,)
    assert mapping.positions_of(["tree"]) == ()


def test_an_unknown_class_is_refused_with_the_nearest(root) -> None:
    with pytest.raises(ConfigError, match=r"wall: exclude.classes: no class 'dor'; did you mean 'door'\?"):
        make_plan(configure(root, exclude={"classes": ["dor"]}))


def test_a_colour_picture_is_no_mask(root) -> None:
    write_masks(root, np.zeros((tiny_scene.HEIGHT, tiny_scene.WIDTH, 3), dtype=np.uint8))
    with pytest.raises(DataError, match="is no mask; save it as grey"):
        read(make_plan(configure(root)).tasks[0], 0)


def test_the_masks_of_a_dataset_of_files(tmp_path) -> None:
    """Half as large as the depth, and only of one frame."""
    for folder in ("images", "depth", "labels/a", "masks"):
        (tmp_path / folder).mkdir(parents=True)
    np.savetxt(tmp_path / "K.txt", CAMERA.matrix)
    np.savetxt(tmp_path / "poses.txt", np.tile(np.eye(4).ravel(), (2, 1)))
    for name in ("0", "1"):
        cv2.imwrite(str(tmp_path / f"depth/{name}.png"), np.full((4, 6), 1000, dtype=np.uint16))
        cv2.imwrite(str(tmp_path / f"images/{name}.png"), np.zeros((4, 6, 3), dtype=np.uint8))
        cv2.imwrite(str(tmp_path / f"labels/a/{name}.png"), np.zeros((4, 6), dtype=np.uint8))
    mask = np.array([[0, 255, 255], [255, 255, 255]], dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "masks/0.png"), mask)
    options = {"root": str(tmp_path), "classes": ["x", "y"], "masks": "masks/{name}.png"}
    task = make_plan(load_config(overrides={"dataset": {"name": "hololens", "options": options}})).tasks[0]
    masked = np.zeros((4, 6), dtype=np.bool_)
    masked[:2, :2] = True
    np.testing.assert_array_equal(read(task, 0).left_out, masked)
    assert read(task, 1).left_out is None
