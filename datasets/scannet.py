"""ScanNet as its SensReader exports it: color/, depth/, pose/, intrinsic/, and label-filt/.

Source: Dai et al., ScanNet, CVPR 2017, and SensReader/python (github.com/ScanNet/ScanNet).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import UInt16
from semstab.data.labels import IGNORE_16BIT
from semstab.datasets.files import options as opt
from semstab.datasets.files.labels import NO_ID
from semstab.datasets.files.options import FileOptions, FrameSource, TruthSource
from semstab.datasets.files.reader import FileDataset, frames_of
from semstab.datasets.formats.disk import MAX_TABLE_BYTES, files_named, read_intrinsics, read_text
from semstab.datasets.geometry.cameras import Camera
from semstab.errors import DataError

Which = Literal["depth", "color"]


class ScanNetOptions(FileOptions):
    """Options with the defaults of the format."""

    depth_scale: opt.DepthScale = 1000
    up_axis: opt.UpAxis = "z"
    ground_truth: opt.GroundTruth = "label-filt/{name}.png"
    void_ids: opt.VoidIds = opt.ZERO_IS_VOID
    intrinsics: Which = Field("depth", description="intrinsics of the depth images: of the depth or the colour camera")
    label_camera: Which = Field("color", description="field of view of label maps: of the colour or the depth camera")
    color_size: opt.Size = (1296, 968)
    class_table: Path | None = Field(None, description="scannetv2-labels.combined.tsv, for ids of the ground truth")
    class_column: str = Field("nyu40id", description="column of that table with the ids of the taxonomy")


class ScanNet(FileDataset[ScanNetOptions]):
    """{name} is the frame's number: 120. A frame whose pose is -inf has lost tracking."""

    Options: type[BaseModel] = ScanNetOptions
    contents = "depth/, pose/ and intrinsic/intrinsic_depth.txt"

    def is_scene(self, folder: Path) -> bool:
        """Return whether depth/, pose/ and the intrinsics of the depth are there; with a surface, the latter two."""
        complete = self.has_depth(folder / "depth") and (folder / "pose").is_dir()
        return complete and _matrix_file(folder, self.options.intrinsics).is_file()

    def frames(self, folder: Path) -> Iterable[FrameSource]:
        """Return a frame for each depth image."""
        camera = self._camera(folder, self.options.intrinsics)
        label_camera = None
        if self.options.label_camera != self.options.intrinsics and _matrix_file(folder, "color").is_file():
            label_camera = self._camera(folder, self.options.label_camera)
        depth = self.depth_files(folder / "depth", "", ".png", instead=files_named(folder / "pose", "", ".txt"))
        return frames_of(folder, depth, camera, pose="pose/{name}.txt", color="color/{name}", label_camera=label_camera)

    def truth(self, folder: Path) -> TruthSource:
        """Return the ground truth with ids of the class table's column, or with its own ids without a table."""
        table = self.options.class_table
        return TruthSource(ids=None if table is None else read_class_table(table, self.options.class_column))

    def _camera(self, folder: Path, which: Which) -> Camera:
        size = self.options.color_size if which == "color" else None
        return Camera(read_intrinsics(_matrix_file(folder, which)), size)


def read_class_table(path: Path, column: str) -> UInt16:
    """Return (65536,) the column's id for each ScanNet id: `IGNORE_16BIT` for an empty cell, `NO_ID` without a row.

    Raises:
        DataError: For a file without the columns, or an id that is no whole number.
    """
    lines = read_text(path, MAX_TABLE_BYTES).splitlines()
    header = lines[0].split("\t") if lines else []
    if "id" not in header or column not in header:
        raise DataError(f"{path}: there are no columns 'id' and '{column}'; set class_column to one it has")
    table = np.full(1 << 16, NO_ID, dtype=np.uint16)
    table[[0, IGNORE_16BIT]] = 0, IGNORE_16BIT
    for number, line in enumerate(lines[1:], start=2):
        row = dict(zip(header, line.split("\t"), strict=False))
        table[_id(row.get("id"), path, number)] = _id(row[column], path, number) if row.get(column) else IGNORE_16BIT
    return table


def _id(text: str | None, path: Path, line: int) -> int:
    if text is None or not (text.isascii() and text.isdecimal() and len(text) < 6 and int(text) < NO_ID):
        raise DataError(f"{path}: line {line} has the id {str(text)[:20]!r}; not a table of classes of ScanNet")
    return int(text)


def _matrix_file(folder: Path, which: Which) -> Path:
    """Return the file of SensReader's export, or of the export of 25,000 frames."""
    path = folder / f"intrinsic/intrinsic_{which}.txt"
    other = folder / f"intrinsics_{which}.txt"
    return other if not path.is_file() and other.is_file() else path
