"""Where the image of a circle has its centre: not where the circle's centre is seen.

Perspective makes an ellipse of it whose centre is shifted towards the farther side, and the lens
bends that ellipse. A detector finds the centroid of the region, so this is what is computed here,
through any lens.
"""

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..geometry import region_centroid, transform_points
from .camera import Camera

SAMPLES = 16
"""Points around a circle; more change the centroid by less than 1e-9 px even where the circle fills
a third of a wide picture."""


def circle_image_centre(
    camera: Camera, camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """The centroid of a circle's image, px, and where the whole circle can be projected.

    Args:
        camera: with any lens.
        camera_from_circle: `(*batch)`; the circle lies around the origin of the xy-plane.
        radius: m.

    Returns:
        As `Camera.project` does: NaN where not valid.
    """
    angle = 2.0 * jnp.pi / SAMPLES * jnp.arange(SAMPLES, dtype=float)

    def boundary(angle: Float[Array, "samples"]) -> tuple[Array, Array]:
        unit = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)], axis=-1)
        circle = radius[..., None, None] * unit.reshape((1,) * radius.ndim + unit.shape)
        return camera.project(transform_points(camera_from_circle, circle))

    pixels, velocity, seen = jax.jvp(boundary, (angle,), (jnp.ones_like(angle),), has_aux=True)
    valid = jnp.all(seen, axis=-1)
    # A stand-in keeps the derivatives of masked circles finite.
    cos, sin = (jnp.broadcast_to(f(angle), seen.shape) for f in (jnp.cos, jnp.sin))
    whole = valid[..., None, None]
    centre = region_centroid(
        jnp.where(whole, pixels, jnp.stack([cos, sin], axis=-1)),
        jnp.where(whole, velocity, jnp.stack([-sin, cos], axis=-1)),
    )
    return jnp.where(valid[..., None], centre, jnp.nan), valid


def circle_centre_bias(
    camera: Camera, camera_from_circle: SE3, radius: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """How far the centre of a circle's image lies from the image of its centre, px.

    Arguments and validity as in `circle_image_centre`.
    """
    centre, valid = circle_image_centre(camera, camera_from_circle, radius)
    projected, _ = camera.project(camera_from_circle.translation())
    return centre - projected, valid
