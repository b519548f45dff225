"""Make the table of the published measures of time: VC and TC, scene by scene, and of all scenes together."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from semstab.data.image_measures import ClipMean, VideoMeasures, WarpedOverlap
from semstab.data.records import Result
from semstab.metrics import macro_mean
from semstab.metrics.temporal_consistency import pooled_tc
from semstab.metrics.video_measures import CLIP_FIELDS
from semstab.report.tables.table import UNDEFINED, Cell, Column, Group, Row, Table

PUBLISHED, ALL_CLIPS, BY_ITSELF = "as VSPW", "all clips", "no truth"
ALL_PIXELS, SEEN = "TC", "TC, not hidden"

COLUMNS = (
    Column("scene", "Scene"),
    Column("vc8_published", "VC8", 4, "higher", over=PUBLISHED),
    Column("vc16_published", "VC16", 4, "higher", over=PUBLISHED),
    Column("vc8", "VC8", 4, "higher", over=ALL_CLIPS),
    Column("vc16", "VC16", 4, "higher", over=ALL_CLIPS),
    Column("self_vc8", "VC8", 4, "higher", over=BY_ITSELF),
    Column("self_vc16", "VC16", 4, "higher", over=BY_ITSELF),
    Column("tc_vspw", "VSPW", 4, "higher", over=ALL_PIXELS),
    Column("tc_etc", "ETC", 4, "higher", over=ALL_PIXELS),
    Column("tc_ssp", "SSP", 4, "higher", over=ALL_PIXELS),
    Column("tc_seen_vspw", "VSPW", 4, "higher", over=SEEN),
    Column("tc_seen_etc", "ETC", 4, "higher", over=SEEN),
    Column("tc_seen_ssp", "SSP", 4, "higher", over=SEEN),
)
FLOWS = {"depth": "depth and pose", "dis": "optical flow between the images (OpenCV's DIS)"}
CAPTION = (
    "VC8 and VC16 are video consistency over clips of 8 and 16 frames: as VSPW's script counts it, which leaves out the"
    " last clip of each video and counts pixels without a label; over all clips, of the labelled pixels; and of the"
    " prediction alone. TC is the mean IoU of a frame's labels with the next frame's, warped by {flow}, in the forms of"
    " VSPW, ETC and SSP, over all pixels that lead into the next image, and without those that are hidden there."
)
WITHOUT_TRUTH = " There is no ground truth of {scenes}: VC is that of the prediction alone."
TOGETHER = " All videos: clips and pixels of all scenes together; of SSP the mean over scenes."


def video_measures(result: Result) -> list[Table]:
    """Return VC and TC by model and scene, where they were asked for."""
    scenes: dict[str, dict[str, VideoMeasures]] = {}
    for record in result.select():
        if record.video_measures is not None:
            scenes.setdefault(record.unit.model, {})[record.unit.scene] = record.video_measures
    if not scenes:
        return []
    groups = tuple(
        Group(
            model,
            tuple((name, *_numbers([video])) for name, video in videos.items()),
            ("All videos", *_numbers([*videos.values()])) if len(videos) > 1 else None,
        )
        for model, videos in scenes.items()
    )
    all_videos = [(name, video) for videos in scenes.values() for name, video in videos.items()]
    lacking = dict.fromkeys(name for name, video in all_videos if not video.vc8.clips and video.self_vc8.clips)
    caption = CAPTION.format(flow=FLOWS[all_videos[0][1].flow])
    caption += WITHOUT_TRUTH.format(scenes=", ".join(lacking)) if lacking else ""
    caption += TOGETHER if any(group.total for group in groups) else ""
    return [Table("video_measures", f"Published measures of time ({UNDEFINED}: undefined)", caption, COLUMNS, groups)]


def _numbers(videos: Sequence[VideoMeasures]) -> Row:
    """Return the numbers of videos as of one set."""
    vc: list[Cell] = [_mean([getattr(video, name) for video in videos]) for name in CLIP_FIELDS]
    return (*vc, *_tc([video.tc for video in videos]), *_tc([video.tc_seen for video in videos]))


def _mean(videos: Sequence[ClipMean]) -> float:
    """Return the mean over all clips of all videos."""
    clips = sum(video.clips for video in videos)
    return sum(video.value * video.clips for video in videos if video.clips) / clips if clips else math.nan


def _tc(videos: Sequence[WarpedOverlap]) -> Row:
    """Return TC in the three forms; NaN for those that pool classes which differ from video to video."""
    ssp = macro_mean([video.ssp for video in videos])
    if len({len(video.sums[0]) for video in videos}) > 1:
        return math.nan, math.nan, ssp
    sums = np.array([video.sums for video in videos], dtype=np.int64).sum(axis=0)
    return pooled_tc(sums, "vspw"), pooled_tc(sums, "etc"), ssp
