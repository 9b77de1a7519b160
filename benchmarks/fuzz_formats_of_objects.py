"""Files of objects: models, their pictures and touches, and the editor's journal."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxlie import SE3

from smartview_jax import io
from smartview_jax.editor.document import Document, apply_change
from smartview_jax.editor.edit_history import EditHistory
from smartview_jax.files import write_atomically
from smartview_jax.io.object_views import ObjectViews
from smartview_jax.modeling import ObjectModel

from . import fuzz_meshes

LARGEST_MISS = 1.0
"""Of a stylus, m."""

_TOUCHES = ("a", "b", "c")
_JOURNAL_HEADER = {"views": ["v1", "v2"]}

_OBJECT = """{
 "smartview_object": 1,
 "unit": "m",
 "name": "wedge",
 "provenance": ["by hand"],
 "planar_tolerance": 0.01,
 "vertices": [[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.04, 0.0], [0.0, 0.0, 0.03]],
 "edges": [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]],
 "faces": [
  {"name": "floor", "loop": [0, 2, 1], "graspable": false},
  {"loop": [0, 1, 3]}, {"loop": [0, 3, 2]}, {"name": "slope", "loop": [1, 2, 3]}
 ],
 "grasps": [
  {"name": "top", "face": 3,
   "object_from_tool": {
    "translation": [0.01, 0.01, 0.02], "quaternion_wxyz": [0.5, 0.5, -0.5, 0.5]
   },
   "opening": 0.05, "depth": 0.01, "tolerance": 0.005}
 ],
 "symmetry": {"confirmed": false, "centre": [0.0, 0.0, 0.0], "rotations": [[1.0, 0.0, 0.0, 0.0]]},
 "covariance": {"per_vertex": [
  [1e-08, 0.0, 0.0, 1e-08, 0.0, 1e-08], [1e-08, 0.0, 0.0, 1e-08, 0.0, 1e-08],
  [1e-08, 0.0, 0.0, 1e-08, 0.0, 1e-08], [1e-08, 1e-09, 0.0, 1e-08, 0.0, 1e-08]]},
 "end": "smartview_object"
}
"""


def write_object(folder: Path) -> Path:
    """Write a wedge with a grasp, a symmetry and its uncertainty."""
    return write_atomically(folder / "wedge.json", _OBJECT)


def model_in_range(model: ObjectModel) -> None:
    """Raise an AssertionError for a model that no file may bring in."""
    fuzz_meshes.in_range(model)
    if model.covariance is not None:
        covariance = np.atleast_3d(model.covariance).reshape(-1, *model.covariance.shape[-2:])
        assert np.isfinite(covariance).all(), "a covariance that is not finite"
        smallest = np.linalg.eigvalsh(covariance).min()
        assert smallest >= -1e-9 * np.abs(covariance).max(), "a covariance that is none"
    for grasp in model.grasps:
        pose = np.asarray(grasp.object_from_tool)
        assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-5, "no rotation"
        assert np.abs(pose[:3, 3]).max() <= fuzz_meshes.LARGEST_SIDE, "a grasp far away"
        assert 0.0 < grasp.opening <= fuzz_meshes.LARGEST_SIDE, f"an opening of {grasp.opening}"
        assert 0 <= grasp.face < len(model.faces), "a grasp on no face"
    if model.symmetry is not None:
        turns = model.symmetry.rotations
        assert np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() < 1e-5, "no rotation"


def write_object_folder(folder: Path) -> Path:
    """Write pictures of an object with their poses."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (24, 32)).astype(np.uint8) for _ in range(3)]
    poses = SE3.exp(rng.normal(scale=0.3, size=(3, 6)))
    io.write_object_views(folder, ["v1", "v2", "v3"], pictures, poses)
    return folder / io.OBJECT_VIEWS_FILE


def load_object_folder(path: Path) -> ObjectViews:
    """Read the folder of its description."""
    return io.load_object_views(path.parent)


def write_misses(name: str) -> Callable[[Path], Path]:
    """Return what writes the misses of three touches: the files are a person's."""
    table = "view,x_mm,y_mm,z_mm\n" + "".join(f"{touch},0.1,-0.2,0.05\n" for touch in _TOUCHES)
    entries = "".join(f"  {touch}: [0.1, -0.2, 0.05]\n" for touch in _TOUCHES)
    content = table if name.endswith(".csv") else f"unit: mm\nmisses:\n{entries}"
    return lambda folder: write_atomically(folder / name, content)


def read_touches(path: Path) -> np.ndarray:
    """Read the misses of the three touches."""
    return io.read_misses(path, _TOUCHES)


def misses_in_range(misses: np.ndarray) -> None:
    """Raise an AssertionError for misses that no stylus has."""
    assert misses.shape[0] == len(_TOUCHES), f"misses of {misses.shape}"
    assert misses.shape[1] in (2, 3), f"misses of {misses.shape}"
    assert (np.abs(misses) <= LARGEST_MISS).all(), "a miss far out"


def write_journal(folder: Path) -> Path:
    """Write the journal of a session in which a face with a grasp was drawn."""
    history = EditHistory(folder / "model.json", _JOURNAL_HEADER)
    clicks = [{"v1": [10.5 * k, 20.25], "v2": [11.5, 3.5 * k]} for k in range(4)]
    changes: list[dict[str, object]] = [
        *({"do": "add_point", "clicks": pair} for pair in clicks),
        {"do": "add_face", "loop": [0, 1, 2], "name": "top", "graspable": True},
        {"do": "add_grasp", "face": 4, "depth": 0.01, "angle": 1.5},
        {"do": "add_constraint", "kind": "length", "items": [[0, 1]], "value": 0.05},
        {"do": "rename", "name": "wedge"},
        {"do": "delete", "kind": "points", "id": 3},
    ]
    for change in changes:
        history.change(change, apply_change(history.document, change))
    history.undo()
    history.close()
    assert history.path is not None
    return history.path


def read_journal(path: Path) -> Document:
    """Open a session's journal as the editor does."""
    history = EditHistory(path.with_name("model.json"), _JOURNAL_HEADER)
    history.close()
    return history.document
