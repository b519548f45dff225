"""Where a pixel falls: cameras, the faces of voxels, coordinates far from the origin, and maps that grow."""

from __future__ import annotations

import numpy as np
import pytest

from semstab.errors import DataError
from semstab.metrics import dominant
from semstab.model.frames import Frame, Intrinsics
from semstab.testing.base import BackendTests
from semstab.testing.builders import LOOKING, sight_line, voxels


class GeometryTests(BackendTests):
    """Each pixel in the voxel that its depth and pose put it into, however far and however many."""

    def test_pinhole_geometry(self) -> None:
        """A camera at (10.25, -19.75, 5.25) looks along x: its x axis is the world's y, its y axis the world's z.

        With fx = 2, fy = 4, cx = 1, cy = 2, pixel (u, v) = (3, 0) at depth 8 lies at x_c = (3-1)/2*8 = 8,
        y_c = (0-2)/4*8 = -4, z_c = 8, so at x_w = (18.25, -11.75, 1.25): voxel (36, -24, 2) of 0.5 m.
        Pixel (0, 2) at depth 2: x_c = -1, y_c = 0, z_c = 2, x_w = (12.25, -20.75, 5.25): voxel (24, -42, 10).
        """
        depth = np.zeros((3, 4), dtype=np.float32)
        depth[0, 3], depth[2, 0] = 8, 2
        labels = np.zeros((3, 4), dtype=np.uint8)
        labels[0, 3] = 2
        T_wc = np.eye(4)
        T_wc[:3, :3], T_wc[:3, 3] = LOOKING["x"], (10.25, -19.75, 5.25)
        table = self.fuse(Frame(0, depth, Intrinsics(2, 4, 1, 2), T_wc, labels), voxel_size=0.5)
        assert voxels(table) == [(24, -42, 10), (36, -24, 2)]
        assert dominant(table).tolist() == [0, 2]

    def test_negative_coordinates_floor(self) -> None:
        """-0.01 m and 0.01 m lie in two voxels, -1 and 0: indices floor, they do not truncate. So on each axis."""
        for axis, name in enumerate("xyz"):
            start = [0.1, 0.1, 0.1]
            start[axis] = -1
            line = sight_line(0, [(0.75, 0), (0.99, 1), (1.01, 2)], start=start, along=name)
            table = self.fuse(line, voxel_size=0.2)
            assert table.index[:, axis].tolist() == [-2, -1, 0]
            assert dominant(table).tolist() == [0, 1, 2]

    def test_a_face_belongs_to_the_voxel_above(self) -> None:
        """q = floor(x_w / r): in voxels of 2^-k m the points -0.5, 0 and 0.5 m are faces, exactly."""
        for k in range(1, 8):
            table = self.fuse(sight_line(0, [(0.5, 0), (1, 0), (1.5, 0)], start=(0, 0, -1)), voxel_size=2.0**-k)
            assert table.iz.tolist() == [-(2 ** (k - 1)), 0, 2 ** (k - 1)]

    def test_a_face_of_decimal_voxels_is_where_float64_puts_it(self) -> None:
        """0.1 + 0.5 = 0.6 m is no face in float64: 0.6 / 0.2 = 2.9999999999999996, so voxel 2 (0.6 * 5 would be 3)."""
        if self.voxel_share:
            pytest.skip("this backend may decide otherwise at a face")
        table = self.fuse(sight_line(0, [(0.5, 0)], start=(0, 0, 0.1)), voxel_size=0.2)
        assert table.iz.tolist() == [2]

    def test_large_coordinates_keep_their_voxels(self) -> None:
        """Poses in UTM coordinates, 500 km east and 4000 km north, shift the map by whole voxels and change nothing.

        There, numbers of single precision are 0.25 m apart, more than a voxel.
        """
        hits = [(0.1 + 0.2 * i, i % 3) for i in range(20)]
        here = self.fuse(sight_line(0, hits, start=(0.1, 0, 0.1), along="y"), voxel_size=0.2)
        there = self.fuse(sight_line(0, hits, start=(5e5 + 0.1, 4e6, 0.1), along="y"), voxel_size=0.2)
        assert voxels(here) == [(0, i, 0) for i in range(20)]
        assert voxels(there) == [(2_500_000, 20_000_000 + i, 0) for i in range(20)]
        assert there.evidence == self.near(here.evidence)

    def test_the_outermost_voxels(self) -> None:
        """As far as the backend reaches, -2^31 and 2^31 - 1 if nothing else is said, voxels are as good as any.

        The next one is refused, and the map stays as it is.
        """
        frames = [sight_line(t, [(0.5, t)], start=(0, 0, z)) for t, z in enumerate((0, -self.reach, self.reach - 1))]
        backend = self.create(1.0, 3)
        for frame in frames:
            backend.integrate(frame)
        with pytest.raises(DataError, match="frame 3"):
            backend.integrate(sight_line(3, [(0.5, 0)], start=(0, 0, self.reach)))
        table = backend.table()
        assert table.iz.tolist() == [-self.reach, 0, self.reach - 1]
        assert dominant(table).tolist() == [1, 0, 2]

    def test_growth_keeps_earlier_voxels(self) -> None:
        """A map that outgrows its first allocation, many times over, forgets nothing: each voxel is seen twice."""
        passes = 2
        frames = [
            sight_line(t, [(i + 0.5, (i + line) % 3) for i in range(400)], start=(7 * line + 0.5, 0.5 - 5 * line, -200))
            for t, line in enumerate([*range(20)] * passes)
        ]
        table = self.fuse(*frames)
        assert voxels(table) == sorted((7 * line, -5 * line, i - 200) for line in range(20) for i in range(400))
        assert (table.op == passes).all()
        assert (table.first_frame == table.ix // 7).all()
        assert dominant(table).tolist() == ((table.iz + 200 + table.ix // 7) % 3).tolist()
        assert table.evidence.max(axis=1) == self.near(np.full(len(table), passes))
        assert table.drift_sum == self.near(np.zeros(len(table)))
