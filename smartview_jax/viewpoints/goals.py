"""What chosen views are to be good for, as one number: the smaller, the better.

The covariance that views allow is the inverse of their information. A goal is either its volume
(D-optimal: everything, in no unit), or the mean square of something that the parameters move
(A-optimal where that is a parameter): the trace of the covariance times a matrix.

Reference: Pukelsheim, Optimal design of experiments, 1993.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxlie import SE3
from jaxtyping import Array, Float

from ..engine import NULL
from .survey import Survey


class Goal(eqx.Module):
    """One number for what views tell.

    Attributes:
        moved: mean square of what is to be known, by the parameters; None is the volume.
        unit: of the number.
    """

    moved: Float[Array, "free free"] | None
    unit: str = eqx.field(static=True)

    def __call__(self, information: Float[Array, "free free"]) -> Float[Array, ""]:
        """The number: a standard deviation, or the geometric mean of all; NaN where it is open."""
        # Of unit diagonal: pixels beside radians would cost the factor its digits.
        lengths = jnp.sqrt(jnp.diagonal(information))
        scaled = information / (lengths[:, None] * lengths[None])
        factor = jnp.linalg.cholesky(scaled)
        seen = jnp.min(jnp.diagonal(factor)) > NULL
        factor = jnp.where(seen, factor, jnp.nan)
        if self.moved is None:
            volume = jnp.sum(jnp.log(jnp.diagonal(factor)) + jnp.log(lengths))
            return jnp.exp(-volume / len(lengths))
        root = solve_triangular(factor, jnp.diag(1.0 / lengths), lower=True)
        return jnp.sqrt(jnp.sum((root @ self.moved) * root))


def everything() -> Goal:
    """D-optimal: the geometric mean of the standard deviations of independent directions."""
    return Goal(None, "")


def hand_eye(survey: Survey, lever: float) -> Goal:
    """A-optimal for the camera on its mount: how far it displaces a point, m.

    Args:
        survey: whose parameters they are.
        lever: distance of that point from the mount's origin, m; it weighs turns by shifts.
    """
    name = survey.calibration.transform_names[0]
    shifts = np.array([one.startswith(f"{name}.translation") for one in survey.names])
    turns = np.array([one.startswith(f"{name}.rotation") for one in survey.names])
    if not (shifts | turns).any():
        raise ValueError(f"{name} is held: there is nothing of it to be known")
    # A turn about an axis does not move what lies on it: two of three count.
    return Goal(jnp.diag(jnp.asarray(shifts + 2.0 / 3.0 * lever**2 * turns)), "m")


def held_out(survey: Survey, camera_from_world: SE3) -> Goal:
    """Expected registration error in other views `(views)`, px, the robot being where it says."""
    return Goal(survey.moved_pixels(camera_from_world), "px")
