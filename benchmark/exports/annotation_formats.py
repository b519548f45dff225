"""Write annotation tasks as files of COCO, Label Studio, CVAT and FiftyOne, with the images that they name."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2

from semstab.config import nearest
from semstab.core.files import write_image, write_json, write_text
from semstab.data.labels import LabelSpace, is_line
from semstab.errors import ConfigError
from semstab.exports.annotation import AnnotationTask
from semstab.task import Task

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

    def by_image(self) -> dict[str, list[tuple[int, AnnotationTask]]]:
        """Return the tasks, numbered from 1, by the file of their image."""
        tasks: dict[str, list[tuple[int, AnnotationTask]]] = {}
        for rank, task in enumerate(self.tasks, start=1):
            tasks.setdefault(self.image(task), []).append((rank, task))
        return tasks

    def companion(self, ending: str) -> Path:
        """Return a further file: tasks_ENDING next to tasks.json."""
        return self.path.with_name(f"{self.path.stem}_{ending}")


def about(task: AnnotationTask) -> dict[str, Any]:
    """Return the properties of a task's location."""
    return {
        "score": round(task.score, 3), "fused": task.label, "second": task.other, "voxels": task.voxels, "op": task.op,
        "center": [round(x, 3) for x in task.center], "views": list(task.views),
    }  # fmt: skip


def coco(file: TaskFile) -> Iterator[str]:
    """Write COCO's instances, polygons in the order of their scores; yield notes on their use."""
    numbers = {name: k for k, name in enumerate(file.by_image(), start=1)}
    sizes = {file.image(task): task.size for task in file.tasks}
    ids = {name: k for k, name in enumerate(file.space.classes, start=1)}
    annotations: list[dict[str, Any]] = []
    for rank, task in enumerate(file.tasks, start=1):
        low = [min(float(p[:, k].min()) for p in task.outline) for k in range(2)]
        high = [max(float(p[:, k].max()) for p in task.outline) for k in range(2)]
        area = sum(float(cv2.contourArea(p.astype("float32"))) for p in task.outline)
        own: dict[str, Any] = {
            "id": rank, "image_id": numbers[file.image(task)], "category_id": ids[task.label], "iscrowd": 0,
            "segmentation": [p.ravel().tolist() for p in task.outline], "area": area,
            "bbox": [*low, high[0] - low[0], high[1] - low[1]],
        }  # fmt: skip
        annotations.append(own | about(task))
    write_json(file.path, {
        "info": {"description": f"{file.scene}, {file.source}: locations where frames disagree, by semstab"},
        "licenses": [],
        "images": [
            {"id": k, "file_name": name, "width": sizes[name][0], "height": sizes[name][1]}
            for name, k in numbers.items()
        ],
        "categories": [{"id": k, "name": name, "supercategory": ""} for name, k in ids.items()],
        "annotations": annotations,
    })  # fmt: skip
    yield f"images: {file.folder}"


def label_studio(file: TaskFile) -> Iterator[str]:
    """Write Label Studio's tasks with a predicted polygon, and the labelling set-up; yield notes on their use."""
    rows = []
    for rank, task in enumerate(file.tasks, start=1):
        W, H = task.size
        polygons = [
            {
                "id": f"{rank}.{k}", "type": "polygonlabels", "from_name": "label", "to_name": "image",
                "original_width": W, "original_height": H, "image_rotation": 0,
                "value": {
                    "points": [[100 * x / W, 100 * y / H] for x, y in polygon.tolist()], "closed": True,
                    "polygonlabels": [task.label],
                },
            }
            for k, polygon in enumerate(task.outline, start=1)
        ]  # fmt: skip
        data = {"image": f"/data/local-files/?d={file.image(task)}", "title": f"{rank}: {task.label} or {task.other}?"}
        predictions = [{"model_version": file.source, "result": polygons}]
        rows.append({"data": {"rank": rank} | data | about(task), "predictions": predictions})
    write_json(file.path, rows)
    labels = (_node("Label", value=name, background=color) for name, color in _colors(file.space))
    image = _node("Image", name="image", value="$image", zoom="true")
    view = _node(
        "View", _node("Header", value="$title"), image, _node("PolygonLabels", *labels, name="label", toName="image")
    )
    setup = file.companion("config.xml")
    write_text(setup, _xml(view, declaration=False))
    yield f"set-up of the project: {setup}; serve {file.folder} as local files"


