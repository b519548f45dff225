"""The estimate of memory: what the maps then hold, cheap where there is no doubt, one line where it is too much."""

from __future__ import annotations

import dataclasses
import re
import tracemalloc

import numpy as np
import pytest
import tiny_scene
from posed_config import configure

import semstab
from semstab import Frame, Intrinsics
from semstab.backends import create, expected_bytes
from semstab.backends.shared.observations import WorkSpace
from semstab.config import Config
from semstab.core.process import available_bytes, resident_bytes
from semstab.engine import map_size, memory, sizing
from semstab.engine.units import Plan, make_plan
from semstab.errors import ConfigError

FRAMES = 30


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tiny_scene.write(tmp_path_factory.mktemp("scene") / "wall", models=("a",), frames=FRAMES)


def planned(root, **settings) -> tuple[Plan, Config]:
    config = configure(root, **{"backends": ["open3d"], **settings})
    return make_plan(config), config


def test_the_estimate_holds_for_a_flight_and_saturates_over_one_place(tmp_path) -> None:
    """From a sample of frames; frames that see nothing new add observations only."""
    root = tiny_scene.write(tmp_path / "wall", models=("a",), frames=60)
    plan, config = planned(root, voxel_size=0.05, pixel_stride=1)
    table = semstab.run(config, report=False).runs[0].map_summary
    size = map_size.map_size(plan.tasks[0], plan.units[0].config)
    assert size.voxels == pytest.approx(table.voxels, rel=0.3)
    assert size.observations == pytest.approx(table.observations, rel=0.3)
    still = dataclasses.replace(plan.tasks[0], indices=[0] * 60)
    size = map_size.map_size(still, plan.units[0].config)
    assert size.voxels == pytest.approx(48)


def test_the_overlap_of_a_flight_in_legs_is_seen(root, monkeypatch) -> None:
    """Of 12 legs of 20 frames, each frame sees 20 by 20 voxels, and overlaps with those of the legs beside it."""
    plan, _ = planned(root)
    x, y = (axis.ravel() for axis in np.indices((20, 20)))

    def voxels_of_frame(index: int) -> np.ndarray:
        leg, along = divmod(index, 20)
        return np.stack([x + 12 * leg, y + 10 * along, np.zeros(400, int)], axis=1)

    monkeypatch.setattr(map_size, "geometry", lambda task, settings, index: index)
    monkeypatch.setattr(map_size, "voxels_in", lambda index, voxel_size: voxels_of_frame(index))
    flight = dataclasses.replace(plan.tasks[0], indices=[*range(240)])
    size = map_size.map_size(flight, plan.units[0].config)
    true = len(np.unique(np.concatenate([voxels_of_frame(index) for index in range(240)]), axis=0))
    assert size.voxels == pytest.approx(true, rel=0.1)
    assert size.observations == pytest.approx(240 * 400)


def test_of_large_frames_a_part_is_looked_at(root, monkeypatch) -> None:
    plan, _ = planned(root)
    x, y, z = (axis.ravel() for axis in np.indices((300, 300, 3)))

    def voxels_of_frame(index: int) -> np.ndarray:
        return np.stack([x + 30 * index, y, z], axis=1)

    monkeypatch.setattr(map_size, "geometry", lambda task, settings, index: index)
    monkeypatch.setattr(map_size, "voxels_in", lambda index, voxel_size: voxels_of_frame(index))
    size = map_size.map_size(dataclasses.replace(plan.tasks[0], indices=[*range(10)]), plan.units[0].config)
    assert size.voxels == pytest.approx(570 * 300 * 3, rel=0.03)
    assert size.by_column == 3


def test_a_unit_that_will_not_fit_is_refused_before_a_frame_is_fused(root, tmp_path) -> None:
    _, config = planned(root, memory_gb=1e-6, tile_size="off")
    said = r"wall, a: about .* million voxels of 0.25 m would take .* GB, and 1e-06 GB is memory_gb; use larger voxels"
    with pytest.raises(ConfigError, match=said + r".*pixel_stride.*\(numpy\).*off forbids to fuse it in tiles"):
        semstab.run(config, out=tmp_path / "run", report=False)
    assert not (tmp_path / "run" / "voxels").exists()


