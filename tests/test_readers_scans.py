"""Readers of scans: every format gives the points, poses and classes it was written from, or one line that says why."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import scan_writers as sw
import yaml
from dataset_writers import numbers, write_lines
from posed_scene import fails
from scan_writers import SCANS

from semstab import Frame
from semstab.backends import create
from semstab.check import check_scene
from semstab.configure import load_config, resolve
from semstab.datasets import open_dataset, recognise
from semstab.datasets.semantickitti import LEARNING_MAP, MOVING
from semstab.errors import ConfigError, DataError


@pytest.fixture(params=SCANS)
def form(request):
    return SCANS[request.param]


@pytest.fixture
def folder(form, tmp_path):
    """The root of a dataset with one scene."""
    sw.write_predicted(form, tmp_path / "data")
    return tmp_path / "data"


def names_of_labels(scene, frame, model):
    """The class of each point in words, None where it has none."""
    space = scene.label_space(model)
    names = dict(zip(space.ids, space.classes, strict=True))
    return [names.get(int(label)) for label in frame.labels[0]]


def same_pose_up_to_the_world(found, expected):
    """Poses agree but for one transform of the whole world."""
    move = found[0] @ np.linalg.inv(expected[0])
    np.testing.assert_allclose(found, [move @ T for T in expected], rtol=0, atol=1e-6)


# --- all formats


def test_points_land_where_the_written_pose_says(form, folder):
    scene = sw.opened(form, folder)
    frames = [scene.frame(k, "net") for k in range(len(scene))]
    assert (len(scene), scene.models, scene.of_scans) == (sw.COUNT, ("net",), True)
    for frame, scan in zip(frames, sw.scans(), strict=True):
        np.testing.assert_allclose(frame.points[0], scan.points, rtol=0, atol=1e-3)
    same_pose_up_to_the_world([f.T_wc for f in frames], [s.T for s in sw.scans()])
    walls = np.concatenate([s.points @ s.T[:3, :3].T + s.T[:3, 3] for s in sw.scans()])
    move = frames[0].T_wc @ np.linalg.inv(sw.scans()[0].T)
    found = np.concatenate([f.points[0] @ f.T_wc[:3, :3].T + f.T_wc[:3, 3] for f in frames])
    np.testing.assert_allclose(found, walls @ move[:3, :3].T + move[:3, 3], rtol=0, atol=2e-3)


def test_labels_are_the_classes_that_were_predicted(form, folder):
    scene = sw.opened(form, folder)
    for k, scan in enumerate(sw.scans()):
        found = names_of_labels(scene, scene.frame(k, "net"), "net")
        assert found == [form.classes[wall] for wall in sw.predicted(scan)]


def test_the_truth_is_read_where_the_format_has_one(form, folder):
    scene = sw.opened(form, folder)
    assert scene.ground_truth == form.truth
    if form.truth:
        found = names_of_labels(scene, scene.frame(1, "gt"), "gt")
        assert found == [form.classes[wall] for wall in sw.scans()[1].walls]
    else:
        fails(ConfigError, "model 'gt' is not there", scene.frame, 1, "gt")


def test_points_that_move_by_the_truth_are_masked(form, folder):
    frame = sw.opened(form, folder).frame(1, "net")
    if form.moves is None:
        assert frame.mask is None
    else:
        np.testing.assert_array_equal(frame.mask[0], sw.scans()[1].walls == form.moves)


def test_the_range_limits_what_is_valid_and_keeps_the_points(form, folder):
    scene = sw.opened(form, folder, min_range=2.0, max_range=4.0)
    frame, all_ = scene.frame(0, "net"), sw.opened(form, folder).frame(0, "net")
    distance = np.linalg.norm(sw.scans()[0].points, axis=1)
    inside = (distance > 2) & (distance < 4)
    assert 20 < inside.sum() < sw.POINTS - 20
    np.testing.assert_array_equal(frame.depth[0] > 0, inside)
    assert (all_.depth > 0).all()
    assert frame.shape == all_.shape == (1, sw.POINTS)


def test_it_is_recognised_as_itself(form, folder):
    assert recognise(folder)[0] == form.dataset
    assert recognise(folder.parent)[0] == form.dataset


def test_it_is_fused_by_its_poses(form, folder):
    """The walls are planes: with right poses they fill as many voxels as the room's surface has."""
    scene = sw.opened(form, folder)
    backend = create("numpy", voxel_size=0.5, num_classes=256)
    for k in range(len(scene)):
        frame = scene.geometry(k)
        backend.integrate(dataclasses.replace(frame, T_wc=np.linalg.inv(shift(scene)) @ frame.T_wc))
    expected = create("numpy", voxel_size=0.5, num_classes=256)
    for k, scan in enumerate(sw.scans()):
        labels = np.zeros(len(scan.points), np.uint8)
        expected.integrate(Frame(k, points=scan.points, labels=labels, T_wc=scan.T))
    assert len(expected.table()) > 300
    assert abs(len(backend.table()) - len(expected.table())) < 60  # points on the planes between voxels may fall anew


