"""Measured centres of circles, freed from what perspective and lens shift them by.

A detector finds the centre of a circle's image; a fit projects the circle's centre. The difference
is known once a calibration is, and hardly depends on it, so a fit is made, the pixels are corrected
by it, and the fit is made again:

    fit = sv.calibrate(data)
    fit = sv.calibrate(sv.correct_circle_centres(data, fit.calibration))

It is always the data as measured that are corrected. One round settles: the shift is at most some
tenths of a pixel, and what a fit is wrong by changes a small share of it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import circle_centre_bias
from ..compilation import optimised
from ..dataset import Dataset, Observations
from ..targets import AbstractTarget, CircleGrid, StackedTarget


def correct_circle_centres(
    data: Dataset,
    calibration: Calibration,
    radius: float | Float[np.ndarray, "points"] | None = None,
) -> Dataset:
    """The data with pixels where the circles' own centres are seen.

    Args:
        data: centres of circles that lie parallel to the target's xy-plane.
        calibration: of any fit to them.
        radius: of the circles, all alike or each its own, in the unit of the target's points, m;
            by default the target's.

    Raises:
        ValueError: a radius that is neither given nor known, or not positive; another target than
            circles; a circle that was seen but that the calibration cannot project, by view.
    """
    radii = np.asarray(circle_radii(data.target) if radius is None else radius, dtype=float)
    if not (np.isfinite(radii).all() and (radii > 0.0).all()):
        raise ValueError(f"radius: expected positive lengths in metres, found {radius!r}")
    count = data.points.shape[1]
    if radii.shape not in ((), (count,)):
        raise ValueError(f"radius: expected one number or {count}, found shape {radii.shape}")
    each = jnp.broadcast_to(jnp.asarray(radii), (count,))
    bias, valid = predicted_bias(calibration, data.observations, each)
    lost = np.asarray(data.visible & ~valid)
    if lost.any():
        view, point = np.argwhere(lost)[0]
        raise ValueError(
            f"view {data.view_ids[view]}: circle {point} was seen, but this calibration cannot "
            "project it"
        )
    pixels = jnp.where(data.visible[..., None], data.pixels - bias, data.pixels)
    return dataclasses.replace(data, pixels=pixels)


@optimised
def predicted_bias(
    calibration: Calibration, observations: Observations, radii: Float[Array, "points"]
) -> tuple[Float[Array, "views points 2"], Bool[Array, "views points"]]:
    """Centre of the image minus image of the centre, px, and where that can be said."""
    size = calibration.target_scale * radii

    def view(seen: Observations) -> tuple[Array, Array]:
        # The circle's frame is the world's, moved to its centre.
        pose = calibration.camera_from_world(seen.command)
        centres = SE3.from_translation(calibration.target_scale * seen.points)
        wide = SE3(jnp.broadcast_to(pose.wxyz_xyz, centres.wxyz_xyz.shape))
        return circle_centre_bias(calibration.camera, wide @ centres, size)

    # View by view: a few dozen points a circle would take as many times the data's memory.
    return jax.lax.map(view, observations)


def circle_radii(target: AbstractTarget | None) -> Float[np.ndarray, "points"]:
    """The radius of every circle of a target, m.

    Raises:
        ValueError: the target is not made of circles, or does not say how large they are.
    """
    if isinstance(target, StackedTarget):
        return np.tile(circle_radii(target.board), len(target.heights))
    if not isinstance(target, CircleGrid):
        raise ValueError(f"target: expected circles, found {target!r}")
    if target.radius is None or (target.origin_mark and target.mark_radius is None):
        name = "radius" if target.radius is None else "mark_radius"
        raise ValueError(f"{name}: the target does not state it, so it has to be given")
    radii = np.full(len(target.points), target.radius)
    if target.mark_radius is not None:
        radii[0] = target.mark_radius
    return radii
