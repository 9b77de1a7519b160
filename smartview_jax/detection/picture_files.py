"""Read picture files, and refuse damaged files and files with several pictures.

OpenCV decodes such files as far as it can, without a message: the upper part of a truncated file,
the first of several pages, the wrong blocks of a JPEG after a wrong byte. Points would then be
found only in part of the picture or nowhere. So the structure of a file is checked before it is
decoded.
"""

import hashlib
import os
import struct
import sys
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

MAX_PICTURE_BYTES = 500_000_000
"""Largest size of a picture file, bytes: 250 megapixels of 16 bits; larger files are refused."""

STRETCH_PERCENTILES = (0.5, 99.5)
"""Percentiles of the grey values that become black and white if a picture has more than 8 bits.

Sensors of 10 to 14 bits use only part of the 16 bits, thermal cameras a small part of their range.
Percentiles ignore single hot or dead pixels.
"""

_INTERLACING = (
    *((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2)),
    (0, 1, 1, 2),
)
"""First column, first row and steps of the seven passes of an interlaced PNG."""

_UNPACKED_AT_ONCE = 1 << 20
"""Bytes of a PNG that are unpacked at a time, to be counted."""

_stderr_lock = threading.Lock()
"""Lock that is held while the process's standard error is redirected."""


class Picture(NamedTuple):
    """A grey picture and the range of grey values of its file.

    Attributes:
        grey: the picture, in the orientation of the sensor.
        grey_range: range of values in the file that contains nearly all pixels
            (`STRETCH_PERCENTILES`).
        largest_grey: the largest value that the file's type can hold.
    """

    grey: UInt8[np.ndarray, "rows columns"]
    grey_range: tuple[float, float]
    largest_grey: float

    @property
    def range_in_words(self) -> str:
        """The range of grey values as a text, for a message that nothing was found."""
        low, high = self.grey_range
        return f"nearly all grey values are {low:.4g} to {high:.4g} of {self.largest_grey:.5g}"


def read_picture(
    path: Path, image_size: tuple[int, int] | None = None
) -> UInt8[np.ndarray, "rows columns"]:
    """Read a picture as grey uint8, in the orientation of the sensor.

    An orientation stored in the file (EXIF) is ignored: a camera model describes its sensor,
    and if only some of the files store an orientation, only those would be rotated. Pictures of
    more than 8 bits are stretched by `STRETCH_PERCENTILES`.

    Args:
        image_size: expected width and height, px; None accepts any size.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: the file cannot be read as a picture, is damaged, or has several pages, or the
            picture has another size.
    """
    return decode_picture(path, picture_bytes(path), image_size).grey


