"""Scans of points: voxels, evidence and errors, worked out by hand, and agreement with the reference."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import backends
from semstab.core.types import Float64
from semstab.data.frames import Frame
from semstab.errors import DataError
from semstab.testing.builders import BackendTests, assert_same_map, checks, only, share_that_differs, sight_line, voxels


def scan_of(index: int, points: Any, values: Any, at: Sequence[float] = (0, 0, 0)) -> Frame:
    """Return a scan of these points, whose sensor is not turned; values are labels, or scores of K classes."""
    T_wc = np.eye(4)
    T_wc[:3, 3] = at
    evidence = np.array(values)
    given: dict[str, Any] = {"scores": evidence.astype(np.float32)} if evidence.ndim == 2 else {"labels": evidence}
    return Frame(index, points=np.array(points, np.float32), T_wc=T_wc, **given)


def random_scans(seed: int, count: int = 3, K: int = 4, N: int = 700) -> list[Frame]:
    """Return scans of a sensor that wanders and turns in scattered points, some of them invalid.

    Every other one has soft scores.
    """
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    scans = []
    for index in range(count):
        T_wc = np.eye(4)
        T_wc[:3, :3] = Rotation.from_euler("xyz", rng.normal(0, 0.4, 3)).as_matrix()
        T_wc[:3, 3] = rng.normal(0, 0.5, 3)
        points = rng.normal(0, 2, (N, 3)).astype(np.float32)
        points[rng.random(N) < 0.1] = rng.choice([0, np.nan, np.inf])
        labels = rng.choice([*range(K), 255], size=N).astype(np.uint8)
        scores = rng.random((N, K), dtype=np.float32)
        given: dict[str, Any] = {"scores": scores} if index % 2 else {"labels": labels}
        scans.append(Frame(index, points=points, T_wc=T_wc, **given))
    return scans


class ScanTests(BackendTests):
    """Scans: what holds for the pixels of an image holds for points."""

    @pytest.fixture(autouse=True)
    def _fuses_scans(self, request: pytest.FixtureRequest) -> None:
        if not self.scans and request.function.__qualname__.startswith("ScanTests."):
            pytest.skip("scans = False: this backend fuses images alone")

    def test_the_voxel_of_a_point(self) -> None:
        """Sensor at (10, 0, 0) and points (0.5, -0.5, 0.5), (-0.5, 0.5, 1.5): voxels (10, -1, 0) and (9, 0, 1)."""
        table = self.fuse(scan_of(0, [(0.5, -0.5, 0.5), (-0.5, 0.5, 1.5)], [0, 2], at=(10, 0, 0)))
        assert voxels(table) == [(9, 0, 1), (10, -1, 0)]
        assert table.evidence[0] == self.near([0, 0, 1])
        assert table.evidence[1] == self.near([1, 0, 0])

    def test_points_of_one_scan_count_once(self) -> None:
        """Labels 0, 0, 1 of three points in a voxel are one observation (2/3, 1/3, 0)."""
        table = self.fuse(scan_of(0, [(0.2, 0.2, 0.2), (0.4, 0.4, 0.4), (0.6, 0.6, 0.6)], [0, 0, 1]))
        q = only(table)
        assert (table.op[q], table.pixels[q]) == (1, 3)
        assert table.evidence[q] == self.near([2 / 3, 1 / 3, 0])

    def test_scores_of_points_are_normalised(self) -> None:
        """Scores (2, 6, 0) count as (1/4, 3/4, 0), and (0, 0, 1) as such: the mean is (1/8, 3/8, 1/2)."""
        table = self.fuse(scan_of(0, [(0.2, 0.2, 0.2), (0.4, 0.4, 0.4)], [(2, 6, 0), (0, 0, 1)]))
        assert table.evidence[only(table)] == self.near([1 / 8, 3 / 8, 1 / 2])

    def test_invalid_points_are_ignored(self) -> None:
        """Points that are not finite, or at the sensor itself, count no more than those without a label."""
        bad = [(math.nan, 1, 1), (1, math.inf, 1), (1, 1, -math.inf), (0, 0, 0), (0.5, 0.5, 0.5)]
        table = self.fuse(scan_of(0, [*bad, (2.5, 0.5, 0.5)], [1, 1, 1, 1, 255, 0]))
        assert voxels(table) == [(2, 0, 0)]
        assert table.pixels.tolist() == [1]

    def test_a_scan_without_valid_points_changes_nothing(self) -> None:
        """Its report has no voxels, and the map stays as it was."""
        backend = self.create(1.0, 3)
        backend.integrate(scan_of(0, [(0.5, 0.5, 0.5)], [0]))
        report = backend.integrate(scan_of(1, [(math.nan, 0, 0)], [0]))
        assert (report.points, report.voxels, report.new_voxels) == (0, 0, 0)
        assert backend.table().op.tolist() == [1]

    def test_scans_and_images_in_one_map(self) -> None:
        """A pixel of label 0 and a point of label 1 in one voxel, one after the other: evidence (1, 1, 0)."""
        image, scan = sight_line(0, [(0.5, 0)]), scan_of(1, [(0.5, 0.5, 0.5)], [1])
        table = self.fuse(image, scan)
        assert table.op.tolist() == [2]
        assert table.evidence[only(table)] == self.near([1, 1, 0])

    def test_a_label_of_a_point_beyond_the_classes_is_refused(self) -> None:
        """It is an error, and the map stays as it was."""
        backend = self.create(1.0, 3)
        with pytest.raises(DataError, match="label"):
            backend.integrate(scan_of(4, [(0.5, 0.5, 0.5)], [3]))
        assert len(backend.table()) == 0

    def test_inputs_are_not_written_to(self) -> None:
        """Points, labels and scores are as before."""
        for scan in random_scans(3, 2):
            arrays: list[Any] = [scan.points, scan.T_wc, scan.labels if scan.scores is None else scan.scores]
            before = [array.copy() for array in arrays]
            self.fuse(scan, K=4)
            for array, old in zip(arrays, before, strict=True):
                np.testing.assert_array_equal(array, old)

    @checks
    @given(st.integers(0, 10_000))
    def test_scans_agree_with_the_reference(self, seed: int) -> None:
        """Random scans, of labels and of scores, give the reference's map."""
        scans = [scan for scan in random_scans(seed) if self.takes(scan)]
        table, reference = (
            self.fuse(*scans, voxel_size=0.4, K=4),
            backends.create("numpy", voxel_size=0.4, num_classes=4),
        )
        for scan in scans:
            reference.integrate(scan)
        expected = reference.table()
        if not self.voxel_share or share_that_differs(table, expected, self.tolerance) > self.voxel_share:
            assert_same_map(table, expected, self.tolerance)

    @checks
    @given(st.permutations(range(40)))
    def test_the_order_of_points_does_not_count(self, order: Sequence[int]) -> None:
        """The points of a scan in another order give the same map, but for rounding."""
        rng = np.random.default_rng(5)
        points: Float64 = rng.normal(0, 1, (40, 3))
        labels = rng.integers(0, 3, 40)
        table = self.fuse(scan_of(0, points, labels), voxel_size=0.7)
        other = self.fuse(scan_of(0, points[[*order]], labels[[*order]]), voxel_size=0.7)
        assert_same_map(table, other, self.tolerance)

    def test_an_organised_cloud_is_its_points(self) -> None:
        """Points (H, W, 3) with labels (H, W) are the same points in a row."""
        (scan,) = random_scans(11, 1)
        assert scan.points is not None
        assert scan.labels is not None
        grid = dataclasses.replace(
            scan,
            points=scan.points.reshape(20, 35, 3),
            labels=scan.labels.reshape(20, 35),
            depth=scan.depth.reshape(20, 35),
        )
        assert_same_map(self.fuse(grid, K=4), self.fuse(scan, K=4), self.tolerance)
