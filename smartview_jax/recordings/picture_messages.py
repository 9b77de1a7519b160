"""Turn the pictures of a recording into picture files without loss.

A `sensor_msgs/Image` becomes a PNG with the same numbers: grey or in colour, of 8 or 16 bits; the
raw pattern of a Bayer sensor is converted to colour first. The file in a
`sensor_msgs/CompressedImage` is kept as it is, so that a JPEG is not compressed twice.
"""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ..files import write_atomically

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
"""Types of the messages that have a picture."""

_GREY = {"mono8": np.uint8, "8uc1": np.uint8, "mono16": np.uint16, "16uc1": np.uint16}
_COLOUR = {
    "rgb8": (3, np.uint8, cv2.COLOR_RGB2BGR),
    "bgr8": (3, np.uint8, None),
    "8uc3": (3, np.uint8, None),
    "rgba8": (4, np.uint8, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, np.uint8, cv2.COLOR_BGRA2BGR),
    "rgb16": (3, np.uint16, cv2.COLOR_RGB2BGR),
    "bgr16": (3, np.uint16, None),
    "yuv422": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, np.uint8, cv2.COLOR_YUV2BGR_YUY2),
    "uyvy": (2, np.uint8, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, np.uint8, cv2.COLOR_YUV2BGR_YUY2),
}
# OpenCV names a Bayer pattern by the second row's second and third pixel, ROS by the first rows.
_BAYER_PATTERNS = {
    "rggb": cv2.COLOR_BayerBG2BGR,
    "bggr": cv2.COLOR_BayerRG2BGR,
    "gbrg": cv2.COLOR_BayerGR2BGR,
    "grbg": cv2.COLOR_BayerGB2BGR,
}
_BAYER = {
    f"bayer_{pattern}{bits}": (kind, conversion)
    for pattern, conversion in _BAYER_PATTERNS.items()
    for bits, kind in (("8", np.uint8), ("16", np.uint16))
}
_SIGNATURES = {b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg"}
"""Suffix of a compressed picture's file by its first bytes."""


class PictureFile(NamedTuple):
    """The content of a picture file.

    Attributes:
        content: bytes of the file.
        suffix: `.png` or `.jpg`.
        size: width and height, px.
        bits: of each number: 8 or 16.
    """

    content: bytes
    suffix: str
    size: tuple[int, int]
    bits: int

    @property
    def kind(self) -> str:
        """Size and kind as text."""
        width, height = self.size
        return f"a {self.suffix} of {width} x {height} px and {self.bits} bits"

    def as_png(self) -> "PictureFile":
        """Return the file with the same numbers as a PNG."""
        if self.suffix == ".png":
            return self
        pixels = cv2.imdecode(np.frombuffer(self.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert pixels is not None  # A damaged file has been refused.
        return png_of(pixels)

    def write(self, folder: Path, view: str, first: "PictureFile | None") -> "PictureFile":
        """Write the file of a view to a data-set folder, and return the first one, which may be it.

        Args:
            folder: of the data set.
            view: name of the view, after a camera's name and a slash if there are several cameras.
            first: the first picture of the camera; None for the first itself.

        Raises:
            ValueError: the picture differs in size or kind from the first.
        """
        first = first or self
        if self[1:] != first[1:]:
            raise ValueError(f"{self.kind}, but the first is {first.kind}")
        write_atomically(folder / "images" / f"{view}{self.suffix}", self.content)
        # Only the description of the first is needed.
        return first._replace(content=b"")


def png_of(pixels: np.ndarray) -> PictureFile:
    """Return the file of a picture, grey or BGR, without loss."""
    content = cv2.imencode(".png", pixels)[1].tobytes()
    return PictureFile(content, ".png", pixels.shape[1::-1], 8 * pixels.itemsize)


def checked_file(content: bytes) -> PictureFile:
    """Return the content of a picture file as it is."""
    suffix = next((s for begin, s in _SIGNATURES.items() if content.startswith(begin)), None)
    if suffix is None:
        raise ValueError(
            "expected a picture as PNG or JPEG; for depth pictures and video streams record the "
            "raw pictures"
        )
    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("a damaged picture")
    return PictureFile(content, suffix, pixels.shape[1::-1], 8 * pixels.itemsize)


def picture_file(message: Any) -> PictureFile:
    """Return the picture of a message as a file.

    Args:
        message: a `sensor_msgs/Image` or `sensor_msgs/CompressedImage`.

    Raises:
        ValueError: an encoding that no camera picture has, or data that do not fit the size.
    """
    if hasattr(message, "encoding"):
        return png_of(_pixels(message))
    try:
        return checked_file(bytes(message.data))
    except ValueError as error:
        raise ValueError(f"format {message.format!r}: {error}") from None


def _pixels(message: Any) -> np.ndarray:
    """Return the numbers of a raw picture: grey, or colour in OpenCV's order BGR."""
    encoding = str(message.encoding).lower()
    if encoding in _GREY:
        return _rows(message, 1, _GREY[encoding])[..., 0]
    if encoding in _COLOUR:
        channels, kind, conversion = _COLOUR[encoding]
        rows = _rows(message, channels, kind)
        return rows if conversion is None else cv2.cvtColor(rows, conversion)
    if encoding in _BAYER:
        kind, conversion = _BAYER[encoding]
        return cv2.cvtColor(_rows(message, 1, kind)[..., 0], conversion)
    known = [*_GREY, *_COLOUR, *_BAYER]
    raise ValueError(f"encoding {message.encoding!r}: expected one of {', '.join(known)}")


def _rows(message: Any, channels: int, kind: type) -> np.ndarray:
    """Return the data as `(rows, columns, channels)`, without the padding of rows."""
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    width, height, step = int(message.width), int(message.height), int(message.step)
    used = width * channels * dtype.itemsize
    if not width or not height or step < used or len(message.data) < step * height:
        raise ValueError(
            f"{width} x {height} px of {message.encoding} in rows of {step} bytes: expected "
            f"{max(step, used) * height} bytes, found {len(message.data)}"
        )
    data = np.frombuffer(bytes(message.data), np.uint8)[: step * height].reshape(height, step)
    numbers = np.ascontiguousarray(data[:, :used]).view(dtype)
    return numbers.reshape(height, width, channels).astype(kind)
