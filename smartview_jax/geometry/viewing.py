"""Poses of cameras that look at a point: by direction, by tilt and azimuth, the paper's five.

Without roll, a camera that looks straight down (along the world's -z) has the picture's x along the
world's x, and so has one that looks straight up, along +z, which is how a board with z into it is
seen. Any other direction is reached from the nearer of the two by the shortest turn; a horizontal
one from above. So roll means the same everywhere near the usual views, the one straight down
included, where conventions by an upright direction break down.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

FIVE_STEP = float(np.deg2rad(9.5))
"""Angle between neighbours of the paper's five viewpoints, seen from the object (Section 5)."""

FIVE_PATTERNS = {
    "cross": ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)),
    "L": ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 2.0)),
}
"""Steps along X and along Y of five viewpoints: the paper's, and one that reaches twice as far."""


def look_at(
    point: Float[Array, "*#views 3"] | np.ndarray | tuple[float, float, float],
    direction: Float[Array, "*#views 3"] | np.ndarray | tuple[float, float, float],
    distance: float | Float[Array, "*#views"] | np.ndarray,
    roll: float | Float[Array, "*#views"] | np.ndarray = 0.0,
) -> SE3:
    """`camera_from_world` of cameras that look at a point.

    Args:
        point: that is to be on the optical axis, in the world's frame, m.
        direction: in which the camera looks, in the world's frame; of any length but zero, for
            which NaN comes back.
        distance: of the point along the optical axis, m.
        roll: by which the camera turns about its optical axis, from x towards y of the picture,
            rad; see the module for where it begins.

    Returns:
        Transforms with the broadcast shape of all four.
    """
    point, direction = jnp.asarray(point, dtype=float), jnp.asarray(direction, dtype=float)
    away, turn = jnp.asarray(distance, dtype=float), jnp.asarray(roll, dtype=float)
    views = jnp.broadcast_shapes(point.shape[:-1], direction.shape[:-1], away.shape, turn.shape)
    point = jnp.broadcast_to(point, (*views, 3))
    direction = jnp.broadcast_to(direction, (*views, 3))
    away, turn = jnp.broadcast_to(away, views), jnp.broadcast_to(turn, views)
    x, y, z = jnp.moveaxis(direction / jnp.linalg.norm(direction, axis=-1, keepdims=True), -1, 0)
    zero = jnp.zeros_like(z)
    # Shortest turns onto the direction: from +z, then from -z; half their angle is at most 45 deg.
    upward = jnp.stack([1.0 + jnp.abs(z), -y, x, zero], axis=-1)
    downward = jnp.stack([1.0 + jnp.abs(z), y, -x, zero], axis=-1)
    up = z > 0.0
    shortest = jnp.where(up[..., None], upward, downward)
    turned = SO3(shortest / jnp.linalg.norm(shortest, axis=-1, keepdims=True))
    start = SO3.from_x_radians(jnp.where(up, 0.0, jnp.pi))
    rotation = SO3.from_z_radians(-turn) @ start @ turned.inverse()
    offset = jnp.stack([zero, zero, away], axis=-1)
    return SE3.from_rotation_and_translation(rotation, offset - rotation.apply(point))


def direction_of(
    tilt: float | Float[Array, "*#views"] | np.ndarray,
    azimuth: float | Float[Array, "*#views"] | np.ndarray,
    above: bool = True,
) -> Float[Array, "*views 3"]:
    """Unit vector in which a camera looks that stands at these angles, as seen from its object.

    Args:
        tilt: between the way to the camera and the world's z axis, rad.
        azimuth: of the way to the camera about the world's z axis, from x, rad.
        above: the camera stands on the side of +z; False for a board with z into it, as OpenCV
            has it, where the tilt is from -z.
    """
    lean, around = jnp.broadcast_arrays(jnp.asarray(tilt, float), jnp.asarray(azimuth, float))
    flat, height = jnp.sin(lean), jnp.cos(lean)
    to_camera = [flat * jnp.cos(around), flat * jnp.sin(around), height if above else -height]
    return -jnp.stack(to_camera, axis=-1)


def five_viewpoints(
    point: Float[Array, "*#views 3"] | np.ndarray,
    distance: float | Float[Array, "5"] | np.ndarray,
    roll: float | Float[Array, "5"] | np.ndarray = 0.0,
    step: float = FIVE_STEP,
    above: bool = True,
    pattern: str = "cross",
) -> SE3:
    """Return the paper's viewpoints (Fig. 6): one from above, and two each along X and Y.

    Without roll the hand-eye transform is poorly determined: a roll for each view is well spent.

    Args:
        point: that all look at, or a point for each, m.
        distance: of the cameras from it, m.
        roll: about the optical axis, for all or for each, rad.
        step: angle between neighbours as seen from the point, rad.
        above: as in `direction_of`.
        pattern: `"cross"`, a step to either side along X and along Y; or `"L"`, one and two steps
            to the same side.

    Returns:
        `camera_from_world`, `(5)`.

    Raises:
        ValueError: a pattern that is not known.
    """
    if pattern not in FIVE_PATTERNS:
        known = ", ".join(FIVE_PATTERNS)
        raise ValueError(f"pattern: expected one of {known}, found {pattern!r}")
    x, y = np.array(FIVE_PATTERNS[pattern]).T
    tilt, azimuth = step * np.hypot(x, y), np.arctan2(y, x)
    return look_at(point, direction_of(tilt, azimuth, above), distance, roll)
