"""`semstab.TemporalStability`: what a run says, frame by frame in a training loop, in one process or in several."""

from __future__ import annotations

import inspect
import math
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from online_rank import FLIGHT, FRAMES, SIZE, K, flights, updated

import semstab
from semstab.errors import ConfigError, DataError
from semstab.online.metric import TemporalStability
from semstab.online.summary import Summary

EXACT = ("vss_op3", "psa_op2", "recurrent_share")
"""What is the same however frames are shared out among processes."""

ABOUT = 0.08
"""Alpha differs by less (by .05 in 40 random partitions of ten frames): a process asks its own frames at spots that
they found, not at others' spots, so that alpha is of other spots, and of the pairs of views within each process."""


@pytest.fixture(scope="module", name="flights")
def _flights():
    """Two sequences of ten frames."""
    return flights()


@pytest.fixture(scope="module")
def plain(flights):
    """The values of the first sequence, frame by frame."""
    return updated(TemporalStability(K, SIZE), flights["scene0"]).compute()


def test_it_says_what_the_command_says(flights):
    metric = TemporalStability(K, SIZE)
    for first, second in zip(*flights.values(), strict=True):  # sequences alternate
        updated(metric, [first], "scene0")
        updated(metric, [second], "scene3")
    run = semstab.run({
        "dataset": {"name": "city", "options": FLIGHT}, "frames": {"stop": FRAMES}, "scenes": ["scene0", "scene3"],
        "models": ["sim-flicker"],
        "voxel_size": SIZE, "taxonomy": None, "check": None, "check_geometry": False,
    })  # fmt: skip
    rows = [
        Summary.from_statistics(r.frames, r.map_summary, r.statistics, r.image_space.compensated_flicker_percent)
        for r in run.records
    ]
    values = metric.compute()
    for name in Summary.NAMES:
        assert values[name] == pytest.approx(np.nanmean([row.scalars()[name] for row in rows]), abs=1e-9), name
    summaries = metric.by_sequence()
    assert [summary.verdict for summary in summaries.values()] == [row.verdict for row in rows]
    assert summaries["scene3"].scalars() == pytest.approx(rows[1].scalars(), abs=1e-9, nan_ok=True)


def test_batches_of_tensors_are_frames_one_by_one(flights, plain):
    frames = flights["scene0"]
    images = [
        torch.stack([torch.from_numpy(np.array(getattr(f, name))) for f in frames])
        for name in ("labels", "depth", "T_wc")
    ]
    labels, depth, poses = images
    camera = torch.from_numpy(frames[0].intrinsics.matrix)
    logits = 9 * torch.nn.functional.one_hot(labels.long(), K).permute(0, 3, 1, 2).float()
    for given_labels, given_camera, given_poses in (
        (labels, camera, poses),
        (labels.long(), camera.expand(len(frames), 3, 3), poses[:, :3]),
        (logits, camera, poses),
    ):
        metric = TemporalStability(K, SIZE)
        metric.update(given_labels, depth, given_camera, given_poses, ["s"] * len(frames))
        assert metric.compute() == pytest.approx(plain, abs=1e-12)


def test_soft_scores_are_fused_as_scores(flights):
    rng = np.random.default_rng(0)
    logits = [3 * rng.normal(size=(K, 54, 96)).astype(np.float32) for _ in range(10)]
    soft, given_soft = TemporalStability(K, SIZE, soft=True), TemporalStability(K, SIZE, soft=True)
    scores = [torch.softmax(torch.from_numpy(values), 0).numpy() for values in logits]
    frames = flights["scene0"]
    for frame, raw, probabilities in zip(frames, logits, scores, strict=True):
        soft.update(raw, frame.depth, frame.intrinsics, frame.T_wc)
        given_soft.update(probabilities, frame.depth, frame.intrinsics, frame.T_wc)
    result = semstab.fuse([
        {"scores": np.moveaxis(probabilities, 0, -1), "depth": f.depth, "intrinsics": f.intrinsics, "T_wc": f.T_wc}
        for f, probabilities in zip(frames, scores, strict=True)
    ], voxel_size=SIZE)  # fmt: skip
    assert given_soft.compute() == pytest.approx(result.summary.scalars(), abs=1e-9, nan_ok=True)
    assert soft.compute() == pytest.approx(given_soft.compute(), abs=1e-5, nan_ok=True)


