"""Scans through the whole tool: check, run, compare, relabel; what a frame of points is, and what it refuses."""

from __future__ import annotations

import math
import shutil

import numpy as np
import pytest
from command_line import bench
from corners import corners
from street import IDS, Street, write_street

import semstab
from semstab import Frame, Intrinsics
from semstab.check import check, scans
from semstab.check.hypotheses import SCANS, scan_poses
from semstab.check.trials import Hypothesis
from semstab.configure import load_config
from semstab.datasets import open_dataset
from semstab.errors import DataError
from semstab.metrics import compensated_flicker
from semstab.statistics import describe
from semstab.statistics.loops.sparse import surface
from semstab.statistics.sparse_depth import SparseDepth


def a_scan(**changes):
    """A good scan of four points, but for the changes."""
    fields = {
        "index": 3, "points": np.ones((4, 3), np.float32), "labels": np.zeros(4, np.uint8), "T_wc": np.eye(4),
    }  # fmt: skip
    return Frame(**fields | changes)


@pytest.mark.parametrize("around", [False, True])
def test_points_on_a_plane_say_its_inverse_depth_and_slopes(around):
    """Inverse depth 0.5 + 0.02 u - 0.01 v: at (4, 3) it is 0.55, with slopes 0.02 / 0.55 and -0.01 / 0.55."""
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[:7, :9])
    grid, w = np.arange(63, dtype=np.int32).reshape(7, 9), 0.5 + 0.02 * u - 0.01 * v
    there, residual, nearest, squared, along_x, along_y = surface(grid, u, v, w, 4.0, 3.0, 2, around)
    assert (there, along_x, along_y) == pytest.approx((0.55, 0.02 / 0.55, -0.01 / 0.55))
    assert (nearest, squared, residual) == (3 * 9 + 4, 0, pytest.approx(0, abs=1e-6))
    few = np.where(np.isin(grid, grid[3, 3:6]), grid, -1).astype(np.int32)
    assert surface(few, u, v, w, 4.0, 3.0, 2, around)[:2] == (0, 0)


@pytest.mark.parametrize(("every", "reach"), [(2, 3), (5, 6), (40, 12)])
def test_neighbours_of_sparse_points_are_looked_for_as_far_as_points_are_apart(every, reach):
    """Pixels of an image of 400 x 400, one in every row and column of some; by 1.1 times their spacing, at most 12."""
    depth = np.zeros((400, 400), np.float32)
    depth[::every, ::every] = 5
    frame = Frame(0, depth, Intrinsics(200, 200, 200, 200), np.eye(4), labels=np.zeros((400, 400), np.uint8))
    assert SparseDepth.from_frame(frame, 3).reach == reach


