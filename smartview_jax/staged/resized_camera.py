"""Fit the size and the shift of pictures that a program resized or cut, to a known camera.

Such pictures have a camera that differs from the known one in three numbers: a resized and shifted
picture keeps the lens and the ratio of both focal lengths. A single tilted view tells them. The
poses of the views follow from them (variable projection: Golub and Pereyra 1973).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from ..cameras import AbstractLens, Camera
from ..data_checks import DETECTION_NOISE
from ..dataset import Observations, camera_residuals
from ..geometry import host_matrices
from ..runtime.modules import with_fields
from .kalman import FAR_PIXELS
from .picture_steps import run_step1, start_of_step2
from .weng import estimate_view_poses

DIFFERENCE_STEP = 1e-4
"""Step of the derivatives, over the size and over the focal length: 0.1 px of 1000."""

USUAL_SIZES = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 1.0, 4.0 / 3.0, 1.5, 2.0)
"""Sizes of binned and resized pictures from which the fit may start as well."""

TOLERANCE = 1e-5
"""Relative change of the numbers, and of the cost, below which the fit ends."""

MAX_EVALUATIONS = 30
"""Largest number of steps of the fit; five to ten are usual."""


def fit_resized_camera(
    known: Camera,
    observations: Observations,
    part: Bool[np.ndarray, "views"],
    lens: str | AbstractLens,
) -> Camera:
    """Return the camera of pictures that differ from a known camera's in size and shift.

    Args:
        known: the camera before the pictures were resized or cut.
        observations: points and pixels of all views.
        part: mask of the views.
        lens: a name or a lens, with which the views alone are fitted for a start.
    """
    picture = known.image_size
    alone = run_step1(observations, picture, part, lens, None).calibrations
    assert alone is not None
    start, _ = start_of_step2(alone, part, lens, picture)
    focal_length = float(np.sqrt(known.alpha_u * known.alpha_v))
    of_part = with_fields(observations, visible=np.asarray(observations.visible) & part[:, None])
    seen = np.asarray(of_part.visible)

    def residuals(numbers: Float[np.ndarray, "3"]) -> Float[np.ndarray, "coordinates"]:
        """Return what the best poses of the views leave over, px."""
        camera = _resized(known, numbers)
        poses = host_matrices(estimate_view_poses(of_part, camera)[0])
        left_over = camera_residuals(camera, poses, of_part)[seen].ravel()
        return np.nan_to_num(left_over, nan=FAR_PIXELS, posinf=FAR_PIXELS, neginf=FAR_PIXELS)

    centre = np.array([float(known.u0), float(known.v0)])
    found = np.array([float(start.u0), float(start.v0)])
    size_found = float(np.sqrt(start.alpha_u * start.alpha_v)) / focal_length
    starts = [np.append(np.log(size_found), (found - centre) / focal_length)]
    # A single view may be fitted by cameras far from its own. Most pictures are resized as a whole,
    # from half a pixel before the middle of the first one.
    for size in USUAL_SIZES:
        moved = (size - 1.0) * (centre + 0.5) / focal_length
        starts.append(np.append(np.log(size), moved))
    nearest = min(starts, key=lambda numbers: np.abs(residuals(numbers)).sum())
    fit = least_squares(
        residuals,
        nearest,
        loss="soft_l1",
        f_scale=DETECTION_NOISE,
        diff_step=DIFFERENCE_STEP,
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        x_scale=0.1,
        max_nfev=MAX_EVALUATIONS,
    )
    return _resized(known, fit.x)


def _resized(known: Camera, numbers: Float[np.ndarray, "3"]) -> Camera:
    """Return a camera of another size and another centre.

    Args:
        known: the camera.
        numbers: logarithm of the size, and by how much the centre moves over the focal length.
    """
    size = float(np.exp(numbers[0]))
    focal_length = float(np.sqrt(known.alpha_u * known.alpha_v))
    return dataclasses.replace(
        known,
        alpha_u=size * known.alpha_u,
        alpha_v=size * known.alpha_v,
        u0=known.u0 + numbers[1] * focal_length,
        v0=known.v0 + numbers[2] * focal_length,
    )
