"""Mistakes in meshes: counts, indices, coordinates and types of numbers in STL, PLY and glTF."""

import json
import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from smartview_jax import io
from smartview_jax.files import write_atomically
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces

from .fuzz_numbers import NUMBERS
from .fuzz_text import ENCODINGS, Mutation, of_text

LARGEST_SIDE = 100.0
"""Of an object, m: more is no object that an arm sees."""

WRONG_FLOATS = (float("nan"), float("inf"), -float("inf"), 1e30, -3e38, 1e-45)
"""Coordinates that no mesh has."""

WRONG_COUNTS = (0, 1, 7, 1000, 2**16, 2**31 - 1, 2**31, 2**32 - 1)
"""Numbers of triangles, vertices or bytes that the files do not have."""


def block() -> ObjectModel:
    """Return a block, its six faces outward."""
    corners = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], float)
    loops = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    faces = tuple(map(Face, loops))
    return ObjectModel(corners * [0.06, 0.04, 0.03], edges_of_faces(faces), faces)


def written(kind: str, as_text: bool = False) -> Callable[[Path], Path]:
    """Return what writes a good mesh to a folder, STL and PLY also as text."""

    def write(folder: Path) -> Path:
        path = folder / f"block.{kind}"
        if not as_text:
            return io.write_mesh(block(), path)
        mesh = io.to_trimesh(block())
        text: Any = (
            mesh.export(file_type="stl_ascii")
            if kind == "stl"
            else mesh.export(file_type="ply", encoding="ascii")
        )
        return write_atomically(path, text)

    return write


def in_range(model: ObjectModel) -> None:
    """Raise an AssertionError for a model that no mesh may bring in."""
    count = len(model.vertices)
    assert np.isfinite(model.vertices).all(), "a vertex that is not finite"
    assert np.ptp(model.vertices, axis=0).max() <= LARGEST_SIDE, "an object far too large"
    assert np.abs(model.vertices).max() <= 10.0 * LARGEST_SIDE, "a vertex far away"
    assert len(model.faces) > 0, "no faces"
    edges = np.asarray(model.edges)
    assert ((edges >= 0) & (edges < count)).all(), "an edge between vertices that are not there"
    for k, face in enumerate(model.faces):
        assert all(0 <= v < count for v in face.indices), "a face of vertices that are not there"
        assert all(len(set(loop)) == len(loop) >= 3 for loop in face.loops), "no loop"
        assert abs(np.linalg.norm(model.plane(k).normal) - 1.0) < 1e-6, "a face without a normal"


def _put(content: bytes, place: int, form: str, value: float) -> bytes | None:
    if place + struct.calcsize(form) > len(content):
        return None
    changed = bytearray(content)
    struct.pack_into(form, changed, place, value)
    return bytes(changed)


# STL: 80 bytes of header, the number of triangles, and 50 bytes of each.


