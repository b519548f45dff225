"""Tests of the tests: backends that are right on small data, each wrong in one place, and the case that finds each.

The conformance data find them as `conform` reads a program's table, and as the pytest class runs the same case.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import sys
from unittest.mock import patch

import numpy as np
import pytest
from corners import combination
from typer.testing import CliRunner

from semstab.backends.numpy_reference import NumpyReference
from semstab.backends.shared import association
from semstab.cli import app
from semstab.conformance import LONG, case_folder, case_names, compared, expected_table, read_case, write_rows
from semstab.testing import BackendConformance

POINTS = association._points
MUTANTS = []


def found_by(case):
    """Name the conformance case that must find the defect."""

    def register(cls):
        MUTANTS.append(pytest.param(cls, case, id=cls.__name__))
        return cls

    return register


class Mutant(NumpyReference):
    """The reference, with a place for each defect."""

    def integrate(self, frame):
        return super().integrate(self.read(frame))

    def read(self, frame):
        """Return the frame as it is fused."""
        return frame

    def points(self, frame, pixels):
        """Yield world coordinates (3, n)."""
        return POINTS(frame, pixels)

    def index(self, points, voxel_size, frame):
        """Return the voxels (3, n) of points."""
        return np.floor(points / voxel_size).astype(np.int64)

    def observed(self, observations, frame):
        """Return what a frame observes."""
        return observations

    def drift(self, drift, log):
        """Return the drift (m,) of each observation."""
        return drift

    def finished(self, table):
        """Return the table, with other columns."""
        return table

    def _observe(self, frame):
        with patch.multiple(association, _points=self.points, voxel_index=self.index):
            return self.observed(super()._observe(frame), frame)

    def table(self):
        log = self.events()
        drift = np.bincount(log.voxel, self.drift(log.drift(), log), minlength=len(log.ix))
        return self.finished(dataclasses.replace(log.table(), drift_sum=drift))


def replaced(table, **columns):
    return dataclasses.replace(table, **columns)


def no_depth(frame, pixels):
    """The frame without depth at some pixels (H, W)."""
    return dataclasses.replace(frame, depth=np.where(pixels, np.float32(0), frame.depth))


def rows(frame):
    return np.broadcast_to(np.arange(frame.shape[0])[:, None], frame.shape)


# --- Many frames, many pixels -----------------------------------------------------------------------------------------


@found_by("frames_255")
class OpSaturatesAt255(Mutant):
    def finished(self, table):
        return replaced(table, op=np.minimum(table.op, 255))


@found_by("frames_255")
class OpWrapsAt256(Mutant):
    def finished(self, table):
        return replaced(table, op=table.op % 256)


@found_by("frames_65536")
class OpSaturatesAt65535(Mutant):
    def finished(self, table):
        return replaced(table, op=np.minimum(table.op, 65535))


@found_by("frames_65536")
class LastFrameIn16Bits(Mutant):
    def finished(self, table):
        return replaced(table, last_frame=table.last_frame % 65536)


@found_by("frames_255")
class NoDriftAfter255Frames(Mutant):
    def drift(self, drift, log):
        return np.where(np.arange(len(log)) - log.starts[log.voxel] < 255, drift, 0)


@found_by("frames_255")
class ForgetsOldEvidence(Mutant):
    def finished(self, table):
        return replaced(table, evidence=np.minimum(table.evidence[:], 99.5))


@found_by("frames_255")
class SumsInFloat32(Mutant):
    def finished(self, table):
        return replaced(table, evidence=table.evidence[:].astype(np.float32))


@found_by("pixels_1000")
class OpPlus2Above1000Pixels(Mutant):
    def finished(self, table):
        log = self.events()
        crowded = np.bincount(log.voxel, log.pixels > 1000, minlength=len(table)).astype(int)
        return replaced(table, op=table.op + 2 * crowded)


@found_by("pixels_1000")
class AtMost1000PixelsOfAFrame(Mutant):
    def observed(self, observations, frame):
        return dataclasses.replace(observations, pixels=np.minimum(observations.pixels, 1000))


@found_by("pixels_65536")
class PixelsOfAFrameIn16Bits(Mutant):
    def observed(self, observations, frame):
        return dataclasses.replace(observations, pixels=observations.pixels % 65536)


@found_by("pixels_65536")
class CountsOfAClassSaturate(Mutant):
    def observed(self, observations, frame):
        count = np.minimum(observations.s_bar * observations.pixels[:, None], 21930)
        return dataclasses.replace(observations, s_bar=count / count.sum(axis=1, keepdims=True))


# --- Many classes -----------------------------------------------------------------------------------------------------


class KeepsSomeClasses(Mutant):
    classes_kept = 0

    def finished(self, table):
        evidence = table.evidence[:].copy()
        evidence[np.argsort(np.argsort(-evidence, axis=1, kind="stable"), axis=1) >= self.classes_kept] = 0
        return replaced(table, evidence=evidence)


@found_by("classes_41")
class KeepsFiveClasses(KeepsSomeClasses):
    classes_kept = 5


@found_by("classes_41")
class KeepsFortyClasses(KeepsSomeClasses):
    classes_kept = 40


@found_by("classes_300")
class Keeps255Classes(KeepsSomeClasses):
    classes_kept = 255


@found_by("classes_300")
class LabelsIn8Bits(Mutant):
    def read(self, frame):
        return dataclasses.replace(frame, labels=frame.labels % 256)


# --- Large maps and images --------------------------------------------------------------------------------------------


@found_by("voxels_4096")
class FirstEvidenceOverwrittenAbove4096Voxels(Mutant):
    def finished(self, table):
        log = self.events()
        lost = np.where((table.op > 1) & (len(table) > 4096), 1.0, 0.0)
        return replaced(table, evidence=table.evidence[:] - lost[:, None] * log.evidence[log.starts])


@found_by("voxels_65536")
class HoldsAtMost65536Voxels(Mutant):
    def finished(self, table):
        return table.rows(np.arange(min(len(table), 65536)))


@found_by("voxels_65536")
class RowOfAVoxelIn16Bits(Mutant):
    def finished(self, table):
        wrong = np.arange(len(table)) % 65536
        return replaced(table, first_frame=table.first_frame[wrong], op=table.op[wrong])


class LeavesOutRows(Mutant):
    most = 0

    def read(self, frame):
        return no_depth(frame, rows(frame) >= self.most)


@found_by("images_4096")
class LeavesOutRowsFrom64(LeavesOutRows):
    most = 64


@found_by("images_4096")
class LeavesOutRowsFrom256(LeavesOutRows):
    most = 256


@found_by("images_4096")
class LeavesOutRowsFrom4096(LeavesOutRows):
    most = 4096


@found_by("images_4096")
class LeavesOutColumnsFrom4096(Mutant):
    def read(self, frame):
        return no_depth(frame, np.broadcast_to(np.arange(frame.shape[1]) >= 4096, frame.shape))


# --- Range and digits -------------------------------------------------------------------------------------------------


@found_by("ranges")
class IgnoresDepthBeyond100Metres(Mutant):
    def read(self, frame):
        return no_depth(frame, frame.depth > 100)


@found_by("ranges")
class IgnoresDepthBeyond5Kilometres(Mutant):
    def read(self, frame):
        return no_depth(frame, frame.depth > 5000)


@found_by("near")
class IgnoresDepthBelow2Millimetres(Mutant):
    def read(self, frame):
        return no_depth(frame, frame.depth < 0.002)


@found_by("near")
class DepthInWholeMillimetres(Mutant):
    def read(self, frame):
        return dataclasses.replace(frame, depth=np.round(frame.depth, 3))


@found_by("rays")
class RaysInFloat32(Mutant):
    def points(self, frame, pixels):
        K, (v, u) = frame.intrinsics, np.nonzero(pixels)
        d = frame.depth[v, u].astype(float)
        x, y = (np.float32((u - K.cx) / K.fx) * d, np.float32((v - K.cy) / K.fy) * d)
        R, t = frame.T_wc[:3, :3], frame.T_wc[:3, 3]
        yield np.stack([((R[i, 0] * x + R[i, 1] * y) + R[i, 2] * d) + t[i] for i in range(3)])


class OtherRays(Mutant):
    """Another product of a ray and depth, of which each is right but for its last digit."""

    def product(self, pixels, f, d):
        """Return x or y (n,) from pixels less the principal point, focal length and depth."""
        raise NotImplementedError

    def points(self, frame, pixels):
        K, (v, u) = frame.intrinsics, np.nonzero(pixels)
        d = frame.depth[v, u].astype(float)
        x, y = self.product(u - K.cx, K.fx, d), self.product(v - K.cy, K.fy, d)
        R, t = frame.T_wc[:3, :3], frame.T_wc[:3, 3]
        yield np.stack([((R[i, 0] * x + R[i, 1] * y) + R[i, 2] * d) + t[i] for i in range(3)])


@found_by("quotients")
class TimesOneOverTheFocalLength(OtherRays):
    def product(self, pixels, f, d):
        return pixels * (1 / f) * d


@found_by("quotients")
class DepthBeforeTheFocalLength(OtherRays):
    def product(self, pixels, f, d):
        return pixels * d / f


@found_by("quotients")
class RaysInExtendedPrecision(OtherRays):
    def product(self, pixels, f, d):
        return (pixels.astype(np.longdouble) / f * d).astype(float)


@found_by("rays")
class IntrinsicsInFloat32(Mutant):
    def read(self, frame):
        K = frame.intrinsics
        camera = type(K)(*(float(np.float32(x)) for x in (K.fx, K.fy, K.cx, K.cy)))
        return dataclasses.replace(frame, intrinsics=camera)


@found_by("utm")
class PosesInFloat32(Mutant):
    def read(self, frame):
        T_wc = frame.T_wc.copy()
        T_wc[:3, 3] = np.float32(T_wc[:3, 3])
        return dataclasses.replace(frame, T_wc=T_wc)


@found_by("utm_faces")
class AnEpsilonBeforeTheFloor(Mutant):
    def index(self, points, voxel_size, frame):
        return super().index(points + 1e-8, voxel_size, frame)


@found_by("utm_faces")
class CoordinatesInMicrometres(Mutant):
    def index(self, points, voxel_size, frame):
        return super().index(np.round(points, 6), voxel_size, frame)


@found_by("decimal_faces")
class TimesOneOverTheVoxelSize(Mutant):
    def index(self, points, voxel_size, frame):
        return np.floor(points * (1 / voxel_size)).astype(np.int64)


class OriginInMetres(Mutant):
    """An origin is subtracted in metres, and added again as voxels."""

    origin = None

    def index(self, points, voxel_size, frame):
        if self.origin is None:
            self.origin = self.chosen(frame.T_wc[:3, 3:], voxel_size)
        there = np.round(self.origin / voxel_size).astype(np.int64)
        return super().index(points - self.origin, voxel_size, frame) + there

    def chosen(self, position, voxel_size):
        """Return the origin (3, 1), metres, from the position of the first camera."""
        raise NotImplementedError


@found_by("utm_origins")
class OriginInTheVoxelOfTheFirstCamera(OriginInMetres):
    def chosen(self, position, voxel_size):
        return np.floor(position / voxel_size) * voxel_size


@found_by("utm_origins")
class OriginInWholeMetres(OriginInMetres):
    def chosen(self, position, voxel_size):
        return np.floor(position)


@found_by("utm_origins")
class OriginInWholeKilometres(OriginInMetres):
    def chosen(self, position, voxel_size):
        return np.floor(position / 1000) * 1000


@found_by("frame_numbers")
class FrameNumbersInFloat32(Mutant):
    def finished(self, table):
        first, last = (np.float32(x).astype(float) for x in (table.first_frame, table.last_frame))
        return replaced(table, first_frame=first, last_frame=np.minimum(last, 2**31 - 1))


# --- Evidence, drift and sums -----------------------------------------------------------------------------------------


@found_by("alike")
class DriftBelow1e6IsZero(Mutant):
    def drift(self, drift, log):
        return np.where(drift < 1e-6, 0, drift)


@found_by("alike")
class DriftOnlyWhereTheClassChanges(Mutant):
    def drift(self, drift, log):
        label = log.evidence[:].argmax(axis=1)
        return np.where(label != np.roll(label, 1), drift, 0)


@found_by("small_scores")
class DropsScoresBelowATenthOfAPercent(Mutant):
    def read(self, frame):
        return dataclasses.replace(frame, scores=np.where(frame.scores < 0.001, 0, frame.scores))


@found_by("small_scores")
class ScoresInHalfPrecision(Mutant):
    def read(self, frame):
        return dataclasses.replace(frame, scores=frame.scores.astype(np.float16))


@found_by("small_scores")
class NoScoreIsBelowAMillionth(Mutant):
    def observed(self, observations, frame):
        return dataclasses.replace(observations, s_bar=np.where(observations.s_bar < 1e-6, 0, observations.s_bar))


@found_by("labels_then_scores")
class ScoresAfterLabelsAreTheirLikeliestClass(Mutant):
    def observed(self, observations, frame):
        if frame.scores is None or not self._history:
            return observations
        return dataclasses.replace(observations, s_bar=np.eye(self.num_classes)[observations.s_bar.argmax(axis=1)])


@found_by("labels_then_scores")
class LabelsAfterScoresAreSmoothed(Mutant):
    soft = False

    def observed(self, observations, frame):
        self.soft |= frame.scores is not None
        smooth = 1e-3 if self.soft and frame.scores is None else 0
        return dataclasses.replace(observations, s_bar=observations.s_bar * (1 - smooth) + smooth / self.num_classes)


@found_by("scores")
class SelfSumIsOp(Mutant):
    def finished(self, table):
        return replaced(table, self_sum=table.op)


@found_by("scores")
class FrameEntropyInNats(Mutant):
    def finished(self, table):
        return replaced(table, frame_entropy_sum=table.frame_entropy_sum * math.log(2))


@found_by("gaps")
class FirstFrameIsTheFirstFused(Mutant):
    def finished(self, table):
        log = self.events()
        return replaced(table, first_frame=log.frame[log.starts])


@found_by("gaps")
class LastFrameIsTheLastFused(Mutant):
    def finished(self, table):
        log = self.events()
        return replaced(table, last_frame=log.frame[log.ends - 1])


# --- The tests --------------------------------------------------------------------------------------------------------


@functools.cache
def fused(mutant, case):
    """The frames of a case, fused."""
    voxel_size, num_classes, frames = read_case(case_folder(case))
    backend = mutant(voxel_size, num_classes)
    for frame in frames:
        backend.integrate(frame)
    return backend


@functools.cache
def table_of(mutant, case):
    """The table of a case's frames; what changes only the table has the log of the reference, or the expected table."""
    if case in LONG:
        return mutant(1.0, 3).finished(expected_table(case))
    if any(getattr(mutant, step) is not getattr(Mutant, step) for step in ("read", "points", "index", "observed")):
        return fused(mutant, case).table()
    backend = mutant(*(getattr(fused(Mutant, case), name) for name in ("voxel_size", "num_classes")))
    vars(backend).update(vars(fused(Mutant, case)))
    return backend.table()


