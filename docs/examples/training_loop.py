"""Train a small network on the city, with mIoU and stability of every epoch: `python training_loop.py [figure.png]`.

After half of the epochs the loss also asks for the same answer under another exposure. mIoU on the validation images
hardly rises; the stability on the flight, whose exposure changes from frame to frame as a camera's does, doubles.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from torch import nn

import semstab
from semstab.datasets import open_dataset

K, SIZE, IGNORE = 8, {"width": 128, "height": 72, "frames": 120}, 255
EPOCHS, EXPOSURE, CONSISTENCY = 14, 0.06, 3.0


def frames(scene: str, count: int, step: int = 1) -> list[semstab.Frame]:
    """Some frames of a flight, with ground truth as labels."""
    flight = open_dataset("city", SIZE).scene(scene)
    return [flight.frame(i, "gt") for i in range(0, count * step, step)]


def tensors(frames: list[semstab.Frame]) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (B, 3, H, W) and labels (B, H, W)."""
    images = [torch.from_numpy(np.moveaxis(frame.color, -1, 0) / np.float32(255) - 0.5) for frame in frames]
    return torch.stack(images), torch.stack([torch.from_numpy(frame.labels.astype(np.int64)) for frame in frames])


def exposed(images: torch.Tensor, random: torch.Generator) -> torch.Tensor:
    """The images with another gain and white balance each."""
    gain = 1 + EXPOSURE * torch.randn(len(images), 1, 1, 1, generator=random)
    return gain * images + EXPOSURE * torch.randn(len(images), 3, 1, 1, generator=random)


def network() -> nn.Module:
    """Four dilated convolutions."""
    layers: list[nn.Module] = []
    for inputs, outputs, dilation in ((3, 16, 1), (16, 24, 2), (24, 24, 4), (24, 24, 8)):
        convolution = nn.Conv2d(inputs, outputs, 3, padding=dilation, dilation=dilation, bias=False)
        layers += [convolution, nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers, nn.Conv2d(24, K, 1))


def miou(predicted: torch.Tensor, labels: torch.Tensor) -> float:
    """Mean intersection over union of the classes that are there."""
    labelled = labels < K
    pairs = torch.bincount(labels[labelled] * K + predicted[labelled], minlength=K * K).reshape(K, K)
    right, union = pairs.diag(), pairs.sum(0) + pairs.sum(1) - pairs.diag()
    return float((right / union)[union > 0].mean())


def train() -> list[dict[str, float]]:
    """Return mIoU and the scalars of `semstab.TemporalStability` of every epoch."""
    torch.manual_seed(0)
    random = torch.Generator().manual_seed(1)
    images, labels = tensors(frames("scene0", 24, 5) + frames("scene1", 12, 10))
    flight = frames("scene3", 24)
    stills, truth = tensors(flight)
    video = exposed(stills, torch.Generator().manual_seed(5))
    net = network()
    optimizer, loss_of = torch.optim.Adam(net.parameters(), 1e-2), nn.CrossEntropyLoss(ignore_index=IGNORE)
    stability = semstab.TemporalStability(num_classes=K, voxel_size=0.5)
    history = []
    for epoch in range(EPOCHS):
        net.train()
        for batch in torch.randperm(len(images), generator=random).split(4):
            scores = net(images[batch])
            loss = loss_of(scores, labels[batch])
            if epoch >= EPOCHS // 2:
                other = net(exposed(images[batch], random)).softmax(1)
                loss = loss + CONSISTENCY * (other - scores.softmax(1).detach()).pow(2).sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        for group in optimizer.param_groups:
            group["lr"] *= 0.9

        net.eval()
        with torch.no_grad():
            for image, frame in zip(video, flight, strict=True):
                stability.update(net(image[None])[0], frame.depth, frame.intrinsics, frame.T_wc)
            values = {name: float(value) for name, value in stability.compute().items()}
            stability.reset()
            history.append({"miou": miou(net(stills).argmax(1), truth), **values})
            print(epoch, *(f"{name} {value:.3f}" for name, value in history[-1].items()))  # noqa: T201
    return history


def draw(history: list[dict[str, float]], path: str) -> None:
    """Draw both curves."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 2.8), layout="constrained", dpi=150)
    axes = figure.subplots()
    epochs = range(1, len(history) + 1)
    styles = (("miou", "#4477aa", "o", "mIoU, validation images"), ("alpha", "#ee6677", "s", "alpha, flight"))
    for name, color, marker, label in styles:
        axes.plot(epochs, [row[name] for row in history], color=color, marker=marker, markersize=4, label=label)
    axes.axvline(len(history) // 2 + 0.5, color="#888888", linewidth=1, linestyle="--")
    axes.text(len(history) // 2 + 0.7, 0.03, "consistency loss", color="#555555", fontsize=9)
    axes.set(xlabel="epoch", ylabel="0 to 1", ylim=(0, 0.65))
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


if __name__ == "__main__":
    rows = train()
    if len(sys.argv) > 1:
        draw(rows, sys.argv[1])
