"""Labels by tiles of the image: the same counts as the reference, whatever the noise, the sizes and the reach."""

from __future__ import annotations

import numpy as np
import pytest

import semstab
from semstab import backends
from semstab.backends.shared.tile_loops import NEAR

INTEGERS = ("ix", "iy", "iz", "op", "pixels", "first_frame", "last_frame")


def noisy_frame(rng: np.random.Generator, index: int, shape: tuple[int, int], far: float, K: int) -> semstab.Frame:
    """Depth that jumps from pixel to pixel, labels of which a third are salt, some pixels without either."""
    H, W = shape
    depth = (far * (0.2 + 0.8 * rng.random((H, 1)) * rng.random(W) ** 3)).astype(np.float32)
    depth[rng.random(shape) < 0.1] = 0
    labels = np.where(rng.random(shape) < 0.3, rng.integers(0, K, shape), 0)
    dtype = np.uint8 if index % 2 or far > 1000 else np.uint16
    labels[rng.random(shape) < 0.05] = np.iinfo(dtype).max  # ignored
    T_wc = np.eye(4)
    T_wc[:3, 3] = rng.normal(scale=0.3, size=3)
    camera = semstab.Intrinsics(W, W, W / 2, H / 2)
    return semstab.Frame(index=index, depth=depth, labels=labels.astype(dtype), intrinsics=camera, T_wc=T_wc)


@pytest.mark.parametrize(("shape", "far", "voxel_size", "K"), [
    ((37, 300), 5.0, 0.1, 3),
    ((16, 64), 50.0, 0.05, 150),
    ((17, 129), 3.0, 0.5, 7),
    ((1, 1), 3.0, 0.5, 7),
    ((33, 70), 4200.0, 0.1, 7),  # beyond 2^15 voxels from the camera: by the other path
])  # fmt: skip
def test_the_counts_are_those_of_the_reference(shape, far, voxel_size, K) -> None:
    rng = np.random.default_rng(5)
    made = {
        name: backends.create(name, voxel_size=voxel_size, num_classes=K, **options)
        for name, options in {"numpy": {}, "numba": {}, "open3d": {}}.items()
    }
    for index in range(4):
        frame = noisy_frame(rng, index, shape, far, K)
        reaches = (frame.depth / voxel_size).max()
        for backend in made.values():
            backend.integrate(frame)
    assert (reaches > NEAR) == (far > 1000)
    expected = made.pop("numpy").table()
    for backend in made.values():
        table = backend.table()
        for name in INTEGERS:
            np.testing.assert_array_equal(getattr(table, name), getattr(expected, name), err_msg=name)
        for name in ("evidence", "drift_sum", "self_sum", "frame_entropy_sum"):
            np.testing.assert_allclose(getattr(table, name), getattr(expected, name), atol=1e-11, err_msg=name)


def test_a_band_with_more_entries_than_it_has_room_for() -> None:
    """Every pixel is a voxel of its own: the first attempt has too little room."""
    rng = np.random.default_rng(6)
    frame = noisy_frame(rng, 0, (18, 3000), 4000.0, 20)
    tables = []
    for threads in (1, 2):
        backend = backends.create("numba", voxel_size=0.2, num_classes=20, threads=threads)
        backend.integrate(frame)
        tables.append(backend.table())
    reference = backends.create("numpy", voxel_size=0.2, num_classes=20)
    reference.integrate(frame)
    assert len(reference.table()) > 30_000
    for table in tables:
        np.testing.assert_array_equal(table.index, reference.table().index)
        np.testing.assert_array_equal(table.evidence, reference.table().evidence)
