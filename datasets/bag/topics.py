"""Choice of bag topics of depth, colour, labels and cameras: by type, encoding and name, or as options name them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from semstab.config import nearest
from semstab.datasets.bag.images import COMPRESSED, DEPTH_ENCODINGS, ID_ENCODINGS, IMAGES, RAW, ImageKind, kind_of
from semstab.datasets.bag.options import BagOptions
from semstab.datasets.bag.poses import POSES, TF, TF_TYPE
from semstab.datasets.bag.reading import OpenBag
from semstab.datasets.geometry.transforms import bare
from semstab.datasets.scene import GROUND_TRUTH
from semstab.errors import DataError

INFO = "sensor_msgs/CameraInfo"

LABELS = re.compile(r"label|semantic|segment|(?:^|[/_])seg(?:$|[/_])|(?:^|[/_])class(?:es)?(?:$|[/_])")
"""Pattern of the names of topics of label maps."""
REGISTERED = re.compile(r"aligned|registered")
"""Pattern of the names of topics of depth in the pixels of colour."""
NO_COLOR = re.compile(r"infra|(?:^|[/_])ir(?:$|[/_\d])|depth|disparity|thermal")
TRANSPORT = re.compile(r"/(?:compressed|compressedDepth)$")


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images: how they are stored, and the frame of the first one."""

    topic: str
    kind: ImageKind
    frame: str

    @property
    def base(self) -> str:
        """Return the topic's name without the transport that compressed images have in theirs."""
        return TRANSPORT.sub("", self.topic)

    def __str__(self) -> str:
        """Return both in words."""
        return f"{self.topic} ({self.kind})"


@dataclass(frozen=True)
class ChosenTopics:
    """The topics that a scene is read from; None or empty for a missing topic.

    Attributes:
        depth: Depth images.
        color: Colour images.
        labels: Label maps by label source.
        depth_info: CameraInfo of the depth images.
        color_info: CameraInfo of the colour images.
        others: Other topics that could be depth or colour.
    """

    depth: ImageTopic | None
    color: ImageTopic | None
    labels: dict[str, ImageTopic]
    depth_info: str | None
    color_info: str | None
    others: tuple[str, ...]


def choose(bag: OpenBag, options: BagOptions) -> ChosenTopics:
    """Return the topics of a bag that options name, else the likeliest ones.

    Raises:
        DataError: If parts are missing that a scene needs, with the topics that there are, or a named topic is none.
    """
    for name, (topic, types) in _named(options).items():
        require(bag, name, topic, types)
    images = dict(_images(bag, options))
    labels = _labels(images, options)
    unlabelled = [
        candidate
        for candidate in images.values()
        if candidate not in labels.values() and not LABELS.search(candidate.topic.lower())
    ]
    depths = [candidate for candidate in unlabelled if is_depth(candidate)]
    colors = [candidate for candidate in unlabelled if is_color(candidate)]
    depth = _one(options.depth, images, depths, lambda candidate: _depth_rank(candidate, bag))
    color = _one(options.color, images, colors, lambda candidate: _color_rank(candidate, depth))
    cast = options.surface is not None
    if cast and options.depth is None:
        depth = None
    primary = depth or color
    depth_info = None if primary is None else options.camera_info or _info_of(bag, primary)
    color_info = None if color is None else options.color_info or _info_of(bag, color)
    lacks = []
    if depth is None and not cast:
        lacks.append("depth images (16UC1, 32FC1 or compressedDepth)")
    if color is None and cast:
        lacks.append("colour images")
    if depth_info is None and options.intrinsics is None and not bag.of_types(INFO):
        lacks.append("camera info")
    if options.trajectory is None and not bag.of_types(*TF_TYPE, *POSES):
        lacks.append("poses")
    if not lacks and depth_info is None and options.intrinsics is None and primary is not None:
        raise DataError(
            f"{bag.path}: no camera info is of {primary.topic}; set camera_info: TOPIC, one of"
            f" {', '.join(bag.of_types(INFO))}"
        )
    if lacks:
        held = f"{', '.join(lacks[:-1])} and no {lacks[-1]}" if len(lacks) > 1 else lacks[0]
        raise DataError(
            f"{bag.path}: holds no {held}; record these, too, or use images in folders with the bag's poses"
            f" (docs/datasets.md, TUM RGB-D); its topics: {bag.listed()}"
        )
    other_topics = [candidate.topic for candidate in depths + colors if candidate not in (depth, color)]
    return ChosenTopics(depth, color, labels, depth_info, color_info, tuple(other_topics))


def has_depth(bag: OpenBag) -> bool:
    """Return whether a bag has a topic that is taken for depth; raises DataError for a damaged one."""
    images = dict(_images(bag, BagOptions(root=bag.path)))
    return any(is_depth(candidate) and not LABELS.search(candidate.topic.lower()) for candidate in images.values())


