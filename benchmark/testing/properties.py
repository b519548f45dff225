"""Evidence and its weight: scenes so small that the measures in their docstrings are worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semstab import backends
from semstab.data.frames import Frame, Intrinsics
from semstab.errors import DataError
from semstab.metrics import dominant, entropy, sbd, vss
from semstab.testing.builders import (
    H_THIRD,
    HITS,
    JS_HALF,
    LOOKING,
    SEQUENCES,
    BackendTests,
    Hit,
    Label,
    Voxel,
    as_frames,
    assert_same_map,
    checks,
    only,
    random_frames,
    share_that_differs,
    sight_line,
    voxels,
)


class EvidenceTests(BackendTests):
    """The evidence of one voxel from the pixels and frames that fall into it."""

    # --- Evidence -----------------------------------------------------------------------------------------------------

    def test_one_voxel_with_two_labels(self) -> None:
        """Label 0, then label 1: e = (1, 1, 0), p = (1/2, 1/2, 0), VSS 0.5, H = ln 2 / ln 3, SBD 0.31128 bits."""
        table = self.fuse(sight_line(0, [(0.5, 0)]), sight_line(1, [(0.5, 1)]))
        q = only(table)
        assert table.op[q] == 2
        assert table.evidence[q] == self.near([1, 1, 0])
        assert vss(table)[q] == self.near(0.5)
        assert sbd(table)[q] == self.near(JS_HALF)
        assert entropy(table)[q] == self.near(math.log(2) / math.log(3))

    def test_pixels_of_one_frame_count_once(self) -> None:
        """Labels 0, 0, 1 in one frame are one observation s_bar = (2/3, 1/3, 0), not three."""
        table = self.fuse(sight_line(0, [(0.2, 0), (0.4, 0), (0.6, 1)]))
        q = only(table)
        assert (table.op[q], table.pixels[q]) == (1, 3)
        assert table.evidence[q] == self.near([2 / 3, 1 / 3, 0])

    def test_each_frame_weighs_the_same(self) -> None:
        """Three pixels of label 0 in one frame weigh as much as one pixel of label 1 in the next: e = (1, 1, 0)."""
        table = self.fuse(sight_line(0, [(0.2, 0), (0.4, 0), (0.6, 0)]), sight_line(1, [(0.5, 1)]))
        q = only(table)
        assert (table.op[q], table.pixels[q]) == (2, 4)
        assert table.evidence[q] == self.near([1, 1, 0])

    def test_a_border_voxel_seen_once(self) -> None:
        """Pixels of one frame that disagree: OP = 1, yet VSS 0.5 and H = ln 2 / ln 3; SBD is undefined."""
        table = self.fuse(sight_line(0, [(0.2, 0), (0.4, 1)]))
        q = only(table)
        assert (table.op[q], table.drift_sum[q]) == (1, 0)
        assert vss(table)[q] == self.near(0.5)
        assert entropy(table)[q] == self.near(math.log(2) / math.log(3))
        assert math.isnan(sbd(table)[q])

    def test_drift_follows_the_accumulated_belief(self) -> None:
        """Labels 0, 1, 0: beliefs (1, 0), (1/2, 1/2), (2/3, 1/3), so SBD is the mean of two divergences.

        The second one has m = (7/12, 5/12) and is H(m) - (H(1/2, 1/2) + H(2/3, 1/3)) / 2, where
        H(m) = log2 12 - (7 log2 7 + 5 log2 5) / 12.
        """
        table = self.fuse(*(sight_line(t, [(0.5, label)]) for t, label in enumerate((0, 1, 0))))
        q = only(table)
        second = math.log2(12) - (7 * math.log2(7) + 5 * math.log2(5)) / 12 - (1 + H_THIRD) / 2
        assert table.drift_sum[q] == self.near(JS_HALF + second)
        assert sbd(table)[q] == self.near((JS_HALF + second) / 2)

    def test_drift_is_between_successive_observations_of_the_voxel(self) -> None:
        """Frames that do not see a voxel cause no drift there: it counts from frame 0 to frame 2."""
        table = self.fuse(sight_line(0, [(0.5, 0)]), sight_line(1, [(1.5, 2)]), sight_line(2, [(0.5, 1)]))
        assert voxels(table) == [(0, 0, 0), (0, 0, 1)]
        assert table.op.tolist() == [2, 1]
        assert table.drift_sum == self.near([JS_HALF, 0])

    def test_sums_over_frames(self) -> None:
        """s_bar (2/3, 1/3) and (1, 0): the sum of ||s_bar||^2 is 5/9 + 1, that of their entropies H(2/3, 1/3) + 0."""
        table = self.fuse(sight_line(0, [(0.2, 0), (0.4, 0), (0.6, 1)]), sight_line(1, [(0.5, 0)]))
        q = only(table)
        assert table.self_sum[q] == self.near(14 / 9)
        assert table.frame_entropy_sum[q] == self.near(H_THIRD)

    def test_dominant_class_is_the_lowest_on_ties(self) -> None:
        """Evidence (0, 1, 1): classes 1 and 2 tie, and 1 is the dominant one."""
        table = self.fuse(sight_line(0, [(0.5, 2)]), sight_line(1, [(0.5, 1)]))
        assert dominant(table).tolist() == [1]

    def test_small_disagreement_survives_many_frames(self) -> None:
        """300 observations (1/3, 2/3, 0) sum to (100, 200, 0), without the rounding of single precision."""
        frame = sight_line(0, [(0.2, 0), (0.4, 1), (0.6, 1)])
        table = self.fuse(*(dataclasses.replace(frame, index=t) for t in range(300)))
        assert table.evidence[only(table)] == self.near([100, 200, 0])

    # --- Which pixels count -------------------------------------------------------------------------------------------

    def test_invalid_depth_is_ignored(self) -> None:
        """Depth 0, negative, NaN or infinite is no depth."""
        bad = [(0.0, 1), (-0.5, 1), (math.nan, 1), (math.inf, 1), (-math.inf, 1)]
        table = self.fuse(sight_line(0, [*bad, (0.5, 0)]))
        assert voxels(table) == [(0, 0, 0)]
        assert table.pixels.tolist() == [1]
        assert table.evidence[0] == self.near([1, 0, 0])

    def test_ignored_labels_give_no_evidence(self) -> None:
        """The ignore id is 255 in 8-bit maps and 65535 in 16-bit maps: those pixels are not there at all."""
        for dtype, ignore in ((np.uint8, 255), (np.uint16, 65535)):
            table = self.fuse(sight_line(0, [(0.2, ignore), (0.4, 2), (1.5, ignore)], dtype=dtype))
            assert voxels(table) == [(0, 0, 0)]
            assert table.pixels.tolist() == [1]
            assert table.evidence[0] == self.near([0, 0, 1])

    def test_many_classes(self) -> None:
        """255 is a class like any other in a 16-bit map."""
        table = self.fuse(sight_line(0, [(0.5, 255), (1.5, 299), (2.5, 65535)], dtype=np.uint16), K=300)
        assert table.evidence.shape == (2, 300)
        assert dominant(table).tolist() == [255, 299]
        assert table.evidence.sum(axis=1) == self.near([1, 1])

    def test_soft_scores_are_normalised_per_pixel(self) -> None:
        """Scores (2, 6, 0) count as (1/4, 3/4, 0), and (0, 0, 0.1) as (0, 0, 1): the mean is (1/8, 3/8, 1/2)."""
        for dtype in (np.float16, np.float32, np.float64):
            table = self.fuse(sight_line(0, [(0.2, (2, 6, 0)), (0.4, (0, 0, 0.1))], dtype=dtype))
            assert table.evidence[only(table)] == self.near([1 / 8, 3 / 8, 1 / 2])

    def test_half_precision_scores_do_not_overflow(self) -> None:
        """60000 + 20000 is beyond float16, whose largest number is 65504; the pixel still counts as (3/4, 1/4, 0)."""
        table = self.fuse(sight_line(0, [(0.5, (60000, 20000, 0))], dtype=np.float16))
        assert table.evidence[only(table)] == self.near([3 / 4, 1 / 4, 0])

    def test_unusable_scores_are_ignored(self) -> None:
        """A pixel whose scores sum to 0, or hold NaN or infinity, is not there."""
        bad = [(0.2, (0, 0, 0)), (0.3, (1, math.nan, 0)), (0.4, (math.inf, 1, 0)), (1.5, (0, 0, 0))]
        table = self.fuse(sight_line(0, [*bad, (0.5, (1, 1, 0))], dtype=np.float32))
        assert table.pixels[only(table)] == 1
        assert table.evidence[only(table)] == self.near([1 / 2, 1 / 2, 0])


# The voxel of a pixel: cameras, the faces of voxels, coordinates far from the origin, and maps that grow.


class GeometryTests(BackendTests):
    """Each pixel in the voxel that its depth and pose put it into, however far and however many."""

    def test_pinhole_geometry(self) -> None:
        """A camera at (10.25, -19.75, 5.25) looks along x: its x axis is the world's y, its y axis the world's z.

        The intrinsics are fx = 2, fy = 4, cx = 1, cy = 2. Voxels have 0.5 m.
        Pixel (u, v) = (3, 0) at depth 8: x_c = (3-1)/2*8 = 8, y_c = (0-2)/4*8 = -4, z_c = 8.
        In the world x_w = (18.25, -11.75, 1.25), in voxel (36, -24, 2).
        Pixel (0, 2) at depth 2: x_c = -1, y_c = 0, z_c = 2, x_w = (12.25, -20.75, 5.25), in voxel (24, -42, 10).
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
        """Voxels q = floor(x_w / r): of 2^-k m the points -0.5, 0 and 0.5 m are faces, exactly."""
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
        """Voxels are as good as any as far as the backend reaches, by default to -2^31 and 2^31 - 1.

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


# Properties of any sequence, on those that hypothesis invents, and agreement with the reference.


class PropertyTests(BackendTests):
    """Properties that no order, shift, name or repetition may change."""

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
        frames = [frame for frame in random_frames(seed) if self.takes(frame)]
        reference = backends.create("numpy", voxel_size=0.4, num_classes=4)
        for frame in frames:
            reference.integrate(frame)
        table, expected = self.fuse(*frames, voxel_size=0.4, K=4), reference.table()
        if not self.voxel_share or share_that_differs(table, expected, self.tolerance) > self.voxel_share:
            assert_same_map(table, expected, self.tolerance)