def test_pixels_without_a_label_are_left_out(flights):
    frames = flights["scene0"]
    for none, kind in ((255, np.uint8), (-100, np.int64), (3, np.int64)):
        metric, expected = TemporalStability(K, SIZE, ignore_index=none), TemporalStability(K, SIZE)
        for frame in frames:
            labels = frame.labels.astype(kind)
            labels[:, :30] = none
            metric.update(labels, frame.depth, frame.intrinsics, frame.T_wc)
            labelled = np.where(labels == none, 255, labels).astype(np.uint8)
            expected.update(labelled, frame.depth, frame.intrinsics, frame.T_wc)
        assert metric.compute() == pytest.approx(expected.compute(), abs=1e-12)
    with pytest.raises(DataError, match="label 9 is not below num_classes = 8"):
        metric.update(np.full((54, 96), 9), frames[0].depth, frames[0].intrinsics, frames[0].T_wc)


@settings(deadline=None, max_examples=3)
@given(owner=st.lists(st.integers(0, 2), min_size=10, max_size=10))
@example(owner=[0] * 10)
def test_processes_add_up_to_one(flights, plain, owner):
    """However the frames are shared out; SBD and flicker are means over the steps that each process saw."""
    frames = flights["scene0"]
    parts = [
        updated(TemporalStability(K, SIZE), [f for f, process in zip(frames, owner, strict=True) if process == k])
        for k in range(3)
    ]
    sent = [pickle.loads(pickle.dumps(part.states())) for part in parts]
    merged = TemporalStability(K, SIZE)
    for states in sent:
        merged.merge_state(states)
    values = merged.compute()
    for name in EXACT:
        assert values[name] == pytest.approx(plain[name], abs=1e-9), name
    assert values["alpha"] == pytest.approx(plain["alpha"], abs=ABOUT)
    assert math.isnan(values["sbd_op3"]) or 0 <= values["sbd_op3"] <= 0.32


def test_whole_sequences_add_up_in_everything(flights):
    a, b = (updated(TemporalStability(K, SIZE), frames, name) for name, frames in flights.items())
    both = TemporalStability(K, SIZE)
    for name, frames in flights.items():
        updated(both, frames, name)
    a.merge_state(b)
    assert a.compute() == pytest.approx(both.compute(), abs=1e-12)
    a.reset()
    assert all(math.isnan(value) for value in a.compute().values())


def test_a_large_map_is_sampled_and_stays_bounded(flights):
    frames = flights["scene0"]
    metric, whole = TemporalStability(K, 0.5, max_voxels=2000), TemporalStability(K, 0.5)
    updated(metric, frames), updated(whole, frames)
    (sample,), (all_of_it,) = metric.states().values(), whole.states().values()
    assert len(sample.table) <= 2000 < len(all_of_it.table) / 8
    assert len(metric._maps[""]._backend.table()) < 6 * 2000
    index = {tuple(row): k for k, row in enumerate(all_of_it.table.index.tolist())}
    rows = [index[tuple(row)] for row in sample.table.index.tolist()]
    np.testing.assert_array_equal(sample.table.op, all_of_it.table.op[rows])
    np.testing.assert_allclose(sample.table.drift_sum, all_of_it.table.drift_sum[rows], atol=1e-12)
    np.testing.assert_allclose(sample.table.evidence, all_of_it.table.evidence[rows], atol=1e-12)
    values, expected = metric.compute(), whole.compute()
    for name in ("vss_op3", "psa_op2", "alpha"):
        assert values[name] == pytest.approx(expected[name], abs=0.06)
    metric.merge_state(whole)
    (merged,) = metric.states().values()
    assert merged.one_in == sample.one_in


