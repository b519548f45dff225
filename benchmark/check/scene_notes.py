"""The notes of `check` on a scene, for a run of one of its models: fewer frames, the same words."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from semstab.check.inspection import Inspection
from semstab.check.labels import Ordered, label_findings
from semstab.check.registration import REGISTERED_FRAMES, notes
from semstab.check.scene_check import POINTS
from semstab.config import Config
from semstab.datasets import Scene
from semstab.predict.dataset import NAME as PREDICTED


def scene_notes(
    scene: Scene, indices: Sequence[int], model: str, config: Config, ordered: Ordered | None = None
) -> tuple[str, ...]:
    """Return what looks wrong in depth and labels of a model, or its images, but may be right; in the words of `check`.

    Labels that the run predicts are those of the images, which are compared with the depth before any is predicted. A
    scene without files, simulated or in a program's memory, has no notes, nor has one of scans. `known` are frames in
    order that `quick_sample` compared.

    Raises:
        DataError: If a frame cannot be read.
    """
    if scene.folder is None or scene.of_scans:
        return ()
    stored, options = stored_labels(scene, model, config), config.dataset.options
    with ThreadPoolExecutor(1, thread_name_prefix="semstab-notes") as pool:
        of_images = pool.submit(_image_notes, scene, indices, model, stored)
        findings = [] if stored is None else label_findings(scene, indices, [model], options, ordered, thorough=False)
        return (
            *(line for of_model in findings for line in (*of_model.wrong, *of_model.remarks)),
            *of_images.result(),
        )


def _image_notes(scene: Scene, indices: Sequence[int], model: str, stored: str | None) -> tuple[str, ...]:
    """Return what looks wrong where depth and labels are compared with the images."""
    inspection = Inspection(scene, indices, stored, (), POINTS, fused=REGISTERED_FRAMES)
    views = [inspection.views[position] for position in sorted(inspection.views)]
    return tuple(notes(scene, views, model))


def stored_labels(scene: Scene, model: str, config: Config) -> str | None:
    """Return the model if its labels are files, or None if the run predicts them or the scene has no files."""
    return None if scene.folder is None or scene.of_scans or config.dataset.name == PREDICTED else model