def picture_bytes(path: Path) -> bytes:
    """Return the content of a picture file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is larger than `MAX_PICTURE_BYTES`.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such picture")
    size = path.stat().st_size
    if size > MAX_PICTURE_BYTES:
        raise ValueError(
            f"{path}: {size / 1e9:.3g} GB; a picture has at most {MAX_PICTURE_BYTES / 1e9:g} GB"
        )
    return path.read_bytes()


def content_hash(data: bytes) -> str:
    """Return a hash that identifies the content of a picture file."""
    return hashlib.sha256(data).hexdigest()[:16]


def decode_picture(path: Path, data: bytes, image_size: tuple[int, int] | None = None) -> Picture:
    """Return the picture in the content of a file.

    Args:
        path: path of the file, for error messages.
        image_size: expected width and height, px; None accepts any size.

    Raises:
        ValueError: it is no picture, is damaged, has several pages, or has another size.
    """
    try:
        for signature, check in _CHECKS:
            if data.startswith(signature):
                check(data)
    except (ValueError, struct.error, IndexError) as error:
        problem = str(error) if type(error) is ValueError else "it ends within the header"
        raise ValueError(f"{path}: a damaged picture: {problem}") from error
    image = _decoded(path, data)
    size = (image.shape[1], image.shape[0])
    if image_size is not None and size != tuple(image_size):
        turned = ""
        if size == tuple(image_size)[::-1]:
            turned = (
                ": turned by 90 degrees, so that its pixels are not the sensor's: turn it back, "
                "and switch automatic turning off"
            )
        raise ValueError(
            f"{path}: expected {image_size[0]} x {image_size[1]} px, found {size[0]} x {size[1]}"
            + turned
        )
    return _as_grey_picture(path, image)


def _decoded(path: Path, data: bytes) -> np.ndarray:
    """Return the grey values with the depth of the file."""
    # `cv2.imread` is not used: it prints to stderr, and on some systems cannot open file names
    # outside ASCII.
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with _standard_error() as complaints:
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags) if data else None
    except cv2.error as error:
        raise ValueError(f"{path}: not a picture that can be read: {error}") from error
    # libjpeg continues after damage with grey or wrong blocks, and only prints a line.
    if damage := [line for line in complaints if "Corrupt JPEG" in line]:
        raise ValueError(f"{path}: a damaged picture: {damage[0].strip()}")
    if image is None:
        raise ValueError(f"{path}: not a picture that can be read")
    return image


def _as_grey_picture(path: Path, image: np.ndarray) -> Picture:
    """Return the picture with 8 bits, stretched if it has more."""
    if image.dtype == np.uint8:
        counts = cv2.calcHist([image], [0], None, [256], [0, 256]).ravel()
        shares = 100.0 * np.cumsum(counts) / image.size
        low, high = (float(np.searchsorted(shares, p)) for p in STRETCH_PERCENTILES)
        return Picture(image, (low, high), 255.0)
    finite = np.isfinite(image)
    if not finite.all():
        raise ValueError(f"{path}: {np.count_nonzero(~finite)} pixels are not finite")
    low, high = (float(value) for value in np.percentile(image, STRETCH_PERCENTILES))
    is_integer = np.issubdtype(image.dtype, np.integer)
    largest = float(np.iinfo(image.dtype).max) if is_integer else float(image.max())
    scale = 255.0 / max(high - low, 1.0 if is_integer else 1e-30)
    stretched = np.clip((image.astype(np.float32) - low) * scale, 0.0, 255.0)
    return Picture(np.rint(stretched).astype(np.uint8), (low, high), largest)


@contextmanager
def _standard_error() -> Iterator[list[str]]:
    """Collect the lines that C libraries print to standard error."""
    lines: list[str] = []
    with _stderr_lock, tempfile.TemporaryFile() as file:
        try:
            sys.stderr.flush()
            saved = os.dup(2)
        # The process may have no standard error, as without a console.
        except (OSError, ValueError, AttributeError):
            yield lines
            return
        try:
            os.dup2(file.fileno(), 2)
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            lines += file.read().decode(errors="replace").splitlines()


def _check_jpeg(data: bytes) -> None:
    """Raise a ValueError if the file ends before the end of the picture."""
    # A thumbnail within the file is a JPEG too, but comes before the last start of scan (FF DA).
    if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda") or b"\xff\xda" not in data:
        raise ValueError("its end mark is missing, so that it was cut")
    # The second picture of a file, as cameras add for their display, is not read.
    _check_scans(data)


def _check_scans(data: bytes) -> None:
    """Raise a ValueError if a progressive JPEG lacks some of its scans.

    Such a file has its picture several times, first coarse and then finer, and every beginning of
    it is a picture, which libjpeg shows without a word.
    """
    position, progressive, missing_bits = 2, False, dict[tuple[int, int], int]()
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = struct.unpack_from(">xBH", data, position)
        segment = data[position + 4 : position + 2 + length]
        if marker == 0xC2:
            progressive = True
            # No coefficient of any component was sent yet.
            missing_bits = {
                (segment[6 + 3 * k], c): 16 for k in range(segment[5]) for c in range(64)
            }
        elif marker == 0xDA and not progressive:
            return
        elif marker == 0xDA:
            first, last, bits = segment[-3:]
            for component in segment[1 : 1 + 2 * segment[0] : 2]:
                missing_bits |= {(component, c): bits & 15 for c in range(first, last + 1)}
        elif marker == 0xD9:
            break
        position += 2 + length
        if marker == 0xDA:
            position = _next_marker(data, position)
    if progressive and any(missing_bits.values()):
        raise ValueError("its last scans are missing, so that it was cut")


def _next_marker(data: bytes, position: int) -> int:
    """Return where the segment after a scan's data begins."""
    while (position := data.find(b"\xff", position)) >= 0 and position + 1 < len(data):
        # A stuffed zero, restart marks and fill bytes belong to the scan.
        if data[position + 1] not in (0x00, 0xFF, *range(0xD0, 0xD8)):
            return position
        position += 1 if data[position + 1] == 0xFF else 2
    return len(data)


