"""Define optimality criteria of view planning: one number per set of views, to be minimised.

The covariance after some views is the inverse of their information matrix. A criterion is either
its volume (D-optimal: all parameters, without a unit), or the mean square of a quantity that
depends on the parameters: the trace of the covariance times a matrix (A-optimal if the quantity is
a parameter, I-optimal if it is a prediction).

Reference: Pukelsheim, Optimal design of experiments, 1993.
"""

from typing import overload

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxlie import SE3
from jaxtyping import Array, Float

from ..dataset import Rig
from ..engine import RANK_TOLERANCE, covariance_factor
from ..robots import CommandLike
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import one_program
from .information_model import InformationModel
from .rig_information import RigInformationModel


class OptimalityCriterion(eqx.Module):
    """An optimality criterion, which maps an information matrix to one number.

    Attributes:
        weight_root: root W of the matrix M = W W^T of the mean square `step @ M @ step` of the
            quantity of interest, for a deviation `step` of the free parameters; None for the
            volume.
        unit: unit of the number.
    """

    weight_root: Float[Array, "free rank"] | None
    unit: str = eqx.field(static=True)

    @classmethod
    def of_matrix(
        cls, weight_matrix: Float[AnyArray, "free free"], unit: str
    ) -> "OptimalityCriterion":
        """Return the criterion of a positive semidefinite matrix M, whose root is computed."""
        return cls(to_device(covariance_factor(np.asarray(weight_matrix))), unit)

    @property
    def weight_matrix(self) -> Float[np.ndarray, "free free"] | None:
        """The matrix M; None for the volume."""
        root = None if self.weight_root is None else np.asarray(self.weight_root)
        return None if root is None else root @ root.T

    @one_program
    def __call__(self, information: Float[Array, "free free"]) -> Float[Array, ""]:
        """Return a standard deviation, or the geometric mean of all standard deviations.

        The result is NaN where the information matrix is singular.
        """
        # With F = D C D, D = sqrt(diag F), C = L L^T and P = F^-1:
        #     D-optimal: det(P)^(1/(2n)) = exp(-(sum log L_ii + sum log D_ii) / n)
        #     A-optimal: sqrt(trace(M P)) = sqrt(trace(W^T P W)) = norm(L^-1 D^-1 W)
        # where D holds the `scales`, L is the `factor` and W the `weight_root`: the six columns of
        # a hand-eye transform cost a twentieth of the inverse.
        # Scaling to unit diagonal keeps the precision of the Cholesky factor, since pixels and
        # radians differ by many orders of magnitude.
        scales = jnp.sqrt(jnp.diagonal(information))
        scaled = information / (scales[:, None] * scales[None])
        factor = jnp.linalg.cholesky(scaled)
        is_regular = jnp.min(jnp.diagonal(factor)) > RANK_TOLERANCE
        factor = jnp.where(is_regular, factor, jnp.nan)
        if self.weight_root is None:
            half_log_determinant = jnp.sum(jnp.log(jnp.diagonal(factor)) + jnp.log(scales))
            return jnp.exp(-half_log_determinant / len(scales))
        scaled_root = self.weight_root / scales[:, None]
        return jnp.linalg.norm(solve_triangular(factor, scaled_root, lower=True))


def d_optimal() -> OptimalityCriterion:
    """Return the D-optimal criterion: the geometric mean of independent standard deviations."""
    return OptimalityCriterion(None, "")


def a_optimal(
    information_model: InformationModel | RigInformationModel,
    lever_arm: float,
    camera: str | None = None,
) -> OptimalityCriterion:
    """Return the A-optimal criterion of the hand-eye transform: the displacement of a point, m.

    It is the root mean square displacement that the uncertainty of the transform causes; of a rig,
    over all cameras whose transforms are fitted.

    Args:
        information_model: the model whose parameters the criterion refers to.
        lever_arm: distance from the mount's origin of the point whose displacement is minimised, m;
            it weights rotations against translations.
        camera: name of the only camera of a rig that counts; None for all of them.

    Raises:
        ValueError: all parameters of the transforms are fixed, or there is no such camera.
    """
    paths = _mounts(information_model, camera)
    names = information_model.parameter_names
    is_translation, is_rotation = (
        np.array([name.startswith(tuple(f"{path}.{part}" for path in paths)) for name in names])
        for part in ("translation", "rotation")
    )
    fitted = sum(any(name.startswith(f"{path}.") for name in names) for path in paths)
    if not fitted:
        raise ValueError(f"{', '.join(paths)} is held fixed: it has no uncertainty to minimise")
    # A rotation about an axis does not displace points on the axis: on average over directions, two
    # of three axes displace the point, hence 2/3 lever_arm^2.
    weights = is_translation + 2.0 / 3.0 * lever_arm**2 * is_rotation
    root = np.diag(np.sqrt(weights / fitted))
    return OptimalityCriterion(to_device(root[:, weights > 0.0]), "m")


def _mounts(
    information_model: InformationModel | RigInformationModel, camera: str | None
) -> tuple[str, ...]:
    """Return the paths of the hand-eye transforms that count."""
    if isinstance(information_model, InformationModel):
        if camera is not None:
            raise ValueError(f"camera: only a rig has cameras with names; found {camera!r}")
        return (information_model.calibration.transform_names[0],)
    mounts = information_model.mounts
    if camera is not None and camera not in mounts:
        raise ValueError(f"expected a camera of {', '.join(mounts)}, found {camera!r}")
    return tuple(mounts.values()) if camera is None else (mounts[camera],)


@overload
def i_optimal(information_model: InformationModel, views: SE3) -> OptimalityCriterion: ...


@overload
def i_optimal(
    information_model: RigInformationModel, views: Rig | CommandLike
) -> OptimalityCriterion: ...


def i_optimal(
    information_model: InformationModel | RigInformationModel, views: SE3 | Rig | CommandLike
) -> OptimalityCriterion:
    """Return the I-optimal criterion: the expected registration error in other views, px.

    The robot is assumed to be where it reports to be.

    Args:
        information_model: the model whose parameters the criterion refers to.
        views: camera poses `camera_from_world` `(views)`. Of a rig, states of the robot as for
            `choose_views`; the error is over all points that all cameras see.
    """
    if isinstance(information_model, RigInformationModel):
        rig = views if isinstance(views, Rig) else information_model.planned(views)
        return OptimalityCriterion.of_matrix(information_model.pixel_moment_matrix(rig), "px")
    if not isinstance(views, SE3):
        raise TypeError("i_optimal: the views of one camera are poses camera_from_world")
    return OptimalityCriterion.of_matrix(information_model.pixel_moment_matrix(views), "px")
