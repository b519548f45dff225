"""Images of ROS messages as the bytes of an image file: PNG and JPEG as they were sent, raw pixels as .npy.

Sources: sensor_msgs/Image and sensor_msgs/image_encodings; image_transport_plugins (compressed_image_transport,
compressed_depth_image_transport).
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from semstab.core.types import Float32
from semstab.datasets.formats.decoders import PNG_SIGNATURE
from semstab.datasets.formats.disk import AGAIN
from semstab.datasets.formats.image_sizes import MAX_PIXELS
from semstab.errors import DataError

JPEG_SIGNATURE = b"\xff\xd8"
RAW, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
IMAGES = (RAW, COMPRESSED)

PIXELS: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3), "rgba8": ("u1", 4), "bgra8": ("u1", 4), "8UC4": ("u1", 4),
    "rgb16": ("u2", 3), "bgr16": ("u2", 3),
    "mono8": ("u1", 1), "8UC1": ("u1", 1), "mono16": ("u2", 1), "16UC1": ("u2", 1), "32FC1": ("f4", 1),
    "bayer_rggb8": ("u1", 1), "bayer_bggr8": ("u1", 1), "bayer_gbrg8": ("u1", 1), "bayer_grbg8": ("u1", 1),
    "yuv422": ("u1", 2), "uyvy": ("u1", 2), "yuv422_yuy2": ("u1", 2), "yuyv": ("u1", 2),
}  # fmt: skip
"""The type and number of samples of a pixel, by encoding."""

TO_RGB = {
    "bgr8": "BGR2RGB", "8UC3": "BGR2RGB", "bgr16": "BGR2RGB", "rgba8": "RGBA2RGB", "bgra8": "BGRA2RGB",
    "8UC4": "BGRA2RGB", "mono8": "GRAY2RGB", "8UC1": "GRAY2RGB", "mono16": "GRAY2RGB", "16UC1": "GRAY2RGB",
    "bayer_rggb8": "BayerRGGB2RGB", "bayer_bggr8": "BayerBGGR2RGB", "bayer_gbrg8": "BayerGBRG2RGB",
    "bayer_grbg8": "BayerGRBG2RGB", "yuv422": "YUV2RGB_UYVY", "uyvy": "YUV2RGB_UYVY", "yuv422_yuy2": "YUV2RGB_YUY2",
    "yuyv": "YUV2RGB_YUY2",
}  # fmt: skip
"""OpenCV's conversion, by encoding; rgb8 and rgb16 need none."""

DEPTH_ENCODINGS = ("16UC1", "32FC1", "mono16")
ID_ENCODINGS = ("mono8", "mono16", "8UC1", "16UC1")

DEPTH_HEADER = struct.Struct("<iff")
"""Before a compressed depth image: its format, and the two parameters of inverse depth, a and b."""


@dataclass(frozen=True)
class ImageKind:
    """How the images of a topic are stored.

    Attributes:
        encoding: Of the pixels: rgb8, 16UC1, ...; empty for a compressed image that does not say it.
        transport: raw, compressed or compressedDepth.
        suffix: Suffix of the file that `content` gives.
    """

    encoding: str
    transport: str
    suffix: str

    def __str__(self) -> str:
        """Return both in words."""
        return " ".join(word for word in (self.encoding, "" if self.transport == "raw" else self.transport) if word)


def kind_of(message: Any, type_: str, where: str) -> ImageKind:
    """Return how an image message of that type is stored.

    Raises:
        DataError: For a compression that is not read, with `where`.
    """
    if type_ == RAW:
        return ImageKind(message.encoding, "raw", ".npy")
    encoding, _, how = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "compressedDepth" in how or data[DEPTH_HEADER.size :].startswith(PNG_SIGNATURE):
        if not data[DEPTH_HEADER.size :].startswith(PNG_SIGNATURE):
            raise DataError(f"{where}: compressed depth of format {message.format!r} is not PNG; record it as png")
        return ImageKind(encoding or "16UC1", "compressedDepth", ".npy" if encoding == "32FC1" else ".png")
    for signature, suffix in ((JPEG_SIGNATURE, ".jpg"), (PNG_SIGNATURE, ".png")):
        if data.startswith(signature):
            return ImageKind(encoding if how else "", "compressed", suffix)
    raise DataError(f"{where}: compression {message.format!r} is neither JPEG nor PNG; record it as one of them")


