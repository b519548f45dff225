"""The remarks of `check` on a scene, for a run of one of its models."""

from __future__ import annotations

from collections.abc import Sequence

from semstab.check.registration import REGISTERED_FRAMES, notes
from semstab.check.scene_check import MADE, POINTS, Inspection
from semstab.config import Config
from semstab.datasets import Scene
from semstab.predict.dataset import NAME as PREDICTED


def scene_notes(scene: Scene, indices: Sequence[int], model: str, config: Config) -> tuple[str, ...]:
    """Return what looks wrong in depth and labels of a model, or its images, but may be right; in the words of `check`.

    Labels that are predicted in memory are those of the images, which are compared with the depth before any is
    predicted. A simulated scene has no remarks.

    Raises:
        DataError: If a frame cannot be read.
    """
    if config.dataset.name == MADE:
        return ()
    source = None if config.dataset.name == PREDICTED else model
    inspection = Inspection(scene, indices, source, (), POINTS, fused=REGISTERED_FRAMES)
    views = [inspection.views[at] for at in sorted(inspection.views)]
    return tuple(notes(scene, views, inspection.reading(config.dataset.options), model))
