"""Find a lens model that fits the middle of the pictures, but not their border.

A lens that bends more than its model can puts the points near the border far from where the model
does. There they are few, and are left out as outliers: what is left fits well, and nothing shows
that the camera is wrong where it saw points. But errors of detection have any direction, while a
wrong lens displaces all points outward, or all inward; and they are anywhere and few, while a wrong
lens displaces most of the points that are as far out.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float
from scipy.special import bdtrc

from ..cameras import Camera
from ..dataset import Observations, camera_residuals
from ..geometry import host_matrices

MAX_CHANCE = 1e-6
"""Probability by chance below which points are displaced as by a lens."""

MIN_VIEWS = 3
"""Fewest views with such points: in one view a wrong pose displaces them alike."""


class BorderMisfit(NamedTuple):
    """Points near the border of the pictures that a camera does not fit.

    Attributes:
        left_out: number of points near the border that were left out, displaced as by a lens.
        seen: number of all points near the border.
        radius: distance from the principal point at which the border begins, px: beyond it the
            points that are displaced so outnumber the others by most.
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
    residuals = camera_residuals(camera, host_matrices(camera_from_world), observations)
    visible &= np.isfinite(residuals).all(axis=2)
    left_out = visible & ~inliers
    rays = np.asarray(observations.pixels) - [float(camera.u0), float(camera.v0)]
    radii, lengths = np.linalg.norm(rays, axis=2), np.linalg.norm(residuals, axis=2)
    # The sine of 45 degrees: a quarter of all directions are as near to the outward one.
    with np.errstate(invalid="ignore"):
        cosine = np.sum(residuals * rays, axis=2) / np.maximum(lengths * radii, 1e-300)
        along, against = left_out & (cosine > np.sqrt(0.5)), left_out & (cosine < -np.sqrt(0.5))
    displaced = max(along, against, key=np.count_nonzero)
    radius = _border_radius(radii[visible], displaced[visible])
    at_border = visible & (radii >= radius)
    displaced &= at_border
    if np.count_nonzero(displaced.any(axis=1)) < MIN_VIEWS:
        return None
    count = int(np.count_nonzero(displaced))
    # Either direction may be the commoner one.
    if 2.0 * bdtrc(count - 1, np.count_nonzero(left_out & at_border), 0.25) > MAX_CHANCE:
        return None
    largest = float(lengths[displaced].max())
    return BorderMisfit(count, int(np.count_nonzero(at_border)), radius, largest)


def _border_radius(
    radii: Float[np.ndarray, "points"], displaced: Bool[np.ndarray, "points"]
) -> float:
    """Return the distance beyond which displaced points outnumber others by most; or infinity."""
    outermost_first = np.argsort(-radii)
    excess = np.cumsum(np.where(displaced[outermost_first], 1, -1))
    if not (excess > 0).any():
        return np.inf
    return float(radii[outermost_first[np.argmax(excess)]])
