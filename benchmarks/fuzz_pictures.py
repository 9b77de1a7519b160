"""Mistakes in picture files: JPEG's segments, TIFF's directory, and PNG's chunks (`fuzz_png`).

A kind that keeps values takes data
away: a picture that is read all the same must be the one that was in the file before.
"""

import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from smartview_jax.detection import read_picture
from smartview_jax.files import write_atomically

from .fuzz_png import PNG
from .fuzz_text import ENCODINGS, Change, Mutation

SIZE = (64, 48)
"""Of the good pictures, px: small, so that many are read in a second."""


def drawn_picture() -> np.ndarray:
    """Return a grey picture with edges and some noise."""
    rng = np.random.default_rng(0)
    picture = rng.integers(90, 110, SIZE[::-1]).astype(np.uint8)
    picture[10:30, 12:40] += 100
    return picture


def written(
    suffix: str, colours: int = 1, deep: bool = False, *options: int
) -> Callable[[Path], Path]:
    """Return what writes a good picture to a folder."""

    def write(folder: Path) -> Path:
        picture = drawn_picture()
        picture = np.repeat(picture[..., None], colours, axis=2) if colours > 1 else picture
        picture = picture.astype(np.uint16) * 256 if deep else picture
        content = cv2.imencode(suffix, picture, options)[1].tobytes()
        return write_atomically(folder / f"picture{suffix}", content)

    return write


def read(path: Path) -> np.ndarray:
    """Read a picture as users do where no size is stated yet."""
    return read_picture(path)


def in_range(picture: np.ndarray) -> None:
    """Raise an AssertionError for what is no grey picture."""
    assert picture.dtype == np.uint8, f"a picture of {picture.dtype}"
    assert picture.ndim == 2, f"a picture of {picture.shape}"
    assert min(picture.shape) >= 1, f"a picture of {picture.shape}"
    assert picture.size <= 1e4 * SIZE[0] * SIZE[1], (
        f"a picture of {picture.shape} from a small file"
    )


# JPEG.


def _segments(content: bytes) -> tuple[list[bytes], bytes] | None:
    """The segments before the picture's data, from their markers on, and the rest."""
    if not content.startswith(b"\xff\xd8"):
        return None
    found, position = [], 2
    while position + 4 <= len(content) and content[position] == 0xFF:
        (length,) = struct.unpack_from(">H", content, position + 2)
        end = position + 2 + length
        found.append(content[position:end])
        if content[position + 1] == 0xDA:
            return found, content[end:]
        position = end
    return None


def of_segments(
    change: Callable[[list[bytes], bytes, random.Random], tuple[list[bytes], bytes] | None],
    keeps_values: bool = False,
) -> Mutation:
    """Return the mutation of a JPEG's segments and of its data."""

    def changed(content: bytes, rng: random.Random) -> bytes | None:
        parts = _segments(content)
        found = None if parts is None else change(*parts, rng)
        return None if found is None else b"\xff\xd8" + b"".join(found[0]) + found[1]

    return Mutation(changed, keeps_values)


def _in_segment(
    markers: bytes, change: Callable[[bytearray, random.Random], Any], keeps_values: bool = False
) -> Mutation:
    """The mutation of the content of one segment with a marker."""

    def changed(
        segments: list[bytes], data: bytes, rng: random.Random
    ) -> tuple[list[bytes], bytes] | None:
        fitting = [k for k, segment in enumerate(segments) if segment[1] in markers]
        if not fitting:
            return None
        k = rng.choice(fitting)
        segment = bytearray(segments[k])
        if len(segment) < 10:
            return None
        change(segment, rng)
        return [*segments[:k], bytes(segment), *segments[k + 1 :]], data

    return of_segments(changed, keeps_values)


def _put(form: str, offset: int, *values: int) -> Callable[[bytearray, random.Random], None]:
    def change(segment: bytearray, rng: random.Random) -> None:
        struct.pack_into(form, segment, offset, rng.choice(values))

    return change


def _random_byte(segment: bytearray, rng: random.Random) -> None:
    segment[rng.randrange(4, len(segment))] = rng.randrange(256)


