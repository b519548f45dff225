"""Rules beyond the numbers: tables and reports, maps and inputs that share nothing, errors that leave no trace."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given

from semstab.data.frames import Frame
from semstab.data.measures import RECURRENT
from semstab.data.results import FrameReport
from semstab.data.voxels import VoxelTable
from semstab.errors import ConfigError, DataError
from semstab.metrics import entropy, vss
from semstab.testing.builders import (
    JS_HALF,
    SEQUENCES,
    BackendTests,
    Hit,
    as_frames,
    assert_same_map,
    checks,
    only,
    random_frames,
    sight_line,
    voxels,
)


class ContractTests(BackendTests):
    """Guarantees to callers, whatever they pass in."""

    # --- Tables -------------------------------------------------------------------------------------------------------

    def test_first_and_last_frame(self) -> None:
        """The lowest and the highest index that saw the voxel; sequences may start anywhere and skip frames."""
        table = self.fuse(sight_line(7, [(0.5, 0), (1.5, 0)]), sight_line(12, [(0.5, 0)]), sight_line(13, [(2.5, 0)]))
        assert table.first_frame.tolist() == [7, 7, 13]
        assert table.last_frame.tolist() == [12, 7, 13]

    def test_frames_out_of_order(self) -> None:
        """Frames 5, 2, 9: first and last go by index, drift by the order of integration."""
        frames = [sight_line(5, [(0.5, 0)]), sight_line(2, [(0.5, 1)]), sight_line(9, [(0.5, 0)])]
        table = self.fuse(*frames)
        ordered = self.fuse(*(dataclasses.replace(frame, index=i) for i, frame in enumerate(frames)))
        q = only(table)
        assert (table.first_frame[q], table.last_frame[q], table.op[q]) == (2, 9, 3)
        assert table.drift_sum == self.near(ordered.drift_sum)

    def test_rows_are_sorted(self) -> None:
        """Rows are sorted by ix, then iy, then iz, whatever order the voxels came in."""
        starts = [(2.5, 0.5), (-0.5, 1.5), (2.5, -7.5), (-0.5, 0.5)]
        table = self.fuse(*(sight_line(t, [(9.5, 0), (0.5, 0)], start=(*xy, -5)) for t, xy in enumerate(starts)))
        corners = [(-1, 0), (-1, 1), (2, -8), (2, 0)]
        assert voxels(table) == [(x, y, z) for x, y in corners for z in (-5, 4)]

    def test_empty_map(self) -> None:
        """A map that has seen nothing has no rows, and K classes."""
        table = self.create(0.2, 5).table()
        assert (len(table), table.K, table.voxel_size) == (0, 5, 0.2)

    def test_a_frame_without_a_valid_pixel(self) -> None:
        """It is no error, reports zeros and leaves the map as it is; also as the first frame."""
        backend = self.create(1.0, 3)
        empty = sight_line(4, [(0.0, 0), (0.5, 255)])
        report = backend.integrate(empty)
        assert (report.frame, report.points, report.voxels, report.new_voxels, report.drift_sum) == (4, 0, 0, 0, 0)
        assert len(backend.table()) == report.map_voxels == 0
        backend.integrate(sight_line(5, [(0.5, 0)]))
        before = backend.table()
        assert backend.integrate(empty).map_voxels == 1
        assert_same_map(backend.table(), before, 0)

    def test_a_table_is_a_snapshot(self) -> None:
        """Further frames do not change a table taken earlier."""
        backend = self.create(1.0, 3)
        backend.integrate(sight_line(0, [(0.5, 0)]))
        table = backend.table()
        backend.integrate(sight_line(1, [(0.5, 1), (1.5, 1)]))
        assert (len(table), table.op[0], table.drift_sum[0]) == (1, 1, 0)
        assert table.evidence[0] == self.near([1, 0, 0])

    def test_tables_in_between_change_nothing(self) -> None:
        """A map is the same whether or not tables were taken on the way."""
        hits = [[(0.2, 0), (1.5, 1)], [(0.4, 1), (2.5, 2)], [(1.5, 1), (3.5, 0)], [(0.2, 0), (3.5, 2)]]
        backend = self.create(1.0, 3)
        for frame in as_frames(hits):
            backend.integrate(frame)
            backend.table()
        assert_same_map(backend.table(), self.fuse(*as_frames(hits)), 0)

    def test_two_maps_share_nothing(self) -> None:
        """Frames of one map do not show in another."""
        a, b = self.create(1.0, 3), self.create(1.0, 3)
        a.integrate(sight_line(0, [(0.5, 0)]))
        assert len(b.table()) == 0
        b.integrate(sight_line(3, [(0.5, 1), (1.5, 1)]))
        assert_same_map(a.table(), self.fuse(sight_line(0, [(0.5, 0)])), self.tolerance)
        assert_same_map(b.table(), self.fuse(sight_line(3, [(0.5, 1), (1.5, 1)])), self.tolerance)

    def test_events_hold_what_the_table_sums(self) -> None:
        """A backend that stores the log of observations stores the whole of it."""
        backend = self.create(1.0, 3)
        for frame in as_frames([[(0.2, 0), (0.4, 1), (1.5, 2)], [(0.5, 1)], [(1.5, 0), (2.5, 2)]]):
            backend.integrate(frame)
        if (events := backend.events()) is not None:
            assert len(events) == 5
            assert_same_map(events.table(), backend.table(), self.tolerance)

    # --- Inputs -------------------------------------------------------------------------------------------------------

    def test_inputs_are_not_modified(self) -> None:
        """A backend reads the caller's arrays and nothing more."""
        for frame in random_frames(0, count=2):
            labels, scores = frame.labels, frame.scores
            arrays = [frame.depth, frame.T_wc, *(a for a in (labels, scores) if a is not None)]
            copies = [array.copy() for array in arrays]
            self.fuse(frame, K=4)
            for array, copy in zip(arrays, copies, strict=True):
                np.testing.assert_array_equal(array, copy)

    def test_arrays_of_any_layout(self) -> None:
        """A strided view of every second pixel and a transposed (column-major) array fuse as packed copies do."""
        for frame in random_frames(1, count=2):
            strided = frame.every(2)
            packed = {
                name: None if array is None else np.ascontiguousarray(array)
                for name, array in (("depth", strided.depth), ("labels", strided.labels), ("scores", strided.scores))
            }
            columns = {name: None if array is None else np.asfortranarray(array) for name, array in packed.items()}
            expected = self.fuse(dataclasses.replace(strided, **packed), K=4)  # type: ignore[arg-type]
            assert int(expected.pixels.sum()) == np.count_nonzero(frame.valid[::2, ::2])
            assert_same_map(self.fuse(strided, K=4), expected, self.tolerance)
            transposed = dataclasses.replace(strided, **columns)  # type: ignore[arg-type]
            assert_same_map(self.fuse(transposed, K=4), expected, self.tolerance)

    # --- Errors -------------------------------------------------------------------------------------------------------

    @pytest.mark.parametrize("voxel_size", [0.0, -0.2, math.nan, math.inf])
    def test_voxel_size_must_be_positive(self, voxel_size: float) -> None:
        """A voxel has a size."""
        with pytest.raises(ConfigError):
            self.create(voxel_size, 3)

    def test_one_class_is_not_enough(self) -> None:
        """Entropy is divided by log K, so K = 1 has none."""
        with pytest.raises(ConfigError):
            self.create(0.2, 1)

    def test_a_label_outside_the_classes(self) -> None:
        """The error names the id, and the frame leaves nothing behind, although its first pixels were good."""
        self.assert_refused(sight_line(7, [(0.5, 1), (1.5, 1), (2.5, 5)]), r"\b5\b")

    def test_a_label_outside_the_classes_without_depth(self) -> None:
        """A pixel without depth is not there, whatever its label says."""
        table = self.fuse(sight_line(0, [(0.5, 1), (0.0, 5)]))
        assert voxels(table) == [(0, 0, 0)]

    def test_scores_of_another_number_of_classes(self) -> None:
        """Four scores a pixel do not fit a map of three classes."""
        self.assert_refused(sight_line(7, [(0.5, (1, 0, 0, 0))], dtype=np.float32), "4")

    def test_an_index_beyond_int32(self) -> None:
        """A point outside the range of voxels is an error that names the frame; the others are not fused either."""
        self.assert_refused(sight_line(7, [(0.5, 1), (1.5, 1)], start=(0.5, 0.5, 2.0**31 - 1)), "frame 7")
        self.assert_refused(sight_line(7, [(0.5, 1), (1.5, 1)], start=(0.5, -(2.0**31) - 1, 0.5)), "frame 7")

    def assert_refused(self, frame: Frame, message: str) -> None:
        """Assert that the frame is a DataError with that message, and leaves no trace in the map or its future."""
        first, later = sight_line(0, [(0.5, 0)]), sight_line(8, [(0.5, 1), (1.5, 2)])
        backend = self.create(1.0, 3)
        backend.integrate(first)
        with pytest.raises(DataError, match=message):
            backend.integrate(frame)
        assert_same_map(backend.table(), self.fuse(first), self.tolerance)
        assert backend.integrate(later).map_voxels == 2
        assert_same_map(backend.table(), self.fuse(first, later), self.tolerance)

    # --- Reports ------------------------------------------------------------------------------------------------------

    def test_report_of_a_frame(self) -> None:
        """Frame 1 meets voxel 0 again with another label, and voxel 1 for the first time with two pixels."""
        backend = self.create(1.0, 3)
        backend.integrate(sight_line(0, [(0.5, 0)]))
        report = backend.integrate(sight_line(1, [(0.5, 1), (1.2, 2), (1.4, 2), (0.0, 2)]))
        assert (report.frame, report.points, report.voxels, report.new_voxels, report.map_voxels) == (1, 3, 2, 1, 2)
        assert report.drift_sum == report.drift == self.near(JS_HALF)
        assert report.seconds >= 0

    def test_report_of_the_map(self) -> None:
        """Voxel 0 is seen in each of five frames, voxel 1 in the first: from frame 2 half the map is recurrent."""
        backend = self.create(1.0, 3)
        reports = [backend.integrate(sight_line(0, [(0.5, 0), (1.5, 1)]))]
        reports += [backend.integrate(sight_line(t, [(0.5, 0)])) for t in range(1, 5)]
        assert [report.map_voxels for report in reports] == [2, 2, 2, 2, 2]
        shares = [report.map_recurrent for report in reports]
        assert shares == self.near([0, 0, 0.5, 0.5, 0.5]) or all(map(math.isnan, shares))

    @checks
    @given(SEQUENCES)
    def test_reports_say_what_the_tables_say(self, sequence: list[list[Hit]]) -> None:
        """A report is the difference of the tables before and after, and the means of the one after."""
        backend = self.create(1.0, 3)
        before = backend.table()
        for frame in as_frames(sequence):
            report = backend.integrate(frame)
            after = backend.table()
            self.assert_report(report, before, after)
            before = after

    def assert_report(self, report: FrameReport, before: VoxelTable, after: VoxelTable) -> None:
        """Assert that counts and drift are differences; the means may be NaN, where a backend has none."""
        assert report.points == after.pixels.sum() - before.pixels.sum()
        assert report.voxels == after.op.sum() - before.op.sum()
        assert report.new_voxels == len(after) - len(before)
        assert report.drift_sum == self.near(after.drift_sum.sum() - before.drift_sum.sum())
        assert report.map_voxels == len(after)
        means = {
            "map_vss_all": vss(after),
            "map_entropy_all": entropy(after),
            "map_recurrent": after.op >= RECURRENT,
        }
        for name, values in means.items():
            reported = getattr(report, name)
            assert math.isnan(reported) or reported == self.near(values.mean()), name
