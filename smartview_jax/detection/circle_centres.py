"""Correct measured circle centres for the bias caused by perspective and the lens.

A detector finds the centre of a circle's image, but a fit projects the circle's centre. The
difference can be computed from a calibration and hardly depends on the calibration's errors. So the
data are fitted, the pixels corrected with the result, and the corrected data fitted again:

    fit = sv.calibrate(data)
    fit = sv.calibrate(sv.correct_circle_centres(data, fit.calibration))

The correction is always applied to the data as measured. One round is enough: the bias is at most
some tenths of a pixel, and errors of the first fit change only a small fraction of it.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..cameras import circle_centre_bias
from ..dataset import Dataset, Observations
from ..runtime.compilation import compiled_optimised
from ..targets import AbstractTarget, CircleGrid, StackedTarget


def correct_circle_centres(
    data: Dataset,
    calibration: Calibration,
    radius: float | Float[np.ndarray, "points"] | None = None,
) -> Dataset:
    """Return the data with each pixel corrected to the image of its circle's centre.

    Args:
        data: detected centres of circles that are parallel to the target's xy-plane.
        calibration: the result of any fit to these data.
        radius: radius of the circles, one number or one for each circle, in the unit of the
            target's points, m; by default the radius that the target states.

    Raises:
        ValueError: a radius that is neither given nor known, or is not positive; a target that does
            not consist of circles; a visible circle that the calibration cannot project (the
            message names the view).

    For example:

        >>> corrected = sv.correct_circle_centres(data, fit.calibration, radius=0.002)
        >>> shift = np.linalg.norm(corrected.pixels - data.pixels, axis=-1)
        >>> print(f"up to {np.nanmax(shift):.2f} px")
        up to 0.10 px
    """
    radii = np.asarray(circle_radii(data.target) if radius is None else radius, dtype=float)
    if not (np.isfinite(radii).all() and (radii > 0.0).all()):
        raise ValueError(f"radius: expected positive lengths in metres, found {radius!r}")
    count = data.points.shape[1]
    if radii.shape not in ((), (count,)):
        raise ValueError(f"radius: expected one number or {count}, found shape {radii.shape}")
    radius_per_point = jax.device_put(np.broadcast_to(radii, (count,)))
    bias, valid = predicted_bias(calibration, data.observations, radius_per_point)
    visible = np.asarray(data.visible)
    not_projectable = visible & ~np.asarray(valid)
    if not_projectable.any():
        view, point = np.argwhere(not_projectable)[0]
        raise ValueError(
            f"view {data.view_ids[view]}: circle {point} is visible, but this calibration cannot "
            "project it"
        )
    measured = np.asarray(data.pixels)
    pixels = np.where(visible[..., None], measured - np.asarray(bias), measured)
    return dataclasses.replace(data, pixels=jax.device_put(pixels))


@compiled_optimised
def predicted_bias(
    calibration: Calibration, observations: Observations, radii: Float[Array, "points"]
) -> tuple[Float[Array, "views points 2"], Bool[Array, "views points"]]:
    """Return the centre of each circle's image minus the image of its centre, px.

    Args:
        calibration: gives the poses, the camera and the scale of the target.
        radii: radius of each circle, in the unit of the target's points, m.

    Returns:
        The bias, NaN where not valid; and whether the whole circle can be projected.
    """
    scaled_radii = calibration.target_scale * radii

    def view_bias(view_observations: Observations) -> tuple[Array, Array]:
        """Return the bias of all circles in one view, and whether each is valid."""
        # camera_from_circle = camera_from_world @ (translation to the circle's centre), because the
        # axes of a circle's frame are parallel to the world's axes.
        pose = calibration.camera_from_world(view_observations.command)
        centres = SE3.from_translation(calibration.target_scale * view_observations.points)
        poses = SE3(jnp.broadcast_to(pose.wxyz_xyz, centres.wxyz_xyz.shape))
        return circle_centre_bias(calibration.camera, poses @ centres, scaled_radii)

    # Views are processed one after another. Each circle is sampled at a dozen or more points, so
    # all views at once would need that many times the memory of the data.
    return jax.lax.map(view_bias, observations)


def circle_radii(target: AbstractTarget | None) -> Float[np.ndarray, "points"]:
    """Return the radius of every circle of a target, m; raise a ValueError if it states none."""
    if isinstance(target, StackedTarget):
        return np.tile(circle_radii(target.board), len(target.heights))
    if not isinstance(target, CircleGrid):
        raise ValueError(f"target: expected circles, found {target!r}")
    if not target.has_known_radii:
        name = "radius" if target.radius is None else "mark_radius"
        raise ValueError(f"{name}: the target does not state it, so it must be given")
    radii = np.full(len(target.points), target.radius)
    if target.mark_radius is not None:
        radii[0] = target.mark_radius
    return radii
