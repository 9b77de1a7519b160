"""Where fits start in the tests."""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3

from smartview_jax import Calibration


def nudged(calibration, size=1e-3):
    """A calibration with both transforms moved a little, by the same amount every time."""
    step = size * np.random.default_rng(7).normal(size=(2, 6))
    return Calibration(
        calibration.camera,
        SE3.exp(jnp.asarray(step[0])) @ calibration.camera_from_mount,
        SE3.exp(jnp.asarray(step[1])) @ calibration.holder_from_world,
        calibration.mount,
    )
