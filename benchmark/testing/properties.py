"""Properties of any sequence, on those that hypothesis invents, and agreement with the reference."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semstab import backends
from semstab.metrics import entropy, sbd, vss
from semstab.testing.base import BackendTests
from semstab.testing.builders import (
    HITS,
    SEQUENCES,
    Hit,
    Label,
    Voxel,
    as_frames,
    assert_same_map,
    checks,
    random_frames,
    share_that_differs,
    sight_line,
    voxels,
)


class PropertyTests(BackendTests):
    """What no order, shift, name or repetition may change."""

    @checks
    @given(SEQUENCES, st.integers(1, 4))
    def test_a_table_taken_between_frames_disturbs_nothing(self, sequence: list[list[Hit]], split: int) -> None:
        """After the first frames the map is that of these frames alone, and in the end that of the whole sequence."""
        backend = self.create(1.0, 3)
        frames = as_frames(sequence)
        for frame in frames[:split]:
            backend.integrate(frame)
        assert_same_map(backend.table(), self.fuse(*frames[:split]), self.tolerance)
        for frame in frames[split:]:
            backend.integrate(frame)
            backend.table()
        assert_same_map(backend.table(), self.fuse(*frames), self.tolerance)

    @checks
    @given(SEQUENCES, st.randoms(use_true_random=False))
    def test_the_order_of_frames_changes_only_drift(self, sequence: list[list[Hit]], random: Any) -> None:
        """Evidence, OP, pixels, and so VSS and entropy, do not depend on the order of integration."""
        frames = as_frames(sequence)
        shuffled = random.sample(frames, len(frames))
        assert_same_map(self.fuse(*shuffled), self.fuse(*frames), self.tolerance, leaving_out=["drift_sum"])

    @checks
    @given(HITS, st.randoms(use_true_random=False))
    def test_the_order_of_pixels_changes_nothing(self, hits: list[Hit], random: Any) -> None:
        """A frame is a set of pixels."""
        shuffled = random.sample(hits, len(hits))
        again = sight_line(1, [(0.5, 0)])
        assert_same_map(
            self.fuse(sight_line(0, shuffled), again), self.fuse(sight_line(0, hits), again), self.tolerance
        )

    @checks
    @given(SEQUENCES, st.tuples(*[st.integers(-1000, 1000)] * 3))
    def test_a_shift_by_whole_voxels_shifts_the_map(self, sequence: list[list[Hit]], shift: Voxel) -> None:
        """Translation moves the indices and nothing else."""
        start = (0.25 + shift[0] / 2, 0.25 + shift[1] / 2, shift[2] / 2)
        here = self.fuse(*(sight_line(t, h, start=(0.25, 0.25, 0)) for t, h in enumerate(sequence)), voxel_size=0.5)
        there = self.fuse(*(sight_line(t, h, start=start) for t, h in enumerate(sequence)), voxel_size=0.5)
        assert voxels(there) == [(x + shift[0], y + shift[1], z + shift[2]) for x, y, z in voxels(here)]
        assert_same_map(dataclasses.replace(there, ix=here.ix, iy=here.iy, iz=here.iz), here, self.tolerance)

    @checks
    @given(SEQUENCES, st.permutations([0, 1, 2]))
    def test_renaming_classes_permutes_evidence(self, sequence: list[list[Hit]], new: list[int]) -> None:
        """Class k called new[k]: column k of the evidence becomes column new[k], the measures stay."""
        names: dict[Label, int] = {**dict(enumerate(new)), 255: 255}
        table = self.fuse(*as_frames(sequence))
        renamed = self.fuse(*as_frames([[(depth, names[label]) for depth, label in hits] for hits in sequence]))
        assert_same_map(dataclasses.replace(renamed, evidence=renamed.evidence[:, new]), table, self.tolerance)

    @checks
    @given(SEQUENCES)
    def test_measures_stay_in_their_ranges(self, sequence: list[list[Hit]]) -> None:
        """SBD and H in [0, 1], VSS in [1/K, 1]; an observation is a distribution, so evidence sums to OP."""
        table = self.fuse(*as_frames(sequence))
        eps = self.tolerance
        drift = sbd(table)
        assert np.isnan(drift[table.op < 2]).all()
        assert ((drift[table.op >= 2] >= 0) & (drift[table.op >= 2] <= 1)).all()
        assert ((vss(table) >= 1 / 3 - eps) & (vss(table) <= 1 + eps)).all()
        assert ((entropy(table) >= 0) & (entropy(table) <= 1 + eps)).all()
        assert table.evidence.sum(axis=1) == self.near(table.op)
        assert ((table.op >= 1) & (table.pixels >= table.op)).all()
        assert (table.self_sum <= table.op + eps).all()

    @checks
    @given(HITS, st.integers(2, 6))
    def test_identical_frames_do_not_drift(self, hits: list[Hit], count: int) -> None:
        """The belief after the same observation again is the same belief."""
        once = self.fuse(sight_line(0, hits))
        table = self.fuse(*(sight_line(t, hits) for t in range(count)))
        assert voxels(table) == voxels(once)
        assert (table.op == count).all()
        assert table.drift_sum == self.near(np.zeros(len(table)))
        assert vss(table) == self.near(vss(once))
        assert entropy(table) == self.near(entropy(once))

    @checks
    @given(st.integers(0, 2**32 - 1))
    def test_agrees_with_the_reference(self, seed: int) -> None:
        """Every column and measure of every voxel, on random cameras, depth, labels and soft scores."""
        frames = random_frames(seed)
        reference = backends.create("numpy", voxel_size=0.4, num_classes=4)
        for frame in frames:
            reference.integrate(frame)
        table = self.fuse(*frames, voxel_size=0.4, K=4)
        assert share_that_differs(table, reference.table(), self.tolerance) <= self.voxel_share
