"""Read and write object models as triangle meshes: OBJ, PLY, STL and glTF, through trimesh.

On reading, adjacent coplanar triangles are joined to flat faces, the edges at which the surface
bends sharply become the wireframe, and the symmetry of the solid is found. On writing, faces are
cut into triangles; graspable surfaces, grasps and uncertainty are lost, because meshes have no
place for them.
"""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ..argument_checks import errors_at, nearest_name, require_one_of
from ..extras import import_extra
from ..files import require_file, write_atomically
from ..geometry import LENGTH_UNITS
from ..modeling import SHARP_ANGLE, Face, ObjectModel, face_plane, find_symmetry
from .triangle_repair import connected_parts, repaired_triangles

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = ("obj", "ply", "stl", "glb", "gltf")
"""Endings of the files that are read and written."""

MIN_EXTENT = 5e-4
"""Smallest extent of a mesh, m; a smaller one is in a larger unit than was stated."""

COPLANAR_ANGLE = float(np.deg2rad(0.5))
"""Largest angle between the normals of two triangles of one flat face, rad."""


def read_mesh(
    path: str | os.PathLike[str], unit: str = "m", sharp_angle: float = SHARP_ANGLE
) -> ObjectModel:
    """Read a mesh as an object model: flat faces, and sharp edges as the wireframe.

    Args:
        path: a file with one of the endings in `MESH_FORMATS`.
        unit: unit of the coordinates: m, cm or mm; most CAD programs write mm. glTF is always in m.
        sharp_angle: smallest bend of the surface that is an edge, rad.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: another format, a file without triangles, or an object so large or small that
            its unit is another one.
        ImportError: trimesh is not installed.
    """
    path = Path(path)
    require_file(path)
    require_one_of("unit", unit, LENGTH_UNITS)
    kind = _format_of(path)
    trimesh = import_extra("trimesh", "objects", "a mesh")
    refuse_broken_text(path, kind)
    try:
        mesh = trimesh.load_mesh(path, file_type=kind, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
        vertices, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)
    # Another library's parser can raise any error for a broken file.
    except Exception as error:
        raise ValueError(f"{path}: not readable as {kind}: {error}") from error
    # The glTF standard fixes metres; the other formats have no unit.
    unit = "m" if kind in ("glb", "gltf") else unit
    # Names of files have fewer restrictions than names of objects.
    name = nearest_name(path.stem)
    with errors_at(path):
        model = model_from_triangles(
            LENGTH_UNITS[unit] * vertices, triangles, sharp_angle, name, str(path)
        )
        if model.extent < MIN_EXTENT:
            raise ValueError(
                f"read in {unit} the object is {1e3 * model.extent:.3g} mm large; expected "
                f"{1e3 * MIN_EXTENT:g} mm or more: is it in another unit?"
            )
        return model


def write_mesh(model: ObjectModel, path: str | os.PathLike[str]) -> Path:
    """Write the faces of a model as triangles in metres, completely or not at all.

    Raises:
        ValueError: a format that is not in `MESH_FORMATS`, or a model without faces.
        ImportError: trimesh or mapbox-earcut is not installed.
    """
    path = Path(path)
    kind = _format_of(path)
    mesh = to_trimesh(model)
    if kind == "gltf":
        from trimesh.exchange.gltf import export_gltf

        # One file, with its numbers inside, so that it is written completely or not at all.
        files = export_gltf(mesh.scene(), embed_buffers=True)
        return write_atomically(path, files["model.gltf"])
    # PLY, STL and glTF have single precision; OBJ, a text format, keeps the model's.
    options: dict[str, Any] = {"digits": 12} if kind == "obj" else {}
    content: Any = mesh.export(file_type=kind, **options)
    return write_atomically(path, content)


def to_trimesh(model: ObjectModel) -> "trimesh.Trimesh":
    """Return the faces of a model as a trimesh mesh with the same vertices.

    The metadata `face_of_triangle` holds the index of the face of each triangle.

    Raises:
        ValueError: the model has no faces.
        ImportError: trimesh or mapbox-earcut is not installed.
    """
    if not model.faces:
        raise ValueError(f"model {model.name!r} has only a wireframe, no faces to write as a mesh")
    trimesh = import_extra("trimesh", "objects", "a mesh")
    parts = [face_triangles(model.vertices, face) for face in model.faces]
    owners = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    mesh = trimesh.Trimesh(model.vertices, np.concatenate(parts), process=False)
    mesh.metadata["face_of_triangle"] = owners
    return mesh