def _check_png(data: bytes) -> None:
    """Raise a ValueError if a chunk is damaged or missing, or has another number of pixels."""
    position, packed = 8, []
    while position < len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end)
        # Only critical chunks, with a capital first letter, matter to the picture.
        if kind[:1].isupper() and zlib.crc32(memoryview(data)[position + 4 : end]) != checksum:
            raise ValueError(f"the checksum of its chunk {kind.decode('latin-1')} is wrong")
        if kind == b"IDAT":
            packed.append(memoryview(data)[position + 8 : end])
        if kind == b"IEND":
            _check_png_size(data, packed)
            return
        position = end + 4
    raise ValueError("its last chunk is missing, so it is truncated")


def _check_png_size(data: bytes, packed: list[memoryview]) -> None:
    """Raise a ValueError if the pixels are more or fewer than the header says.

    OpenCV would show the rows that there are, or take gigabytes for those that there are not.
    """
    width, height, depth, colours, *_, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    bits = depth * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(colours, 1)
    steps = _INTERLACING if interlaced else ((0, 0, 1, 1),)
    expected = 0
    for left, top, across, down in steps:
        columns, rows = -(-(width - left) // across), -(-(height - top) // down)
        # Each row begins with the kind of its filter.
        expected += rows * (1 + -(-columns * bits // 8)) if columns > 0 and rows > 0 else 0
    # Some programs write a few bytes too many; a row too many is another picture's.
    most = expected + -(-width * bits // 8)
    unpacker, unpacked = zlib.decompressobj(), 0
    try:
        for part in packed:
            rest: bytes | memoryview = part
            while rest and unpacked <= most and not unpacker.eof:
                unpacked += len(unpacker.decompress(rest, _UNPACKED_AT_ONCE))
                rest = unpacker.unconsumed_tail
        while unpacked <= most and (more := unpacker.decompress(b"", _UNPACKED_AT_ONCE)):
            unpacked += len(more)
    except zlib.error as error:
        raise ValueError(f"its pixels cannot be unpacked: {error}") from error
    if not expected <= unpacked <= most:
        relation = "more" if unpacked > most else "fewer"
        raise ValueError(f"it has {relation} pixels than the {width} x {height} of its header")


def _check_tiff(data: bytes) -> None:
    """Raise a ValueError if the file has several pages, or ends before its directory."""
    order = "<" if data[:2] == b"II" else ">"
    (position,) = struct.unpack_from(f"{order}I", data, 4)
    pages, visited = 0, set()
    while position and position not in visited:
        visited.add(position)
        (entries,) = struct.unpack_from(f"{order}H", data, position)
        pages += not _is_reduced(data, position + 2, entries, order)
        (position,) = struct.unpack_from(f"{order}I", data, position + 2 + 12 * entries)
    if pages > 1:
        raise ValueError(f"{pages} pages; expected one picture in each file")


def _is_reduced(data: bytes, position: int, entries: int, order: str) -> bool:
    """Return whether a page of a TIFF is marked as a smaller copy of another page."""
    for k in range(entries):
        tag, _, _, value = struct.unpack_from(f"{order}HHII", data, position + 12 * k)
        if tag == 254:
            return bool(value & 1)
    return False


_CHECKS: tuple[tuple[bytes, Callable[[bytes], None]], ...] = (
    (b"\xff\xd8\xff", _check_jpeg),
    (b"\x89PNG\r\n\x1a\n", _check_png),
    (b"II*\x00", _check_tiff),
    (b"MM\x00*", _check_tiff),
)
"""First bytes of the files of each format, and the check of its structure."""