def _lost_segment(
    segments: list[bytes], data: bytes, rng: random.Random
) -> tuple[list[bytes], bytes]:
    k = rng.randrange(len(segments))
    return segments[:k] + segments[k + 1 :], data


def _repeated_segment(
    segments: list[bytes], data: bytes, rng: random.Random
) -> tuple[list[bytes], bytes]:
    k = rng.randrange(len(segments))
    return [*segments[:k], segments[k], *segments[k:]], data


def _segment_length(
    segments: list[bytes], data: bytes, rng: random.Random
) -> tuple[list[bytes], bytes]:
    k = rng.randrange(len(segments))
    length = rng.choice((0, 1, 2, len(segments[k]) - 3, len(segments[k]) + 5, 2**16 - 1))
    segments[k] = segments[k][:2] + struct.pack(">H", length) + segments[k][4:]
    return segments, data


def _with_segment(*added: bytes, keeps_values: bool = False) -> Mutation:
    def change(segments: list[bytes], data: bytes, rng: random.Random) -> tuple[list[bytes], bytes]:
        k = rng.randrange(len(segments))
        return [*segments[:k], rng.choice(added), *segments[k:]], data

    return of_segments(change, keeps_values)


def _of_scan(change: Callable[[bytes, random.Random], bytes], keeps_values: bool) -> Mutation:
    """The mutation of the picture's data without the end mark, which stays."""
    return of_segments(
        lambda segments, data, rng: (segments, change(data[:-2], rng) + data[-2:]), keeps_values
    )


def _inside(data: bytes, added: bytes, rng: random.Random) -> bytes:
    k = rng.randrange(len(data) + 1)
    return data[:k] + added + data[k:]


def _exif(order: bytes, orientation: int, first: int = 8) -> bytes:
    """The segment of an EXIF directory with an orientation."""
    form = ">" if order == b"MM" else "<"
    entry = struct.pack(f"{form}HHIHH", 0x0112, 3, 1, orientation, 0)
    directory = struct.pack(f"{form}H", 1) + entry + struct.pack(f"{form}I", first)
    body = b"Exif\0\0" + order + struct.pack(f"{form}HI", 42, first) + directory
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


_FRAMES = bytes(set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC})
_COMMENT = b"\xff\xfe" + struct.pack(">H", 2**16 - 1) + b"a" * (2**16 - 3)

