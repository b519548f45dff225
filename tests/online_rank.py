"""One of two processes of `test_online_metric`: `python online_rank.py RANK FOLDER`."""

import sys

import torch

import semstab
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


def _main(rank, folder):
    """Every second frame of one sequence, and a whole one; then one frame more."""
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    whole = f"whole{rank}"
    first, second = flights().values()
    metric = semstab.TemporalStability(K, SIZE)
    updated(metric, first[rank::2], "split")
    updated(metric, (first, second)[rank], whole)
    before = metric.compute()
    updated(metric, first[:1], whole)
    assert metric.by_sequence().keys() == {"split", whole}  # its own frames again
    torch.save((before, metric.compute()), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    _main(int(sys.argv[1]), sys.argv[2])
