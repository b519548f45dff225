"""Tests of the tests: a backend that is wrong in one place fails the conformance test written for that place.

Each broken backend is the oracle, which passes the suite (`TestOracle` in test_backends.py), with one method changed.
"""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest
from oracle import Oracle

from semstab.errors import DataError
from semstab.testing import BackendConformance

BROKEN = []


def fails(test):
    """Names the conformance test that must find the defect."""

    def register(cls):
        BROKEN.append(pytest.param(dataclasses.dataclass(cls), test, id=cls.__name__))
        return cls

    return register


# --- World-space association ---


@fails("test_negative_coordinates_floor")
class Truncates(Oracle):
    def discretise(self, x):
        return int(x / self.voxel_size)


@fails("test_negative_coordinates_floor")
class RoundsToTheNearestVoxel(Oracle):
    def discretise(self, x):
        return round(x / self.voxel_size)


@fails("test_a_face_of_decimal_voxels_is_where_float64_puts_it")
class MultipliesByTheReciprocal(Oracle):
    def discretise(self, x):
        return math.floor(x * (1 / self.voxel_size))


@fails("test_large_coordinates_keep_their_voxels")
class PointsInSinglePrecision(Oracle):
    def discretise(self, x):
        return math.floor(float(np.float32(x)) / self.voxel_size)


@fails("test_an_index_beyond_int32")
class IndicesWrapAround(Oracle):
    def discretise(self, x):
        return (super().discretise(x) + 2**31) % 2**32 - 2**31


@fails("test_pinhole_geometry")
class DepthAlongTheRay(Oracle):
    def world_point(self, frame, u, v, d):
        K = frame.intrinsics
        return super().world_point(frame, u, v, d / math.hypot((u - K.cx) / K.fx, (v - K.cy) / K.fy, 1))


@fails("test_pinhole_geometry")
class PixelCornersAtIntegers(Oracle):
    def world_point(self, frame, u, v, d):
        return super().world_point(frame, u + 0.5, v + 0.5, d)


@fails("test_pinhole_geometry")
class PoseTransposed(Oracle):
    def world_point(self, frame, u, v, d):
        T_wc = frame.T_wc.copy()
        T_wc[:3, :3] = T_wc[:3, :3].T
        return super().world_point(dataclasses.replace(frame, T_wc=T_wc), u, v, d)


# --- Which pixels count ---


@fails("test_invalid_depth_is_ignored")
class TakesNegativeDepth(Oracle):
    def has_depth(self, d):
        return math.isfinite(d) and d != 0


@fails("test_ignored_labels_give_no_evidence")
class IgnoredIsClassZero(Oracle):
    def one_hot(self, frame, u, v):
        return super().one_hot(frame, u, v) or [1.0] + [0.0] * (self.num_classes - 1)


@fails("test_many_classes")
class Ignores255In16Bits(Oracle):
    def is_ignored(self, label, itemsize):
        return label in (255, 65535)


@fails("test_soft_scores_are_normalised_per_pixel")
class ScoresAsTheyCome(Oracle):
    def normalised(self, scores, total):
        return scores


@fails("test_half_precision_scores_do_not_overflow")
class SumsScoresInTheirOwnPrecision(Oracle):
    def normalised(self, scores, total):
        with np.errstate(over="ignore"):
            total = float(np.sum(scores, dtype=np.float16))
        return super().normalised(scores, total) if math.isfinite(total) else None


@fails("test_unusable_scores_are_ignored")
class ZeroScoresAreUniform(Oracle):
    def evidence(self, frame, u, v):
        if frame.scores is not None and not frame.scores[v, u].any():
            return [1 / self.num_classes] * self.num_classes
        return super().evidence(frame, u, v)


@fails("test_arrays_of_any_layout")
class ReadsMemoryInsteadOfTheArray(Oracle):
    def one_hot(self, frame, u, v):
        labels = frame.labels.ravel(order="K").reshape(frame.shape)
        return super().one_hot(dataclasses.replace(frame, labels=labels), u, v)


# --- Evidence ---


@fails("test_pixels_of_one_frame_count_once")
class EachPixelIsEvidence(Oracle):
    def average(self, vectors):
        return [sum(s[k] for s in vectors) for k in range(self.num_classes)]


@fails("test_pixels_of_one_frame_count_once")
class EachPixelIsAnObservation(Oracle):
    def observe(self, q, frame, vectors):
        for s in vectors:
            super().observe(q, frame, [s])


@fails("test_a_border_voxel_seen_once")
class MajorityVoteWithinAFrame(Oracle):
    def average(self, vectors):
        mean = super().average(vectors)
        return [1.0 if k == mean.index(max(mean)) else 0.0 for k in range(self.num_classes)]


@fails("test_each_frame_weighs_the_same")
class MeanOverAllPixels(Oracle):
    def accumulated(self, q):
        weights = [visit.pixels for visit in self.history[q]]
        mean = sum(weights) / len(weights)
        weighted = [[s * n / mean for s in visit.s_bar] for visit, n in zip(self.history[q], weights, strict=True)]
        return np.cumsum(weighted, axis=0).tolist()


@fails("test_small_disagreement_survives_many_frames")
class SumsInSinglePrecision(Oracle):
    def accumulated(self, q):
        return np.cumsum([visit.s_bar for visit in self.history[q]], axis=0, dtype=np.float32).tolist()


# --- Drift ---


@fails("test_one_voxel_with_two_labels")
class DriftInNats(Oracle):
    def divergence(self, p, q):
        return super().divergence(p, q) * math.log(2)


