"""The frames of a scene that a selection picks, without those that lack a file or whose pose was lost."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from semstab.config import FrameSelection
from semstab.datasets.files.messages import MAX_LISTED, listed
from semstab.datasets.scene import Scene
from semstab.errors import DataError

logger = logging.getLogger("semstab")


@dataclass(frozen=True)
class Selected:
    """Indices of frames, in order.

    indices     those to read
    incomplete  selected ones that were left out because they lack a file
    lost        selected ones that were left out because tracking was lost
    """

    indices: list[int]
    incomplete: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()

    @property
    def left_out(self) -> int:
        """How many frames were selected, but left out."""
        return len(self.incomplete) + len(self.lost)


def select_frames(
    scene: Scene, selection: FrameSelection, sources: Sequence[str] = (), *, color: bool = False
) -> Selected:
    """The selected frames of a sequence, to be read with the labels of these sources (or its colour) and no others.

    What is left out is said in a warning. Reads no image. Raises ConfigError for a frame or a range of time that the
    scene does not have, DataError where selected frames lack files and the scene does not leave such frames out.
    """
    times = scene.timestamps
    chosen = selection.indices(len(scene), None if times is None else times.tolist())
    missing = {index: paths for index in chosen if (paths := scene.missing(index, sources, color=color))}
    complete = [index for index in chosen if index not in missing]
    if len(complete) < len(chosen):
        needs = ("depth", "pose", *(("labels",) if sources else ()), *(("colour",) if color else ()))
        _tell_missing(scene, [path for paths in missing.values() for path in paths], len(complete), len(chosen), needs)
    lost = {index for index in complete if not scene.tracked(index)}
    if lost:
        more = ", ..." if len(lost) > MAX_LISTED else ""
        logger.warning(
            "%s: %d of %d selected frames have no pose (tracking was lost) and are left out: %s%s",
            scene.name, len(lost), len(chosen), ", ".join(map(str, sorted(lost)[:MAX_LISTED])), more,
        )  # fmt: skip
    return Selected(
        indices=[index for index in complete if index not in lost],
        incomplete=tuple(missing),
        lost=tuple(sorted(lost)),
    )


def _tell_missing(scene: Scene, paths: list[str], complete: int, selected: int, needs: Sequence[str]) -> None:
    where = str(scene.folder or scene.name)
    if not scene.skips_incomplete:
        skip = "set incomplete: skip (--option incomplete=skip) to leave such frames out"
        raise DataError(f"{where}: {listed(paths, where)}; add them, or {skip}")
    if not complete:
        raise DataError(
            f"{where}: no selected frame has {', '.join(needs[:-1])} and {needs[-1]} ({listed(paths, where)})"
        )
    logger.warning("%s: %d of %d frames left out: %s", where, selected - complete, selected, listed(paths, where))
