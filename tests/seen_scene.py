"""A scene of two solids on a table, in two rendered pictures, for the tests of the search.

`python tests/seen_scene.py` renders the pictures in `localization/data` again.
"""

import functools
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.features import PictureEvidence, picture_evidence
from smartview_jax.geometry import host_matrices, look_at
from smartview_jax.modeling import ObjectModel, SeenViews
from smartview_jax.simulation import (
    SolidScene,
    Surface,
    box,
    matt,
    render_solids,
    speckled,
    stepped_block,
)

IMAGE_SIZE = (640, 480)
"""Of all pictures in the tests of the search, so that they share compiled programs."""

SAMPLES = 512
"""Number of points along the edges of all wireframes that are fitted, for the same reason.

They are so near each other that an object takes all edge points between them.
"""

CAMERA = sv.Camera(800.0, 805.0, 325.0, 236.0, OpenCV5(-0.15, 0.05, 0.0, 0.0, 0.0), IMAGE_SIZE)
CALIBRATION = sv.Calibration.eye_in_hand(CAMERA, np.eye(4), np.eye(4))
PICTURES = [
    Path(__file__).parent / "localization" / "data" / f"seen_{view}.png" for view in range(2)
]


class SeenScene(NamedTuple):
    """Two pictures, what is found in them, and the models with their true poses."""

    pictures: list[np.ndarray]
    evidence: list[PictureEvidence]
    views: SeenViews
    models: list[ObjectModel]
    world_from_object: list[np.ndarray]


def placed(x, y, angle):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    pose[:2, 3] = x, y
    return pose


SOLIDS = stepped_block(0.06), box(0.05, 0.035, 0.02)
POSES = [placed(-0.035, 0.0, 0.4), placed(0.045, 0.01, 1.2)]


def base_from_tool():
    """Two views 25 degrees apart."""
    directions = np.array([[0.35, 0.45, -1.0], [-0.1, 0.45, -1.0]])
    cameras = look_at((0.0, 0.0, 0.015), directions, 0.36, np.array([0.2, -0.4]))
    return np.linalg.inv(host_matrices(cameras))


@functools.cache
def seen_scene():
    """A stepped block and a box."""
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in PICTURES]
    evidence = [picture_evidence(picture, CAMERA) for picture in pictures]
    views = SeenViews.of(CALIBRATION, base_from_tool())
    return SeenScene(pictures, evidence, views, [solid.exact_model() for solid in SOLIDS], POSES)


def render():
    """Write the pictures."""
    surfaces = [Surface.of_plane(0.5, matt(0.3))]
    for solid, pose in zip(SOLIDS, POSES, strict=True):
        surfaces.append(Surface.of_polyhedron(solid.moved(pose), speckled(0.7, 0.02, 0.003)))
    for path, pose in zip(PICTURES, base_from_tool(), strict=True):
        path.parent.mkdir(exist_ok=True)
        scene = SolidScene(surfaces)
        cv2.imwrite(str(path), render_solids(CALIBRATION, pose, scene, exposure=1.2, samples=8))


def errors(model, poses, truth):
    """Rotation (degrees) and translation of the middle (mm) from the nearest equal pose."""
    equal = truth @ model.symmetry.object_from_object
    turns = np.einsum("pij,sij->ps", poses[:, :3, :3], equal[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((turns - 1.0) / 2.0, -1.0, 1.0)))
    best = angles.argmin(axis=1)
    middle = np.append(model.vertices.mean(axis=0), 1.0)
    shifts = ((poses - equal[best]) @ middle)[:, :3]
    return angles.min(axis=1), 1e3 * np.linalg.norm(shifts, axis=1)


def shaken(pose, rng, degrees, millimetres, count):
    """A pose moved by random turns and shifts of given sizes."""
    tangents = rng.standard_normal((count, 2, 3))
    tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns = Rotation.from_rotvec(np.deg2rad(degrees) * tangents[:, 0])
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = 1e-3 * millimetres * tangents[:, 1]
    return pose @ poses


if __name__ == "__main__":
    render()