@fails("test_one_voxel_with_two_labels")
class DriftIsADistance(Oracle):
    def divergence(self, p, q):
        return math.sqrt(super().divergence(p, q))


@fails("test_drift_follows_the_accumulated_belief")
class DriftBetweenObservations(Oracle):
    def beliefs(self, q):
        return [visit.s_bar for visit in self.history[q]]


@fails("test_drift_follows_the_accumulated_belief")
class DriftFromTheFirstBelief(Oracle):
    def drift(self, q):
        p = self.beliefs(q)
        return sum(self.divergence(p[t], p[0]) for t in range(1, len(p)))


@fails("test_a_border_voxel_seen_once")
class DriftFromTheUniformBelief(Oracle):
    def drift(self, q):
        return super().drift(q) + self.divergence(self.beliefs(q)[0], [1 / self.num_classes] * self.num_classes)


# --- What the map remembers ---


@fails("test_first_and_last_frame")
class CountsFramesFromZero(Oracle):
    def first_frame(self, q):
        return super().first_frame(q) - min(visit.frame for log in self.history.values() for visit in log)


@fails("test_frames_out_of_order")
class FirstFrameIsTheFirstIntegrated(Oracle):
    def first_frame(self, q):
        return self.history[q][0].frame


@fails("test_growth_keeps_earlier_voxels")
class LosesVoxelsWhenItGrows(Oracle):
    """What stale views of the attributes look like: after growing, earlier voxels hold nothing."""

    def observe(self, q, frame, vectors):
        if q not in self.history and len(self.history) == 1024:
            self.history.clear()
        super().observe(q, frame, vectors)


@fails("test_two_maps_share_nothing")
class SharesItsHistory(Oracle):
    everyone = {}  # noqa: RUF012

    def __post_init__(self):
        super().__post_init__()
        self.history = self.everyone


@fails("test_a_table_is_a_snapshot")
class TableIsALiveView(Oracle):
    def table(self):
        self.live = super().table()
        return self.live

    def integrate(self, frame):
        report = super().integrate(frame)
        if (live := getattr(self, "live", None)) is not None:
            for row in range(len(live)):
                column = live.op.base
                column.setflags(write=True)
                column[row] = self.op(self.rows()[row])
        return report


@fails("test_a_table_taken_between_frames_disturbs_nothing")
class TableForgetsTheOrder(Oracle):
    def table(self):
        for log in self.history.values():
            log.reverse()
        return super().table()


@fails("test_rows_are_sorted")
class SortsFromTheWrongEnd(Oracle):
    def rows(self):
        return sorted(self.history, key=lambda q: q[::-1])


@fails("test_the_order_of_frames_changes_only_drift")
class LaterFramesWeighLess(Oracle):
    def average(self, vectors):
        return [s / (1 + len(self.history) / 10) for s in super().average(vectors)]


# --- Errors and reports ---


@fails("test_a_label_outside_the_classes")
class KeepsPartOfABadFrame(Oracle):
    def integrate(self, frame):
        try:
            return super().integrate(frame)
        except DataError:
            self.observe((0, 0, 0), frame, [[1.0, 0.0, 0.0]])
            raise


@fails("test_a_label_outside_the_classes")
class LabelsWrapAround(Oracle):
    def one_hot(self, frame, u, v):
        wrapped = np.where(frame.labels == 255, 255, frame.labels % self.num_classes).astype(np.uint8)
        return super().one_hot(dataclasses.replace(frame, labels=wrapped), u, v)


@fails("test_scores_of_another_number_of_classes")
class CutsSurplusScores(Oracle):
    def check(self, frame):
        pass


@fails("test_one_class_is_not_enough")
class AllowsOneClass(Oracle):
    def __post_init__(self):
        pass


@fails("test_a_frame_without_a_valid_pixel")
class RefusesEmptyFrames(Oracle):
    def integrate(self, frame):
        if not frame.valid.any():
            raise DataError("nothing to see")
        return super().integrate(frame)


@fails("test_report_of_a_frame")
class ReportsAllVoxelsAsNew(Oracle):
    def integrate(self, frame):
        report = super().integrate(frame)
        return dataclasses.replace(report, new_voxels=report.voxels)


@fails("test_reports_say_what_the_tables_say")
class ReportsTheMeanOfTheFrame(Oracle):
    def integrate(self, frame):
        report = super().integrate(frame)
        last = [q for q in self.history if self.last_frame(q) == frame.index]
        return dataclasses.replace(report, map_vss_all=sum(map(self.vss, last)) / len(last) if last else math.nan)


@pytest.mark.parametrize(("broken", "test"), BROKEN)
def test_a_broken_backend_fails(broken, test):
    class Suite(BackendConformance):
        def create(self, voxel_size, num_classes):
            return broken(voxel_size, num_classes)

    with pytest.raises((AssertionError, DataError, pytest.fail.Exception)):
        getattr(Suite(), test)()


def test_a_suite_needs_a_backend():
    with pytest.raises(NotImplementedError, match="how its backend is made"):
        BackendConformance().test_empty_map()


def test_without_hypothesis_the_error_says_what_to_install():
    code = "import sys; sys.modules['hypothesis'] = None; import semstab.testing"
    failed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    last_line = failed.stderr.strip().splitlines()[-1]
    assert last_line.startswith("semstab.errors.MissingDependencyError: semstab.testing cannot be used")
    assert last_line.endswith("pip install 'semstab[testing]'")
