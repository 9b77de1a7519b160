"""Shift the camera poses by the calibration error that an object's edges make most likely.

An error of the calibration displaces each picture as a whole, differently from the others, so that
no pose of an object fits its edges in all pictures. This is no evidence against the object:
before its edges are judged, the views are corrected by the likeliest error under the
calibration's covariance.
"""

import numpy as np
from jaxtyping import Float

from ..cameras import moved_cameras
from ..geometry import host_exponentials
from ..modeling import CalibrationUncertainty, SeenViews
from ..runtime.padding import repeat_last


def corrected_views(
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
    error: Float[np.ndarray, "numbers"],
) -> SeenViews:
    """Return views whose cameras and poses are corrected by errors of the calibration.

    Args:
        views: cameras and poses as calibrated.
        uncertainty: of the calibration in these views.
        error: true minus calibrated parameters, such as the `calibration_error` of a refined pose.
    """
    if not len(error):
        return views
    local = uncertainty.view_jacobian @ error
    # Every view lists the parameters of all cameras, before its own twist.
    camera = moved_cameras(views.camera, local[0, :-6])
    moved = host_exponentials(local[:, -6:]) @ views.camera_from_world
    padded = repeat_last(moved, len(views.padded))
    return views._replace(camera=camera, camera_from_world=moved, padded=padded)
