"""Read and write object models as JSON that a person can read.

    {
     "smartview_object": 1,
     "unit": "m",
     "name": "bracket",
     "vertices": [
      [0.0, 0.0, 0.0],
      ...
     ],
     "edges": [[0, 1], ...],
     "faces": [{"name": "top", "loop": [4, 5, 7, 6], "graspable": true}, ...],
     "grasps": [{"name": ..., "face": 1, "object_from_tool": {...}, "opening": 0.05, ...}],
     "end": "smartview_object"
    }

Faces run counter-clockwise as seen from outside. The unit holds for all lengths; the library itself
writes metres. The schema is in `schemas.object_model`; an unknown key is an error.
"""

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .. import schemas
from ..argument_checks import errors_at, require_readable_or_empty
from ..files import parse_json, read_text, write_atomically
from ..geometry import LENGTH_UNITS, host_poses
from ..modeling import Face, Grasp, ObjectModel, Symmetry
from .meshes import MESH_FORMATS

FORMAT_VERSION = 1
"""Version of the format."""

_UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))
"""Rows and columns of xx, xy, xz, yy, yz, zz."""


def save_object_model(model: ObjectModel, path: str | os.PathLike[str]) -> Path:
    """Write an object model as JSON in metres, completely or not at all.

    Raises:
        ValueError: an invalid value, so that the file could not be read back.
    """
    content = object_model_to_dict(model)
    with errors_at(f"{path}: not written, it could not be read back"):
        # Reading repairs names that earlier versions wrote, so names are checked here.
        for part in (model, *model.faces, *model.grasps):
            require_readable_or_empty(type(part).__name__, part.name)
        object_model_from_dict(content)
    return write_atomically(path, _readable_json(content))


def load_object_model(path: str | os.PathLike[str]) -> ObjectModel:
    """Read an object model that `save_object_model` or a person wrote.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not JSON, not an object model, or a part of the model is wrong; the
            message names the file and the line or entry.
    """
    try:
        content = parse_json(read_text(path), path)
    except ValueError as error:
        expected = "expected an object model, such as smartview model writes"
        if Path(path).suffix.lower().lstrip(".") in MESH_FORMATS:
            expected += "; sv.io.read_mesh and sv.io.save_object_model make one of a mesh"
        raise ValueError(f"{error}; {expected}") from error
    with errors_at(path):
        return object_model_from_dict(content)


def object_model_to_dict(model: ObjectModel) -> dict[str, Any]:
    """Return the content of a model's file: plain numbers, in metres."""
    content: dict[str, Any] = {
        "smartview_object": FORMAT_VERSION,
        "unit": "m",
        "name": model.name,
        "provenance": list(model.provenance),
        "planar_tolerance": model.planar_tolerance,
        "tolerance": model.tolerance,
        "vertices": model.vertices.tolist(),
        "edges": model.edges.tolist(),
        "faces": [_face_to_dict(face) for face in model.faces],
        "grasps": [_grasp_to_dict(grasp) for grasp in model.grasps],
    }
    if model.symmetry is not None:
        axis = model.symmetry.axis
        content["symmetry"] = {
            "confirmed": model.symmetry.confirmed,
            "centre": model.symmetry.centre.tolist(),
            "rotations": [_quaternion(rotation) for rotation in model.symmetry.rotations],
            **({} if axis is None else {"axis": axis.tolist()}),
        }
    if model.covariance is not None and model.covariance.ndim == 3:
        content["covariance"] = {"per_vertex": model.covariance[:, *_UPPER].tolist()}
    elif model.covariance is not None:
        content["covariance"] = {"full": model.covariance.tolist()}
    if model.calibration_factor is not None:
        content["calibration_factor"] = model.calibration_factor.tolist()
    # Last, so that a truncated file is recognised even if its brackets were closed by hand.
    return {**content, "end": "smartview_object"}


