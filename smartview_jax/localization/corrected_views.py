"""Put the camera where the edges of an object say that it was, within what its calibration allows.

An estimated calibration displaces every picture as a whole, each in its own way, so that no pose of
an object lies on its edges in all of them. That is no evidence against the object: the displacement
that is likeliest under the calibration's covariance is taken away before its edges are judged.
"""

import jax
import numpy as np
from jaxtyping import Float

from ..cameras import Camera
from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty, SeenViews
from ..runtime.array_namespace import to_device
from ..runtime.padding import repeat_last


def corrected_views(
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
    error: Float[np.ndarray, "numbers"],
) -> SeenViews:
    """Return views whose camera and poses are corrected by errors of a calibration's numbers.

    Args:
        views: camera and poses as they were calibrated.
        uncertainty: of the calibration in these views.
        error: true minus calibrated numbers, such as the `calibration_error` of a refined pose.
    """
    if not len(error):
        return views
    local = uncertainty.view_jacobian @ error
    # All views have one camera; its numbers come before the twist of each view.
    camera = _moved_camera(views.camera, local[0, :-6])
    moved = host_exponentials(local[:, -6:]) @ views.camera_from_world
    padded = repeat_last(moved, len(views.padded))
    return views._replace(camera=camera, camera_from_world=moved, padded=padded)


def _moved_camera(camera: Camera, change: Float[np.ndarray, "parameters"]) -> Camera:
    """Return a camera with other parameters, in the order of its leaves."""
    leaves, structure = jax.tree.flatten(camera)
    sizes = [np.size(leaf) for leaf in leaves]
    parts = np.split(change, np.cumsum(sizes)[:-1])
    moved = [
        to_device(np.asarray(leaf) + part.reshape(np.shape(leaf)))
        for leaf, part in zip(leaves, parts, strict=True)
    ]
    return jax.tree.unflatten(structure, moved)
