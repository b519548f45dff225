"""Stability in image coordinates: flicker, flicker without the camera's motion, video consistency."""

from __future__ import annotations

from collections.abc import Iterable

from semstab.metrics import macro_mean
from semstab.model.records import ImageSpace, Result
from semstab.outputs.tables.table import Column, Group, Row, Table

_NUMBERS = (
    Column("flicker_percent", "Flicker (%)", 2, "lower"),
    Column("compensated_flicker_percent", "compensated (%)", 2, "lower"),
    Column("compensated_share_percent", "co-visible (%)", 2),
    Column("vc8", "VC8", 4, "higher"),
    Column("vc16", "VC16", 4, "higher"),
    Column("self_vc8", "VC8", 4, "higher", over="Without truth"),
    Column("self_vc16", "VC16", 4, "higher", over="Without truth"),
)
_WHAT = (
    "Flicker: share of the pixels valid in two consecutive sampled frames whose label changes. Compensated: the same"
    " after the earlier map is warped by depth and pose, occluded pixels left out, so that camera motion does not"
    " count; co-visible is the share of the valid pixels that the warped map reaches. VC8, VC16: video consistency, the"
    " share of the pixels whose ground truth stays the same through a clip of 8 or 16 frames and whose prediction does"
    " too; without truth, of all pixels valid throughout."
)
_REGIONS = (
    " Regions without classes ({names}) are matched from frame to frame; a pixel stays where its regions are a match."
)


def flicker(result: Result) -> list[Table]:
    """Frame-wise flicker, macro means by backbone, and scene by scene (paper, Frame-wise Temporal Semantic Flicker)."""
    methods = _by_method(result)
    if not methods:
        return []
    regions = dict.fromkeys(row.backbone for row in result.regions)
    what = _WHAT + (_REGIONS.format(names=", ".join(regions)) if regions else "")
    macro = tuple((name, *_numbers(scenes.values())) for name, scenes in methods.items())
    columns, caption = (Column("method", "Method"), *_NUMBERS), f"{what} Macro means: each scene counts once."
    tables = [Table("flicker", "Flicker in image space", caption, columns, (Group("", macro),), by="")]
    if any(len(scenes) > 1 for scenes in methods.values()):
        groups = tuple(
            Group(name, tuple((scene, *_numbers([found])) for scene, found in scenes.items()))
            for name, scenes in methods.items()
        )
        columns = (Column("scene", "Scene"), *_NUMBERS)
        tables.append(Table("flicker_by_scene", "Flicker in image space, by scene", what, columns, groups))
    return tables


def _by_method(result: Result) -> dict[str, dict[str, ImageSpace]]:
    """By backbone and scene; regions without classes have flicker only."""
    methods: dict[str, dict[str, ImageSpace]] = {}
    for record in result.select():
        methods.setdefault(record.unit.backbone, {})[record.unit.scene] = record.image_space
    for row in result.regions:
        found = ImageSpace(row.flicker_percent, row.compensated_flicker_percent, row.compensated_share)
        methods.setdefault(row.backbone, {})[row.scene] = found
    return methods


def _numbers(scenes: Iterable[ImageSpace]) -> Row:
    rows = list(scenes)
    return (
        macro_mean([row.flicker_percent for row in rows]),
        macro_mean([row.compensated_flicker_percent for row in rows]),
        100 * macro_mean([row.compensated_share for row in rows]),
        macro_mean([row.vc8 for row in rows]),
        macro_mean([row.vc16 for row in rows]),
        macro_mean([row.self_vc8 for row in rows]),
        macro_mean([row.self_vc16 for row in rows]),
    )
