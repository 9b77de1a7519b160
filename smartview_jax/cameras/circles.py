"""Compute the centre of a circle's image, which differs from the image of the circle's centre.

Perspective maps a circle to an ellipse, and the image of the circle's centre is shifted from the
ellipse's centre towards the farther side; the lens then bends the ellipse. A detector finds the
centroid of the imaged region. This centroid is computed here, for any lens.
"""

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..geometry import transform_points
from .camera import Camera

BOUNDARY_SAMPLES = 16
"""Number of points that sample a circle's boundary.

More points change the centroid by less than 1e-9 px, even if the circle fills a third of a wide
picture.
"""


def circle_image_centre(
    camera: Camera, camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Return the centroid of a circle's image, px.

    Args:
        camera: with any lens.
        camera_from_circle: `(*batch)`; the circle lies in the xy-plane, around the origin.
        radius: m.

    Returns:
        The centroid, NaN where not valid; and whether the whole circle can be projected.
    """
    angle = 2.0 * jnp.pi / BOUNDARY_SAMPLES * jnp.arange(BOUNDARY_SAMPLES, dtype=float)

    def boundary(angle: Float[Array, "samples"]) -> tuple[Array, Array]:
        """Return the pixels of the boundary at these angles, and whether each is valid."""
        unit = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)
        circle = radius[..., None, None] * unit.reshape((1,) * radius.ndim + unit.shape)
        return camera.project(transform_points(camera_from_circle, circle))

    # Green's theorem needs the curve and its derivative with respect to the angle. One
    # Jacobian-vector product gives both, through any lens.
    pixels, velocity, boundary_valid = jax.jvp(
        boundary, (angle,), (jnp.ones_like(angle),), has_aux=True
    )
    valid = jnp.all(boundary_valid, axis=-1)
    # Circles that are not valid are replaced by the unit circle, which keeps derivatives finite.
    cos, sin = (jnp.broadcast_to(f(angle), boundary_valid.shape) for f in (jnp.cos, jnp.sin))
    valid_mask = valid[..., None, None]
    centre = region_centroid(
        jnp.where(valid_mask, pixels, jnp.stack([cos, sin], axis=-1)),
        jnp.where(valid_mask, velocity, jnp.stack([-sin, cos], axis=-1)),
    )
    return jnp.where(valid[..., None], centre, jnp.nan), valid


def circle_centre_bias(
    camera: Camera, camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Return the centre of a circle's image minus the image of its centre, px.

    Arguments and validity as in `circle_image_centre`.
    """
    centre, valid = circle_image_centre(camera, camera_from_circle, radius)
    projected, _ = camera.project(camera_from_circle.translation())
    return centre - projected, valid


def region_centroid(
    boundary: Float[Array, "*batch samples 2"], velocity: Float[Array, "*batch samples 2"]
) -> Float[Array, "*batch 2"]:
    """Return the centroid of the region inside a closed smooth curve, by Green's theorem.

    The integrals use the trapezoidal rule over one period, whose error falls exponentially with
    the number of samples.

    Args:
        boundary: points of the curve at equal steps of its parameter, over one period.
        velocity: derivative of these points with respect to the parameter.

    Returns:
        The centroid; NaN where the curve encloses no area.
    """
    # With p measured from the mean m of the boundary, and p x p' = x y' - y x':
    #   area     A = 1/2 integral (p x p') dt
    #   centroid c = m + 1/A integral 2/3 p 1/2 (p x p') dt
    # because p dt sweeps a triangle from m, whose centroid is at 2/3 p.
    # Without m, the digits of a small region far from the origin would cancel out.
    mean = jnp.mean(boundary, axis=-2, keepdims=True)
    p = boundary - mean
    # The factors 1/2 and the step dt are in both integrals and cancel in their ratio.
    cross_product = p[..., 0] * velocity[..., 1] - p[..., 1] * velocity[..., 0]
    moment = 2.0 / 3.0 * jnp.sum(cross_product[..., None] * p, axis=-2)
    return mean[..., 0, :] + moment / jnp.sum(cross_product, axis=-1)[..., None]
