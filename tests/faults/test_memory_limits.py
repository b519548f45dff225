"""Memory that does not suffice: one line, before the system ends the process, and what is finished is kept."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from posed_config import configure
from posed_writer import write_posed

import semstab
from semstab import Frame, Intrinsics
from semstab.backends.numpy_reference import NumpyReference
from semstab.core.process import available_bytes, group_bytes
from semstab.errors import ConfigError
from semstab.statistics.agreement import alpha_of
from semstab.statistics.cluster_sums import ALPHA_SUMS, ClusterSums, Functional, side_by_side
from semstab.statistics.intervals import estimate

SIDE, FRAMES = 160, 6


@pytest.fixture
def growing(tmp_path):
    """A first frame of which a pixel is valid, then a wall of which each frame sees another part, pixel by pixel."""
    frames = []
    for i in range(FRAMES):
        depth = np.full((SIDE, SIDE), 2 if i else 0, np.float32)
        depth[0, 0] = 2
        pose = np.eye(4)
        pose[:3, 3] = [2.0 * i, 0.001, 0.001]
        labels = (np.indices((SIDE, SIDE))[1] % 3).astype(np.uint8)
        frames.append(Frame(i, depth, Intrinsics(SIDE, SIDE, SIDE / 2, SIDE / 2), pose, labels=labels))
    return write_posed(
        tmp_path / "wall", [f"{i}" for i in range(FRAMES)], {"a": frames, "b": frames}, classes=["x", "y", "z"]
    )


def test_a_map_that_outgrows_the_memory_is_given_up_in_one_line(growing, tmp_path) -> None:
    """Though its first frame promised little; what was finished before is kept."""
    settings = {"backends": ["numba"], "check": None, "voxel_size": 0.0125, "check_geometry": False}
    small = configure(growing, models=["a"], frames={"stop": 2}, **settings)
    semstab.run(small, out=tmp_path / "out", report=False)
    large = configure(growing, memory_gb=0.012, tile_size="off", **settings)
    with pytest.raises(ConfigError, match=r"wall, a, numba: after \d of 6 frames the map has .* million voxels"):
        semstab.run(large, out=tmp_path / "out", report=False, overwrite=True)
    again = semstab.run(small, out=tmp_path / "out", report=False)
    assert again.manifest["units"]["kept"] == 1
    assert len(semstab.run(large.model_copy(update={"memory_gb": 2.0}), report=False).records) == 2


def group(folder, limit: str, used: int, cache: int, version: int) -> None:
    folder.mkdir(parents=True)
    names = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    for name, value in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{value}\n")
    prefix = "" if version == 2 else "total_"
    (folder / "memory.stat").write_text(f"anon 7\n{prefix}inactive_file {cache}\n{prefix}active_file 5\n")


def test_the_limits_of_nested_groups_of_both_versions_bound_what_is_free(tmp_path) -> None:
    """The tightest one counts, and page cache is no use of memory."""
    proc, root = tmp_path / "proc", tmp_path / "cgroup"
    proc.mkdir()
    (proc / "cgroup").write_text("0::/user/job/step\n")
    group(root / "user", "1000", 900, 495, 2)
    group(root / "user/job", "max", 900, 0, 2)
    group(root / "user/job/step", "2000", 800, 0, 2)
    assert group_bytes(proc, root) == 600
    (root / "user/memory.max").write_text("max\n")
    assert group_bytes(proc, root) == 1205
    # In a container the path is that of the host, which is not there; the limit stands at the root
    root = tmp_path / "cgroup1"
    (proc / "cgroup").write_text("3:cpu,cpuacct:/docker/ab\n4:memory:/docker/ab\n")
    group(root / "memory", "5000", 1005, 100, 1)
    assert group_bytes(proc, root) == 4100
    group(root / "memory/docker/ab", "3000", 1000, 0, 1)
    assert group_bytes(proc, root) == 2005
    (proc / "cgroup").write_text("nonsense\n")
    assert group_bytes(proc, root) is None
    assert group_bytes(tmp_path / "nowhere", root) is None


@pytest.mark.skipif(sys.platform != "linux", reason="macOS does not bound the address space")
def test_the_processes_own_limit_bounds_what_is_free() -> None:
    program = (
        "import resource, psutil; from semstab.core.process import available_bytes\n"
        "used = psutil.Process().memory_info().vms\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + 50_000_000, -1)); print(available_bytes())"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert 0 < int(said) <= 50_000_000
    assert available_bytes() > 50_000_000


def test_thousands_of_classes_take_no_square_of_them() -> None:
    """A matrix of 6,000 by 6,000 would take 288 MB."""
    K = 6000
    depth, labels = np.full((6, 8), 2, np.float32), np.arange(48, dtype=np.uint16).reshape(6, 8) * 100
    frame = Frame(0, depth, Intrinsics(8, 8, 4, 3), np.eye(4), labels=labels)
    sums = np.zeros((9, 3 + K))
    sums[:, :103] = [3, 5, 5, *100 * [0.05]]
    tracemalloc.start()
    try:
        NumpyReference(0.5, K).integrate(frame)
        columns = side_by_side(dict(zip(ALPHA_SUMS, (1, 1, 1, K), strict=True)))
        of_nine = ClusterSums(np.arange(27).reshape(9, 3), np.arange(9), sums, columns, 1.0, 1)
        number = Functional(ALPHA_SUMS, alpha_of, -1.0, 1.0, "agreement", pairs=ALPHA_SUMS[:2])
        assert estimate(of_nine, number).value < 1
        assert tracemalloc.get_traced_memory()[1] < 1e8
    finally:
        tracemalloc.stop()