def suite(mutant):
    """The pytest class for a backend."""

    class Suite(BackendConformance):
        long_cases = True

        def create(self, voxel_size, num_classes):
            return mutant(voxel_size, num_classes)

        def fuse_case(self, case):
            return table_of(mutant, case)

    return Suite()


FIRST = {param.values[1]: param for param in reversed(MUTANTS)}
ONCE = [FIRST[case] for case in ("frames_65536", "voxels_65536")]
"""Found by the data alone: these cases are large, and another mutant of each is found by the suite."""


@pytest.mark.parametrize(
    ("mutant", "case"),
    [pytest.param(*p.values, id=p.id, marks=combination if p in ONCE else ()) for p in FIRST.values()],
)
def test_a_subtle_defect_is_found_by_the_data(mutant, case, tmp_path):
    write_rows(tmp_path / "table.csv", table_of(mutant, case))
    assert "voxel" in compared(case_folder(case), tmp_path / "table.csv")


@pytest.mark.parametrize(("mutant", "case"), [param for param in MUTANTS if param not in ONCE])
def test_a_subtle_defect_is_found_by_the_suite(mutant, case, monkeypatch):
    if case.startswith(("frames_", "voxels_", "pixels_")):  # large: their likely causes are tried by the data above
        monkeypatch.setattr("semstab.testing.cases.likely_cause", lambda *_: "")
    with pytest.raises(AssertionError, match=r"the voxel \(.*\) (is .*, expected|is missing|should not be there)"):
        suite(mutant).test_case(case)


