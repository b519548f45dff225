"""Model `colour-clusters`: k-means of colour and texture with one codebook a sequence; no weights, no training."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydantic import BaseModel, Field

from semstab.config import Settings
from semstab.core.types import Float32
from semstab.data.labels import IGNORE_8BIT, LabelSpace
from semstab.errors import ConfigError
from semstab.models import Image, Model, Prediction

Features = Float32


class ColourClusterOptions(Settings):
    """Number of clusters, and the pixels that they are computed from."""

    clusters: int = Field(8, ge=2, lt=IGNORE_8BIT, description="number of clusters, the classes")
    fit_frames: int = Field(5, ge=1, description="the codebook comes from that many first frames of the sequence")
    samples: int = Field(20_000, ge=100, description="pixels drawn from each of these frames")
    scale: float = Field(
        2.0, gt=0, allow_inf_nan=False, description="standard deviation of the Gaussian window, pixels"
    )
    seed: int = Field(0, ge=0, lt=2**31, description="of the drawn pixels and of k-means")


@dataclass(frozen=True, eq=False)
class Codebook:
    """Cluster centres of normalised features.

    Attributes:
        mean, deviation: (D,) of the features that it was fitted to.
        centres: (K, D), by increasing lightness.
        variance: Mean squared distance of a feature from its centre, an axis.
    """

    mean: Features
    deviation: Features
    centres: Features
    variance: float


class ColourClusters(Model):
    """Each pixel is the nearest cluster centre of its smoothed colour and local texture.

    Features are the CIE Lab colour smoothed by a Gaussian window, and the standard deviation of lightness in it. The
    centres are computed once a sequence, in its first frames, and stay: an id means the same in every frame. Scores are
    the clusters' posteriors under equal, spherical Gaussians.
    """

    Options: type[BaseModel] = ColourClusterOptions
    gives_scores = True

    def __init__(self, options: ColourClusterOptions, codebook: Codebook | None = None) -> None:
        self.options = options
        self.fit_frames = options.fit_frames
        names = tuple(f"cluster {k}" for k in range(options.clusters))
        self.label_space = LabelSpace("colour clusters", names)
        self.codebook = codebook

    def fit(self, images: Sequence[Image]) -> ColourClusters:
        """Return the model with the codebook of these images.

        Raises:
            ConfigError: If they have fewer pixels than clusters.
        """
        rng = np.random.default_rng(self.options.seed)
        samples = []
        for image in images:
            pixels = pixel_features(image, self.options.scale).reshape(-1, 4)
            if len(pixels) > self.options.samples:
                pixels = pixels[np.sort(rng.choice(len(pixels), self.options.samples, replace=False))]
            samples.append(pixels)
        return ColourClusters(self.options, _codebook(np.concatenate(samples), self.options))

    def predict(self, images: Sequence[Image], *, scores: bool = False) -> list[Prediction]:
        """See `Model`.

        Raises:
            ConfigError: If `fit` was not called.
        """
        if self.codebook is None:
            raise ConfigError("colour-clusters has no codebook yet; call fit with the first images of the sequence")
        return [_predict(pixel_features(image, self.options.scale), self.codebook, scores) for image in images]

    def identity(self) -> dict[str, Any]:
        """Return the settings and the codebook."""
        book = self.codebook
        arrays = () if book is None else (book.mean, book.deviation, book.centres)
        digest = hashlib.blake2b(b"".join(array.tobytes() for array in arrays), digest_size=16).hexdigest()
        return {**self.options.model_dump(mode="json"), "codebook": digest}


def pixel_features(image: Image, scale: float) -> Features:
    """Return (H, W, 4): Lab colour in a Gaussian window, lightness 0 to 100, and the deviation of lightness in it."""
    lab = cv2.cvtColor(image.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    mean = cv2.GaussianBlur(lab, (0, 0), scale)
    lightness = lab[..., 0]
    variance = cv2.GaussianBlur(lightness * lightness, (0, 0), scale) - mean[..., 0] ** 2
    return np.dstack([mean, np.sqrt(np.maximum(variance, 0))]).astype(np.float32)


def _codebook(pixels: Features, options: ColourClusterOptions) -> Codebook:
    if len(pixels) < options.clusters:
        raise ConfigError(f"colour-clusters: {len(pixels)} pixels cannot make {options.clusters} clusters; use fewer")
    mean, deviation = pixels.mean(axis=0), np.maximum(pixels.std(axis=0), np.float32(1e-3))
    normalised = (pixels - mean) / deviation
    cv2.setRNGSeed(options.seed)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    compactness, _, centres = cv2.kmeans(
        normalised, options.clusters, np.empty(0, np.int32), stop, 3, cv2.KMEANS_PP_CENTERS
    )
    ordered = np.ascontiguousarray(centres[np.argsort(centres[:, 0], kind="stable")], dtype=np.float32)
    return Codebook(mean, deviation, ordered, variance=max(compactness / pixels.size, 1e-6))


def _predict(features: Features, codebook: Codebook, scores: bool) -> Prediction:
    normalised = (features - codebook.mean) / codebook.deviation
    # ||x - c||^2 less ||x||^2, which is the same for every centre
    distance = (codebook.centres**2).sum(axis=1) - 2 * (normalised @ codebook.centres.T)
    labels = distance.argmin(axis=2).astype(np.uint8)
    if not scores:
        return Prediction(labels)
    weight = np.exp((distance.min(axis=2, keepdims=True) - distance) / np.float32(2 * codebook.variance))
    return Prediction(labels, weight / weight.sum(axis=2, keepdims=True))
