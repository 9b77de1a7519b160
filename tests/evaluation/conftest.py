"""The scene that the tests of this room share: with one number of views and of points."""

from typing import NamedTuple

import numpy as np
import pytest
from standard_scene import POINTS, VIEWS

from smartview_jax import Noise, Prior, Rig, RigFit, fit_rig
from smartview_jax.calibration import Calibration
from smartview_jax.robot_errors import LinearInPosition
from smartview_jax.simulation import random_scene

NOISE = Noise(0.15, 1e-4, float(np.deg2rad(0.01)), field=(3e-4, 1e-3))
"""Of the rig's cameras and robot."""


class FittedRig(NamedTuple):
    """A rig without any error, and what its fit was given."""

    rig: Rig
    truths: dict[str, Calibration]
    noise: Noise
    options: dict
    fit: RigFit


@pytest.fixture(scope="session")
def scene():
    """An exact robot, 0.15 px of noise."""
    return random_scene(0, VIEWS, POINTS)


@pytest.fixture(scope="session")
def fitted_rig():
    """Two cameras in one place; the second saw less, and the robot may err smoothly."""
    scene = random_scene(0, 8, POINTS, pixel_noise=0.0)
    right = scene.data.mask_views([3, 6, 7])
    rig = Rig({"left": scene.data, "right": right})
    truths = dict.fromkeys(rig.cameras, scene.calibration)
    options = {
        "field": LinearInPosition.from_poses(rig.base_from_tool),
        "free": ("target_scale",),
        "priors": {
            "target_scale": Prior(mean=1.0, std=0.002),
            "left.camera.lens.k1": Prior(std=0.01),
        },
    }
    return FittedRig(rig, truths, NOISE, options, fit_rig(rig, truths, noise=NOISE, **options))
