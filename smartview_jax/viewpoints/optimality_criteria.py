"""Define optimality criteria of view planning: one number per set of views, to be minimised.

The covariance after some views is the inverse of their information matrix. A criterion is either
its volume (D-optimal: all parameters, without a unit), or the mean square of a quantity that
depends on the parameters: the trace of the covariance times a matrix (A-optimal if the quantity is
a parameter, I-optimal if it is a prediction).

Reference: Pukelsheim, Optimal design of experiments, 1993.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxlie import SE3
from jaxtyping import Array, Float

from ..engine import RANK_TOLERANCE
from ..runtime.array_namespace import to_device
from ..runtime.compilation import one_program
from .information_model import InformationModel


class OptimalityCriterion(eqx.Module):
    """An optimality criterion, which maps an information matrix to one number.

    Attributes:
        weight_matrix: matrix M of the mean square `step @ M @ step` of the quantity of interest,
            for a deviation `step` of the free parameters; None for the volume.
        unit: unit of the number.
    """

    weight_matrix: Float[Array, "free free"] | None
    unit: str = eqx.field(static=True)

    @one_program
    def __call__(self, information: Float[Array, "free free"]) -> Float[Array, ""]:
        """Return a standard deviation, or the geometric mean of all standard deviations.

        The result is NaN where the information matrix is singular.
        """
        # With F = D C D, D = sqrt(diag F), C = L L^T and P = F^-1:
        #     D-optimal: det(P)^(1/(2n)) = exp(-(sum log L_ii + sum log D_ii) / n)
        #     A-optimal: sqrt(trace(M P)) = sqrt(sum of (A M) * A), with A = L^-1 D^-1
        # where D holds the `scales`, L is the `factor` and A the `inverse_factor`.
        # Scaling to unit diagonal keeps the precision of the Cholesky factor, since pixels and
        # radians differ by many orders of magnitude.
        scales = jnp.sqrt(jnp.diagonal(information))
        scaled = information / (scales[:, None] * scales[None])
        factor = jnp.linalg.cholesky(scaled)
        is_regular = jnp.min(jnp.diagonal(factor)) > RANK_TOLERANCE
        factor = jnp.where(is_regular, factor, jnp.nan)
        if self.weight_matrix is None:
            half_log_determinant = jnp.sum(jnp.log(jnp.diagonal(factor)) + jnp.log(scales))
            return jnp.exp(-half_log_determinant / len(scales))
        inverse_factor = solve_triangular(factor, jnp.diag(1.0 / scales), lower=True)
        return jnp.sqrt(jnp.sum((inverse_factor @ self.weight_matrix) * inverse_factor))


def d_optimal() -> OptimalityCriterion:
    """Return the D-optimal criterion: the geometric mean of independent standard deviations."""
    return OptimalityCriterion(None, "")


def a_optimal(information_model: InformationModel, lever_arm: float) -> OptimalityCriterion:
    """Return the A-optimal criterion of the hand-eye transform: the displacement of a point, m.

    It is the root mean square displacement that the uncertainty of the transform causes.

    Args:
        information_model: the model whose parameters the criterion refers to.
        lever_arm: distance from the mount's origin of the point whose displacement is minimised, m;
            it weights rotations against translations.

    Raises:
        ValueError: all parameters of the transform are fixed.
    """
    name = information_model.calibration.transform_names[0]
    is_translation, is_rotation = (
        np.array([p.startswith(f"{name}.{part}") for p in information_model.parameter_names])
        for part in ("translation", "rotation")
    )
    if not (is_translation | is_rotation).any():
        raise ValueError(f"{name} is held fixed: it has no uncertainty to minimise")
    # A rotation about an axis does not displace points on the axis: on average over directions, two
    # of three axes displace the point, hence 2/3 lever_arm^2.
    return OptimalityCriterion(
        to_device(np.diag(is_translation + 2.0 / 3.0 * lever_arm**2 * is_rotation)), "m"
    )


def i_optimal(information_model: InformationModel, camera_from_world: SE3) -> OptimalityCriterion:
    """Return the I-optimal criterion: the expected registration error in other views `(views)`, px.

    The robot is assumed to be where it reports to be.
    """
    return OptimalityCriterion(information_model.pixel_moment_matrix(camera_from_world), "px")
