"""Define goals of view planning: one number per set of views, to be minimised.

The covariance that views allow is the inverse of their information matrix. A goal is either its
volume (D-optimal: all parameters, without a unit), or the mean square of a quantity that depends on
the parameters (A-optimal if the quantity is a parameter): the trace of the covariance times a
matrix.

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
    """An optimality criterion, which maps an information matrix to one number.

    Attributes:
        moved: matrix M of the mean square `step @ M @ step` of the quantity of interest; None for
            the volume.
        unit: unit of the number.
    """

    moved: Float[Array, "free free"] | None
    unit: str = eqx.field(static=True)

    def __call__(self, information: Float[Array, "free free"]) -> Float[Array, ""]:
        """Return a standard deviation, or the geometric mean of all standard deviations.

        The result is NaN where the information matrix is singular.
        """
        # With F = D C D, D = sqrt(diag F), C = L L^T and P = F^-1:
        #     D-optimal: det(P)^(1/(2n)) = exp(-(sum log L_ii + sum log D_ii) / n)
        #     A-optimal: sqrt(trace(M P)) = sqrt(sum of (A M) * A), with A = L^-1 D^-1
        # Scaling to unit diagonal keeps the digits of the Cholesky factor, since pixels and radians
        # differ by many orders of magnitude.
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
    """Return the D-optimal goal: the geometric mean of independent standard deviations."""
    return Goal(None, "")


def hand_eye(survey: Survey, lever: float) -> Goal:
    """Return the A-optimal goal of the hand-eye transform: the displacement of a point, m.

    It is the root mean square displacement that the uncertainty of the transform causes.

    Args:
        survey: survey whose parameters the goal refers to.
        lever: distance of a point from the mount's origin at which the displacement is meant, m; it
            weights rotations against translations.

    Raises:
        ValueError: all parameters of the transform are fixed.
    """
    name = survey.calibration.transform_names[0]
    shifts = np.array([one.startswith(f"{name}.translation") for one in survey.names])
    turns = np.array([one.startswith(f"{name}.rotation") for one in survey.names])
    if not (shifts | turns).any():
        raise ValueError(f"{name} is held: there is nothing of it to be known")
    # A rotation about an axis does not move points on it: on average over directions two of three
    # axes displace the point, hence 2/3 lever^2.
    return Goal(jnp.diag(jnp.asarray(shifts + 2.0 / 3.0 * lever**2 * turns)), "m")


def held_out(survey: Survey, camera_from_world: SE3) -> Goal:
    """Return the goal of the expected registration error in other views `(views)`, px.

    The robot is assumed to be where it reports to be.
    """
    return Goal(survey.moved_pixels(camera_from_world), "px")
