"""Make the tables of stability in image coordinates: flicker, with and without motion, and video consistency."""

from __future__ import annotations

from collections.abc import Iterable

from semstab.data.image_measures import ImageSpace
from semstab.data.records import Result
from semstab.metrics.image_space import mean_over_scenes
from semstab.report.tables.table import Column, Group, Row, Table

# Stability in image coordinates: flicker, flicker without the camera's motion, video consistency.

_NUMBERS = (
    Column("flicker_percent", "Pixel flicker (%)", 2, "lower"),
    Column("compensated_flicker_percent", "Flicker (%)", 2, "lower"),
    Column("compensated_share_percent", "co-visible (%)", 2),
    Column("vc8", "VC8", 4, "higher"),
    Column("vc16", "VC16", 4, "higher"),
    Column("self_vc8", "VC8", 4, "higher", over="Without truth"),
    Column("self_vc16", "VC16", 4, "higher", over="Without truth"),
)
_WHAT = (
    "Pixel flicker is the share of the pixels valid in two consecutive sampled frames whose label changes. Flicker is"
    " the same share after the earlier map is warped by {motion}, without occluded pixels, so that {motion_of}"
    " does not count; co-visible is the share of the valid pixels that the warped map reaches. VC8 and VC16 are video"
    " consistency: of the pixels whose ground truth stays the same through a clip of 8 or 16 frames, the share whose"
    " prediction stays the same. Without truth they are of all pixels that are valid throughout the clip."
)
_REGIONS = (
    " Regions without classes ({names}) are matched from frame to frame; a pixel is unchanged if its regions match."
)


def flicker(result: Result) -> list[Table]:
    """Return flicker by model, and scene by scene (paper, Frame-wise Temporal Semantic Flicker)."""
    if not (methods := _by_method(result)):
        return []
    if result.select() and not result.maps.records:
        motion = "optical flow between the images (OpenCV's DIS)"
        what = _WHAT.format(motion=motion, motion_of="motion of the camera and of things")
    else:
        what = _WHAT.format(motion="depth and pose", motion_of="camera motion")
    regions = dict.fromkeys(row.model for row in result.regions)
    what += _REGIONS.format(names=", ".join(regions)) if regions else ""
    groups = tuple(
        Group(
            name,
            tuple((scene, *_numbers([numbers])) for scene, numbers in scenes.items()),
            ("Mean", *_numbers(scenes.values())) if len(scenes) > 1 else None,
        )
        for name, scenes in methods.items()
    )
    caption = f"{what} The mean is a macro mean: each scene counts once."
    return [Table("flicker", "Flicker in image space", caption, (Column("scene", "Scene"), *_NUMBERS), groups)]


def _by_method(result: Result) -> dict[str, dict[str, ImageSpace]]:
    """Return the numbers by model and scene; regions without classes have flicker only."""
    methods: dict[str, dict[str, ImageSpace]] = {}
    for record in result.select():
        methods.setdefault(record.unit.model, {})[record.unit.scene] = record.image_space
    for row in result.regions:
        numbers = ImageSpace(row.flicker_percent, row.compensated_flicker_percent, row.compensated_share)
        methods.setdefault(row.model, {})[row.scene] = numbers
    return methods


def _numbers(scenes: Iterable[ImageSpace]) -> Row:
    mean = mean_over_scenes(scenes)
    return (
        mean.flicker_percent, mean.compensated_flicker_percent, 100 * mean.compensated_share, mean.vc8, mean.vc16,
        mean.self_vc8, mean.self_vc16,
    )  # fmt: skip
