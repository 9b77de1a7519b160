"""Two cameras on one hand that see one target."""

import numpy as np
from scipy.spatial.transform import Rotation

from smartview_jax import Dataset, Rig
from smartview_jax.data_checks import SeenTarget
from smartview_jax.geometry import host_exponentials
from smartview_jax.targets import Chessboard

POINTS = Chessboard(6, 9, 0.025).points
NOISE = np.repeat([1e-4, 3e-4], 3)
"""Standard deviations of a pose from one picture: m, rad."""


def rig_of(pixels, states=12):
    """Two cameras on the hand, with the states `0, 1, ...` in common."""
    cameras = {}
    for name, seed in zip(("left", "right"), pixels, strict=True):
        seen = np.random.default_rng(seed).uniform(100.0, 400.0, (states, len(POINTS), 2))
        poses = np.tile(np.eye(4), (states, 1, 1))
        poses[:, :3, 3] = np.arange(states)[:, None] * [0.01, 0.0, 0.0]
        cameras[name] = Dataset.from_arrays(POINTS, seen, poses, (640, 480))
    return Rig(cameras)


def seen_by_both(displacement, rng, states=12, place_error=0.02):
    """The poses of a target in two cameras, the second of which sees it displaced.

    The places that each camera tells with its robot are wrong by centimetres.
    """
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.4, (states, 3))).as_matrix()
    first = np.tile(np.eye(4), (states, 1, 1))
    first[:, :3, :3] = turns
    first[:, :3, 3] = rng.normal([0.0, 0.0, 0.45], 0.05, (states, 3))
    second_from_first = host_exponentials(np.array([-0.12, 0.01, 0.0, 0.02, -0.2, 0.05]))
    second = second_from_first @ first @ displacement
    poses = [
        host_exponentials(rng.normal(0.0, NOISE, (states, 6))) @ exact for exact in (first, second)
    ]
    places = [
        host_exponentials(rng.normal(0.0, place_error, 6) * [1, 1, 1, 0.1, 0.1, 0.1]) @ place
        for place in (np.eye(4), displacement)
    ]
    views = np.arange(states)
    return {
        name: SeenTarget(views, seen, place)
        for name, seen, place in zip(("left", "right"), poses, places, strict=True)
    }
