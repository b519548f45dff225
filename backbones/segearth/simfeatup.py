"""SimFeatUp: features of patches upsampled 16 times, along the edges of the image (Li et al. 2025, CVPR).

After FeatUp (Fu et al. 2024, ICLR). One learned joint bilateral upsampler is applied four times, each doubling the
resolution. The names of the parameters are those of the public checkpoints.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from semstab.errors import ConfigError, DataError, one_line

KEY_DIM = 32
PREFIX = "upsampler."
DOUBLINGS = 4


class JointBilateralUpsampler(nn.Module):
    """Features at twice their resolution, or at that of the guidance: a kernel of each pixel's own over its neighbours.

    The kernel is the product of a range kernel, the softmax of the likeness of the guidance in a learned space, and a
    Gaussian of the distance; normalised, plus a learned correction.
    """

    def __init__(self, radius: int = 5) -> None:
        super().__init__()
        self.radius = radius
        self.diameter = 2 * radius + 1
        taps = self.diameter**2
        self.range_temp = nn.Parameter(torch.tensor(0.0))
        self.sigma_spatial = nn.Parameter(torch.tensor(1.0))
        self.range_proj = _two_layers(3, KEY_DIM, KEY_DIM)
        self.fixup_proj = _two_layers(3 + taps, taps, taps)

    def forward(self, source: torch.Tensor, guidance: torch.Tensor) -> torch.Tensor:
        """(N, C, H, W) from source (N, C, h, w) and guidance (N, 3, H, W); H and W must exceed the radius."""
        kernel = self.kernel(guidance)
        bicubic = nn.functional.interpolate(source, size=guidance.shape[-2:], mode="bicubic", align_corners=False)
        result = torch.zeros_like(bicubic)
        for tap, neighbour in enumerate(self._neighbours(bicubic)):
            result.addcmul_(kernel[:, tap, None], neighbour)
        return result

    def kernel(self, guidance: torch.Tensor) -> torch.Tensor:
        """(N, taps, H, W) the weight of each neighbour, row by row."""
        key = self.range_proj(guidance)
        likeness = torch.stack([(key * neighbour).sum(dim=1) for neighbour in self._neighbours(key)], dim=1)
        temperature = self.range_temp.exp().clamp(1e-4, 1e4)
        kernel = (temperature * likeness).softmax(dim=1) * self._spatial_kernel()
        kernel = kernel / kernel.sum(dim=1, keepdim=True).clamp(min=1e-7)
        corrected: torch.Tensor = kernel + 0.1 * self.fixup_proj(torch.cat([kernel, guidance], dim=1))
        return corrected

    def _spatial_kernel(self) -> torch.Tensor:
        """(1, taps, 1, 1) exp(-|delta|^2 / (2 sigma^2)), each axis of the window being -1 to 1."""
        axis = torch.linspace(-1, 1, self.diameter, dtype=self.sigma_spatial.dtype, device=self.sigma_spatial.device)
        squared = axis[:, None] ** 2 + axis[None, :] ** 2
        return torch.exp(-squared / (2 * self.sigma_spatial**2)).reshape(1, -1, 1, 1)

    def _neighbours(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Of each tap the image (N, C, H, W), moved so that a pixel holds that neighbour; mirrored at the border."""
        H, W = x.shape[-2:]
        mirrored = nn.functional.pad(x, [self.radius] * 4, mode="reflect")
        taps = range(self.diameter)
        return [mirrored[..., dy : dy + H, dx : dx + W] for dy in taps for dx in taps]


class SimFeatUp(nn.Module):
    """One upsampler, four times, and a learned correction of the channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.up = JointBilateralUpsampler()
        self.fixup_proj = nn.Sequential(nn.Dropout2d(0.2), nn.Conv2d(channels, channels, 1))

    @classmethod
    def load(cls, path: Path, channels: int, device: torch.device, dtype: torch.dtype) -> SimFeatUp:
        """From a checkpoint, ready to use. Raises DataError where the file is none, or has other shapes."""
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
            weights = content.get("state_dict", content)
            module = cls(channels)
            module.load_state_dict({key.removeprefix(PREFIX): value for key, value in weights.items()})
        except Exception as error:  # torch.load raises whatever its unpickler does
            raise DataError(
                f"{path}: no SimFeatUp weights for {channels} channels ({one_line(error)[:200]}); name the checkpoint"
                " 'jbu_one' that was trained for this CLIP"
            ) from error
        return module.to(device, dtype).eval()

    def forward(self, features: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """(N, C, 16 h, 16 w) from features (N, C, h, w) and the normalised image (N, 3, H, W) behind them.

        Raises ConfigError for fewer than 3x3 patches, over which a neighbourhood cannot be mirrored.
        """
        if 2 * min(features.shape[-2:]) <= self.up.radius:
            raise ConfigError(
                f"SimFeatUp needs 3x3 patches or more, a window has {features.shape[-2]}x{features.shape[-1]};"
                " use larger windows"
            )
        for _ in range(DOUBLINGS):
            size = (2 * features.shape[-2], 2 * features.shape[-1])
            features = self.up(features, nn.functional.adaptive_avg_pool2d(image, size))
        corrected: torch.Tensor = features + 0.1 * self.fixup_proj(features)
        return corrected


def _two_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, hidden, 1), nn.GELU(), nn.Dropout2d(0.1), nn.Conv2d(hidden, outputs, 1))
