"""Compute the image of a circle: the ellipse seen by a pinhole, and the centroid of any curve."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float


def circle_dual_conic(
    camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> Float[Array, "*batch 3 3"]:
    """Return the dual conic of a circle's image on the plane z = 1, without lens distortion.

    The circle lies in the xy-plane of its frame, around the origin. The homography
    `H = [r1 r2 t]` maps its points `(x, y, 1)` to the image, and the circle's dual conic
    `diag(r^2, r^2, -1)` to `H diag(r^2, r^2, -1) H^T`.

    Args:
        camera_from_circle: `(*batch)`.
        radius: m.

    Returns:
        A symmetric matrix for each circle, defined up to a factor.
    """
    # H = [r1 r2 t],   dual conic of the image = H diag(r^2, r^2, -1) H^T.
    # The dual is used because the conic itself needs the inverse of H, which does not exist where
    # the circle is seen edge on.
    rotation, t = camera_from_circle.rotation().as_matrix(), camera_from_circle.translation()
    H = jnp.concatenate([rotation[..., :, :2], t[..., None]], axis=-1)
    diagonal = jnp.stack([radius**2, radius**2, -jnp.ones_like(radius)], axis=-1)
    return (H * diagonal[..., None, :]) @ jnp.swapaxes(H, -1, -2)


def conic_centre(dual: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 2"]:
    """Return the centre of a conic from its dual.

    The centre is the pole of the line at infinity, and so the last column of the dual.
    """
    # With the dual D and the line at infinity l = (0, 0, 1): centre ~ D l = (D_13, D_23, D_33).
    return dual[..., :2, 2] / dual[..., 2:, 2]


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
