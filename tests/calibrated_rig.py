"""Two cameras on an arm with errors, and the fit of both: calibrated once in a run."""

import functools

from once_a_run import computed_once

from smartview_jax import calibrate
from smartview_jax.simulation import six_axis_rig_scene


@functools.cache
def rig_scene():
    """Each camera sees the board in eight states of its own."""
    return six_axis_rig_scene(1, cameras=2)


def calibrated_rig(tmp_path_factory):
    """The default fit of the scene's rig."""
    return computed_once(tmp_path_factory, "rig", lambda: calibrate(rig_scene().rig))
