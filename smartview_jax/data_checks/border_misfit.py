"""Find a lens model that fits the middle of the pictures, but not their border.

A lens that bends more than its model can puts the points near the border far from where the model
does. There they are few, and are left out as outliers: what is left fits well, and nothing shows
that the camera is wrong where it saw points. But errors of detection have any direction, while a
wrong lens displaces all points outward, or all inward.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool
from scipy.special import bdtrc

from ..cameras import Camera
from ..dataset import Observations, view_residuals
from ..geometry import host_matrices
from ..runtime.array_namespace import to_device

MAX_CHANCE = 1e-6
"""Probability by chance below which points are displaced as by a lens."""

MIN_VIEWS = 3
"""Fewest views with such points: in one view a wrong pose displaces them alike."""


class BorderMisfit(NamedTuple):
    """Points near the border of the pictures that a camera does not fit.

    Attributes:
        left_out: number of points that were left out and are displaced as by a lens.
        seen: number of all points that were seen as far from the principal point.
        radius: smallest distance of these points from the principal point, px.
        largest: largest distance of such a point from where the camera puts it, px.
    """

    left_out: int
    seen: int
    radius: float
    largest: float

    def sentence(self, lens: str, better: str | None) -> str:
        """Return what is wrong in words, and what to do.

        Args:
            lens: name of the lens, or what the camera is called.
            better: name of a lens that leaves fewer points out; None if none is known.
        """
        advice = (
            f"use lens='{better}' (--lens {better})"
            if better is not None
            else "try another lens, and look at the detections there"
        )
        return (
            f"{lens} does not fit the border of the pictures: of {self.seen} points more than "
            f"{self.radius:.0f} px from the principal point {self.left_out} were left out, all "
            f"displaced along the radius, by up to {self.largest:.2g} px: {advice}"
        )


def find_border_misfit(
    observations: Observations,
    used: Bool[np.ndarray, "views"],
    inliers: Bool[np.ndarray, "views points"],
    camera: Camera,
    camera_from_world: SE3,
) -> BorderMisfit | None:
    """Return the points that were left out because the lens does not fit the border, if any.

    Args:
        observations: points and pixels.
        used: mask of the views to check.
        inliers: mask of the points that the camera was fitted to.
        camera: common to all views.
        camera_from_world: the pose of each view that fits best with this camera.
    """
    visible = np.asarray(observations.visible) & used[:, None]
    poses = host_matrices(camera_from_world)
    residuals = np.asarray(view_residuals(camera, to_device(np.ones(())), poses, observations))
    left_out = visible & ~inliers & np.isfinite(residuals).all(axis=2)
    middle = np.array([float(camera.u0), float(camera.v0)])
    rays = np.asarray(observations.pixels) - middle
    radii = np.linalg.norm(rays, axis=2)
    residual, ray = residuals[left_out], rays[left_out]
    # The sine of 45 degrees: a quarter of all directions are as near to the outward one.
    lengths = np.linalg.norm(residual, axis=1) * np.linalg.norm(ray, axis=1)
    along = np.sum(residual * ray, axis=1) > np.sqrt(0.5) * lengths
    against = np.sum(residual * ray, axis=1) < -np.sqrt(0.5) * lengths
    radial = max(along, against, key=np.count_nonzero)
    count = int(np.count_nonzero(radial))
    # Either direction may be the commoner one.
    if count == 0 or 2.0 * bdtrc(count - 1, len(radial), 0.25) > MAX_CHANCE:
        return None
    displaced = np.zeros_like(left_out)
    displaced[left_out] = radial
    if np.count_nonzero(displaced.any(axis=1)) < MIN_VIEWS:
        return None
    radius = float(radii[displaced].min())
    return BorderMisfit(
        count,
        int(np.count_nonzero(radii[visible] >= radius)),
        radius,
        float(np.linalg.norm(residuals[displaced], axis=1).max()),
    )