def test_a_unit_that_will_not_fit_is_fused_in_tiles(root, monkeypatch) -> None:
    """The limit is the free memory, where none is set; a quarter of it where code and frames take it all."""
    plan, config = planned(root)
    assert not sizing.planned_sizes(config, plan.units, 1).tile_sizes
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000)
    found = sizing.planned_sizes(config, plan.units, 1)
    assert found.tile_sizes.keys() == {unit.identity for unit in plan.units}
    assert re.search(r"2\.5e-07 GB are free: it is fused in tiles of .* m, which take .* GB$", found.lines[0])


def test_tiles_are_as_large_as_the_memory_allows_and_as_many_as_processes_need(root) -> None:
    (unit,) = planned(root, backends=["numba"], check=None)[0].units
    size = map_size.MapSize(voxels=1e8, observations=3e8, by_column=2.0)
    kind = sizing._map_memory(unit, soft=False)
    edges = [sizing._tile_edge(kind, size, budget, 1) for budget in (1e8, 4e8, 16e8)]
    assert edges[1] == 2 * edges[0]
    assert edges[2] == 4 * edges[0]
    assert memory.MapMemory("numba", 3).tile(2 * edges[0] ** 2, 6 * edges[0] ** 2) < 1e8
    assert sizing._tile_edge(kind, map_size.MapSize(1e6, 3e6, 2.0), 1e12, 8) ** 2 * 2 * 2 * 8 <= 1e6


def test_one_frame_is_enough_where_there_is_ample_room(root, monkeypatch) -> None:
    plan, config = planned(root)
    monkeypatch.setattr(sizing, "map_size", lambda *_: pytest.fail("frames were read"))
    found = sizing.planned_sizes(config, plan.units, 1)
    assert not found.tile_sizes
    assert not found.refused


def test_the_limit_is_not_kept(root) -> None:
    _, config = planned(root, memory_gb=8)
    assert "memory_gb" not in config.to_yaml()
    assert 1e8 < available_bytes() < 1e15


@pytest.mark.parametrize("name", ["numba", "open3d"])
def test_maps_take_what_their_backend_expects(name) -> None:
    """Within a factor of three, over a floor with a class a column, seen by four frames side by side."""
    side = 300
    depth = np.full((side, side), 30.0)
    labels = (np.indices((side, side))[1] % 7).astype(np.uint8)
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 30.0 * np.arange(4)
    tracemalloc.start()
    backend = create(name, voxel_size=0.1, num_classes=7)
    for index, pose in enumerate(poses):
        voxels = backend.integrate(Frame(index, depth, Intrinsics(300, 300, 150, 150), pose, labels)).map_voxels
    held, _ = tracemalloc.get_traced_memory()  # Open3D's own tensors are not in it
    tracemalloc.stop()
    if name == "open3d":
        held = sum(backend.grid.attribute(column).numpy().nbytes for column in backend.attributes)
    assert voxels > 200_000
    assert held / 3 < expected_bytes(name, voxels, voxels, 7) < 3 * held


def test_a_backend_that_does_not_say_counts_as_nothing(monkeypatch) -> None:
    from semstab.backends import REGISTRY

    monkeypatch.setattr(REGISTRY, "load", lambda name: object)
    assert expected_bytes("theirs", 10, 10, 3) == 0


def test_the_reference_with_many_classes_takes_little_more_than_its_map_for_a_frame() -> None:
    """At most a few vectors of all classes for each voxel that the frame touches, own, before and after."""
    K, shape = 150, (240, 320)
    depth = np.ones(shape, np.float32)
    labels = np.zeros(shape, np.uint8)
    frame = Frame(0, depth, Intrinsics(100, 100, 160, 120), np.eye(4), labels=labels)
    reference = create("numpy", voxel_size=0.02, num_classes=K)
    tracemalloc.start()
    voxels = reference.integrate(frame).voxels
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < expected_bytes("numpy", voxels, voxels, K) + 10 * 8 * K * voxels + 1e7


def test_room_that_is_not_written_to_takes_no_memory() -> None:
    """Large pages would take all of it: work space of a 4K image has a gap after the entries of each band of rows."""
    before = resident_bytes()
    room = WorkSpace().room("word", 1 << 25, gaps=True)
    room[:: 1 << 18] = 1  # every 2 MB
    assert room[1 << 18] == 1
    assert resident_bytes() - before < 32e6


@pytest.mark.parametrize(
    ("backend", "of_truth"),
    [("open3d", "numba"), ("numba+bayes", "numba"), ("numpy", "numpy"), ("open3d-projective", "open3d-projective")],
)
def test_ground_truth_is_fused_by_the_fastest_backend_with_the_same_voxels_and_reach(backend, of_truth):
    assert memory.truth_backend(backend) == of_truth
