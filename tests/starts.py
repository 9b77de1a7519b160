"""Where fits start in the tests."""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, OpenCV4


def nudged(calibration, size=1e-3):
    """A calibration with both transforms moved a little, by the same amount every time."""
    step = size * np.random.default_rng(7).normal(size=(2, 6))
    return Calibration(
        calibration.camera,
        SE3.exp(jnp.asarray(step[0])) @ calibration.camera_from_mount,
        SE3.exp(jnp.asarray(step[1])) @ calibration.holder_from_world,
        calibration.mount,
    )


def reference_start(reference, distortion=None):
    """A start near a real data set's reference: its `X` is the camera's pose in the mount."""
    distortion = reference["K"][4:] if distortion is None else distortion
    camera = Camera(*reference["K"][:4], OpenCV4(*distortion), tuple(reference["image_size"]))
    poses = []
    for key in ("X_fixedK", "Y_fixedK"):
        numbers = np.asarray(reference[key])
        rotation = SO3.exp(jnp.asarray(numbers[:3]))
        poses.append(SE3.from_rotation_and_translation(rotation, jnp.asarray(numbers[3:])))
    mount = "eye_in_hand" if reference["eye_in_hand"] else "eye_to_hand"
    return nudged(Calibration(camera, poses[0].inverse(), poses[1], mount), 2e-3)