def face_triangles(vertices: Float[np.ndarray, "V 3"], face: Face) -> Int[np.ndarray, "T 3"]:
    """Return a face cut into triangles: vertex indices, in the orientation of the face.

    Raises:
        ImportError: mapbox-earcut is not installed.
    """
    mapbox_earcut = import_extra("mapbox_earcut", "objects", "cutting faces into triangles")
    plane = face_plane(vertices, face)
    # Earcut works in the plane and takes all loops one after the other.
    flat = plane.coordinates(vertices[face.indices])
    ends = np.cumsum([len(loop) for loop in face.loops]).astype(np.uint32)
    corners = mapbox_earcut.triangulate_float64(flat, ends).reshape(-1, 3)
    # Counter-clockwise in the plane's coordinates is outward; earcut guarantees no orientation.
    a, b, c = (flat[corners[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    corners = np.where(area[:, None] < 0.0, corners[:, ::-1], corners)
    return np.array(face.indices)[corners.astype(int)]


def _format_of(path: Path) -> str:
    """Return the ending of a mesh file, if it is a known one."""
    kind = path.suffix.lower().lstrip(".")
    if kind not in MESH_FORMATS:
        raise ValueError(f"{path}: expected a name ending in .{', .'.join(MESH_FORMATS)}")
    return kind


def model_from_triangles(
    vertices: Float[np.ndarray, "V 3"],
    triangles: Int[np.ndarray, "T 3"],
    sharp_angle: float = SHARP_ANGLE,
    name: str = "",
    source: str = "",
) -> ObjectModel:
    """Return the object model of a triangle mesh; see `read_mesh`.

    Args:
        vertices: in metres; vertices in one place are joined.
        triangles: counter-clockwise as seen from outside; others are turned over, and the model's
            `provenance` says so (`repaired_triangles`).
        sharp_angle: smallest bend of the surface that is an edge, rad.
        source: origin of the mesh, for the provenance.

    Raises:
        ValueError: there are no triangles, or coordinates are not finite.
    """
    repaired = repaired_triangles(vertices, triangles)
    trimesh = import_extra("trimesh", "objects", "a mesh")
    mesh = trimesh.Trimesh(repaired.vertices, repaired.triangles, process=False)
    owners = _flat_groups(mesh)
    loops_by_face = [_boundary_loops(mesh.faces[owners == k]) for k in range(owners.max() + 1)]
    # Vertices in the middle of a straight edge are artefacts of the triangulation.
    kept = _corners(mesh.vertices, loops_by_face)
    shortened = [[tuple(v for v in loop if kept[v]) for loop in loops] for loops in loops_by_face]
    faces = [_face_from_loops(mesh.vertices, loops) for loops in shortened]
    edges = _sharp_edges(mesh, owners, shortened, sharp_angle)
    number = np.cumsum(kept) - 1
    renumbered = tuple(
        Face(*(_renumbered(face.loop, number), tuple(_renumbered(h, number) for h in face.holes)))
        for face in faces
    )
    provenance = (*((f"from the mesh {source}",) if source else ()), *repaired.notes)
    model = ObjectModel(
        repaired.vertices[kept], number[edges], renumbered, name=name, provenance=provenance
    )
    try:
        return dataclasses.replace(model, symmetry=find_symmetry(model))
    except ValueError:
        # A single straight edge has no finite group.
        return model


def _flat_groups(mesh: Any) -> Int[np.ndarray, "T"]:
    """Return the index of the flat face of each triangle."""
    pairs, angles = mesh.face_adjacency, mesh.face_adjacency_angles
    largest, joined = COPLANAR_ANGLE, angles <= COPLANAR_ANGLE
    while True:
        # Flat faces are the connected parts of the graph of coplanar neighbours.
        groups = connected_parts(pairs[joined], len(mesh.faces))
        # A round surface of very many triangles bends little from each to the next. There a smaller
        # angle is required.
        is_bent = _are_bent(mesh, groups)[groups[pairs]].any(axis=1) & joined
        if not is_bent.any():
            return groups
        largest *= 0.5
        joined &= ~is_bent | (angles <= largest)


def _are_bent(mesh: Any, groups: Int[np.ndarray, "T"]) -> Bool[np.ndarray, "groups"]:
    """Return which groups of triangles are not flat."""
    weighted = mesh.face_normals * mesh.area_faces[:, None]
    sums = np.stack([np.bincount(groups, column) for column in weighted.T], axis=1)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    # The normals of a closed surface cancel.
    means = sums / np.maximum(lengths, np.finfo(float).tiny)
    cosines = (mesh.face_normals * means[groups]).sum(axis=1)
    return np.bincount(groups, cosines < np.cos(COPLANAR_ANGLE)) > 0


def _boundary_loops(triangles: Int[np.ndarray, "T 3"]) -> list[tuple[int, ...]]:
    """Return the boundary loops of connected triangles, in the triangles' orientation."""
    sides = {(int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3)}
    following: dict[int, list[int]] = {}
    for a, b in sides:
        # An inner side occurs in both directions.
        if (b, a) not in sides:
            following.setdefault(a, []).append(b)
    loops = []
    # Each side is used once; a vertex in which two loops touch has two followers.
    while following:
        loop = [min(following)]
        while not (len(loop) > 1 and loop[-1] == loop[0]):
            ends = following[loop[-1]]
            loop.append(ends.pop())
            if not ends:
                del following[loop[-2]]
        loops.append(tuple(loop[:-1]))
    return loops


def _corners(
    vertices: Float[np.ndarray, "V 3"], loops_by_face: list[list[tuple[int, ...]]]
) -> np.ndarray:
    """Return which vertices are corners: some loop bends there."""
    corners = np.zeros(len(vertices), bool)
    for loop in (loop for loops in loops_by_face for loop in loops):
        points = vertices[list(loop)]
        before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        sine = np.linalg.norm(np.cross(before, after), axis=1)
        lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        bends = (sine > COPLANAR_ANGLE * lengths) | (np.sum(before * after, axis=1) < 0.0)
        corners[np.array(loop)[bends]] = True
    return corners


def _face_from_loops(vertices: Float[np.ndarray, "V 3"], loops: list[tuple[int, ...]]) -> Face:
    """Return the face of the loops; the outer loop has the largest extent."""
    extents = [float(np.ptp(vertices[list(loop)], axis=0).max()) for loop in loops]
    outer = int(np.argmax(extents))
    return Face(loops[outer], tuple(loop for k, loop in enumerate(loops) if k != outer))


def _sharp_edges(
    mesh: Any,
    owners: Int[np.ndarray, "T"],
    loops_by_face: list[list[tuple[int, ...]]],
    sharp_angle: float,
) -> Int[np.ndarray, "E 2"]:
    """Return the edges at which the surface ends or bends by at least the sharp angle."""
    normals: dict[frozenset[int], list[np.ndarray]] = {}
    for k, loops in enumerate(loops_by_face):
        # The largest triangle of a flat face has the most accurate normal.
        members = np.flatnonzero(owners == k)
        normal = mesh.face_normals[members[np.argmax(mesh.area_faces[members])]]
        for loop in loops:
            for pair in zip(loop, loop[1:] + loop[:1], strict=True):
                normals.setdefault(frozenset(pair), []).append(normal)
    # An edge with a single face is the border of an open surface, and always sharp.
    sharp = [
        tuple(sorted(pair))
        for pair, sides in normals.items()
        if len(sides) != 2 or np.arccos(np.clip(sides[0] @ sides[1], -1, 1)) >= sharp_angle
    ]
    return np.array(sorted(sharp), int).reshape(-1, 2)


def _renumbered(loop: Iterable[int], number: Int[np.ndarray, "V"]) -> tuple[int, ...]:
    """Return a loop with the vertices' new numbers."""
    return tuple(int(number[v]) for v in loop)


def refuse_broken_text(path: Path, kind: str) -> None:
    """Raise a ValueError if an OBJ or a PLY in text form has too many or too few numbers or rows.

    trimesh reads what it finds: a number that a blank has broken in two is another vertex, and of a
    PLY only as many lines are read as its header says.
    """
    if kind == "obj":
        _check_obj(path)
    elif kind == "ply":
        _check_ply(path)


def _check_obj(path: Path) -> None:
    """Raise a ValueError if some vertices have more numbers than others.

    Three are a point; a fourth, which is a weight, and three more for a colour are legal.
    """
    rows = (line.split() for line in path.read_bytes().splitlines())
    counts = {len(row) - 1 for row in rows if row and row[0] == b"v"}
    if len(counts) > 1:
        numbers = ", ".join(map(str, sorted(counts)))
        raise ValueError(f"{path}: vertices of {numbers} numbers; expected as many in each")


def _check_ply(path: Path) -> None:
    """Raise a ValueError if the rows of a PLY in text form do not match its header."""
    header, mark, rest = path.read_bytes().partition(b"end_header")
    if not mark or b"format ascii" not in header:
        return
    rows = [row for line in rest.splitlines() if (row := line.split())]
    # By element: the number of rows, and the kinds of values in each.
    elements: list[tuple[int, list[bool]]] = []
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
            elements.append((int(words[2]), []))
        elif words[:1] == [b"property"] and elements:
            elements[-1][1].append(words[1:2] == [b"list"])
    expected = sum(count for count, _ in elements)
    if len(rows) != expected:
        raise ValueError(f"{path}: {len(rows)} rows, but its header says {expected}")
    start = 0
    for count, is_list in elements:
        for row in rows[start : start + count]:
            if len(row) != _row_length(row, is_list):
                text = b" ".join(row[:8]).decode("latin-1")
                raise ValueError(f"{path}: the row {text!r} has not the numbers of its header")
        start += count


def _row_length(row: list[bytes], is_list: list[bool]) -> int:
    """Return how many words a row has, in which each list begins with its length."""
    place = 0
    for value_is_list in is_list:
        if not value_is_list:
            place += 1
        elif place < len(row) and row[place].isdigit():
            place += 1 + int(row[place])
        else:
            return -1
    return place
