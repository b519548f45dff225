"""The k largest scores of each pixel: which they are, and the bound on what leaving out the others changes."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from command_line import bench
from posed_scene import frame as posed_frame
from posed_scene import write_scene

import semstab
from semstab import backends
from semstab.metrics import vss
from semstab.pixels.preparation import keep_largest

K = 12


def frame(index: int = 0, dtype: str = "float32") -> semstab.Frame:
    """A wall seen with scores of all classes, some more certain than others; ties, and pixels without a prediction."""
    rng = np.random.default_rng(index)
    scores = (rng.random((24, 32, K)) ** (1 + 9 * rng.random((24, 32, 1)))).astype(dtype)
    scores[0, :8] = 0.5
    scores[1, :8] = 0
    scores[2, :8, 3] = np.nan
    scores[3, :8, 0] = -0.0
    depth = np.full((24, 32), 3, dtype=np.float32)
    return semstab.Frame(index, depth, semstab.Intrinsics(32, 32, 16, 12), np.eye(4), scores=scores)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("k", [1, 3, K, K + 1])
def test_the_largest_are_kept_and_of_equal_ones_the_lowest(dtype, k) -> None:
    whole = frame(dtype=dtype)
    largest = keep_largest(whole, k)
    np.testing.assert_array_equal(largest.valid, whole.valid)
    order = np.argsort(-whole.scores, axis=2, kind="stable")[..., :k]
    expected = np.zeros_like(whole.scores)
    np.put_along_axis(expected, order, np.take_along_axis(whole.scores, order, 2), 2)
    np.testing.assert_array_equal(largest.scores[whole.valid], expected[whole.valid])
    assert largest.scores.dtype == whole.scores.dtype
    if k >= K:
        assert largest.scores_left_out is None
        return
    some = np.isfinite(whole.scores).all(axis=2) & (whole.scores.sum(axis=2) > 0)
    lost = 1 - expected[some].sum(axis=1, dtype=float) / whole.scores[some].sum(axis=1, dtype=float)
    assert largest.scores_left_out.mean == pytest.approx(lost.mean(), rel=1e-6)
    assert largest.scores_left_out.most == pytest.approx(lost.max(), rel=1e-6)


@pytest.mark.parametrize("k", [1, 2, 5])
def test_a_belief_changes_by_at_most_the_share_that_is_left_out(k) -> None:
    """The mean over a voxel's frames of the mean over its pixels: what `top_k` says."""
    frames = [frame(index) for index in range(3)]
    maps = [backends.create("numba", voxel_size=0.5, num_classes=K) for _ in range(3)]
    for whole in frames:
        cut = keep_largest(whole, k)
        left_out = 1 - np.divide(cut.scores.sum(2), whole.scores.sum(2), where=whole.valid, out=np.zeros(whole.shape))
        share = np.stack([left_out, 1 - left_out], axis=2)  # fused like evidence, it is averaged like evidence
        share[~whole.valid] = 0
        for map_, given in zip(maps, (whole, cut, dataclasses.replace(whole, scores=share.clip(0, 1))), strict=True):
            padded = np.concatenate([given.scores, np.zeros((*given.shape, K - given.scores.shape[2]))], axis=2)
            map_.integrate(dataclasses.replace(given, scores=padded))
    exact, cut_off, lost = (map_.table() for map_ in maps)
    bound = lost.evidence[:, 0] / lost.op
    beliefs = [table.evidence[:] / table.op[:, None] for table in (exact, cut_off)]
    assert (np.abs(beliefs[0] - beliefs[1]).sum(axis=1) / 2 <= bound + 1e-6).all()
    assert (np.abs(vss(exact) - vss(cut_off)) <= bound + 1e-6).all()
    assert 0.01 < bound.mean() <= 1 - k / K


def test_a_run_tells_what_its_flag_left_out(tmp_path) -> None:
    """Of random scores much: the summary has the mean and the bound, the terminal says them; of all of them nothing."""
    scene = write_scene(tmp_path / "scene")
    words = ("--data", scene, "--model", "net-scores", "--top-k", 1, "--check", "none", "--rerun", "off")
    told = bench(*words, "--out", tmp_path / "cut", cwd=tmp_path).stdout
    (run,) = json.loads((tmp_path / "cut/summary.json").read_text())["runs"]
    frames = [posed_frame(k, "net-scores").scores.astype(float) for k in range(3)]
    lost = np.array([1 - scores.max(axis=2) / scores.sum(axis=2) for scores in frames])
    assert run["scores_left_out"] == pytest.approx({"mean": lost.mean(), "most": lost.max()}, rel=1e-3)
    assert f"top_k leaves out {lost.mean():.2%} of a pixel's scores on average, {lost.max():.2%} at most" in " ".join(
        told.split()
    )


def test_label_maps_have_no_largest_scores(tmp_path) -> None:
    scene = write_scene(tmp_path / "scene")
    told = bench("--data", scene, "--model", "net", "--top-k", 1, "--check", "none", cwd=tmp_path, code=2).stderr
    assert "top_k keeps the largest scores of a pixel, but net has label maps; leave it out" in " ".join(told.split())
