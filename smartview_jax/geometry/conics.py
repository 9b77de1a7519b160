"""Images of circles: the ellipse that a pinhole sees, and the centroid of any closed curve."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float


def circle_dual_conic(
    camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> Float[Array, "*batch 3 3"]:
    """The dual conic of a circle's image on the plane at unit distance, without a lens.

    The circle lies around the origin of its frame's xy-plane. Its points `(x, y, 1)` reach the
    image by the homography `H = [r1 r2 t]`, and the dual conic `diag(r^2, r^2, -1)` becomes
    `H diag(r^2, r^2, -1) H^T`, where the conic itself would need H's inverse.

    Args:
        camera_from_circle: `(*batch)`.
        radius: m.
    """
    turn, t = camera_from_circle.rotation().as_matrix(), camera_from_circle.translation()
    H = jnp.concatenate([turn[..., :, :2], t[..., None]], axis=-1)
    weights = jnp.stack([radius**2, radius**2, -jnp.ones_like(radius)], axis=-1)
    return (H * weights[..., None, :]) @ jnp.swapaxes(H, -1, -2)


def conic_centre(dual: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 2"]:
    """The centre of a conic: the pole of the line at infinity, the dual's last column."""
    return dual[..., :2, 2] / dual[..., 2:, 2]


def region_centroid(
    boundary: Float[Array, "*batch samples 2"], velocity: Float[Array, "*batch samples 2"]
) -> Float[Array, "*batch 2"]:
    """The centroid of what a closed smooth curve encloses, by Green's theorem.

    The trapezoidal rule on a period: its error falls exponentially with the number of samples.

    Args:
        boundary: the curve at equal steps of its parameter, one turn.
        velocity: its derivative by the parameter.

    Returns:
        NaN where nothing is enclosed.
    """
    middle = jnp.mean(boundary, axis=-2, keepdims=True)
    # About a point within, or far from the origin the digits of a small region would cancel.
    p = boundary - middle
    swept = p[..., 0] * velocity[..., 1] - p[..., 1] * velocity[..., 0]
    # Every element of the fan is a triangle, whose centroid lies two thirds of the way out.
    moment = 2.0 / 3.0 * jnp.sum(swept[..., None] * p, axis=-2)
    return middle[..., 0, :] + moment / jnp.sum(swept, axis=-1)[..., None]
