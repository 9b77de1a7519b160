"""A box at a known pose, its corners in calibrated views, and how far a pose is from it."""

import jax
import jax.numpy as jnp
import numpy as np
from drawn_edges import seen_views
from solids import box

from smartview_jax.engine import Noise
from smartview_jax.geometry import host_exponentials, host_logarithms

MODEL = box()
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
SIGMA = 0.3
NOISE = Noise(0.1, 3e-4, float(np.deg2rad(0.05)))


def placed(points, pose=POSE):
    return points @ pose[:3, :3].T + pose[:3, 3]


MIDDLE = placed(MODEL.vertices.mean(axis=0))

OTHER_POSE = POSE.copy()
"""The pose of a second box, with some room between both."""
OTHER_POSE[:3, 3] += POSE[:3, :3] @ [0.085, 0.01, 0.0]


def views_of_both():
    """Two views from so far away that the box and a second one next to it are in the picture."""
    return seen_views(MIDDLE + 0.5 * (OTHER_POSE - POSE)[:3, 3], distance=0.6)


@jax.jit
def _project(camera, points):
    return camera.project(points)[0]


def projected(views, points):
    """Pixels of points in the world, in every view, by nothing but the camera."""
    moved = [points @ m[:3, :3].T + m[:3, 3] for m in views.camera_from_world]
    return np.asarray(_project(views.camera, jnp.asarray(moved)))


def error_of(pose):
    return host_logarithms(np.linalg.inv(POSE) @ pose)
