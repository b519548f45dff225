"""Options of bags: topics, frames and stamps, which are found where they are not given."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from semstab.config import Settings
from semstab.datasets.files import options as opt
from semstab.datasets.files.options import FileOptions, Finite, Positive

Pose = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]


class PoseOptions(Settings):
    """Options of where the poses of a bag's sensor come from, and of its clock."""

    pose: str | None = Field(None, description="tf, or a topic of Odometry, PoseStamped or TransformStamped")
    trajectory: Path | None = Field(None, description="file of the poses instead: t tx ty tz qx qy qz qw (TUM)")
    world_frame: str | None = Field(None, description="frame that voxels are in: map, odom, ...")
    pose_frame: str | None = Field(None, description="frame that the poses of a topic or a file are of")
    extrinsics: Pose | None = Field(
        None, description="[x, y, z, qx, qy, qz, qw] of the sensor's frame in the frame that poses are of"
    )
    stamps: Literal["header", "bag"] = Field("header", description="time of a message: its header's, or the bag's")
    max_pose_gap: Positive = Field(0.5, description="most seconds between the two poses around a frame or a scan")
    time_offset: opt.TimeOffset = 0.0


class BagOptions(PoseOptions, FileOptions):
    """Options with the defaults of ROS: topics and frames that are not named are found."""

    root: Path = Field(description="a bag, or the folder above bags")
    depth: str | None = Field(None, description="topic of depth images")
    color: str | None = Field(None, description="topic of colour images")
    camera_info: str | None = Field(None, description="topic of the depth camera's CameraInfo")
    color_info: str | None = Field(None, description="topic of the colour camera's CameraInfo")
    label_topics: dict[str, str] | None = Field(
        None, description="topics of label maps by label source, gt for the ground truth; {} for none"
    )
    camera_frame: str | None = Field(None, description="optical frame of the camera in /tf, if not the header's")
    max_difference: Positive = Field(0.02, description="seconds by which depth, colour and labels may differ")
    rectified: bool | None = Field(None, description="whether images are rectified, if not as 'rect' in their topic")
    labels_on: Literal["original", "undistorted"] = Field(
        "original", description="images that label maps belong to: the bag's own, or undistorted ones"
    )
    intrinsics: opt.FourIntrinsics = None
    up_axis: opt.UpAxis = "z"
