"""The reference on a sample of the voxels: the same numbers as the whole reference, however thin the sample becomes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import semstab
from semstab.backends import numpy_reference
from semstab.backends.numpy_reference import NumpyReference, NumpySample, in_sample
from semstab.data.voxels import Extent

K = 5


def frames(seed: int, count: int = 5, size: tuple[int, int] = (24, 32)) -> list[semstab.Frame]:
    """Frames of a rough wall; a part of the pixels lies on faces of voxels."""
    rng = np.random.default_rng(seed)
    shape = size
    made = []
    for index in range(count):
        depth = rng.uniform(0.5, 3, shape).round(int(rng.integers(1, 4))).astype(np.float32)
        depth[rng.random(shape) < 0.1] = 0
        pose = np.eye(4)
        pose[:3, 3] = rng.integers(-2, 3, 3) * 0.25
        camera = semstab.Intrinsics(16.0, 16.0, 16.0, 12.0)
        labels = rng.integers(0, K, shape).astype(np.uint8)
        made.append(semstab.Frame(index, depth, camera, pose, labels=labels))
    return made


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([0.01, 0.05, 0.25]), st.booleans())
def test_the_sample_is_the_part_of_the_whole_reference_that_its_hash_draws(seed, voxel_size, part) -> None:
    within = Extent((-100, -100), (5, 7)) if part else None
    whole, sample = NumpyReference(voxel_size, K, within), NumpySample(voxel_size, K, within)
    for frame in frames(seed):
        whole.integrate(frame)
        sample.integrate(frame)
    expected = whole.table()
    expected, found = expected.rows(in_sample(expected.index.T, sample.one_in)), sample.table()
    np.testing.assert_array_equal(found.index, expected.index)
    for name in ("op", "pixels", "drift_sum"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(found.evidence[:], expected.evidence[:])


@pytest.mark.parametrize("one_in", [2, 8, 64])
def test_a_sample_of_one_in_many_is_that_share_and_part_of_a_thicker_one(one_in) -> None:
    index = np.stack(np.meshgrid(*[np.arange(-20, 20)] * 3, indexing="ij")).reshape(3, -1)
    drawn = in_sample(index, one_in)
    assert np.count_nonzero(drawn) == pytest.approx(index.shape[1] / one_in, rel=0.15)
    assert in_sample(index, one_in // 2)[drawn].all()


@pytest.mark.parametrize("most", [5, 40])
def test_a_sample_that_becomes_too_large_is_made_thinner_and_stays_exact(most, monkeypatch) -> None:
    monkeypatch.setattr(numpy_reference, "MOST", most)
    whole, sample = NumpyReference(0.05, K), NumpySample(0.05, K)
    for frame in frames(1, 12):
        whole.integrate(frame)
        sample.integrate(frame)
    assert sample.one_in > numpy_reference.ONE_IN
    found, expected = sample.table(), whole.table()
    assert 0 < len(found) <= most
    expected = expected.rows(in_sample(expected.index.T, sample.one_in))
    np.testing.assert_array_equal(found.index, expected.index)
    np.testing.assert_array_equal(found.evidence[:], expected.evidence[:])
    np.testing.assert_array_equal(found.op, expected.op)


@pytest.mark.parametrize(("allowed", "one_in"), [(60.0, 1), (0.0, 16)])
def test_all_voxels_are_fused_as_long_as_that_takes_less_time_than_the_backend(allowed, one_in) -> None:
    """A reference that is too slow becomes thinner, down to the usual sample and no further; it stays exact."""
    whole, sample = NumpyReference(0.05, K), NumpySample(0.05, K, whole=True)
    for frame in frames(2, 8):
        whole.integrate(frame)
        sample.integrate(frame, allowed)
    assert sample.one_in == one_in
    found, expected = sample.table(), whole.table()
    expected = expected.rows(in_sample(expected.index.T, one_in))
    np.testing.assert_array_equal(found.index, expected.index)
    np.testing.assert_array_equal(found.drift_sum, expected.drift_sum)
    np.testing.assert_array_equal(found.evidence[:], expected.evidence[:])


def test_a_map_that_is_too_large_is_not_fused_as_a_whole(monkeypatch) -> None:
    whole, sample = NumpyReference(0.05, K), NumpySample(0.05, K, whole=True)
    for frame in frames(1, 12):
        whole.integrate(frame)
    most = len(whole.table()) // 3
    monkeypatch.setattr(numpy_reference, "MOST_OF_ALL", most)
    for frame in frames(1, 12):
        sample.integrate(frame, 60.0)
    assert sample.one_in == 4
    assert 0 < len(sample.table()) <= most
