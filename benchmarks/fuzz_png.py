"""Mistakes in PNG files; checksums are mostly right, so that decoders see the mistake."""

import random
import struct
import zlib
from collections.abc import Callable

from .fuzz_text import Mutation

LARGE = (2**16 - 1, 30_000, 2**31 - 1, 2**32 - 1)
"""Sizes that no such file can hold."""

BOMB_BYTES = 20_000_000
"""What a text in a file grows to when it is unpacked."""

Chunk = tuple[bytes, bytes]
"""The kind of a chunk and its content."""

ChunkChange = Callable[[list[Chunk], random.Random], list[Chunk] | None]


def _chunks(content: bytes) -> list[Chunk] | None:
    found: list[Chunk] = []
    position = 8
    while content.startswith(b"\x89PNG") and position + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, position)
        found.append((kind, content[position + 8 : position + 8 + length]))
        position += 12 + length
    return found or None


def _joined(chunks: list[Chunk]) -> bytes:
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def of_chunks(change: ChunkChange, keeps_values: bool = False) -> Mutation:
    """Return the mutation of a PNG's chunks, whose lengths and checksums are right again."""

    def changed(content: bytes, rng: random.Random) -> bytes | None:
        chunks = _chunks(content)
        found = None if chunks is None else change(chunks, rng)
        return None if found is None else _joined(found)

    return Mutation(changed, keeps_values)


def _of_header(offset: int, form: str, *values: int) -> Mutation:
    """Another value in the header: width, height, depth, colour type, and how it is packed."""

    def change(chunks: list[Chunk], rng: random.Random) -> list[Chunk] | None:
        (kind, data), *rest = chunks
        if kind != b"IHDR" or len(data) < 13:
            return None
        header = bytearray(data)
        struct.pack_into(form, header, offset, rng.choice(values))
        return [(kind, bytes(header)), *rest]

    return of_chunks(change, keeps_values=True)


def _with_chunk(*chunks: Chunk, keeps_values: bool = False) -> Mutation:
    """Another chunk before the pixels, or at the end."""

    def change(found: list[Chunk], rng: random.Random) -> list[Chunk]:
        k = rng.choice((1, len(found) - 1, len(found)))
        return [*found[:k], rng.choice(chunks), *found[k:]]

    return of_chunks(change, keeps_values)


def _of_pixels(change: Callable[[bytes, random.Random], bytes], keeps_values: bool) -> Mutation:
    def changed(chunks: list[Chunk], rng: random.Random) -> list[Chunk]:
        return [(kind, change(data, rng) if kind == b"IDAT" else data) for kind, data in chunks]

    return of_chunks(changed, keeps_values)


def _some_rows(data: bytes, rng: random.Random) -> bytes:
    """The pixels, unpacked, cut and packed again: whole as a stream, but too few."""
    try:
        rows = zlib.decompress(data)
    except zlib.error:
        return b""
    return zlib.compress(rows[: rng.randrange(len(rows))])


def _wrong_filter(data: bytes, rng: random.Random) -> bytes:
    try:
        rows = bytearray(zlib.decompress(data))
    except zlib.error:
        return b""
    if rows:
        rows[0] = rng.randrange(5, 256)
    return zlib.compress(bytes(rows))


def _lost_chunk(chunks: list[Chunk], rng: random.Random) -> list[Chunk]:
    k = rng.randrange(len(chunks))
    return chunks[:k] + chunks[k + 1 :]


def _repeated_chunk(chunks: list[Chunk], rng: random.Random) -> list[Chunk]:
    k = rng.randrange(len(chunks))
    return [*chunks[:k], chunks[k], *chunks[k:]]


def _shuffled_chunks(chunks: list[Chunk], rng: random.Random) -> list[Chunk]:
    return rng.sample(chunks, len(chunks))


def _chunk_length(content: bytes, rng: random.Random) -> bytes | None:
    chunks = _chunks(content)
    if chunks is None:
        return None
    k = rng.randrange(len(chunks))
    place = len(_joined(chunks[:k]))
    length = rng.choice((0, 1, len(chunks[k][1]) + 1, 2**31 - 1, 2**32 - 1))
    return content[:place] + struct.pack(">I", length) + content[place + 4 :]


def _chunk_checksum(content: bytes, rng: random.Random) -> bytes | None:
    chunks = _chunks(content)
    if chunks is None:
        return None
    end = len(_joined(chunks[: rng.randrange(1, len(chunks) + 1)]))
    return content[: end - 4] + rng.randbytes(4) + content[end:]


def _newlines_changed(content: bytes, rng: random.Random) -> bytes:
    """What a transfer as text does to a file."""
    return rng.choice((content.replace(b"\r\n", b"\n"), content.replace(b"\n", b"\r\n")))


_TEXT_BOMB = b"Comment\0\0" + zlib.compress(b"a" * BOMB_BYTES)
_PROFILE_BOMB = b"icc\0\0" + zlib.compress(b"\0" * BOMB_BYTES)

PNG: dict[str, Mutation] = {
    "PNG chunk length": Mutation(_chunk_length, True),
    "PNG checksum": Mutation(_chunk_checksum, True),
    "PNG width": _of_header(0, ">I", 0, 1, 32, 128, *LARGE),
    "PNG height": _of_header(4, ">I", 0, 1, 24, 96, *LARGE),
    "PNG bit depth": _of_header(8, "B", 0, 1, 2, 3, 4, 7, 16, 32, 255),
    "PNG colour type": _of_header(9, "B", 1, 2, 3, 4, 5, 6, 7, 255),
    "PNG packing": _of_header(10, "B", 1, 255),
    "PNG filters": _of_header(11, "B", 1, 64, 255),
    "PNG interlacing": _of_header(12, "B", 1, 2, 255),
    "PNG palette": _with_chunk(
        *((b"PLTE", bytes(length)) for length in (0, 1, 3, 4, 768, 771, 9999)), keeps_values=True
    ),
    "PNG transparency": _with_chunk(*((b"tRNS", bytes(length)) for length in (0, 2, 6, 300))),
    "PNG gamma": _with_chunk((b"gAMA", b""), (b"gAMA", bytes(4)), (b"gAMA", b"\xff" * 4)),
    "PNG text bomb": _with_chunk((b"zTXt", _TEXT_BOMB), (b"iTXt", _TEXT_BOMB), keeps_values=True),
    "PNG profile bomb": _with_chunk((b"iCCP", _PROFILE_BOMB), (b"iCCP", b""), keeps_values=True),
    "PNG animation": _with_chunk(
        *((b"acTL", struct.pack(">II", count, 0)) for count in (0, 1, 2, 2**31 - 1))
    ),
    "PNG unknown chunk": _with_chunk((b"ABCD", b"x"), (b"abCd", b"x"), (b"\0\0\0\0", b"")),
    "PNG chunk lost": of_chunks(_lost_chunk, True),
    "PNG chunk twice": of_chunks(_repeated_chunk, True),
    "PNG chunks in another order": of_chunks(_shuffled_chunks, True),
    "PNG pixels cut": _of_pixels(lambda data, rng: data[: rng.randrange(len(data) + 1)], True),
    "PNG rows missing": _of_pixels(_some_rows, True),
    "PNG pixels of another kind": _of_pixels(lambda data, rng: rng.randbytes(len(data)), True),
    "PNG filter of a row": _of_pixels(_wrong_filter, True),
    "PNG sent as text": Mutation(_newlines_changed, True),
}
"""Mistakes in PNG files."""