@pytest.mark.parametrize("case", sorted({param.values[1] for param in MUTANTS} - {*LONG}))
def test_without_a_defect_the_data_are_passed(case):
    suite(Mutant).test_case(case)


def test_every_kind_of_defect_has_a_mutant():
    assert len(MUTANTS) >= 40
    assert {param.values[1] for param in MUTANTS} <= {*case_names()}


# --- The likely cause, in words ---------------------------------------------------------------------------------------


class Rounds(Mutant):
    def index(self, points, voxel_size, frame):
        return np.floor(points / voxel_size + 0.5).astype(np.int64)


class Truncates(Mutant):
    def index(self, points, voxel_size, frame):
        return np.trunc(points / voxel_size).astype(np.int64)


class AppliesWorldToCamera(Mutant):
    def read(self, frame):
        return dataclasses.replace(frame, T_wc=np.linalg.inv(frame.T_wc))


class PositionsInFloat32(Mutant):
    def points(self, frame, pixels):
        yield from (points.astype(np.float32) for points in POINTS(frame, pixels))

    def index(self, points, voxel_size, frame):
        return np.floor(points.astype(np.float32) / np.float32(voxel_size)).astype(np.int64)


class CountsPixels(Mutant):
    def observed(self, observations, frame):
        return dataclasses.replace(observations, s_bar=observations.s_bar * observations.pixels[:, None])