def shift(scene):
    """The transform from the world of the written poses to that of the scene."""
    return scene.T_wc(0) @ np.linalg.inv(sw.scans()[0].T)


def test_the_digest_changes_with_points_labels_and_options(form, folder):
    def digest(**options):
        return sw.opened(form, folder, **options).digest([0, 1], "net")

    first, name = digest(), sw.opened(form, folder).frame_name(1)
    assert digest() == first != digest(max_range=30.0)
    found = {first}
    templates = [template for template in (form.points, form.predicted) if template]
    for template in templates:
        path = folder / template.format(name)
        path.write_bytes(path.read_bytes()[:-1] + b"\x01")
        found.add(digest())
    assert len(found) == 1 + len(templates)


def test_labels_of_another_scan_are_refused_with_the_file(form, folder):
    scene = sw.opened(form, folder)
    form.predict(folder, scene.frame_name(2), sw.predicted(sw.scans()[2])[:-3])
    fails(DataError, f"{sw.POINTS - 3} labels but {sw.POINTS} points; give one for each point", scene.frame, 2, "net")
    scene.frame(1, "net")


def test_a_file_that_is_missing_is_named(form, folder):
    name = sw.opened(form, folder).frame_name(2)
    (folder / form.predicted.format(name)).unlink()
    scene = sw.opened(form, folder)
    (lost,) = scene.missing(2, ["net"])
    assert name in lost
    assert lost.startswith(str(folder))
    fails(DataError, "choose scans that have it, or add it", scene.frame, 2, "net")
    assert scene.missing(1, ["net"]) == []


@pytest.mark.parametrize("form", [form for form in SCANS.values() if form.points], ids=lambda form: form.points)
def test_a_damaged_file_of_points_is_named(form, folder):
    path = folder / form.points.format(sw.opened(form, folder).frame_name(1))
    path.write_bytes(path.read_bytes()[:-2])
    fails(DataError, path.name, sw.opened(form, folder).frame, 1, "net")
    path.write_bytes(b"")
    said = f"{path.name}: (the file is empty|.*it is no LAS file)"
    fails(DataError, said, sw.opened(form, folder).frame, 1, "net")


def test_there_is_no_such_scan_nor_model(form, folder):
    scene = sw.opened(form, folder)
    fails(ConfigError, f"there is no scan {sw.COUNT}; it has {sw.COUNT}, counted from 0", scene.frame, sw.COUNT, "net")
    fails(ConfigError, "model 'nett' is not there; did you mean 'net'", scene.frame, 0, "nett")


@pytest.mark.parametrize("form", [SCANS["semantickitti"], SCANS["nuscenes"]], ids=["semantickitti", "nuscenes"])
def test_check_finds_that_the_scans_lie_on_each_other(form, folder):
    dense(form, folder)
    options = form.options | {"root": str(folder)}
    content = {"dataset": {"name": form.dataset, "options": options}, "models": ["net"], "voxel_size": 0.5}
    checked = check_scene(sw.opened(form, folder), resolve(load_config(None, content | {"taxonomy": None})))
    assert checked.verdict.state == "sound"


def dense(form, folder):
    """Scans with as many points as the check needs, over the ones that are there."""
    many = [sw.room(k, 6000) for k in range(sw.COUNT)]
    for name, scan in zip(form.write(folder, many), many, strict=True):
        form.predict(folder, name, scan.walls)


