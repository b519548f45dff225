"""Cameras of Agisoft Metashape: File, Export, Export Cameras, as Agisoft XML.

Source: Agisoft Metashape User Manual, Professional Edition, Appendix D, Camera models; its XML as version 2 writes it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydantic import BaseModel, Field

from semstab.core.types import Float64
from semstab.datasets.formats.disk import read_bytes
from semstab.datasets.geometry.cameras import Camera
from semstab.datasets.geometry.lenses import Lens
from semstab.datasets.photographs import PhotographOptions, Photographs, Reconstruction, Shot, from_geocentric
from semstab.errors import DataError, summarize_error

logger = logging.getLogger("semstab")

HEAD_BYTES = 4096
"""Bytes at the beginning of a file that show whether it is one of cameras."""

MOST_SKEW = 0.5
"""Pixels at the border of the image by which b2 may move a point, as no other camera here has such a term."""

Element = ElementTree.Element


class MetashapeOptions(PhotographOptions):
    """Options with the defaults of the format."""

    chunk: int | None = Field(None, ge=0, description="which of several chunks, counted from 0")


class Metashape(Photographs[MetashapeOptions]):
    """Cameras that are aligned and enabled. The cameras of a georeferenced chunk are brought into its projection.

    A chunk with a geographic reference system has geocentric coordinates; its cameras are brought into the zone of UTM,
    or into `crs`, in which the mesh has to be exported, too. The coordinates of a local chunk stay as they are.
    """

    Options: type[BaseModel] = MetashapeOptions
    contents = "cameras.xml of Metashape (File, Export, Export Cameras)"
    patterns = ("*.xml",)

    def has_cameras(self, path: Path) -> bool:
        """Return whether the file is a document with a chunk."""
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        return b"<document" in head and b"<chunk" in head

    def reconstruction(self, path: Path, folder: Path) -> Reconstruction:
        """Read the file. Raises what `read_chunk` and `from_geocentric` raise."""
        shots, reference = read_chunk(path, self.options.chunk)
        if reference is None or reference.lstrip().upper().startswith(("LOCAL_CS", "ENGCRS", "ENGINEERINGCRS")):
            return Reconstruction(path, shots)
        poses, georeference = from_geocentric(np.stack([s.pose for s in shots]), reference, self.options.crs, str(path))
        placed = [Shot(s.name, pose, s.camera, s.lens) for s, pose in zip(shots, poses, strict=True)]
        return Reconstruction(path, placed, georeference, (0.0, 0.0, 0.0))


def read_chunk(path: Path, wanted: int | None = None) -> tuple[list[Shot], str | None]:
    """Return the aligned cameras of a file's only chunk, or of the one with that number, and its reference system.

    Poses are from the camera to the chunk's world, in metres.

    Raises:
        DataError: For a damaged file, several chunks without a setting that selects one, an unknown camera model.
    """
    try:
        document = ElementTree.fromstring(read_bytes(path))
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: of an encoding
        raise DataError(f"{path}: no XML ({summarize_error(error)}); export the cameras again") from error
    chunks = document.findall("chunk")
    if not chunks:
        raise DataError(f"{path}: holds no chunk; export the cameras again, as Agisoft XML")
    if len(chunks) > 1 and wanted is None:
        names = ", ".join(f"{k}: {chunk.get('label', '')[:40]}" for k, chunk in enumerate(chunks[:5]))
        raise DataError(f"{path}: {len(chunks)} chunks ({names}); choose one: --option chunk=NUMBER")
    if not 0 <= (wanted or 0) < len(chunks):
        raise DataError(f"{path}: there is no chunk {wanted}; it has {len(chunks)}, counted from 0")
    chunk = chunks[wanted or 0]
    lenses = {name: sensor for sensor in chunk.iterfind("sensors/sensor") if (name := sensor.get("id")) is not None}
    world = _similarity(chunk.find("transform"), f"{path}: chunk")
    components = {
        part.get("id"): _similarity(part.find("transform"), f"{path}: component {part.get('id')}")
        for part in chunk.iterfind("components/component")
    }
    cameras = [camera for camera in chunk.iterfind("cameras//camera") if camera.get("enabled") not in ("0", "false")]
    aligned = [camera for camera in cameras if camera.find("transform") is not None]
    if not aligned:
        raise DataError(
            f"{path}: none of its {len(cameras)} cameras is aligned; align the photographs, and export again"
        )
    if len(aligned) < len(cameras):
        logger.warning("%s: %d of %d cameras are not aligned", path, len(cameras) - len(aligned), len(cameras))
    if len({camera.get("component_id") for camera in aligned}) > 1:
        raise DataError(
            f"{path}: its cameras are in several components, which share no coordinates; export one of them"
        )
    read: dict[str, tuple[Camera, Lens | None]] = {}
    shots = []
    for camera in aligned:
        name, sensor = camera.get("label") or f"camera {camera.get('id')}", camera.get("sensor_id", "")
        where = f"{path}: camera {name[:80]!r}"
        if sensor not in lenses:
            raise DataError(f"{where}: its sensor {sensor[:20]!r} is not in the file")
        if sensor not in read:
            read[sensor] = _lens(lenses[sensor], f"{path}: sensor {sensor}")
        scale, rigid = _product(world, components.get(camera.get("component_id"), (1.0, np.eye(4))))
        camera_pose = np.array(_numbers(camera.find("transform"), 16, where)).reshape(4, 4)
        pose = rigid @ camera_pose
        pose[:3, 3] = scale * rigid[:3, :3] @ camera_pose[:3, 3] + rigid[:3, 3]
        shots.append(Shot(name, pose, *read[sensor]))
    return shots, chunk.findtext("reference")


Similarity = tuple[float, Float64]
"""A scale, and a rigid matrix (4, 4): x -> scale R x + t."""


def _similarity(transform: Element | None, where: str) -> Similarity:
    """Return rotation, translation and scale of an element; those that it lacks do nothing."""
    T, scale = np.eye(4), 1.0
    if transform is None:
        return scale, T
    if (rotation := transform.find("rotation")) is not None:
        T[:3, :3] = np.array(_numbers(rotation, 9, where)).reshape(3, 3)
    if (translation := transform.find("translation")) is not None:
        T[:3, 3] = _numbers(translation, 3, where)
    if (size := transform.find("scale")) is not None:
        (scale,) = _numbers(size, 1, where)
    if not scale > 0:
        raise DataError(f"{where}: the scale is {scale:g}; export the cameras again")
    return scale, T


def _product(outer: Similarity, inner: Similarity) -> Similarity:
    """Return what the inner and then the outer one do."""
    rigid = outer[1] @ inner[1]
    rigid[:3, 3] = outer[0] * outer[1][:3, :3] @ inner[1][:3, 3] + outer[1][:3, 3]
    return outer[0] * inner[0], rigid


def _numbers(element: Element | None, count: int, where: str) -> list[float]:
    """Return the finite numbers that an element holds."""
    words = ("" if element is None else element.text or "").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        what = "the element" if element is None else f"'{element.tag}'"
        raise DataError(f"{where}: {what} must hold {count} number{'s' * (count > 1)}; export the cameras again")
    return values


def _lens(sensor: Element, where: str) -> tuple[Camera, Lens | None]:
    """Return the pinhole that stands for a sensor, and its lens where that distorts.

    Of the calibrations the adjusted one counts. P1 and P2 are OpenCV's p2 and p1, and pixels count from the corner of
    the first one.
    """
    calibrations = sensor.findall("calibration")
    calibration = next(
        (candidate for candidate in calibrations if candidate.get("class") == "adjusted"),
        next(iter(calibrations), None),
    )
    if calibration is None:
        raise DataError(f"{where}: has no calibration; align the photographs, and export the cameras again")
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", "fisheye"):
        raise DataError(f"{where}: the camera model {kind[:30]!r} is not read; there is frame, fisheye")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    try:
        width, height = (int(resolution.get(key, "")) for key in ("width", "height"))  # type: ignore[union-attr]
    except (AttributeError, ValueError) as error:
        raise DataError(f"{where}: has no resolution; export the cameras again") from error
    value = dict(_coefficients(calibration, where))
    f, b1, b2 = (value.get(key, 0.0) for key in ("f", "b1", "b2"))
    k1, k2, k3, k4, p1, p2, p3, p4 = (value.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"))
    beyond = p3 or p4 or (k4 and kind == "frame") or ((p1 or p2) and kind == "fisheye")
    if beyond or abs(b2) * height / 2 > MOST_SKEW * abs(f):
        raise DataError(
            f"{where}: has a coefficient that is not read here (b2, p3, p4; k4 of a frame, p1, p2 of a fisheye); export"
            " undistorted photographs with their cameras"
        )
    size, centre = (width, height), ((width - 1) / 2, (height - 1) / 2)
    cx, cy = value.get("cx", 0.0) + centre[0], value.get("cy", 0.0) + centre[1]
    stated = Camera.stated((f + b1, f, cx, cy), size, where)
    if kind == "frame" and not any((k1, k2, k3, p1, p2)):
        return stated, None
    coefficients = (k1, k2, p2, p1, k3) if kind == "frame" else (k1, k2, k3, k4)
    pinhole = Camera.stated((f, f, *centre), size, where)
    return pinhole, Lens(stated, "brown" if kind == "frame" else "fisheye", coefficients)


def _coefficients(calibration: Element, where: str) -> Iterator[tuple[str, float]]:
    for element in calibration:
        if element.tag in ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"):
            yield element.tag, _numbers(element, 1, where)[0]