@pytest.mark.parametrize(("change", "message"), [
    ({"predicted": np.zeros((54, 96))}, "frame 0: labels are float64"),
    ({"predicted": np.zeros((5, 54, 96), np.float32)}, r"frame 0: logits of shape \(5, 54, 96\); give \(8, H, W\)"),
    ({"depth": np.ones((2, 54, 96), np.float32)}, "do not belong together"),
    ({"T_wc": np.diag([1, 1, -1, 1.0])}, "frame 0, pose: the rotation mirrors"),
    ({"sequence": ["a", "b"]}, "sequence: 2 names for 1 frames"),
])  # fmt: skip
def test_what_cannot_be_measured_is_one_line(change, message):
    metric = TemporalStability(K, SIZE)
    fine = {"predicted": np.zeros((54, 96), int), "depth": np.ones((54, 96), np.float32),
            "intrinsics": np.diag([50.0, 50, 1]), "T_wc": np.eye(4)}  # fmt: skip
    with pytest.raises(DataError, match=message):
        metric.update(**{**fine, **change})
    assert not metric.states()
    with pytest.raises(ConfigError, match="at least 2 classes"):
        TemporalStability(1)


# --- torchmetrics, Lightning, several processes


def test_it_is_a_metric_of_torchmetrics(flights, plain):
    from torchmetrics import Metric, MetricCollection
    from torchmetrics.aggregation import MeanMetric

    assert issubclass(semstab.TemporalStability, Metric)
    collection = MetricCollection({"stability": semstab.TemporalStability(K, SIZE), "mean": MeanMetric()})
    metric = collection["stability"].clone()
    for frame in flights["scene0"]:
        batch = metric(frame.labels, frame.depth, frame.intrinsics, frame.T_wc)
    assert batch["recurrent_share"] == 0  # of the last frame alone
    assert {name: float(value) for name, value in metric.compute().items()} == pytest.approx(plain, nan_ok=True)
    assert metric.by_sequence()[""].frames == 10
    other = semstab.TemporalStability(K, SIZE)
    other.merge_state(metric)
    assert float(other.compute()["alpha"]) == pytest.approx(plain["alpha"])
    metric.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torchmetrics: compute before update
        assert math.isnan(float(metric.compute()["alpha"]))


def test_two_processes_say_what_one_says(flights, tmp_path):
    (tmp_path / "flights.pickle").write_bytes(pickle.dumps(flights))
    subprocess.run([sys.executable, Path(__file__).parent / "online_rank.py", tmp_path], check=True, timeout=120)
    (first, second), (other, _) = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    one = TemporalStability(K, SIZE)
    for name, frames in (("split", flights["scene0"]), ("whole0", flights["scene0"]), ("whole1", flights["scene3"])):
        updated(one, frames, name)
    alone = one.compute()
    for name in EXACT:
        assert float(first[name]) == pytest.approx(alone[name], abs=1e-9), name
    assert float(first["alpha"]) == pytest.approx(alone["alpha"], abs=ABOUT)
    assert {name: float(value) for name, value in first.items()} == {
        name: float(value) for name, value in other.items()
    }
    assert float(second["recurrent_share"]) != float(first["recurrent_share"])


def test_lightning_logs_it(flights, plain, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Lightning's own imports
        import lightning

    frames = flights["scene0"]

    class Module(lightning.LightningModule):
        def __init__(self):
            super().__init__()
            self.stability = semstab.TemporalStability(K, SIZE)

        def validation_step(self, batch, index):
            frame = frames[int(batch)]
            self.stability.update(frame.labels, frame.depth, frame.intrinsics, frame.T_wc)

        def on_validation_epoch_end(self):
            self.log_dict({f"val/{name}": value for name, value in self.stability.compute().items()})
            self.stability.reset()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trainer = lightning.Trainer(
            accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False,
            enable_checkpointing=False, default_root_dir=tmp_path,
        )  # fmt: skip
        (logged,) = trainer.validate(Module(), torch.utils.data.DataLoader(torch.arange(10)), verbose=False)
    assert logged == pytest.approx({f"val/{name}": value for name, value in plain.items()}, rel=1e-6)


def test_help_shows_the_arguments_of_the_metric_and_its_own_documentation():
    of_torch, of_numpy = semstab.TemporalStability, TemporalStability
    for name in ("__init__", "update"):
        wrapped, arguments = (
            dict(inspect.signature(getattr(metric, name)).parameters) for metric in (of_torch, of_numpy)
        )
        wrapped.pop("of_torchmetrics", None)
        assert [(parameter.name, parameter.default) for parameter in wrapped.values()] == [
            (parameter.name, parameter.default) for parameter in arguments.values()
        ]
    assert of_torch.__doc__ == of_numpy.__doc__
    assert "T_wc: (4, 4)" in of_torch.update.__doc__