class OpByPixel(Mutant):
    def finished(self, table):
        return replaced(table, op=table.pixels)


class ClassAxisFirst(Mutant):
    def read(self, frame):
        if frame.scores is None:
            return frame
        H, W, K = frame.scores.shape
        return dataclasses.replace(frame, scores=frame.scores.reshape(K, H, W).transpose(1, 2, 0))


class ClassesReversed(Mutant):
    def finished(self, table):
        return replaced(table, evidence=table.evidence[:][:, ::-1])


@pytest.mark.parametrize(("kind", "case", "words"), [
    (Rounds, "random", "half a voxel off; take floor"),
    (Truncates, "negative", "cut towards zero; take floor"),
    (AppliesWorldToCamera, "random", "world to camera"),
    (PositionsInFloat32, "utm", "float32"),
    (CountsPixels, "pixels_of_one_frame", "pixels are counted, not averaged"),
    (OpByPixel, "pixels_of_one_frame", "OP counts pixels"),
    (ClassAxisFirst, "random_scores", "the class axis is exchanged"),
    (ClassesReversed, "random", "classes are exchanged"),
])  # fmt: skip
def test_a_failure_says_the_likely_cause(kind, case, words, tmp_path) -> None:
    voxel_size, K, frames = read_case(case_folder(case))
    backend = kind(voxel_size, K)
    for frame in frames:
        backend.integrate(frame)
    write_rows(tmp_path / "table.csv", backend.table())
    assert re.search(f"; likely: .*{words}", compared(case_folder(case), tmp_path / "table.csv"))


