"""Labels that agree more and are worse: `compare` says so, with the truth's numbers if there is truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from corners import corners
from striped_floor import K, flight

import semstab


def floor(frame):
    """Coordinates (H, W) of the floor in metres."""
    v, u = np.mgrid[: frame.shape[0], : frame.shape[1]]
    x = (u - frame.intrinsics.cx) / frame.intrinsics.fx * frame.depth + frame.T_wc[0, 3]
    y = (v - frame.intrinsics.cy) / frame.intrinsics.fy * frame.depth + frame.T_wc[1, 3]
    return x, y


def by_place(frame, labels):
    """A class for each square of the floor, whatever is there."""
    x, y = (np.floor(c / 0.7).astype(int) for c in floor(frame))
    return (x * 7919 + y * 104729) % 11 % K


def frozen(frame, labels):
    """The true class, but for a third of the squares of the floor, which are wrong in all frames."""
    x, y = (np.floor(c / 0.7).astype(int) for c in floor(frame))
    true = np.floor(floor(frame)[0] / 0.9).astype(int) % K
    return np.where((x * 7919 + y * 104729) % 3 == 0, (true + 1) % K, true)


def merged(frame, labels):
    """Two classes are one."""
    return np.minimum(labels, 1)


STABLE_AND_WORSE = {"by place": by_place, "frozen": frozen, "merged": merged}


def run(change=None, truth=True, frames=12):
    """The result of a model that takes class 1 for 2 and 2 for 1 in some patches, or of its labels changed."""
    given = []
    for noisy, clean in zip(flight(frames, flicker=0.3, patch=5), flight(frames), strict=True):
        swapped = np.where(noisy.labels == clean.labels, clean.labels, np.array([0, 2, 1])[clean.labels])
        labels = swapped if change is None else change(noisy, swapped)
        K_wc = np.array([[50.0, 0, 40], [0, 50, 30], [0, 0, 1]])
        given.append(
            {"labels": labels.astype(np.uint8), "depth": noisy.depth, "intrinsics": K_wc, "T_wc": noisy.T_wc}
            | ({"truth": clean.labels} if truth else {})
        )
    return semstab.fuse(given, voxel_size=0.1, classes="abc", statistics=truth, model="new" if change else "old")


@pytest.fixture(scope="module")
def old():
    return {truth: run(truth=truth) for truth in (True, False)}


@pytest.mark.parametrize(
    ("name", "truth"),
    corners(itertools.product(STABLE_AND_WORSE, (True, False)),
            always=[*((name, True) for name in STABLE_AND_WORSE), ("merged", False)]),
)  # fmt: skip
def test_what_is_more_stable_and_less_right_is_said_to_be_so(old, name, truth):
    change = STABLE_AND_WORSE[name]
    found = semstab.compare(old[truth], run(change, truth))
    (alpha,) = (row for row in found.overall[0].contrasts if row.measure == "alpha")
    assert alpha.change == "better"
    first, *_ = found.cautions
    if truth:
        assert first.startswith("new is more stable and less right than old (accuracy (OP>=2) .")
        (accuracy,) = (row for row in found.overall[0].contrasts if row.measure == "accuracy_op2")
        assert f"accuracy (OP>=2) {f'{accuracy.other:.3f}'.lstrip('0')} against" in first
    else:
        assert first.endswith("not that they are right: no ground truth was compared")
    assert any("fewer classes" in text for text in found.cautions) == (change is merged)
    assert f"caution: {first}" in repr(found)


def steady(frame, labels):
    """The labels as they are."""
    return labels


def test_nothing_is_said_if_no_difference_is_shown(old):
    assert semstab.compare(old[True], run(steady)).cautions == ()
