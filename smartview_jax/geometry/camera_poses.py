"""Compute poses of cameras that look at a point, such as the paper's five viewpoints.

Roll is measured from the following orientation. A camera that looks straight down (along the
world's -z) with zero roll has the picture's x along the world's x. The same holds for a camera that
looks straight up, along +z, for example at a board whose z points into it. For any other direction,
the orientation with zero roll is reached from the nearer of these two by the smallest rotation; for
a horizontal direction, from the camera that looks down. With this definition roll varies smoothly
near the usual views. Definitions by an upright direction are singular where the camera looks
straight down.
"""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..argument_checks import require_one_of
from ..runtime.array_namespace import AnyArray, as_float_array, to_device
from ..runtime.compilation import compiled, is_traced

FIVE_VIEWPOINT_STEP = float(np.deg2rad(9.5))
"""Angle between neighbours of the paper's five viewpoints from the object, rad (Section 5)."""

FIVE_VIEWPOINT_PATTERNS = {
    "cross": ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)),
    "L": ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 1.0), (0.0, 2.0)),
}
"""Offsets along X and along Y of the five viewpoints of each pattern, in steps.

The cross is the paper's pattern; the L has viewpoints twice as far from the first one.
"""


def look_at(
    point: Float[Array, "*#views 3"] | np.ndarray | tuple[float, float, float],
    direction: Float[Array, "*#views 3"] | np.ndarray | tuple[float, float, float],
    distance: float | Float[Array, "*#views"] | np.ndarray,
    roll: float | Float[Array, "*#views"] | np.ndarray = 0.0,
) -> SE3:
    """Return `camera_from_world` of cameras that look at a point.

    Args:
        point: the point on the optical axis, in the world's frame, m.
        direction: viewing direction in the world's frame, of any length except zero, for which the
            result is NaN.
        distance: distance of the point from the camera along the optical axis, m.
        roll: rotation of the camera about its optical axis, from x towards y of the picture, rad;
            the module's docstring defines its zero.

    Returns:
        Transforms with the broadcast shape of all four arguments.

    For example:

        >>> downwards = (0.0, 0.0, -1.0)
        >>> camera_from_world = sv.look_at((0.0, 0.0, 0.0), downwards, distance=0.3)
        >>> centre = np.linalg.inv(sv.geometry.host_matrices(camera_from_world))[:3, 3]
        >>> print(np.rint(1e3 * centre).astype(int), "mm")
        [  0   0 300] mm
    """
    arguments = tuple(as_float_array(x) for x in (point, direction, distance, roll))
    if is_traced(arguments):
        return _look_at(*arguments)
    # Outside of a transformation NumPy is faster: there is no program to compile or to load.
    numbers = _look_at_numbers(*(np.asarray(argument) for argument in arguments), xp=np)
    return SE3(to_device(numbers))


@compiled
def _look_at(
    point: Float[Array, "*#views 3"],
    direction: Float[Array, "*#views 3"],
    distances: Float[Array, "*#views"],
    rolls: Float[Array, "*#views"],
) -> SE3:
    """Compute `look_at` as one program instead of about thirty operations."""
    numbers = _look_at_numbers(point, direction, distances, rolls, jnp)
    return SE3(numbers)  # pyright: ignore[reportArgumentType]


def _look_at_numbers(
    point: Float[AnyArray, "*#views 3"],
    direction: Float[AnyArray, "*#views 3"],
    distances: Float[AnyArray, "*#views"],
    rolls: Float[AnyArray, "*#views"],
    xp: ModuleType,
) -> Float[AnyArray, "*views 7"]:
    """Return the numbers `wxyz_xyz` of `look_at`, computed with NumPy or JAX (`xp`)."""
    # With d the unit direction and S the smallest rotation to d from the
    # nearer of +z and -z:
    #   camera_from_world = (R, t),   R = Rz(-roll) R0 S^-1,   t = (0, 0, distance) - R point,
    # where R0 is the identity for +z and half a rotation about x for -z.
    views = np.broadcast_shapes(
        point.shape[:-1], direction.shape[:-1], distances.shape, rolls.shape
    )
    point = xp.broadcast_to(point, (*views, 3))
    direction = xp.broadcast_to(direction, (*views, 3))
    distances, rolls = xp.broadcast_to(distances, views), xp.broadcast_to(rolls, views)
    length = xp.linalg.norm(direction, axis=-1, keepdims=True)
    # A direction of length zero gives NaN, without NumPy's warning of a division by zero.
    x, y, z = xp.moveaxis(direction / xp.where(length > 0.0, length, np.nan), -1, 0)
    # The smallest rotation from +-z to (x, y, z) has the quaternion (1 + |z|, -+y, +-x, 0) before
    # normalisation. With the nearer axis the angle is at most 90 degrees and the real part not
    # below 1, so that the norm cannot vanish.
    looks_up = z > 0.0
    sign = xp.where(looks_up, 1.0, -1.0)
    w = 1.0 + xp.abs(z)
    norm = xp.sqrt(w * w + x * x + y * y)
    # With the inverse (a, b, c, 0) of this rotation and the roll's half angle, R is
    # (cos, 0, 0, -sin) (a, b, c, 0) for +z, and (cos, 0, 0, -sin) (0, 1, 0, 0) (a, b, c, 0) for -z.
    a, b, c = w / norm, sign * y / norm, -sign * x / norm
    zero = xp.zeros_like(a)
    turned = (
        xp.where(looks_up, a, -b),
        xp.where(looks_up, b, a),
        xp.where(looks_up, c, zero),
        xp.where(looks_up, zero, c),
    )
    cosine, sine = xp.cos(0.5 * rolls), -xp.sin(0.5 * rolls)
    w, x, y, z = (
        cosine * turned[0] - sine * turned[3],
        cosine * turned[1] - sine * turned[2],
        cosine * turned[2] + sine * turned[1],
        cosine * turned[3] + sine * turned[0],
    )
    vector = xp.stack([x, y, z], axis=-1)
    # R p = p + 2 v x (w p + v x p) for the quaternion (w, v).
    rotated = point + 2.0 * xp.cross(vector, w[..., None] * point + xp.cross(vector, point))
    offset = xp.stack([zero, zero, distances], axis=-1)
    return xp.concatenate([w[..., None], vector, offset - rotated], axis=-1)


