"""The two processes of `test_online_metric`, forked once all is imported: `python online_rank.py FOLDER`."""

import multiprocessing
import pickle
import sys
from pathlib import Path

from semstab.datasets import open_dataset

FLIGHT = {"width": 96, "height": 54, "frames": 80}
SIZE, K, FRAMES = 1.0, 8, 10


def flights():
    """The first ten frames of two flights, by name."""
    dataset = open_dataset("city", FLIGHT)
    return {name: [dataset.scene(name).frame(i, "sim-flicker") for i in range(FRAMES)] for name in ("scene0", "scene3")}


def updated(metric, frames, sequence=""):
    for frame in frames:
        metric.update(frame.labels, frame.depth, frame.intrinsics, frame.T_wc, sequence)
    return metric


def _rank(rank, folder, first, second):
    """Every second frame of one sequence, and a whole one; then one frame more."""
    import torch

    import semstab

    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    whole = f"whole{rank}"
    metric = semstab.TemporalStability(K, SIZE)
    updated(metric, first[rank::2], "split")
    updated(metric, (first, second)[rank], whole)
    before = metric.compute()
    updated(metric, first[:1], whole)
    assert metric.by_sequence().keys() == {"split", whole}  # its own frames again
    torch.save((before, metric.compute()), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def _main(folder):
    """Take the frames that the test has left there."""
    import semstab

    assert semstab.TemporalStability  # imports torch and torchmetrics, which takes most of the time
    frames = pickle.loads(Path(folder, "flights.pickle").read_bytes())
    start = multiprocessing.get_context("fork").Process
    ranks = [start(target=_rank, args=(rank, folder, *frames.values())) for rank in range(2)]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join()
    sys.exit(max(abs(rank.exitcode) for rank in ranks))


if __name__ == "__main__":
    _main(sys.argv[1])
