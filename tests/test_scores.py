"""Soft scores by tiles of the image and dense rows: as the reference has them, of any type, and mixed with labels."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numba
import numpy as np
import pytest

import semstab
from semstab import backends
from semstab.backends.shared.beliefs import observe_eights, plogp_eights
from semstab.backends.shared.score_loops import LANES
from semstab.errors import DataError
from semstab.testing import EXACT, SUMS, assert_same_map


def soft_frame(rng: np.random.Generator, index: int, K: int, dtype: str, shape: tuple[int, int] = (35, 150)):
    """Depth that jumps now and then, scores of all classes, some pixels without depth or without a prediction."""
    H, W = shape
    depth = (2 + np.floor(3 * rng.random((H, 1)) * rng.random(W) ** 3)).astype(np.float32)
    depth[rng.random(shape) < 0.1] = 0
    scores = rng.random((H, W, K)).astype(dtype)
    scores[rng.random(shape) < 0.05] = 0
    scores[rng.random(shape) < 0.02, K // 2] = np.nan
    T_wc = np.eye(4)
    T_wc[:3, 3] = rng.normal(scale=0.3, size=3)
    camera = semstab.Intrinsics(W, W, W / 2, H / 2)
    return semstab.Frame(index=index, depth=depth, scores=scores, intrinsics=camera, T_wc=T_wc)


def hard(frame: semstab.Frame) -> semstab.Frame:
    """Its likeliest labels."""
    return dataclasses.replace(frame, labels=frame.predicted, scores=None)


def cut(frame: semstab.Frame) -> semstab.Frame:
    """Its scores where they are the largest of the pixel, else 0: few classes a voxel."""
    assert frame.scores is not None
    return dataclasses.replace(frame, scores=np.where(frame.scores == frame.scores.max(2)[..., None], frame.scores, 0))


@pytest.mark.parametrize(("K", "dtype"), [(3, "float64"), (7, "float16"), (20, "float32"), (150, "float16")])
def test_scores_and_labels_in_turns_are_the_reference(K, dtype) -> None:
    """Voxels of labels become dense rows, and dense rows take labels and scores of few classes."""
    rng = np.random.default_rng(K)
    frames = [soft_frame(rng, index, K, dtype) for index in range(5)]
    frames = [hard(frames[0]), frames[1], cut(frames[2]), hard(frames[3]), frames[4]]
    made = {name: backends.create(name, voxel_size=0.3, num_classes=K) for name in ("numpy", "numba", "open3d")}
    for frame in frames:
        expected, *reports = (backend.integrate(frame) for backend in made.values())
        for report in reports:
            for what in ("points", "voxels", "new_voxels", "drift_sum", "map_vss_all", "map_entropy_all"):
                assert getattr(report, what) == pytest.approx(getattr(expected, what), abs=1e-9), what
    reference = made.pop("numpy").table()
    for backend in made.values():
        assert_same_map(backend.table(), reference, 1e-10)


def test_any_number_of_threads_gives_the_same_sums() -> None:
    tables = []
    for threads in (1, numba.config.NUMBA_NUM_THREADS):
        rng = np.random.default_rng(2)
        backend = backends.create("numba", voxel_size=0.1, num_classes=7, threads=threads)
        for index in range(3):
            backend.integrate(soft_frame(rng, index, 7, "float32"))
        tables.append(backend.table())
    for column in (*EXACT, *SUMS):
        np.testing.assert_array_equal(getattr(tables[0], column), getattr(tables[1], column), err_msg=column)


@pytest.mark.parametrize(("K", "shape"), [(2, (1, 1)), (3, (2, 9)), (20, (17, 7))])
def test_images_smaller_than_a_tile(K, shape) -> None:
    """The last pixels' scores are not read together with what lies behind them."""
    rng = np.random.default_rng(K)
    scores = np.full((shape[0] + 1, shape[1], K), np.nan, dtype=np.float32)
    scores[:-1] = rng.random((*shape, K))
    frame = dataclasses.replace(soft_frame(rng, 0, K, "float32", shape), scores=scores[:-1])
    made = [backends.create(name, voxel_size=0.3, num_classes=K) for name in ("numpy", "numba")]
    for backend in made:
        backend.integrate(frame)
    assert_same_map(made[1].table(), made[0].table(), 1e-12)


def test_every_pixel_a_voxel_of_its_own() -> None:
    """More voxels than a band has room for at first."""
    rng = np.random.default_rng(4)
    frame = soft_frame(rng, 0, 3, "float32", (17, 600))
    frame = dataclasses.replace(frame, depth=(1 + 400 * rng.random(frame.shape)).astype(np.float32))
    made = [backends.create(name, voxel_size=0.05, num_classes=3) for name in ("numpy", "numba")]
    for backend in made:
        assert backend.integrate(frame).voxels > 9000
    assert_same_map(made[1].table(), made[0].table(), 1e-12)


def test_a_pixel_out_of_reach_without_a_prediction_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    frame = soft_frame(rng, 0, 3, "float32")
    depth, scores = np.array(frame.depth), np.array(frame.scores)
    depth[3, 4], scores[3, 4] = 1e7, 0
    with_hole = dataclasses.replace(frame, depth=depth, scores=scores)
    backend = backends.create("numba", voxel_size=0.3, num_classes=3)
    assert backend.integrate(with_hole).points == np.count_nonzero(with_hole.valid)
    scores[3, 4] = 1
    with pytest.raises(DataError, match=r"more than 2\^20 voxels"):
        backend.integrate(dataclasses.replace(frame, depth=depth, scores=scores))


@pytest.mark.parametrize("K", [7, 150])
def test_a_map_of_scores_takes_what_is_expected(K) -> None:
    """Within a factor of three; the frame's own work space, which does not grow with the map, is left out."""
    rng = np.random.default_rng(7)
    backend = backends.create("numba", voxel_size=0.02, num_classes=K)
    frame = soft_frame(rng, 0, K, "float16", (60, 200))
    frame = dataclasses.replace(frame, scores=np.nan_to_num(frame.scores))
    backend.integrate(frame)
    tracemalloc.start()
    for index in range(1, 4):
        pose = np.array(frame.T_wc)
        pose[0, 3] += 10.0 * index
        voxels = backend.integrate(dataclasses.replace(frame, index=index, T_wc=pose)).map_voxels
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert voxels > 15_000
    assert held / 3 < backends.expected_bytes("numba", voxels, voxels, K, soft=True) < 3 * held


@pytest.mark.parametrize("features", [None, ""])
def test_the_fast_logarithm(features, monkeypatch) -> None:
    """With the instructions of this machine (None), and without wide vectors."""
    if features is not None:
        monkeypatch.setattr("numba.core.codegen.JITCPUCodegen.magic_tuple", lambda _: ("", "", features))

    @numba.njit
    def logarithms(p, found):
        sums = np.zeros(LANES)
        for i in range(p.shape[0]):
            sums[i % LANES] = p[i]
            found[i, 0] = observe_eights(np.zeros(LANES), sums, 1.0, 1.0, 1.0)[3]
            found[i, 1] = plogp_eights(sums, 1.0)
            sums[i % LANES] = 0.0

    p = np.concatenate([[0.0, 0.5, 1.0, 1e-300], np.random.default_rng(0).random(1000), 1 + 1e-9 * np.arange(-50, 50)])
    found = np.empty((len(p), 2))
    logarithms(p, found)
    expected = p * np.log2(np.where(p > 0, p, 1).astype(np.longdouble))
    for each_found in found.T:
        np.testing.assert_allclose(each_found, expected.astype(np.float64), rtol=2e-15, atol=1e-300)