def content(message: Any, kind: ImageKind, where: str, *, color: bool) -> bytes:
    """Return an image message as the content of a file: of `color` as RGB (H, W, 3) uint8, else as it is stored.

    Raises:
        DataError: For another kind than the topic's first image, or pixels that cannot be read, with `where`.
    """
    if kind.transport == "raw":
        if message.encoding != kind.encoding:
            raise DataError(f"{where}: is {message.encoding}, but the first image of the topic is {kind.encoding}")
        samples = samples_of(message, where)
        return npy(_rgb(samples, kind.encoding, where) if color else samples)
    data: bytes = message.data.tobytes()
    if kind.transport == "compressed":
        return data
    if len(data) <= DEPTH_HEADER.size:
        raise DataError(f"{where}: the compressed depth image is truncated; {AGAIN}")
    image = data[DEPTH_HEADER.size :]
    return image if kind.suffix == ".png" else npy(_from_inverse(image, data, where))


def samples_of(message: Any, where: str) -> npt.NDArray[Any]:
    """Return the pixels of a sensor_msgs/Image, (H, W) or (H, W, channels), in the machine's order of bytes.

    Raises:
        DataError: For an encoding that is not known, or fewer bytes than the image has, with `where`.
    """
    if message.encoding not in PIXELS:
        raise DataError(f"{where}: encoding {message.encoding!r} is not read; known: {', '.join(PIXELS)}")
    code, channels = PIXELS[message.encoding]
    dtype = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
    H, W, row = int(message.height), int(message.width), int(message.step)
    least = W * channels * dtype.itemsize
    if not 0 < H * W <= MAX_PIXELS or row < least or len(message.data) < (H - 1) * row + least:
        raise DataError(
            f"{where}: {W}x{H} pixels {message.encoding} in rows of {row} bytes do not fit into {len(message.data)}"
            f" bytes; {AGAIN}"
        )
    strides = (row, channels * dtype.itemsize, dtype.itemsize)
    samples: npt.NDArray[Any] = np.ndarray((H, W, channels), dtype, np.ascontiguousarray(message.data), 0, strides)
    samples = samples.astype(dtype.newbyteorder("="), copy=False)
    return np.ascontiguousarray(samples[..., 0] if channels == 1 else samples)


def _rgb(samples: npt.NDArray[Any], encoding: str, where: str) -> npt.NDArray[np.uint8]:
    import cv2

    if samples.dtype == np.float32:
        raise DataError(f"{where}: {encoding} is no colour; set color to a topic of colour images")
    if encoding in TO_RGB:
        samples = np.asarray(cv2.cvtColor(samples, getattr(cv2, f"COLOR_{TO_RGB[encoding]}")))
    deep = samples.dtype == np.uint16
    return (samples >> 8 if deep else samples).astype(np.uint8)


def _from_inverse(image: bytes, data: bytes, where: str) -> Float32:
    """Return depth (H, W) of a PNG of quantized inverse depth: a / (v - b) metres, 0 where v is 0."""
    import cv2

    _, a, b = DEPTH_HEADER.unpack_from(data)
    stored = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2:
        raise DataError(f"{where}: the compressed depth image is damaged; {AGAIN}")
    with np.errstate(all="ignore"):
        depth = np.where(stored == 0, np.float32(0), np.float32(a) / (stored.astype(np.float32) - np.float32(b)))
    return depth.astype(np.float32)


def npy(array: npt.NDArray[Any]) -> bytes:
    """Return an array as the content of an .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()
