"""Measure what single views do to a joint fit: how far each moves it, and how credible its pose is.

Both are in closed form, from the normal equations at the optimum. There the gradients of all views
and priors sum to zero, so without view i a Gauss-Newton step is

    (R - R_i)^-1 g_i

with R the reduced normal matrix (Schur complement of the pose corrections), and R_i and g_i the
view's part of it and of the gradient. For the poses: under the model the estimate of a correction
`c_i` with the prior `N(0, S)` has covariance `S - V_i`, with V_i its posterior covariance. The
Mahalanobis distance

    sqrt(c_i^T (S - V_i)^-1 c_i)

equals the distance of the view's free pose from the pose that all other views predict.

Reference: Cook, Detection of influential observation in linear regression, 1977.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Array, Float

from ..compilation import compiled
from ..engine import BlockArrow, JointProblem, Step, eliminate, select

TELLING = 1e-6
"""The smallest fraction of a correction's prior variance that a view must explain to be tested."""


class Influence(NamedTuple):
    """The change of a fit's common parameters when one view is left out.

    Attributes:
        moves: the fit without the view minus the fit with it, own units.
        std: standard deviations of the parameters in the fit with all views.
        parameter_names: names of the columns.
        view_ids: names of the rows.
        mount: path of the transform that describes where the camera is mounted.
    """

    moves: Float[np.ndarray, "views free"]
    std: Float[np.ndarray, "free"]
    parameter_names: tuple[str, ...]
    view_ids: tuple[str, ...]
    mount: str

    def on(self, path: str | None = None) -> Float[np.ndarray, "views"]:
        """Return each view's largest effect on a path's parameters, in their standard deviations.

        Args:
            path: by default the camera's mount: `camera_from_tool` for eye-in-hand,
                `camera_from_base` for eye-to-hand.

        Raises:
            ValueError: the path names no free parameter.
        """
        chosen = select(self.parameter_names, (path or self.mount,))
        return np.abs(self.moves[:, chosen] / self.std[chosen]).max(axis=1)


@compiled
def moves_without(problem: JointProblem, z: Step) -> Float[Array, "views free"]:
    """Return how far the free common parameters move if a view is left out, to first order.

    Args:
        problem: the problem, in the parameters' own units.
        z: its optimum.
    """
    matrix = problem.normal_equations(z).matrix
    parts, (gradient, own_part) = eliminate(matrix), problem.observed_by_view(z)
    if len(matrix.own):
        # R_i = A_i - B_i^T C_i^-1 B_i. The view's own gradient, data and prior together, is zero at
        # the optimum, so eliminating the correction does not change g_i.
        own_part = own_part - jnp.einsum("vki,vkj->vij", matrix.border, parts.gain)
    # Solve (R - R_i) x = g_i with unit columns, all views batched.
    lengths = jnp.sqrt(jnp.diagonal(parts.reduced))
    unit = 1.0 / jnp.where(lengths > 0.0, lengths, 1.0)
    rest = (parts.reduced[None] - own_part) * unit[None, :, None] * unit[None, None]
    scaled = jnp.linalg.solve(rest, (gradient * unit[None])[..., None])[..., 0]
    return scaled * unit[None]


class PoseScores(NamedTuple):
    """The distance of each view's free pose from the pose that the other views predict.

    Attributes:
        distance: Mahalanobis distance, in standard deviations; where the variance components were
            estimated from these same views, in those estimated without the view, which made them
            larger.
        p_value: probability of a distance at least as large, under the components as estimated.
    """

    distance: Float[Array, "views"]
    p_value: Float[Array, "views"]


@compiled
def pose_scores(
    problem: JointProblem, z: Step, matrix: BlockArrow, sizes_known: bool
) -> PoseScores:
    """Test every view's reported pose against the other views.

    Views without six free corrections with priors have distance 0 and p-value 1.

    Args:
        problem: the problem with priors on the corrections, in the parameters' own units.
        z: its optimum.
        matrix: of the normal equations there.
        sizes_known: whether the priors' standard deviations are given, not estimated from these
            views.
    """
    parts = eliminate(matrix)
    eye = jnp.eye(len(parts.reduced))
    lengths = jnp.sqrt(jnp.diagonal(parts.reduced))
    unit = jnp.diag(1.0 / jnp.where(lengths > 0.0, lengths, 1.0))
    shared = unit @ jnp.linalg.solve(unit @ parts.reduced @ unit, eye) @ unit
    # V_i = C_i^-1 + G_i P G_i^T, with G_i = C_i^-1 B_i and P = R^-1 the common covariance.
    covariance = parts.own_covariance(shared)

    weight = problem.prior_weight.corrections
    # Whitened by W = S^-1/2:
    #     pull = W (c - mean),  explained = I - W V W,  d^2 = pull^T explained^-1 pull
    # Directions about which the view says nothing have an eigenvalue of zero and are left out.
    pull = weight * problem.off_mean(problem.step(z)).corrections
    explained = jnp.eye(6)[None] - weight[..., None] * covariance * weight[:, None]
    share, axes = jnp.linalg.eigh(explained)
    along = jnp.einsum("vki,vk->vi", axes, pull)
    scored = jnp.all(problem.own_free & (weight > 0.0), axis=1)
    telling = (share > TELLING) & scored[:, None]
    square = jnp.sum(jnp.where(telling, along**2 / jnp.where(telling, share, 1.0), 0.0), axis=1)
    degrees = jnp.sum(telling.astype(float), axis=1)
    counted = jnp.maximum(degrees, 1.0)
    # Chi-square tail of k degrees of freedom, P(X > d^2) = Q(k / 2, d^2 / 2).
    p_value = jnp.where(degrees > 0.0, gammaincc(0.5 * counted, 0.5 * square), 1.0)
    if not sizes_known:
        # Externally studentised, as in regression: with nu degrees of freedom over all views, the
        # variance without this view is (nu - d^2) / (nu - k), so d^2 <- d^2 (nu - k) / (nu - d^2).
        whole = jnp.sum(jnp.where(telling, share, 0.0))
        rest = jnp.maximum(whole - square, 1e-3 * whole)
        square = square * jnp.maximum(whole - counted, 1.0) / jnp.where(rest > 0.0, rest, 1.0)
    return PoseScores(jnp.sqrt(square), p_value)
