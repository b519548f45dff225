"""A map fused tile by tile is the map fused at once, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from semstab import backends
from semstab.errors import ConfigError
from semstab.model.extent import Extent
from semstab.model.voxels import VoxelTable
from semstab.testing import random_frames
from semstab.testing.builders import EXACT, SUMS, sight_line

K, SIZE = 4, 0.4


def fused(name: str, frames, within: Extent | None = None, **options) -> VoxelTable:
    backend = backends.create(name, voxel_size=SIZE, num_classes=K, within=within, **options)
    for frame in frames:
        backend.integrate(frame)
    return backend.table()


def assert_same_bits(part: VoxelTable, whole: VoxelTable) -> None:
    for name in ("ix", "iy", "iz", *EXACT, *SUMS):
        assert np.asarray(getattr(part, name)).tobytes() == np.asarray(getattr(whole, name)).tobytes(), name


@pytest.mark.parametrize("name", ["numpy", "numba", "open3d", "torch"])
def test_the_maps_of_tiles_are_the_parts_of_the_whole_map(name) -> None:
    """Whichever frame opens a tile's map; labels and soft scores, to the last bit."""
    frames = random_frames(3, count=4, K=K)
    whole = fused(name, frames)
    tiles = [Extent((x, y), (x + 16, y + 16)) for x in range(-16, 16, 16) for y in range(-16, 16, 16)]
    found = 0
    for tile in tiles:
        part = fused(name, frames, tile)
        assert_same_bits(part, whole.rows(tile.holds(whole.index.T)))
        found += len(part)
    assert found == len(whole) > 500


def test_a_frame_that_reaches_far_is_restricted_too() -> None:
    """Beyond 2^15 voxels from the camera pixels become voxels by another loop."""
    far = [sight_line(t, [(0.5, 1), (20000.5, 2), (20001.5, 0)], along="x") for t in range(2)]
    whole, part = fused("numba", far), fused("numba", far, Extent((50000, 0), (50003, 4)))
    assert 0 < len(part) < len(whole)
    assert_same_bits(part, whole.rows(Extent((50000, 0), (50003, 4)).holds(whole.index.T)))


def test_a_backend_that_looks_pixels_up_cannot_be_restricted() -> None:
    with pytest.raises(ConfigError, match="open3d-projective' does not associate pixel by pixel"):
        fused("open3d-projective", [], Extent((0, 0), (1, 1)))
    with pytest.raises(ConfigError, match="'numba' has no option 'within'"):
        fused("numba", [], "all")