REFUSED = {
    "points are no rows of three": ({"points": np.ones((4, 2), np.float32)}, r"points must be \(N, 3\), got shape"),
    "there are no points": ({"points": np.ones((0, 3), np.float32)}, r"points must be \(N, 3\)"),
    "points are whole numbers": ({"points": np.ones((4, 3), np.int32)}, "points are int32; convert"),
    "another number of labels": ({"labels": np.zeros(5, np.uint8)}, "5 labels but 4 points; give one for each point"),
    "another number of scores": ({"labels": None, "scores": np.ones((3, 2))}, "3 scores but 4 points"),
    "intrinsics too": ({"intrinsics": Intrinsics(1, 1, 0, 0)}, "give depth and intrinsics, or points"),
    "no pose": ({"T_wc": None}, "there is no pose; give T_wc"),
    "neither depth nor points": ({"points": None}, "give depth and intrinsics, or points"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_scan_is_refused(name):
    changes, said = REFUSED[name]
    with pytest.raises(DataError, match=said):
        a_scan(**changes)


def test_a_scan_is_an_image_of_one_row():
    points = np.array([[3, 4, 0], [0, 0, 0], [np.nan, 1, 1], [np.inf, 0, 0]], np.float32)
    scan = a_scan(points=points, labels=[0, 0, 0, 0])
    assert scan.shape == (1, 4)
    assert scan.is_scan
    assert scan.depth[0, 0] == 5
    assert scan.valid.tolist() == [[True, False, False, False]]
    assert scan.every(3).points[0, :, 0].tolist() == [3, math.inf]


def test_a_scan_keeps_as_many_points_as_a_square_image_has_pixels():
    scan = a_scan(points=np.ones((1000, 3), np.float32), labels=np.zeros(1000, np.uint8))
    assert scan.within(10).shape == (1, 100)
    assert scan.within(40) is scan


@pytest.mark.parametrize("rows", [16, 64])
def test_rays_are_about_as_far_apart_as_the_sphere_has_room(rows):
    """Rays in rows over 30 degrees of elevation, 720 columns: the angle is the root of the solid angle of each."""
    at, up = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.radians(np.linspace(-15, 15, rows)))
    points = 20 * np.stack([np.cos(up) * np.cos(at), np.cos(up) * np.sin(at), np.sin(up)], axis=-1)
    scan = a_scan(points=points.astype(np.float32), labels=np.zeros(points.shape[:2], np.uint8))
    solid = 2 * math.pi * 2 * math.sin(math.radians(15))
    assert scan.ray_angle == pytest.approx(math.sqrt(solid / points[..., 0].size), rel=0.15)


def test_flicker_of_scans_compares_with_the_label_of_most_points_of_the_voxel():
    """Before: labels 1, 1, 2 in one voxel and 0 in another; now 1 and 2 there, and a point where none was: 1 of 2."""
    at = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.3, 0.3], [2.5, 0.5, 0.5]], np.float32)
    before = a_scan(points=at, labels=np.array([1, 1, 2, 0], np.uint8))
    moved = np.eye(4)
    moved[0, 3] = -5
    now = a_scan(
        points=np.array([[5.4, 0.4, 0.4], [7.5, 0.5, 0.5], [20, 0, 0]], np.float32),
        labels=np.array([1, 2, 1], np.uint8), T_wc=moved,
    )  # fmt: skip
    pair = compensated_flicker(before, now, voxel_size=1.0)
    assert (pair.flicker_percent, pair.share) == (50.0, pytest.approx(2 / 3))


# --- A drive through a street of boxes, in SemanticKITTI's layout


@pytest.fixture(scope="module")
def street():
    return Street.made(seed=0)


@pytest.fixture(scope="module")
def folder(street, tmp_path_factory):
    root = tmp_path_factory.mktemp("street")
    write_street(root / "00", street)
    return root


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """A run of a clean model, one that flips labels in each third scan, and one that is worse the farther it looks."""
    where = tmp_path_factory.mktemp("run")
    result = bench("run", "--data", folder, "--voxel-size", "0.5", "--out", "out", cwd=where, report=True)
    return where / "out", result.stdout


def test_points_land_where_the_poses_say(street, folder):
    scene = open_dataset("semantickitti", {"root": folder}).scene("00")
    for index in (0, 5):
        frame = scene.frame(index, "gt")
        np.testing.assert_allclose(frame.T_wc, street.poses[index], atol=1e-6)
        np.testing.assert_array_equal(frame.points[0], street.scans[index])
        id_of = {name: k for k, name in zip(scene.label_space("gt").ids, scene.label_space("gt").classes, strict=True)}
        assert {*np.unique(frame.labels)} <= {*IDS, 65535}
        assert id_of["car"] == 10


def test_the_folder_is_recognised_and_checked(folder, tmp_path):
    result = bench("check", "--data", folder, "-v", cwd=tmp_path)
    assert "read as semantickitti" in result.stdout + result.stderr
    assert "SOUND" in result.stdout
    assert "scans lie on each other" in " ".join(result.stdout.split())
    assert "noise    points lie" in result.stdout