def test_another_defect_has_no_likely_cause(tmp_path) -> None:
    table = expected_table("random")
    write_rows(tmp_path / "table.csv", replaced(table, drift_sum=table.drift_sum + 1))
    assert "likely" not in compared(case_folder("random"), tmp_path / "table.csv")


# --- Backends that leave something out --------------------------------------------------------------------------------


class LabelsAlone(NumpyReference):
    def integrate(self, frame):
        assert frame.scores is None
        assert not frame.is_scan
        return super().integrate(frame)


class TestLabelsAlone(BackendConformance):
    """What it does not take is skipped, also on random frames, and nothing fails."""

    scans = scores = False

    def create(self, voxel_size, num_classes):
        return LabelsAlone(voxel_size, num_classes)


def test_conform_says_what_is_not_covered() -> None:
    cases = [word for name in ("one_pixel", "scores", "scan_scores", "scan") for word in ("--only", name)]
    program = f"{sys.executable} -m semstab.conformance.fuse numpy"
    done = CliRunner().invoke(app, ["conform", program, *cases, "--no-scans", "--no-scores"])
    assert done.stdout.splitlines() == [
        "one_pixel: the same",
        "scores: not covered, it has scores",
        "scan_scores: not covered, it has scans and scores",
        "scan: not covered, it has scans",
    ]