def is_depth(images: ImageTopic) -> bool:
    """Return whether images may be depth, by encoding and name."""
    if images.kind.transport == "compressedDepth" or images.kind.encoding == "32FC1":
        return True
    if images.kind.encoding == "16UC1":
        return not re.search("infra", images.topic.lower())
    return images.kind.encoding == "mono16" and "depth" in images.topic.lower()


def is_color(images: ImageTopic) -> bool:
    """Return whether images may be colour."""
    return images.kind.transport != "compressedDepth" and images.kind.encoding not in DEPTH_ENCODINGS


def _named(options: BagOptions) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the topics that options name, with the types that each may have."""
    topics = {
        "depth": (options.depth, IMAGES),
        "color": (options.color, IMAGES),
        "camera_info": (options.camera_info, (INFO,)),
        "color_info": (options.color_info, (INFO,)),
        "pose": (None if options.pose == TF else options.pose, tuple(POSES)),
    }
    labels = {f"label_topics.{name}": (topic, IMAGES) for name, topic in (options.label_topics or {}).items()}
    return {name: (topic, types) for name, (topic, types) in (topics | labels).items() if topic is not None}


def require(bag: OpenBag, option: str, name: str, types: tuple[str, ...]) -> None:
    """Raise DataError if the topic that an option names is not there, of none of the types, or empty."""
    topic = bag.topics.get(name)
    if topic is None:
        raise DataError(f"{bag.path}: option {option}: there is no topic '{name}'; {nearest(name, [*bag.topics])}")
    if topic.type not in types or not topic.count:
        what = f"of type {topic.type}, not {' or '.join(types)}" if topic.count else "without a message"
        raise DataError(f"{bag.path}: option {option}: {name} is {what}; its topics: {bag.listed()}")


def _images(bag: OpenBag, options: BagOptions) -> Iterable[tuple[str, ImageTopic]]:
    """Yield the topics of images that can be read; of a named one that cannot be an error is raised."""
    requested = {topic for topic, _ in _named(options).values()}
    for name in bag.of_types(RAW, COMPRESSED):
        try:
            message = bag.first(name)
            if message is None:
                raise DataError(f"{bag.path}, {name}: holds no message that can be read; record the bag again")
            kind = kind_of(message, bag.topics[name].type, f"{bag.path}, {name}")
        except DataError:
            if name in requested:
                raise
        else:
            yield name, ImageTopic(name, kind, bare(message.header.frame_id))


def _labels(images: dict[str, ImageTopic], options: BagOptions) -> dict[str, ImageTopic]:
    if options.label_topics is not None:
        return {name: images[topic] for name, topic in options.label_topics.items()}
    label_maps = [
        candidate
        for candidate in images.values()
        if LABELS.search(candidate.topic.lower())
        and candidate.kind.encoding in ID_ENCODINGS
        and (candidate.kind.transport == "raw" or candidate.kind.suffix == ".png")
        and candidate.topic not in (options.depth, options.color)
    ]
    return {
        _source_name(candidate.base): candidate
        for candidate in sorted(label_maps, key=lambda candidate: candidate.kind.transport, reverse=True)
    }


def _source_name(topic: str) -> str:
    """Return the label source that a topic is: /net/labels is net-labels."""
    name = re.sub(r"[^\w.]+", "-", topic).strip("-.") or "labels"
    return f"{name}-labels" if name == GROUND_TRUTH else name


Rank = tuple[bool | int | str, ...]


def _one(
    topic: str | None, images: dict[str, ImageTopic], candidates: list[ImageTopic], rank: Callable[[ImageTopic], Rank]
) -> ImageTopic | None:
    """Return the images of a named topic, else the candidate of the lowest rank, or None without candidates."""
    return images[topic] if topic is not None else min(candidates, key=rank, default=None)


def _depth_rank(images: ImageTopic, bag: OpenBag) -> Rank:
    return (
        not REGISTERED.search(images.topic),
        _info_of(bag, images) is None,
        "depth" not in images.topic.lower(),
        images.kind.transport != "raw",
        images.topic,
    )


def _color_rank(images: ImageTopic, depth: ImageTopic | None) -> Rank:
    return (
        bool(NO_COLOR.search(images.topic.lower())),
        images.kind.encoding in ID_ENCODINGS,
        depth is not None and images.frame != depth.frame,
        "rect" not in images.base.rpartition("/")[2],
        images.kind.transport != "raw",
        images.topic,
    )


def _info_of(bag: OpenBag, images: ImageTopic) -> str | None:
    """Return the CameraInfo topic of images: the topic of their namespace, else of their frame, else None."""
    infos = bag.of_types(INFO)
    sibling = f"{images.base.rpartition('/')[0]}/camera_info"
    if sibling in infos:
        return sibling
    firsts = ((name, bag.first(name)) for name in infos)
    of_frame = [
        name for name, message in firsts if message is not None and bare(message.header.frame_id) == images.frame
    ]
    return min(of_frame, default=None)