MISTAKES = {
    "inverse poses": ({"pose_convention": "world_to_camera"}, "set pose_convention: camera_to_world"),
    "the calibration forgotten": ({"pose_frame": "lidar"}, "set pose_frame: camera"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_the_poses_is_named_with_the_option_that_mends_it(name, folder):
    options, mend = MISTAKES[name]
    config = load_config({"dataset": {"name": "semantickitti", "options": {"root": str(folder), **options}}})
    (checked,) = check(config)
    assert checked.verdict.state == "unsound"
    assert mend in checked.verdict.text


def test_a_new_hypothesis_of_scans_is_one_entry(street, monkeypatch, tmp_path):
    turned = np.diag([1.0, -1, -1, 1])
    write_street(tmp_path / "00", Street(street.scans, street.ids, [T @ turned for T in street.poses]))
    entry = Hypothesis("poses turned about x", scan_poses(lambda T: T @ turned), "turn them back")
    monkeypatch.setattr(scans, "SCANS", (*SCANS, entry))
    assert checked_street(tmp_path).text.endswith("with poses turned about x; turn them back")


@pytest.mark.parametrize(("seed", "rows"), corners([(0, 16), (1, 64)], always=[(0, 16)]))
def test_a_straight_drive_is_sound_though_rings_meet_best_where_nothing_moves(seed, rows, tmp_path):
    write_street(tmp_path / "00", Street.made(seed, rows=rows, turn=0.0, sideways=0.0))
    verdict = checked_street(tmp_path)
    assert verdict.state == "sound", verdict.text
    assert not {"poses in millimetres", "inverse poses"} & {*verdict.undetermined}


@pytest.mark.parametrize(("rows", "turn"), corners([(16, 0.0), (24, 0.03)], always=[(16, 0.0)]))
def test_positions_of_another_unit_are_named_in_straight_drives_too(rows, turn, tmp_path):
    for factor, name in ((0.001, "poses in kilometres"), (1000.0, "poses in millimetres")):
        made = Street.made(1, rows=rows, turn=turn, sideways=0.0)
        poses = [np.block([[T[:3, :3], factor * T[:3, 3:]], [T[3:]]]) for T in made.poses]
        write_street(tmp_path / f"{factor}/00", Street(made.scans, made.ids, poses))
        verdict = checked_street(tmp_path / f"{factor}")
        assert verdict.state == "unsound"
        assert f"with {name}; " in verdict.text


def checked_street(root):
    (checked,) = check(load_config({"dataset": {"name": "semantickitti", "options": {"root": str(root)}}}))
    return checked.verdict


@pytest.mark.parametrize("coordinates", ["sensor", "world"])
def test_points_in_the_world_are_told_from_those_in_the_axes_of_the_sensor(street, coordinates, tmp_path):
    """At UTM coordinates too, where each error is a tiny share of the distance from the origin."""
    offset = np.array([448262.0, 5411932.0, 300.0])
    for folder in ("points", "pose", "labels/net"):
        (tmp_path / folder).mkdir(parents=True)
    for k, (points, ids, pose) in enumerate(street):
        moved = pose.copy()
        moved[:3, 3] += offset
        world = points @ moved[:3, :3].T.astype(np.float64) + moved[:3, 3]
        np.save(tmp_path / f"points/{k:03d}.npy", world if coordinates == "world" else points)
        np.savetxt(tmp_path / f"pose/{k:03d}.txt", moved)
        np.save(tmp_path / f"labels/net/{k:03d}.npy", np.searchsorted(IDS, ids).astype(np.uint8))
    for told in ("sensor", "world"):
        options = {"root": str(tmp_path), "coordinates": told, "classes": ["car", "road", "building", "tree"]}
        (checked,) = check(load_config({"dataset": {"name": "points_folder", "options": options}}))
        if told == coordinates:
            assert checked.verdict.state == "sound"
        else:
            assert checked.verdict.state == "unsound"
            assert f"set coordinates: {coordinates}" in checked.verdict.text


def test_scans_without_points_are_passed_over(street, tmp_path):
    """Two of ten hold a point at the sensor alone: the others tell that the poses are right."""
    lost = Street([of_scan[:1] * 0 if k in (0, 4) else of_scan for k, of_scan in enumerate(street.scans)],
                  [of_scan[:1] if k in (0, 4) else of_scan for k, of_scan in enumerate(street.ids)],
                  street.poses)  # fmt: skip
    write_street(tmp_path / "00", lost)
    (checked,) = check(load_config({"dataset": {"name": "semantickitti", "options": {"root": str(tmp_path)}}}))
    assert checked.verdict.state == "sound"


def test_a_run_refuses_poses_that_check_calls_unsound(folder, tmp_path):
    words = "run", "--data", folder, "--dataset", "semantickitti", "--option", "pose_frame=lidar", "--check", "none"
    result = bench(*words, cwd=tmp_path, code=2)
    assert "scans do not lie on each other" in result.stderr
    assert "--option pose_frame=camera" in result.stderr
    more = "--no-geometry-check", "--voxel-size", "0.5", "--model", "clean", "--frames", ":2"
    bench(*words, *more, cwd=tmp_path)


def test_the_screen_names_the_scans_that_stand_out_and_the_range(run):
    _, text = run
    words = " ".join(text.split())
    assert "most stable first: 1. clean" in words
    assert "frames that stand out, flips: " in words
    assert {name for name in ("000001", "000004", "000007") if name in words.split("stand out, flips:")[1]} != set()
    assert "far: reliable up to" in words


def test_the_screen_says_why_a_model_that_labels_too_little_is_usable_at_most(street, tmp_path):
    write_street(tmp_path / "00", street.with_ids(lambda ids, k: np.where(ids == 70, 0, ids)))
    result = bench("run", "--data", tmp_path, "--model", "gt", "--voxel-size", "0.5", "--out", "out", cwd=tmp_path)
    assert "USABLE" in result.stdout
    assert "of the locations have no label in most frames: such a map is usable at most" in result.stdout
    assert "% of the points change class per scan" in result.stdout


def test_scans_without_labels_are_no_images_to_predict_on(street, tmp_path):
    write_street(tmp_path / "00", street)
    shutil.rmtree(tmp_path / "00/predictions")
    result = bench("run", "--data", tmp_path, cwd=tmp_path, code=2)
    assert "00: there are no labels of its scans; searched " in result.stderr
    assert "add those of a model, or measure the ground truth: --model gt" in result.stderr


def test_strata_by_range_tell_a_model_that_is_worse_far_away(run):
    folder, _ = run
    by_model = {record.unit.model: record.statistics.ranges for record in semstab.load(folder).result.select()}
    far, clean = by_model["far"], by_model["clean"]
    assert clean.reliable == clean.farthest
    assert not clean.is_told
    assert far.reliable < clean.reliable
    alphas = [row.alpha.value for row in far.strata if not math.isnan(row.alpha.value)]
    assert alphas[0] > 0.9
    assert alphas[-1] < 0.6
    assert sum(row.share for row in far.strata) == pytest.approx(1)


def test_the_report_says_up_to_which_range(run):
    page = (run[0] / "report.html").read_text(encoding="utf-8")
    assert "<dt>reliable</dt>" in page
    assert "Agreement by range" in page


def test_truth_is_stable_and_corrupted_scans_are_found(run, tmp_path):
    folder, _ = run
    result = bench("compare", f"{folder}:clean", f"{folder}:flips", cwd=tmp_path)
    words = " ".join(result.stdout.split())
    assert "flips is less stable than clean" in words or "flips: worse in" in words
    assert "the top contributing frames are 00000" in words


def test_relabelled_scans_are_label_files_that_are_read_again(run, folder, tmp_path):
    bench("relabel", f"{run[0]}:flips", "--out", tmp_path / "new", "--leave-one-out", cwd=tmp_path)
    files = sorted((tmp_path / "new/predictions/flips-fused").glob("*.label"))
    scene = open_dataset("semantickitti", {"root": folder, "labels_root": tmp_path / "new"}).scene("00")
    assert len(files) == len(scene)
    truth, fused = (scene.frame(1, name).labels for name in ("gt", "flips-fused"))
    both = (truth != 65535) & (fused != 65535)
    flips = open_dataset("semantickitti", {"root": folder}).scene("00").frame(1, "flips").labels
    assert np.mean(fused[both] == truth[both]) > np.mean(flips[both] == truth[both]) + 0.05


def test_predictions_in_a_folder_of_their_own_are_called_by_scene_and_model(street, folder, tmp_path):
    """As benchmarks take them: LABELS/SCENE/MODEL/NAME.label."""
    (tmp_path / "00").mkdir()
    (tmp_path / "00/mine").symlink_to(folder / "00/predictions/far")
    options = {"root": folder, "labels_root": tmp_path}
    scene = open_dataset("semantickitti", options).scene("00")
    assert scene.models == ("mine",)
    far = open_dataset("semantickitti", {"root": folder}).scene("00").frame(3, "far")
    np.testing.assert_array_equal(scene.frame(3, "mine").labels, far.labels)


def test_moving_points_are_left_out_of_all_models_by_default(street, tmp_path):
    moving = street.with_ids(lambda ids, k: np.where(ids == 10, 252, ids))
    write_street(tmp_path / "00", moving)
    with_movers, left = (
        open_dataset("semantickitti", {"root": tmp_path, "moving": how}).scene("00").frame(0, "clean")
        for how in ("keep", "leave_out")
    )
    assert with_movers.mask is None
    np.testing.assert_array_equal(left.mask[0], moving.ids[0] == 252)


def test_scans_of_a_program_are_fused_as_images_are(street):
    frames = [
        {"points": points, "labels": np.searchsorted(IDS, ids).astype(np.uint8), "T_wc": pose}
        for points, ids, pose in street
    ]
    result = semstab.fuse(frames, voxel_size=0.5)
    assert result.summary.alpha > 0.9


def test_alpha_of_scans_that_are_labelled_at_random_is_0(street):
    """Labels that are drawn anew for each point of each scan agree by chance, however far from a spot they lie."""
    from semstab.statistics import Sampler

    rng, sampler = np.random.default_rng(0), Sampler(3)
    backend = semstab.backends.create("numba", voxel_size=0.5, num_classes=3)
    for k, (points, pose) in enumerate(zip(street.scans, street.poses, strict=True)):
        frame = Frame(k, points=points, T_wc=pose, labels=rng.integers(0, 3, len(points)).astype(np.uint8))
        sampler.add(frame)
        backend.integrate(frame)
    assert describe(backend.table(), spots=sampler.sample()).headline.alpha.value == pytest.approx(0, abs=0.03)


def test_a_scan_cannot_be_looked_up_in_an_image(street):
    backend = semstab.backends.create("open3d-projective", voxel_size=0.5, num_classes=3)
    with pytest.raises(DataError, match="looks voxels up in an image, and a scan is none"):
        backend.integrate(a_scan())


def test_no_model_predicts_on_scans(folder, tmp_path):
    result = bench("run", "--data", folder, "--predict", "colour-clusters", cwd=tmp_path, code=2)
    assert "00: holds scans, and models and filters work on images; write the labels" in result.stderr


def test_scans_are_not_converted_to_images(folder, tmp_path):
    result = bench("convert", "--data", folder, "--out", tmp_path / "images", cwd=tmp_path, code=2)
    assert "00: holds scans, and a posed folder holds images" in result.stderr
    assert not (tmp_path / "images").exists()
