"""What looks wrong in a scene, but may be right: values that mean 'no depth', labels off the edges of depth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from semstab.check.conventions import OPTION, Reading
from semstab.check.registration import Edges, find_offset, grey_levels, image_edges, label_edges
from semstab.check.sentinels import find_sentinel
from semstab.check.views import View, evenly
from semstab.datasets import Scene
from semstab.errors import DataError

REGISTERED_FRAMES = 16
"""Frames in which the edges of labels are compared with those of depth."""


def remarks(scene: Scene, views: Sequence[View], how: Reading, backbone: str) -> Iterator[str]:
    """One line each; the views have the labels of `backbone`, or none."""
    if how.convention.depth == "planar" and (
        found := find_sentinel((view.depth for view in views), how.depth_scale or 1)
    ):
        values = [*how.said.get("invalid_depth", ()), found.value]
        yield f"{found}; set {how.change('invalid_depth', '[' + ', '.join(f'{value:.15g}' for value in values) + ']')}"
    some = [views[k] for k in evenly(len(views), REGISTERED_FRAMES)]
    if (offset := find_offset(list(_edges(scene, some)))) is not None:
        what = "the images" if some[0].labels is None else f"labels of {backbone}"
        mend = "register them to the depth"
        if "color_intrinsics" in scene.settings:
            mend = f"set {OPTION}color_intrinsics: [fx, fy, cx, cy], or {mend}"
        yield f"{what} look as if they were not registered to the depth: {offset}; {mend}"


def _edges(scene: Scene, views: Sequence[View]) -> Iterator[Edges]:
    """Depth and edges of the labels, or without labels of the images, of views."""
    for view in views:
        if view.labels is not None:
            yield view.depth, label_edges(view.labels, view.ignore_id)
            continue
        try:
            grey = scene.predicted(view.index, labels=grey_levels(scene.image(view.index))).labels
        except DataError:  # no image of the depth's view: whoever needs it says so
            continue
        if grey is not None:
            yield view.depth, image_edges(grey[:: view.stride, :: view.stride])