# --- SemanticKITTI


@pytest.fixture
def kitti(tmp_path):
    sw.write_predicted(SCANS["semantickitti"], tmp_path / "sequences/00")
    return tmp_path / "sequences/00"


def read(folder, **options):
    return sw.opened(SCANS["semantickitti"], folder, **options)


def test_kitti_poses_are_of_the_lidar_in_the_first_lidars_world(kitti):
    scene = read(kitti)
    np.testing.assert_allclose([scene.T_wc(k) for k in range(4)], [s.T for s in sw.scans()], rtol=0, atol=1e-9)
    np.testing.assert_allclose(scene.timestamps, [0, 0.1, 0.2, 0.3])
    assert (scene.name, scene.up.tolist()) == ("00", [0, 0, 1])
    assert open_dataset("semantickitti", {"root": kitti.parents[1]}).scenes == ("00",)


@pytest.mark.parametrize("kind", ["<u2", "<i8"])
def test_labels_of_another_width_are_told_by_the_number_of_points(kitti, kind):
    expected = read(kitti).frame(1, "net").labels
    for path in (kitti / "predictions/net").iterdir():
        path.write_bytes((np.fromfile(path, "<u4") & 0xFFFF).astype(kind).tobytes())
    np.testing.assert_array_equal(read(kitti).frame(1, "net").labels, expected)


def test_ids_of_training_are_named(kitti):
    for path in (kitti / "predictions/net").iterdir():
        ids = np.arange(len(np.fromfile(path, "<u4")), dtype="<u4") % 20
        path.write_bytes(ids.tobytes())
    said = (
        "is no class of the format; are ids 0 to 19 those that a network is trained with[?] write them back by learning"
    )
    fails(DataError, said, read(kitti).frame, 0, "net")


def test_kitti_poses_may_be_of_the_lidar_or_inverse(kitti):
    write_lines(kitti / "poses.txt", [numbers(np.linalg.inv(scan.T)[:3]) for scan in sw.scans()])
    (kitti / "calib.txt").unlink()
    scene = read(kitti, pose_frame="lidar", pose_convention="world_to_camera")
    np.testing.assert_allclose([scene.T_wc(k) for k in range(4)], [s.T for s in sw.scans()], rtol=0, atol=1e-9)
    fails(DataError, "calib.txt: is missing; it holds Tr.*pose_frame=lidar", read, kitti)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("P0: 1 2 3", "calib.txt: has no line Tr"),
        ("Tr: 1 2 3", "calib.txt: has no line Tr of 12 numbers"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 one 0", "calib.txt: line 1: 'one' is not a number"),
        ("Tr: 0 0 0 0 0 0 0 0 0 0 0 0", "calib.txt: the rotation is not orthonormal"),
        ("Tr: 1 0 0 0 0 1 0 0 0 0 1 nan", "calib.txt: the matrix holds a number that is not finite"),
    ],
)
def test_kitti_calibration_that_is_none_is_refused(kitti, line, said):
    (kitti / "calib.txt").write_text(line + "\n")
    fails(DataError, said, read, kitti)


def test_kitti_poses_that_are_fewer_or_damaged_are_refused(kitti):
    lines = (kitti / "poses.txt").read_text().splitlines()
    write_lines(kitti / "poses.txt", lines[:3])
    fails(DataError, "poses.txt: has 3 poses, and scan 000003 is number 3; add its pose", read, kitti)
    write_lines(kitti / "poses.txt", [*lines[:3], "1 2 3"])
    fails(DataError, "poses.txt: line 4 has 3 values; expected 12", read, kitti)
    write_lines(kitti / "poses.txt", [*lines[:3], " ".join(["1e30"] * 12)])
    fails(DataError, r"poses.txt: pose 4: the pose holds 1e\+30", read, kitti)
    write_lines(kitti / "poses.txt", [*lines[:3], " ".join(["nan"] * 12)])
    assert [read(kitti).tracked(k) for k in range(4)] == [True, True, True, False]


