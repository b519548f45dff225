"""The up axis: synthetic rooms and slopes whose up is known, the built-in towns, and a real shelf."""

import os
from pathlib import Path

import numpy as np
import pytest

from semstab import backends, datasets
from semstab.errors import DataError
from semstab.metrics.up_axis import estimate_up

DATA = Path(os.environ.get("SEMSTAB_DATA", Path(__file__).parents[2] / "shared" / "data"))


def degrees(a, b):
    return float(np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1))))


def looking(towards, positions=((0, 0, 1.5),), up=(0, 0, 1)):
    """Poses of unrolled cameras that look along a direction, in a world whose z is up."""
    z = np.array(towards) / np.linalg.norm(towards)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    poses[:, :3, 3] = positions
    return poses


def plane(rng, corner, a, b, count):
    """Points spread over the parallelogram at a corner with edges a and b, a centimetre rough."""
    s, t = rng.random((2, count, 1))
    return np.array(corner) + s * np.array(a) + t * np.array(b) + rng.normal(0, 0.01, (count, 3))


def room(rng, wall=2000):
    """A floor of 4 m x 4 m, a ceiling, and a wall ahead (at y = 4 m) with as many points as is said."""
    floor = plane(rng, (-2, 0, 0), (4, 0, 0), (0, 4, 0), 1500)
    ceiling = plane(rng, (-2, 0, 2.5), (4, 0, 0), (0, 4, 0), 1500)
    ahead = plane(rng, (-2, 4, 0), (4, 0, 0), (0, 0, 2.5), wall)
    return np.concatenate([floor, ceiling, ahead])


def test_a_level_camera_finds_the_floor_and_not_the_larger_wall_or_the_ceiling():
    points = room(np.random.default_rng(0))
    assert degrees(estimate_up(points, looking((0, 1, -0.2))), (0, 0, 1)) < 1


def test_a_camera_that_looks_straight_down_finds_the_ground():
    rng = np.random.default_rng(1)
    ground = plane(rng, (-20, -20, 0), (40, 0, 0), (0, 40, 0), 6000)
    facade = plane(rng, (-20, -20, 0), (40, 0, 0), (0, 0, 6), 2000)
    nadir = looking((0, 0, -1), positions=[(x, 0, 30) for x in range(-5, 6)], up=(0, 1, 0))
    assert degrees(estimate_up(np.concatenate([ground, facade]), nadir), (0, 0, 1)) < 0.5


def test_a_slope_is_taken_for_the_ground():
    """The documented limit: without a level the ground's own slope, here 10 degrees, cannot be told."""
    rng = np.random.default_rng(2)
    rise = np.tan(np.deg2rad(10)) * 40
    hill = plane(rng, (-20, -20, 0), (40, 0, rise), (0, 40, 0), 6000)
    up = estimate_up(hill, looking((0, 1, -1), positions=[(0, -20, 30)]))
    assert degrees(up, (0, 0, 1)) == pytest.approx(10, abs=0.5)


@pytest.mark.parametrize("seed", range(2))
def test_the_answer_turns_with_the_world_and_moves_with_nothing(seed):
    rng = np.random.default_rng(seed)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.sign(np.linalg.det(R))
    shift = np.array([500_000, 4_000_000, 100])
    points, poses = room(np.random.default_rng(0)), looking((0, 1, -0.2))
    turned = poses.copy()
    turned[:, :3, :3] = R @ poses[:, :3, :3]
    turned[:, :3, 3] = poses[:, :3, 3] @ R.T + shift
    assert degrees(estimate_up(points @ R.T + shift, turned), R @ (0, 0, 1)) < 1


def test_the_same_input_gives_the_same_answer():
    points, poses = room(np.random.default_rng(0)), looking((0, 1, -0.2))
    first = estimate_up(points, poses)
    assert np.linalg.norm(first) == pytest.approx(1)
    for _ in range(3):
        assert (estimate_up(points, poses) == first).all()


LINE = np.arange(50.0)[:, None] * (1, 0, 0)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((2, 3)), np.ones((50, 3)), LINE])
def test_too_few_points_are_refused(points):
    with pytest.raises(DataError, match=f"there is no ground plane under the cameras in {len(points)} points; set the"):
        estimate_up(points, looking((0, 1, 0)))


def test_a_ceiling_alone_is_no_ground():
    ceiling = plane(np.random.default_rng(3), (-2, 0, 2.5), (4, 0, 0), (0, 4, 0), 5000)
    with pytest.raises(DataError, match="no ground plane"):
        estimate_up(ceiling, looking((0, 1, 0)))


def fused(frames, voxel_size, K):
    backend = backends.create("numba", voxel_size=voxel_size, num_classes=K)
    for frame in frames:
        backend.integrate(frame)
    return backend.table(), [frame.T_wc for frame in frames]


def test_a_town_from_the_air():
    """The camera looks 55 degrees down, so up in its images is nearly level; the terrain falls by a few degrees."""
    scene = datasets.open_dataset("city", {"width": 96, "height": 54, "frames": 8}).scene("scene0")
    table, poses = fused([scene.frame(index, "gt") for index in range(8)], 1.0, 8)
    assert degrees(-np.mean(poses, axis=0)[:3, 1], scene.up) > 45
    assert degrees(estimate_up(table, poses), scene.up) < 4


def test_a_real_shelf():
    """Its back wall is its largest plane; the bin's floor, horizontal in the robot's base frame (z up), is up."""
    root = DATA / "apc_shelf"
    if not root.is_dir():
        pytest.skip(f"{root} is not here; set SEMSTAB_DATA")
    scene = datasets.open_dataset("posed_folder", {"root": root}).scene("apc_shelf")
    frames = [scene.frame(index, "gt", color=False).every(4) for index in range(len(scene))]
    table, poses = fused(frames, 0.01, 5)
    assert degrees(estimate_up(table, poses), (0, 0, 1)) < 8
