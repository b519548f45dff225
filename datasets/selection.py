"""The frames of a scene that a selection picks, without those whose pose was lost."""

from __future__ import annotations

import logging

from semstab.config import FrameSelection
from semstab.datasets import Scene, Timed, Tracked

logger = logging.getLogger("semstab")

MAX_LISTED = 5


def select_frames(scene: Scene, selection: FrameSelection) -> list[int]:
    """Indices of the selected frames, in order; those without a pose are left out, with a warning that lists them.

    Reads no image. Raises ConfigError for a frame or a range of time that the scene does not have.
    """
    times = scene.timestamps if isinstance(scene, Timed) else None
    chosen = selection.indices(len(scene), None if times is None else times.tolist())
    if not isinstance(scene, Tracked):
        return chosen
    lost = [index for index in chosen if not scene.tracked(index)]
    if lost:
        more = ", ..." if len(lost) > MAX_LISTED else ""
        listed = ", ".join(str(index) for index in lost[:MAX_LISTED])
        logger.warning(
            "%s: %d of %d selected frames have no pose (tracking was lost) and are left out: %s%s",
            scene.name, len(lost), len(chosen), listed, more,
        )  # fmt: skip
    without = set(lost)
    return [index for index in chosen if index not in without]