def test_kitti_scans_of_a_part_of_a_sequence_have_the_poses_of_their_numbers(kitti):
    for folder, suffix in (("velodyne", "bin"), ("labels", "label"), ("predictions/net", "label")):
        (kitti / folder / f"000000.{suffix}").unlink()
    scene = read(kitti)
    assert [scene.frame_name(k) for k in range(3)] == ["000001", "000002", "000003"]
    np.testing.assert_allclose(scene.T_wc(0), sw.scans()[1].T, rtol=0, atol=1e-9)
    np.testing.assert_allclose(scene.timestamps, [0.1, 0.2, 0.3])


def test_kitti_ids_are_joined_as_the_benchmark_does_and_others_refused(kitti):
    stored = np.zeros(sw.POINTS, "<u4")
    stored[:8] = 13, 60, 254, 0, 99, 52, 1, 30
    (kitti / "predictions/net/000000.label").write_bytes(stored.tobytes())
    frame = read(kitti).frame(0, "net")
    assert frame.labels[0, :8].tolist() == [20, 40, 30, 65535, 65535, 65535, 65535, 30]
    stored[3] = 123
    (kitti / "predictions/net/000000.label").write_bytes(stored.tobytes())
    fails(DataError, "000000.label: the id 123 is no class of the format", read(kitti).frame, 0, "net")
    (kitti / "predictions/net/000000.label").write_bytes(stored.tobytes()[:-1])
    fails(DataError, f"000000.label: {4 * sw.POINTS - 1} bytes are no uint32", read(kitti).frame, 0, "net")


def test_kitti_moving_points_may_be_kept(kitti):
    assert read(kitti, moving="keep").frame(1, "net").mask is None
    short = (kitti / "labels/000001.label").read_bytes()[:-4]
    (kitti / "labels/000001.label").write_bytes(short)
    fails(
        DataError,
        f"000001.label: {sw.POINTS - 1} values of the mask but {sw.POINTS} points",
        read(kitti).frame,
        1,
        "net",
    )
    for file in (kitti / "labels").iterdir():
        file.unlink()
    scene = read(kitti)
    assert not scene.ground_truth
    assert scene.frame(1, "net").mask is None


def test_kitti_a_learning_map_of_ones_own(kitti, tmp_path):
    table = tmp_path / "map.yaml"
    ids = {int(n): k % 2 for k, n in enumerate(sw.KITTI_IDS)}
    table.write_text(yaml.safe_dump({"learning_map": ids}))
    classes = ("flat", "other")
    scene = read(kitti, learning_map=table, classes=classes)
    found = names_of_labels(scene, scene.frame(0, "net"), "net")
    assert found == [classes[wall % 2] for wall in sw.predicted(sw.scans()[0])]
    fails(ConfigError, "map.yaml: name the classes of its ids", read, kitti, learning_map=table)
    table.write_text(yaml.safe_dump({"learning_map": {10: 70000}}))
    fails(ConfigError, "learning_map: 70000 is no id", read, kitti, learning_map=table, classes=classes)
    table.write_text(yaml.safe_dump({"learning_map": {10: "car"}}))
    fails(ConfigError, "has no learning_map of ids", read, kitti, learning_map=table, classes=classes)


def test_kitti_predictions_elsewhere_and_ids_that_are_void(kitti, tmp_path):
    (tmp_path / "out/net/predictions").parent.mkdir(parents=True)
    (kitti / "predictions/net").rename(tmp_path / "out/net/predictions")
    scene = read(kitti, labels_root=tmp_path / "out", void_ids={"net": [40]})
    assert scene.models == ("net",)
    labels = scene.frame(0, "net").labels[0]
    np.testing.assert_array_equal(labels == 65535, sw.predicted(sw.scans()[0]) == 0)
    fails(ConfigError, r"put its files into .*predictions/MODEL/000000\.label", read(kitti).frame, 0, "net")


def test_kitti_is_missing_what_makes_a_scene(kitti):
    (kitti / "poses.txt").unlink()
    fails(DataError, r"no scene here.*velodyne/ and poses\.txt", read, kitti)
    fails(DataError, r"the nearest is semantickitti \(without poses\.txt\)", recognise, kitti)
    (kitti / "poses.txt").write_text(numbers(np.eye(4)[:3]))
    for file in (kitti / "velodyne").iterdir():
        file.unlink()
    fails(DataError, "holds no scan; expected velodyne/ and poses.txt", read, kitti)