def _triangles(content: bytes) -> int:
    return max((len(content) - 84) // 50, 1)


def _stl_count(content: bytes, rng: random.Random) -> bytes | None:
    near = (_triangles(content) - 1, _triangles(content) + 1)
    return _put(content, 80, "<I", rng.choice((*WRONG_COUNTS, *near)))


def _stl_count_of_other_order(content: bytes, rng: random.Random) -> bytes | None:
    return _put(content, 80, ">I", _triangles(content))


def _stl_number(first: int, *values: float) -> Mutation:
    """Another number of a normal (the first three of twelve) or of a vertex."""

    def change(content: bytes, rng: random.Random) -> bytes | None:
        triangle, number = rng.randrange(_triangles(content)), rng.randrange(first, first + 3)
        place = 84 + 50 * triangle + 4 * number
        return _put(content, place, "<f", rng.choice(values))

    return Mutation(change)


def _stl_flat(content: bytes, rng: random.Random) -> bytes:
    place = 84 + 50 * rng.randrange(_triangles(content))
    corner = content[place + 12 : place + 24]
    return content[: place + 12] + 3 * corner + content[place + 48 :]


def _stl_turned(content: bytes, rng: random.Random) -> bytes:
    """One triangle with its corners the other way round."""
    place = 84 + 50 * rng.randrange(_triangles(content)) + 12
    corners = content[place : place + 36]
    return content[:place] + corners[24:] + corners[12:24] + corners[:12] + content[place + 36 :]


def _stl_repeated(content: bytes, rng: random.Random) -> bytes | None:
    place = 84 + 50 * rng.randrange(_triangles(content))
    longer = content + content[place : place + 50]
    return _put(longer, 80, "<I", _triangles(content) + 1)


STL: dict[str, Mutation] = {
    "STL count of triangles": Mutation(_stl_count, keeps_values=True),
    "STL count in another byte order": Mutation(_stl_count_of_other_order, keeps_values=True),
    "STL vertex": _stl_number(3, *WRONG_FLOATS),
    "STL normal": _stl_number(0, *WRONG_FLOATS, 0.0, 7.0),
    "STL triangle without an area": Mutation(_stl_flat),
    "STL triangle turned": Mutation(_stl_turned),
    "STL triangle twice": Mutation(_stl_repeated),
    "STL header": Mutation(
        lambda content, rng: (
            rng.choice((b"solid x\n", b"solid\0", b"\xff" * 80)).ljust(80, b" ") + content[80:]
        ),
        keeps_values=True,
    ),
    "STL header lost": Mutation(lambda content, rng: content[80:]),
    "STL bytes after the end": Mutation(
        lambda content, rng: content + rng.randbytes(rng.randrange(1, 99))
    ),
}
"""Mistakes in binary STL files."""


# PLY: a header of text lines, then the vertices and lists of their numbers.


def _header_end(content: bytes) -> int:
    mark = b"end_header\n"
    return content.find(mark) + len(mark) if mark in content else 0


def _of_header(change: Callable[[str, random.Random], str | None], keeps: bool = False) -> Mutation:
    """The mutation of the text before the numbers."""

    def changed(content: bytes, rng: random.Random) -> bytes | None:
        end = _header_end(content)
        header = change(content[:end].decode("latin-1"), rng) if end else None
        return None if header is None else header.encode("latin-1", "replace") + content[end:]

    return Mutation(changed, keeps)


def _exchanging(pattern: str, *words: str) -> Callable[[str, random.Random], str | None]:
    """The change of one of the places where a pattern is found."""

    def change(text: str, rng: random.Random) -> str | None:
        places = list(re.finditer(pattern, text))
        if not places:
            return None
        found = rng.choice(places)
        word = rng.choice([word for word in words if word != found[0]])
        return text[: found.start()] + word + text[found.end() :]

    return change


def _ply_lines(text: str, rng: random.Random) -> str:
    lines = text.splitlines(keepends=True)
    k, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.randrange(3)
    if way == 0:
        del lines[k]
    elif way == 1:
        lines.insert(j, lines[k])
    else:
        lines[k], lines[j] = lines[j], lines[k]
    return "".join(lines)


def _ply_numbers(form: str, *values: float) -> Mutation:
    """Another number anywhere in the binary part: a coordinate, an index, the length of a list."""

    def change(content: bytes, rng: random.Random) -> bytes | None:
        end = _header_end(content)
        rest = len(content) - end
        if not end or rest < 1:
            return None
        return _put(content, end + rng.randrange(rest), form, rng.choice(values))

    return Mutation(change)


def _ply_vertex(content: bytes, rng: random.Random) -> bytes | None:
    end = _header_end(content)
    found = re.search(rb"element vertex (\d{1,6})\n", content)
    if not end or found is None or not int(found[1]):
        return None
    # Three coordinates in single precision.
    return _put(content, end + 4 * rng.randrange(3 * int(found[1])), "<f", rng.choice(WRONG_FLOATS))


_TYPES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double", "float64", "x", "")

PLY: dict[str, Mutation] = {
    "PLY format": _of_header(
        _exchanging(
            r"format \w+ 1\.0",
            *("format binary_big_endian 1.0", "format ascii 1.0", "format binary_little_endian 9"),
            *("format x", "format", "format binary_little_endian 1.0"),
        ),
        keeps=True,
    ),
    "PLY count": _of_header(
        _exchanging(r"(?<=vertex )\d+|(?<=face )\d+", *map(str, WRONG_COUNTS), "-1", "x"), True
    ),
    "PLY type": _of_header(_exchanging(r"(?<=property )\w+|(?<=list )\w+", *_TYPES)),
    "PLY name": _of_header(
        _exchanging(r"\b[xyz]\b|vertex_ind\w+|\bvertex\b|\bface\b", "x", "y", "w", "")
    ),
    "PLY header lines": _of_header(_ply_lines),
    "PLY header without an end": _of_header(lambda text, rng: text.replace("end_header", "end")),
    "PLY CR LF": _of_header(lambda text, rng: text.replace("\n", "\r\n"), keeps=True),
    "PLY byte": _ply_numbers("<B", 0, 1, 2, 4, 128, 255),
    "PLY index": _ply_numbers("<i", -1, 8, 2**31 - 1, -(2**31)),
    "PLY vertex": Mutation(_ply_vertex),
}
"""Mistakes in PLY files."""


# glTF: JSON, and in a .glb a binary part after it.


def _glb_parts(content: bytes) -> tuple[Any, bytes] | None:
    """The JSON tree and what follows it."""
    if content[:4] != b"glTF" or len(content) < 20:
        return None
    (length,) = struct.unpack_from("<I", content, 12)
    try:
        return json.loads(content[20 : 20 + length]), content[20 + length :]
    except ValueError:
        return None


def _glb_joined(tree: Any, rest: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest


def _glb_entry(keys: tuple[str, ...], *values: Any) -> Mutation:
    """Another value of an entry with one of some names, anywhere in the JSON part."""

    def change(content: bytes, rng: random.Random) -> bytes | None:
        parts = _glb_parts(content)
        places = (
            [] if parts is None else [node for node in _nodes(parts[0]) if set(keys) & set(node)]
        )
        if parts is None or not places:
            return None
        node = rng.choice(places)
        node[rng.choice([key for key in keys if key in node])] = rng.choice(values)
        return _glb_joined(*parts)

    return Mutation(change)


def _nodes(tree: Any) -> list[dict[str, Any]]:
    """All mappings in a tree."""
    if isinstance(tree, list):
        return [node for part in tree for node in _nodes(part)]
    if isinstance(tree, dict):
        return [tree, *(node for part in tree.values() for node in _nodes(part))]
    return []


def _glb_cycle(content: bytes, rng: random.Random) -> bytes | None:
    """A node that is its own child."""
    parts = _glb_parts(content)
    if parts is None or not isinstance(parts[0], dict) or not parts[0].get("nodes"):
        return None
    parts[0]["nodes"][0]["children"] = [0]
    return _glb_joined(*parts)


def _glb_number(offset: int) -> Mutation:
    def change(content: bytes, rng: random.Random) -> bytes | None:
        return _put(content, offset, "<I", rng.choice(WRONG_COUNTS))

    return Mutation(change)


def _glb_vertex(content: bytes, rng: random.Random) -> bytes | None:
    parts = _glb_parts(content)
    if parts is None or len(parts[1]) < 16:
        return None
    place = len(content) - 4 * rng.randrange(1, (len(parts[1]) - 8) // 4)
    return _put(content, place, "<f", rng.choice(WRONG_FLOATS))


_OTHER = (None, -1, 0, 1, 7, 2**31, 2**70, 0.5, "x", [], {}, True, [0], {"a": 1})

GLB: dict[str, Mutation] = {
    "glTF version": _glb_number(4),
    "glTF length": _glb_number(8),
    "glTF length of the JSON": _glb_number(12),
    "glTF accessor": _glb_entry(
        ("count", "componentType", "byteOffset", "bufferView", "type", "max", "min"),
        *(*_OTHER, 5120, 5121, 5123, 5125, 5126, 5130, "VEC2", "VEC4", "SCALAR", "MAT4"),
    ),
    "glTF buffer": _glb_entry(("byteLength", "byteStride", "target", "buffer", "uri"), *_OTHER),
    "glTF mesh": _glb_entry(
        ("attributes", "POSITION", "indices", "primitives", "mode", "meshes", "mesh"), *_OTHER
    ),
    "glTF node": _glb_entry(
        ("nodes", "children", "matrix", "scenes", "scene", "translation", "rotation", "scale"),
        *(*_OTHER, [float("nan")] * 16, [1e30] * 16, [0.0] * 16, [1.0] * 3),
    ),
    "glTF cycle of nodes": Mutation(_glb_cycle),
    "glTF vertex": Mutation(_glb_vertex),
}
"""Mistakes in binary glTF files."""

MESH_TEXT: dict[str, Mutation] = {
    "vertex lost": of_text(_exchanging(r"(?m)^\s*v(?:ertex)? .*\n", "")),
    "vertex twice": of_text(_exchanging(r"(?m)^(?=\s*v(?:ertex)? )", "v 0 0 0\n")),
    "index": of_text(
        _exchanging(
            r"(?m)(?<= )\d+(?=\s|/|$)", *map(str, WRONG_COUNTS), "-1", "0", "9", "1/2/3", "1.5"
        )
    ),
    "keyword": of_text(
        _exchanging(
            r"(?m)^\s*[a-z]+\b", "facet", "v", "f", "vn", "l", "usemtl", "mtllib ../x", "x", ""
        )
    ),
}
"""Mistakes in meshes that are text."""

BINARY: dict[str, Mutation] = {
    name: ENCODINGS[name] for name in ("cut", "beginning lost", "byte changed", "bytes lost")
}
"""Mistakes in any binary file."""

_AS_TEXT = ENCODINGS | NUMBERS | MESH_TEXT

MESHES: dict[str, tuple[Callable[[Path], Path], dict[str, Mutation]]] = {
    "STL": (written("stl"), STL | BINARY),
    "STL as text": (written("stl", as_text=True), _AS_TEXT),
    "PLY": (written("ply"), PLY | BINARY),
    "PLY as text": (written("ply", as_text=True), PLY | _AS_TEXT),
    "OBJ": (written("obj"), _AS_TEXT),
    "glTF": (written("glb"), GLB | BINARY),
}
"""What writes a good mesh, and the mistakes that are made in it."""
