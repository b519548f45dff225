"""The conformance data as tests: the cases that `semstab-bench conform` gives to a program, with the same sentences."""

from __future__ import annotations

import functools

import pytest

from semstab.conformance import (
    AT_FACES,
    LONG,
    OF_SCANS,
    as_rows,
    case_folder,
    case_names,
    expected_table,
    likely_cause,
    read_case,
)
from semstab.data.voxels import VoxelTable
from semstab.testing.builders import BackendTests, assert_same_map, share_that_differs


class CaseTests(BackendTests):
    """Each case of the conformance data."""

    @pytest.mark.parametrize("case", case_names())
    def test_case(self, case: str) -> None:
        """The map of the case's frames is the case's table, in every column."""
        if case in LONG and not self.long_cases:
            pytest.skip(f"{case} has very many frames; long_cases = True runs it")
        if case in OF_SCANS and not self.scans:
            pytest.skip("scans = False: this backend fuses images alone")
        if self.voxel_share and case in AT_FACES:
            pytest.skip("this backend may decide otherwise at a face")
        table, expected = self.fuse_case(case), expected_table(case)
        if not self.voxel_share or share_that_differs(table, expected, self.tolerance) > self.voxel_share:
            voxel_size, K, frames = read_case(case_folder(case))
            cause = functools.partial(likely_cause, voxel_size, K, frames, as_rows(expected), as_rows(table))
            assert_same_map(table, expected, self.tolerance, cause=cause)

    def fuse_case(self, case: str) -> VoxelTable:
        """Return the map of a case's frames."""
        voxel_size, num_classes, frames = read_case(case_folder(case))
        return self.fuse(*frames, voxel_size=voxel_size, K=num_classes)