# --- nuScenes


@pytest.fixture
def nuscenes(tmp_path):
    sw.write_predicted(SCANS["nuscenes"], tmp_path / "nuscenes")
    return tmp_path / "nuscenes"


def read_nuscenes(folder, **options):
    return sw.opened(SCANS["nuscenes"], folder, **options)


def change_table(folder, table, change):
    path = folder / f"v1.0-mini/{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))


def test_nuscenes_poses_are_of_the_lidar_in_the_world(nuscenes):
    scene = read_nuscenes(nuscenes)
    np.testing.assert_allclose([scene.T_wc(k) for k in range(4)], [s.T for s in sw.scans()], rtol=0, atol=1e-9)
    np.testing.assert_allclose(scene.timestamps - scene.timestamps[0], [0, 0.5, 1, 1.5])
    assert (scene.name, scene.up.tolist(), len(scene.frame_name(0))) == ("scene-0061", [0, 0, 1], 32)


def test_nuscenes_truth_has_ids_of_categories_and_predictions_those_of_the_challenge(nuscenes):
    name = read_nuscenes(nuscenes).frame_name(0)
    labels = nuscenes / f"predictions/net/{name}_lidarseg.bin"
    labels.write_bytes(bytes([5, 255, 0, 16] * (sw.POINTS // 4)))
    assert read_nuscenes(nuscenes).frame(0, "net").labels[0, :4].tolist() == [5, 65535, 65535, 16]
    labels.write_bytes(bytes([17]) * sw.POINTS)
    fails(DataError, r"_lidarseg.bin: the id 17 is no class of the format", read_nuscenes(nuscenes).frame, 0, "net")
    change_table(nuscenes, "category", lambda rows: rows[1].update(name="static.vegetation"))
    scene = read_nuscenes(nuscenes)
    found = names_of_labels(scene, scene.frame(0, "gt"), "gt")
    assert [found[k] for k in np.flatnonzero(sw.scans()[0].walls == 0)[:3]] == ["vegetation"] * 3
    change_table(nuscenes, "category", lambda rows: rows.pop(2))
    fails(DataError, "the id 2 is no class of the format", read_nuscenes(nuscenes).frame, 0, "gt")
    change_table(nuscenes, "category", lambda rows: rows[1].pop("index"))
    fails(DataError, "static.vegetation: 'index' is missing", read_nuscenes(nuscenes).frame, 0, "gt")


def test_nuscenes_results_as_they_are_handed_in(nuscenes, tmp_path):
    (tmp_path / "results/net/lidarseg").mkdir(parents=True)
    (nuscenes / "predictions/net").rename(tmp_path / "results/net/lidarseg/val")
    options = {"labels_root": tmp_path / "results", "labels": "{model}/lidarseg/val/{name}_lidarseg.bin"}
    scene = read_nuscenes(nuscenes, **options)
    found = names_of_labels(scene, scene.frame(3, "net"), "net")
    assert found == [SCANS["nuscenes"].classes[wall] for wall in sw.predicted(sw.scans()[3])]


def test_nuscenes_has_a_scene_for_each_of_its_own(nuscenes):
    change_table(nuscenes, "scene", lambda rows: rows.append({"token": "t", "name": "scene-0007"}))
    change_table(nuscenes, "sample", lambda rows: rows[3].update(scene_token="t"))
    dataset = open_dataset("nuscenes", {"root": nuscenes})
    assert dataset.scenes == ("scene-0007", "scene-0061")
    assert [len(dataset.scene(name)) for name in dataset.scenes] == [1, 3]
    np.testing.assert_allclose(dataset.scene("scene-0007").T_wc(0), sw.scans()[3].T, rtol=0, atol=1e-9)
    change_table(nuscenes, "sample", lambda rows: rows[3].update(scene_token="s"))
    fails(DataError, "holds no scan", open_dataset("nuscenes", {"root": nuscenes}).scene, "scene-0007")
    assert open_dataset("nuscenes", {"root": nuscenes.parent}).scenes == ("nuscenes-scene-0007", "nuscenes-scene-0061")


def test_nuscenes_of_two_versions_asks_for_one(nuscenes):
    shutil.copytree(nuscenes / "v1.0-mini", nuscenes / "v1.0-trainval")
    fails(ConfigError, "v1.0-mini and v1.0-trainval; choose one.*version=v1.0-mini", read_nuscenes, nuscenes)
    assert read_nuscenes(nuscenes, version="v1.0-mini").ground_truth
    assert not read_nuscenes(nuscenes, version="v1.0-trainval").ground_truth


@pytest.mark.parametrize(
    ("table", "change", "said"),
    [
        ("sample", lambda rows: rows.pop(), "sample.json: sample s3 is missing, which .* in sample_data.json names"),
        ("ego_pose", lambda rows: rows.pop(), "ego_pose.json: pose e3 is missing"),
        (
            "ego_pose",
            lambda rows: rows[1].update(rotation=[1, 0, 0]),
            "'rotation' of e1 is .* 4 numbers",
        ),
        (
            "ego_pose",
            lambda rows: rows[1].update(rotation=[2, 0, 0, 0]),
            "quaternion of pose 2 has length 2, not 1",
        ),
        ("ego_pose", lambda rows: rows[1].update(translation=[0, "x", 0]), "'translation' of e1: .*expected a number"),
        ("sample_data", lambda rows: [row.pop("filename") for row in rows], "'filename' of a row is None"),
        ("sample_data", lambda rows: [row.update(filename="../x") for row in rows], "the path '../x' leaves"),
        ("sample_data", lambda rows: [row.pop("timestamp") for row in rows], "'timestamp' is missing"),
        ("scene", lambda rows: rows.append(dict(rows[0])), "two scenes are called 'scene-0061'"),
        ("scene", lambda rows: rows.append(7), "scene.json: expected a list of objects"),
    ],
)
def test_nuscenes_tables_that_do_not_fit_are_named(nuscenes, table, change, said):
    change_table(nuscenes, table, change)
    fails(DataError, said, read_nuscenes, nuscenes)


def test_nuscenes_lidars_by_their_channel(nuscenes):
    said = "there is no channel 'LIDAR_BACK', only CAM_FRONT, LIDAR_TOP"
    fails(ConfigError, said, read_nuscenes, nuscenes, channel="LIDAR_BACK")


# --- KITTI-360


@pytest.fixture
def kitti360(tmp_path):
    sw.write_predicted(SCANS["kitti360"], tmp_path / "KITTI-360")
    return tmp_path / "KITTI-360"


def read_kitti360(folder, **options):
    return sw.opened(SCANS["kitti360"], folder, **options)


def test_kitti360_poses_are_of_the_lidar_by_the_number_of_the_frame(kitti360):
    scene = read_kitti360(kitti360)
    np.testing.assert_allclose([scene.T_wc(k) for k in range(4)], [s.T for s in sw.scans()], rtol=0, atol=1e-9)
    assert scene.name == f"data_3d_raw-{sw.DRIVE}"
    path = kitti360 / f"data_poses/{sw.DRIVE}/poses.txt"
    lines = path.read_text().splitlines()
    write_lines(path, [*lines[:2], *lines[3:]])
    scene = read_kitti360(kitti360)
    assert [scene.tracked(k) for k in range(4)] == [True, False, True, True]
    np.testing.assert_allclose(scene.T_wc(2), sw.scans()[2].T, rtol=0, atol=1e-9)


def test_kitti360_without_a_part_says_which(kitti360):
    (kitti360 / "calibration/calib_cam_to_velo.txt").unlink()
    fails(DataError, "calib_cam_to_velo.txt: cannot be read", read_kitti360, kitti360)
    (kitti360 / "calibration/calib_cam_to_pose.txt").write_text("image_01: 1 2 3\n")
    fails(DataError, "calib_cam_to_pose.txt: has no line image_00", read_kitti360, kitti360)
    (kitti360 / f"data_poses/{sw.DRIVE}/poses.txt").unlink()
    fails(DataError, "poses.txt: cannot be read", read_kitti360, kitti360)


def test_kitti360_ids_are_integers_of_the_users_classes(kitti360):
    path = kitti360 / f"data_3d_raw/{sw.DRIVE}/predictions/net/0000000007.npy"
    np.save(path, np.zeros((sw.POINTS, 6), np.float32))
    fails(DataError, "0000000007.npy: holds float32, not integers", read_kitti360(kitti360).frame, 0, "net")
    np.save(path, np.full(sw.POINTS, 70000))
    fails(DataError, "ids go from 70000 to 70000; they must be 0 to 65535", read_kitti360(kitti360).frame, 0, "net")
    fails(DataError, "the classes of 'net' are not known", read_kitti360(kitti360, classes=None).label_space, "net")
    (kitti360 / f"data_3d_raw/{sw.DRIVE}/velodyne_points/data/copy.bin").write_bytes(b"0" * 16)
    fails(DataError, "copy.bin: the name is no number of a frame", read_kitti360, kitti360)


# --- points_folder


def read_points(folder, **options):
    return sw.opened(SCANS["points_folder, NPY"], folder, **options)


@pytest.fixture
def clouds(tmp_path):
    sw.write_predicted(SCANS["points_folder, NPY"], tmp_path / "clouds")
    return tmp_path / "clouds"


def test_clouds_without_a_pose_are_not_tracked_and_poses_may_be_inverse(clouds):
    for k, scan in enumerate(sw.scans()):
        write_lines(clouds / f"pose/scan {8 + k}.txt", [numbers(row) for row in np.linalg.inv(scan.T)])
    (clouds / "pose/scan 10.txt").unlink()
    scene = read_points(clouds, pose_convention="world_to_camera")
    assert [scene.frame_name(k) for k in range(4)] == ["scan 8", "scan 9", "scan 10", "scan 11"]
    assert [scene.tracked(k) for k in range(4)] == [True, True, False, True]
    np.testing.assert_allclose(scene.T_wc(3), sw.scans()[3].T, rtol=0, atol=1e-9)
    fails(DataError, "scan 10.txt: the pose is not finite", scene.frame, 2, "net")


def test_clouds_with_all_poses_in_one_file(clouds):
    shutil.rmtree(clouds / "pose")
    write_lines(clouds / "poses.txt", [numbers(scan.T[:3]) for scan in sw.scans()])
    scene = read_points(clouds)
    np.testing.assert_allclose([scene.T_wc(k) for k in range(4)], [s.T for s in sw.scans()], rtol=0, atol=1e-12)
    write_lines(clouds / "poses.txt", [numbers(scan.T[:3]) for scan in sw.scans()[:3]])
    fails(DataError, "poses.txt: has 3 poses, but there are 4 clouds", read_points, clouds)


def test_clouds_in_the_world_keep_their_millimetres_far_from_its_origin(tmp_path):
    form = SCANS["points_folder, LAZ in the world"]
    sw.write_predicted(form, tmp_path)
    frame = sw.opened(form, tmp_path).frame(2, "net")
    assert frame.T_wc[1, 3] > 4_999_000
    np.testing.assert_allclose(frame.points[0], sw.scans()[2].points, rtol=0, atol=2e-4)
    np.testing.assert_allclose(frame.depth[0], np.linalg.norm(sw.scans()[2].points, axis=1), rtol=0, atol=2e-4)


def test_clouds_beside_depth_images_are_recognised_as_those(clouds):
    (clouds / "depth").mkdir()
    assert recognise(clouds)[0] == "posed_folder"
    assert len(read_points(clouds)) == sw.COUNT


def test_clouds_labels_gt_are_the_truth(clouds):
    (clouds / "labels/net").rename(clouds / "labels/gt")
    scene = read_points(clouds)
    assert (scene.models, scene.ground_truth) == ((), True)
    found = names_of_labels(scene, scene.frame(0, "gt"), "gt")
    assert found == ["abcdef"[wall] for wall in sw.predicted(sw.scans()[0])]


def test_clouds_that_hold_something_else_are_named(clouds):
    path = clouds / "points/scan 8.npy"
    for array in (np.zeros((sw.POINTS, 2)), np.zeros((sw.POINTS, 3), np.int32), np.zeros(sw.POINTS)):
        np.save(path, array)
        fails(DataError, r"scan 8.npy: holds .*; write float \(N, 3\), metres", read_points(clouds).frame, 0, "net")
    shutil.copy(path, clouds / "points/scan 8.ply")
    fails(DataError, "is the same frame; delete one of the two", read_points, clouds)
    path.unlink()
    fails(DataError, "scan 8.ply: not a PLY file", read_points(clouds).frame, 0, "net")


# --- points_folder, PLY with classes


@pytest.fixture
def plys(tmp_path):
    """Returns a function that writes all clouds with the walls as a property, and opens them."""

    def written(name="label", dtype=np.uint8, change=lambda walls: walls, **options):
        sw.write_predicted(SCANS["points_folder, PLY"], tmp_path)
        for k, scan in enumerate(sw.scans()):
            walls = {name: change(scan.walls.astype(dtype))} if name else {}
            sw.write_ply(tmp_path / f"points/scan {8 + k}.ply", scan.points, **walls)
        return sw.opened(SCANS["points_folder, PLY"], tmp_path, **options)

    return written


@pytest.mark.parametrize(
    "name", ["label", "Class", "classification", "scalar_Label", "scalar_Classification", "sem_class"]
)
@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float32])
def test_classes_in_ply_files_are_the_truth(plys, name, dtype):
    scene = plys(name, dtype)
    np.testing.assert_array_equal(scene.frame(2, "gt").labels[0], sw.scans()[2].walls)
    np.testing.assert_array_equal(scene.frame(2, "gt").points[0], sw.scans()[2].points)
    np.testing.assert_array_equal(scene.frame(2, "net").labels[0], sw.predicted(sw.scans()[2]))


def test_the_property_of_classes_in_ply_files_may_be_named(plys):
    assert not plys("mine").ground_truth
    assert not plys("label", label_field="").ground_truth
    np.testing.assert_array_equal(plys("mine", label_field="mine").frame(0, "gt").labels[0], sw.scans()[0].walls)
    said = "scan 8.ply: has no property 'mina', option label_field; did you mean 'mine'"
    fails(DataError, said, plys("mine", label_field="mina").frame, 0, "gt")


def test_a_property_that_holds_no_classes_is_refused_and_nan_is_none(plys):
    lost = np.arange(sw.POINTS) == 7
    frame = plys("scalar_Label", np.float32, lambda walls: np.where(lost, np.float32("nan"), walls)).frame(0, "gt")
    np.testing.assert_array_equal(frame.labels[0] == 65535, lost)
    scene = plys("label", np.float32, lambda walls: walls + np.float32(0.25))
    scene.frame(0, "net")
    fails(DataError, "scan 8.ply: the field 'label' holds .*25, which is no class", scene.frame, 0, "gt")


def test_a_ply_file_without_classes_among_others_is_named(plys, tmp_path):
    scene = plys()
    sw.write_ply(tmp_path / "points/scan 9.ply", sw.scans()[1].points)
    scene.frame(1, "net")
    fails(
        DataError,
        r"scan 9.ply: no property is one of classes \(label, .*; name it by label_field",
        scene.frame,
        1,
        "gt",
    )


def test_ply_files_may_hold_predictions(plys, tmp_path):
    plys("")
    shutil.rmtree(tmp_path / "labels")
    for k, scan in enumerate(sw.scans()):
        sw.write_ply(tmp_path / f"labels/own/scan {8 + k}.ply", scan.points, label=scan.walls.astype(np.int32))
    scene = sw.opened(SCANS["points_folder, PLY"], tmp_path)
    assert (scene.models, scene.ground_truth) == (("own",), False)
    np.testing.assert_array_equal(scene.frame(1, "own").labels[0], sw.scans()[1].walls)


def test_what_moves_is_of_the_class_of_what_stands() -> None:
    """Car, bicyclist, person, motorcyclist, on-rails, bus, truck and other-vehicle, as the benchmark joins them."""
    assert [LEARNING_MAP[k] for k in MOVING] == [LEARNING_MAP[k] for k in (10, 31, 30, 32, 16, 13, 18, 20)]
    assert [*MOVING] == [*range(252, 260)]
