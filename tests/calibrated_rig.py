"""Two cameras on an arm with errors, and the fit of both: calibrated once in a run."""

import functools
import pickle

from once_a_run import made_once

from smartview_jax import calibrate
from smartview_jax.simulation import six_axis_rig_scene


@functools.cache
def rig_scene():
    """Each camera sees the board in eight states of its own."""
    return six_axis_rig_scene(1, cameras=2)


def calibrated_rig(tmp_path_factory):
    """The default fit of the scene's rig."""
    folder = made_once(tmp_path_factory, "rig", _calibrate)
    return pickle.loads((folder / "fit.pickle").read_bytes())


def _calibrate(folder):
    folder.mkdir()
    (folder / "fit.pickle").write_bytes(pickle.dumps(calibrate(rig_scene().rig)))