def object_model_from_dict(content: Any) -> ObjectModel:
    """Return the model of a file's content, in metres; a ValueError names a wrong entry."""
    file = schemas.validate_content(content, schemas.OBJECT_MODEL_SCHEMA)
    scale = LENGTH_UNITS[file.unit]
    symmetry = file.symmetry
    factor = file.calibration_factor
    return ObjectModel(
        scale * np.array(file.vertices, float).reshape(-1, 3),
        np.array(file.edges, int).reshape(-1, 2),
        tuple(
            Face(tuple(face.loop), tuple(map(tuple, face.holes)), face.name, face.graspable)
            for face in file.faces
        ),
        None if file.covariance is None else scale**2 * _covariance(file.covariance),
        None if factor is None else scale * _matrix(factor, "calibration_factor"),
        tuple(_grasp_from_entry(grasp, scale) for grasp in file.grasps),
        None
        if symmetry is None
        else Symmetry(
            np.stack([_rotation(quaternion) for quaternion in symmetry.rotations]),
            scale * np.array(symmetry.centre),
            None if symmetry.axis is None else np.array(symmetry.axis, float),
            symmetry.confirmed,
        ),
        file.name,
        tuple(file.provenance),
        file.planar_tolerance,
        scale * file.tolerance,
    )


def _readable_json(content: dict[str, Any]) -> str:
    """Return JSON in which every row of numbers, and every short mapping, is on one line."""
    # One vertex, edge or loop on a line, so that versions can be compared line by line.
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    strings: list[str] = []

    def hide(match: re.Match[str]) -> str:
        strings.append(match.group())
        return f'"{len(strings) - 1}"'

    # Strings may contain brackets, so they are set aside while the innermost lists are joined.
    text = re.sub(r'"(?:[^"\\]|\\.)*"', hide, text)
    text = re.sub(r"\[([^\[\]{}]*)\]", lambda m: f"[{' '.join(m.group(1).split())}]", text)
    return re.sub(r'"(\d+)"', lambda m: strings[int(m.group(1))], text) + "\n"


def _face_to_dict(face: Face) -> dict[str, Any]:
    return {
        **({"name": face.name} if face.name else {}),
        "loop": list(face.loop),
        **({"holes": [list(hole) for hole in face.holes]} if face.holes else {}),
        **({} if face.graspable is None else {"graspable": face.graspable}),
    }


def _grasp_to_dict(grasp: Grasp) -> dict[str, Any]:
    """Return a grasp as a mapping, in metres."""
    return {
        "name": grasp.name,
        "face": grasp.face,
        "object_from_tool": {
            "translation": grasp.object_from_tool[:3, 3].tolist(),
            "quaternion_wxyz": _quaternion(grasp.object_from_tool[:3, :3]),
        },
        "opening": grasp.opening,
        "depth": grasp.depth,
        "tolerance": grasp.tolerance,
    }


def _grasp_from_entry(entry: Any, scale: float) -> Grasp:
    """Return the grasp of a file's entry, converted to metres."""
    rotation = _rotation(entry.object_from_tool.quaternion_wxyz)
    pose = host_poses(rotation, scale * np.array(entry.object_from_tool.translation))
    lengths = (scale * entry.opening, scale * entry.depth, scale * entry.tolerance)
    return Grasp(entry.name, entry.face, pose, *lengths)


def _quaternion(rotation: np.ndarray) -> list[float]:
    """Return the unit quaternion of a rotation matrix, real part first."""
    # Canonical (w >= 0), so that equal rotations give equal files.
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return [w, x, y, z]


def _rotation(quaternion_wxyz: list[float]) -> np.ndarray:
    """Return the rotation matrix of a quaternion, real part first."""
    w, x, y, z = quaternion_wxyz
    if abs(np.hypot(np.hypot(w, x), np.hypot(y, z)) - 1.0) > 1e-6:
        raise ValueError(f"symmetry.rotations: expected unit quaternions, found {quaternion_wxyz}")
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def _covariance(entry: Any) -> np.ndarray:
    """Return the covariance of an entry, in the file's unit squared."""
    if entry.full is not None:
        return _matrix(entry.full, "covariance.full")
    # Fill both triangles of the symmetric matrix from the upper one.
    rows = np.array(entry.per_vertex, float).reshape(-1, 6)
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, *_UPPER] = covariance[:, *_UPPER[::-1]] = rows
    return covariance


def _matrix(rows: list[list[float]], entry: str) -> np.ndarray:
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"{entry}: its rows have different lengths")
    return np.array(rows, float).reshape(len(rows), -1)
