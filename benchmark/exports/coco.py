"""Write annotation tasks as COCO instances, which annotation tools import, with the images that they name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from semstab.core.files import write_image, write_json
from semstab.data.labels import LabelSpace
from semstab.errors import ConfigError
from semstab.exports.annotation import AnnotationTask
from semstab.task import Task

FORMAT = "coco"

MOST = 50
"""The number of tasks by default."""


@dataclass(frozen=True, eq=False)
class TaskFile:
    """The tasks of a scene, the most urgent first, and the file in which they are stored.

    Attributes:
        space: The classes that are annotated.
        source: The label source, whose fused classes are proposed.
    """

    tasks: Sequence[AnnotationTask]
    space: LabelSpace
    scene: str
    source: str
    path: Path

    @property
    def folder(self) -> Path:
        """Return the folder of the images: tasks_images next to tasks.json."""
        return self.path.with_name(f"{self.path.stem}_images")

    def image(self, task: AnnotationTask) -> str:
        """Return the file of a task's image, relative to that of the tasks."""
        return f"{self.folder.name}/{task.image.replace('/', '_')}.jpg"

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Return the width and height of each image, pixels, by its file."""
        return {self.image(task): task.size for task in self.tasks}


def about(task: AnnotationTask) -> dict[str, Any]:
    """Return the properties of a task's location."""
    return {
        "score": round(task.score, 3), "fused": task.label, "second": task.other, "voxels": task.voxels, "op": task.op,
        "center": [round(x, 3) for x in task.center], "views": list(task.views),
    }  # fmt: skip


def write_coco(file: TaskFile) -> None:
    """Write COCO's instances, polygons in the order of their scores."""
    sizes = file.sizes()
    numbers = {name: k for k, name in enumerate(sizes, start=1)}
    ids = {name: k for k, name in enumerate(file.space.classes, start=1)}
    annotations: list[dict[str, Any]] = []
    for rank, task in enumerate(file.tasks, start=1):
        low = [min(float(p[:, k].min()) for p in task.outline) for k in range(2)]
        high = [max(float(p[:, k].max()) for p in task.outline) for k in range(2)]
        area = sum(float(cv2.contourArea(p.astype("float32"))) for p in task.outline)
        annotation: dict[str, Any] = {
            "id": rank, "image_id": numbers[file.image(task)], "category_id": ids[task.label], "iscrowd": 0,
            "segmentation": [p.ravel().tolist() for p in task.outline], "area": area,
            "bbox": [*low, high[0] - low[0], high[1] - low[1]],
        }  # fmt: skip
        annotations.append(annotation | about(task))
    write_json(file.path, {
        "info": {"description": f"{file.scene}, {file.source}: locations where frames disagree, by semstab"},
        "licenses": [],
        "images": [
            {"id": numbers[name], "file_name": name, "width": W, "height": H} for name, (W, H) in sizes.items()
        ],
        "categories": [{"id": k, "name": name, "supercategory": ""} for name, k in ids.items()],
        "annotations": annotations,
    })  # fmt: skip


def check(kind: str, path: Path) -> None:
    """Raise ConfigError if a format is not known, or the file has the suffix of another format."""
    if kind != FORMAT:
        raise ConfigError(
            f"no format '{kind}'; write {FORMAT}, which CVAT, Label Studio and FiftyOne import (docs/annotation.md)"
        )
    if path.suffix.lower() != ".json":
        raise ConfigError(f"{path}: {FORMAT} is a .json file")


def write_tasks(file: TaskFile, task: Task) -> str:
    """Write tasks of frames, and their images; return where the images are."""
    for of_image in {task.image: task for task in file.tasks}.values():
        color = task.scene.color(of_image.frame)
        assert color is not None
        image = file.path.parent / file.image(of_image)
        write_image(image, cv2.cvtColor(color, cv2.COLOR_RGB2BGR), cv2.IMWRITE_JPEG_QUALITY, 95)
    write_coco(file)
    return f"images: {file.folder}"
