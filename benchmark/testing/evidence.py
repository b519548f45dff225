"""What counts, and how much: scenes so small that the measures stand beside them, worked out by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from semstab.metrics import dominant, entropy, sbd, vss
from semstab.testing.base import BackendTests
from semstab.testing.builders import H_THIRD, JS_HALF, only, sight_line, voxels


class EvidenceTests(BackendTests):
    """What one voxel learns from the pixels and frames that fall into it."""

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
        """e = (0, 1, 1): classes 1 and 2 tie, and 1 is the dominant one."""
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
        """In a 16-bit map 255 is a class like any other."""
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