def viewing_direction(
    tilt: float | Float[Array, "*#views"] | np.ndarray,
    azimuth: float | Float[Array, "*#views"] | np.ndarray,
    above: bool = True,
) -> Float[Array, "*views 3"]:
    """Return the unit viewing direction of a camera given by tilt and azimuth from its object.

    Args:
        tilt: angle between the direction from object to camera and the world's z axis, rad.
        azimuth: angle of the direction from object to camera about the world's z axis, measured
            from x, rad.
        above: whether the camera is on the +z side; False for a board with z into it, as in
            OpenCV, where the tilt is measured from -z.
    """
    # NumPy needs no compilation.
    xp = jnp if is_traced(tilt, azimuth) else np
    tilts, azimuths = xp.broadcast_arrays(xp.asarray(tilt, float), xp.asarray(azimuth, float))
    horizontal, height = xp.sin(tilts), xp.cos(tilts)
    to_camera = [
        horizontal * xp.cos(azimuths),
        horizontal * xp.sin(azimuths),
        height if above else -height,
    ]
    return as_float_array(-xp.stack(to_camera, axis=-1))


def spiral_directions(
    heights: Float[np.ndarray, "directions"], start: float = 0.0
) -> Float[np.ndarray, "directions 3"]:
    """Return unit vectors on a spiral about z, which spreads equally spaced heights evenly.

    Args:
        heights: of the vectors along z, from -1 to 1.
        start: angle of the first one about z, rad.
    """
    # Each is further by the golden angle.
    angle = start + np.pi * (3.0 - np.sqrt(5.0)) * np.arange(len(heights))
    around = np.sqrt(1.0 - heights**2)
    return np.column_stack([around * np.cos(angle), around * np.sin(angle), heights])


def five_viewpoints(
    point: Float[Array, "*#views 3"] | np.ndarray,
    distance: float | Float[Array, "5"] | np.ndarray,
    roll: float | Float[Array, "5"] | np.ndarray = 0.0,
    step: float = FIVE_VIEWPOINT_STEP,
    above: bool = True,
    pattern: str = "cross",
) -> SE3:
    """Return the paper's five viewpoints (Fig. 6): one from above, two along X and two along Y.

    If all views have the same roll, the hand-eye transform is poorly determined; a different roll
    for each view is recommended.

    Args:
        point: the point that all cameras look at, or one for each camera, m.
        distance: distance of the cameras from the point, m.
        roll: rotation about the optical axis, for all cameras or for each, rad.
        step: angle between neighbours as seen from the point, rad.
        above: as in `viewing_direction`.
        pattern: `"cross"`, one step to either side along X and along Y; or `"L"`, one and two steps
            to the same side.

    Returns:
        `camera_from_world`, `(5)`.

    Raises:
        ValueError: an unknown pattern.

    For example:

        >>> views = sv.five_viewpoints(np.zeros(3), distance=0.2)
        >>> centres = np.linalg.inv(sv.geometry.host_matrices(views))[:, :3, 3]
        >>> print(np.rint(1e3 * centres).astype(int))
        [[  0   0 200]
         [ 33   0 197]
         [-33   0 197]
         [  0  33 197]
         [  0 -33 197]]
    """
    require_one_of("pattern", pattern, FIVE_VIEWPOINT_PATTERNS)
    x, y = np.array(FIVE_VIEWPOINT_PATTERNS[pattern]).T
    tilt, azimuth = step * np.hypot(x, y), np.arctan2(y, x)
    return look_at(point, viewing_direction(tilt, azimuth, above), distance, roll)