JPEG: dict[str, Mutation] = {
    "JPEG segment length": of_segments(_segment_length),
    "JPEG segment lost": of_segments(_lost_segment),
    "JPEG segment twice": of_segments(_repeated_segment),
    "JPEG height": _in_segment(_FRAMES, _put(">H", 5, 0, 8, 24, 96, 2**15, 2**16 - 1), True),
    "JPEG width": _in_segment(_FRAMES, _put(">H", 7, 0, 8, 32, 128, 2**15, 2**16 - 1), True),
    "JPEG precision": _in_segment(_FRAMES, _put("B", 4, 0, 1, 7, 12, 16, 255), True),
    "JPEG components": _in_segment(_FRAMES, _put("B", 9, 0, 2, 4, 255), True),
    "JPEG sampling": _in_segment(_FRAMES, _put("B", 11, 0, 0x01, 0x12, 0x44, 0xFF)),
    "JPEG kind of frame": _in_segment(_FRAMES, _put("B", 1, *_FRAMES)),
    "JPEG quantisation table": _in_segment(b"\xdb", _random_byte),
    "JPEG Huffman table": _in_segment(b"\xc4", _random_byte),
    "JPEG scan header": _in_segment(b"\xda", _random_byte),
    "JPEG restart interval": _with_segment(
        *(b"\xff\xdd\0\4" + struct.pack(">H", n) for n in (0, 1, 7, 2**16 - 1)), keeps_values=True
    ),
    "JPEG restart mark": _of_scan(
        lambda data, rng: _inside(data, bytes([0xFF, rng.randrange(0xD0, 0xD8)]), rng), False
    ),
    "JPEG mark inside": _of_scan(
        lambda data, rng: _inside(data, bytes([0xFF, rng.randrange(1, 0xD0)]), rng), False
    ),
    "JPEG data cut": _of_scan(lambda data, rng: data[: len(data) * rng.randrange(90) // 100], True),
    "JPEG data changed": _of_scan(lambda data, rng: _inside(data, rng.randbytes(3), rng), False),
    "JPEG orientation": _with_segment(
        *(_exif(order, k) for order in (b"II", b"MM") for k in (*range(10), 2**16 - 1)),
        keeps_values=True,
    ),
    "JPEG EXIF directory": _with_segment(
        *(_exif(b"MM", 6, first) for first in (0, 2**31, 2**32 - 1)), keeps_values=True
    ),
    "JPEG colours": _with_segment(
        *(b"\xff\xee\0\x0eAdobe\0d\0\0\0\0" + bytes([k]) for k in (0, 1, 2, 255))
    ),
    "JPEG comments": _with_segment(_COMMENT * 20, keeps_values=True),
    "JPEG end mark lost": Mutation(lambda content, rng: content.removesuffix(b"\xff\xd9"), True),
    "two JPEGs": Mutation(lambda content, rng: content + content, True),
}
"""Mistakes in JPEG files."""


# TIFF.


def _directory_entry(offset: int, form: str, *values: int) -> Change:
    """Another tag, type, count or value in one of the entries of the first page."""

    def change(content: bytes, rng: random.Random) -> bytes | None:
        if not content.startswith(b"II") or len(content) < 8:
            return None
        (place,) = struct.unpack_from("<I", content, 4)
        if place + 2 > len(content):
            return None
        (count,) = struct.unpack_from("<H", content, place)
        entry = place + 2 + 12 * rng.randrange(max(count, 1)) + offset
        if entry + 4 > len(content):
            return None
        changed = bytearray(content)
        struct.pack_into(form, changed, entry, rng.choice(values))
        return bytes(changed)

    return change


def _directory_place(content: bytes, rng: random.Random) -> bytes | None:
    place = rng.choice((0, 1, 8, len(content) - 1, len(content), 2**32 - 1))
    return content[:4] + struct.pack("<I", place) + content[8:]


TIFF: dict[str, Mutation] = {
    "TIFF directory": Mutation(_directory_place, True),
    "TIFF tag": Mutation(_directory_entry(0, "<H", 254, 256, 257, 258, 262, 273, 322)),
    "TIFF type": Mutation(_directory_entry(2, "<H", 0, 1, 2, 3, 4, 5, 12, 13, 2**16 - 1)),
    "TIFF count": Mutation(_directory_entry(4, "<I", 0, 1, 2, 1000, 2**31, 2**32 - 1)),
    "TIFF value": Mutation(_directory_entry(8, "<I", 0, 1, 2, 8, 16, 1000, 2**31, 2**32 - 1)),
    "TIFF byte order": Mutation(lambda content, rng: b"MM\0*" + content[4:], True),
}
"""Mistakes in TIFF files."""

ANY_FILE: dict[str, Mutation] = {
    "cut": Mutation(ENCODINGS["cut"].change, keeps_values=True),
    **{name: ENCODINGS[name] for name in ("beginning lost", "byte changed", "bytes lost")},
}
"""Mistakes in any picture."""

PICTURES: dict[str, tuple[Callable[[Path], Path], dict[str, Mutation]]] = {
    "PNG": (written(".png"), PNG | ANY_FILE),
    "PNG of 16 bits": (written(".png", 1, True), PNG | ANY_FILE),
    "PNG in colours": (written(".png", 3), PNG | ANY_FILE),
    "JPEG": (written(".jpg"), JPEG | ANY_FILE),
    "JPEG in colours": (written(".jpg", 3), JPEG | ANY_FILE),
    "progressive JPEG": (
        written(".jpg", 1, False, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        JPEG | ANY_FILE,
    ),
    "TIFF": (written(".tif", 1, False, cv2.IMWRITE_TIFF_COMPRESSION, 1), TIFF | ANY_FILE),
}
"""What writes a good picture, and the mistakes that are made in it."""