def cvat(file: TaskFile) -> Iterator[str]:
    """Write CVAT for images 1.1, and the labels for the task's raw constructor; yield notes on their use."""
    images, colors, own = file.by_image(), list(_colors(file.space)), ("task", "score", "second")
    text = ("mutable", "False"), ("input_type", "text"), ("default_value", ""), ("values", "")
    attributes = [_node("attribute", _node("name", what), *(_node(*pair) for pair in text)) for what in own]
    labels = [
        _node("label", _node("name", name), _node("color", color), _node("attributes", *attributes))
        for name, color in colors
    ]
    scene = _node("name", f"{file.scene}, {file.source}"), _node("size", str(len(images))), _node("mode", "annotation")
    drawn = []
    for k, (name, tasks) in enumerate(images.items()):
        W, H = tasks[0][1].size
        polygons = [
            _node(
                "polygon",
                *(_node("attribute", value, name=what) for what, value in zip(own, values, strict=True)),
                label=task.label, source="semstab", occluded="0", z_order="0", group_id=str(rank),
                points=";".join(f"{x:.2f},{y:.2f}" for x, y in polygon.tolist()),
            )
            for rank, task in tasks
            for values in [(str(rank), f"{task.score:.3f}", task.other)]
            for polygon in task.outline
        ]  # fmt: skip
        drawn.append(_node("image", *polygons, id=str(k), name=Path(name).name, width=str(W), height=str(H)))
    meta = _node("meta", _node("task", *scene, _node("labels", *labels)))
    write_text(file.path, _xml(_node("annotations", _node("version", "1.1"), meta, *drawn)))
    constructor = file.companion("labels.json")
    declared = [{"name": what, "mutable": False, "input_type": "text", "values": [""]} for what in own]
    write_json(constructor, [{"name": name, "color": color, "attributes": declared} for name, color in colors])
    yield f"labels of the task: {constructor} (Raw); images: {file.folder}; then upload as 'CVAT 1.1'"


def fiftyone(file: TaskFile) -> Iterator[str]:
    """Write FiftyOne's dataset as JSON, a sample with polylines for each image; yield notes on its use."""
    fields, labels = "fiftyone.core.fields", "fiftyone.core.labels.Polylines"
    samples = []
    for name, tasks in file.by_image().items():
        polylines = []
        for rank, task in tasks:
            W, H = task.size
            points = [[[x / W, y / H] for x, y in polygon.tolist()] for polygon in task.outline]
            polylines.append({"_cls": "Polyline", "label": task.label, "points": points, "closed": True, "filled": True,
                              "attributes": {}, "tags": [], "task": rank, **about(task)})  # fmt: skip
        samples.append({"filepath": name, "tags": [], "metadata": None, "_media_type": "image",
                        "score": max(each["score"] for each in polylines),
                        "places": {"_cls": "Polylines", "polylines": polylines}})  # fmt: skip
    write_json(file.path, {
        "name": f"semstab-{file.scene}-{file.source}",
        "media_type": "image",
        "sample_fields": {
            "score": f"{fields}.FloatField",
            "places": f"{fields}.EmbeddedDocumentField({labels})",
        },
        "info": {"scene": file.scene, "source": file.source},
        "default_classes": list(file.space.classes),
        "samples": samples,
    })  # fmt: skip
    yield f'open: fiftyone.Dataset.from_json("{file.path.name}", rel_dir=".")'


FORMATS: Mapping[str, tuple[str, Callable[[TaskFile], Iterator[str]]]] = {
    "coco": (".json", coco), "labelstudio": (".json", label_studio), "cvat": (".xml", cvat),
    "fiftyone": (".json", fiftyone),
}  # fmt: skip
"""The formats by name: the suffix of the file, and the function that writes it and yields notes on its use."""


def check(kind: str, path: Path) -> None:
    """Raise ConfigError where a format is not known, or the file has the suffix of another format."""
    if kind not in FORMATS:
        raise ConfigError(f"no format '{kind}'; {nearest(kind, [*FORMATS])}")
    if path.suffix.lower() != FORMATS[kind][0]:
        raise ConfigError(f"{path}: {kind} is a {FORMATS[kind][0]} file")


def write_tasks(file: TaskFile, kind: str, task: Task) -> tuple[str, ...]:
    """Write tasks of frames, and their images; return notes on their use."""
    for one in {task.image: task for task in file.tasks}.values():
        color = task.scene.color(one.frame)
        assert color is not None
        image = file.path.parent / file.image(one)
        write_image(image, cv2.cvtColor(color, cv2.COLOR_RGB2BGR), cv2.IMWRITE_JPEG_QUALITY, 95)
    return tuple(FORMATS[kind][1](file))


def _colors(space: LabelSpace) -> Iterator[tuple[str, str]]:
    """Yield each class with its colour: '#ff0000'."""
    yield from (
        (name, "#{:02x}{:02x}{:02x}".format(*color)) for name, color in zip(space.classes, space.colors, strict=True)
    )


def _node(tag: str, *content: ElementTree.Element | str, **attributes: str) -> ElementTree.Element:
    """Return an element with a text or others in it."""
    node = ElementTree.Element(tag, {key: _in_xml(value) for key, value in attributes.items()})
    node.text = _in_xml("".join(each for each in content if isinstance(each, str))) or None
    node.extend(each for each in content if not isinstance(each, str))
    return node


def _in_xml(text: str) -> str:
    """Return a text with U+FFFD for the characters that XML cannot hold, which a scene's or an image's name may."""
    return "".join(c if is_line(c) else "\ufffd" for c in text)


def _xml(root: ElementTree.Element, *, declaration: bool = True) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=declaration) + "\n"
