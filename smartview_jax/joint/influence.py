"""Measure the effect of single views on a joint fit: parameter changes, and outlying poses.

Both are in closed form, from the normal equations at the optimum. There the gradients of all views
and priors sum to zero, so without view i a Gauss-Newton step is

    (R - R_i)^-1 g_i

with R the reduced normal matrix (the Schur complement after the pose corrections are eliminated),
and R_i and g_i the view's contributions to it and to the gradient. For the poses: under the model
the estimate of a correction `c_i` with the prior `N(0, S)` has covariance `S - V_i`, with V_i its
posterior covariance. The Mahalanobis distance

    sqrt(c_i^T (S - V_i)^-1 c_i)

equals the distance of the view's free pose from the pose that all other views predict.

Reference: Cook, Detection of influential observation in linear regression, 1977.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import chdtrc

from ..engine import (
    AbstractProblem,
    BlockArrow,
    JointProblem,
    Step,
    eliminate,
    parameter_mask,
    reduced_equations,
    refuse_aspects,
)
from ..runtime.compilation import compiled

MIN_EXPLAINED_VARIANCE_FRACTION = 1e-6
"""The smallest fraction of a correction's prior variance that a view must explain to be tested."""


class Influence(NamedTuple):
    """The change of a fit's common parameters when one view is left out.

    Attributes:
        deletion_changes: the fit without the view minus the fit with it, in each parameter's unit.
        std: standard deviations of the parameters in the fit with all views.
        parameter_names: names of the columns.
        view_ids: names of the rows.
        mount_path: path of the hand-eye transform.
    """

    deletion_changes: Float[np.ndarray, "views free"]
    std: Float[np.ndarray, "free"]
    parameter_names: tuple[str, ...]
    view_ids: tuple[str, ...]
    mount_path: str

    def max_standardised_change(self, path: str | None = None) -> Float[np.ndarray, "views"]:
        """Return each view's largest effect on a path's parameters, in their standard deviations.

        Args:
            path: by default the camera's mount: `camera_from_tool` for eye-in-hand,
                `camera_from_base` for eye-to-hand.

        Raises:
            ValueError: the path names no free parameter.
        """
        paths = (path or self.mount_path,)
        refuse_aspects(paths)
        selected = parameter_mask(self.parameter_names, paths)
        return np.abs(self.deletion_changes[:, selected] / self.std[selected]).max(axis=1)


@compiled
def deletion_changes(problem: JointProblem, z: Step) -> Float[Array, "views free"]:
    """Return the changes of the free common parameters if a view is left out, to first order.

    Args:
        problem: the problem, in the parameters' own units.
        z: its optimum.
    """
    information = eliminate(problem.normal_equations(z).matrix).schur_complement
    # R_i = A_i - B_i^T C_i^-1 B_i. The view's own gradient, data and prior together, is zero at the
    # optimum, so eliminating the correction does not change g_i.
    view_information = problem.without_corrections(problem.blocks_by_view(z))
    gradient = problem.gradients_by_view(z)
    # Solve (R - R_i) x = g_i, scaled so that R has a unit diagonal, all views batched.
    column_norms = jnp.sqrt(jnp.diagonal(information))
    inverse_norms = 1.0 / jnp.where(column_norms > 0.0, column_norms, 1.0)
    information_without_view = (
        (information[None] - view_information)
        * inverse_norms[None, :, None]
        * inverse_norms[None, None]
    )
    scaled_change = jnp.linalg.solve(
        information_without_view, (gradient * inverse_norms[None])[..., None]
    )[..., 0]
    return scaled_change * inverse_norms[None]


class PoseOutlierTest(NamedTuple):
    """The distance of each view's free pose from the pose that the other views predict.

    Attributes:
        distance: Mahalanobis distance. If the variance components were estimated from these views,
        it uses the components estimated without the view, which inflated them.
        p_value: probability of a distance at least as large, under the estimated components.
    """

    distance: Float[np.ndarray, "views"]
    p_value: Float[np.ndarray, "views"]


def pose_outlier_test(
    problem: AbstractProblem, z: Step, matrix: BlockArrow, sigmas_known: bool
) -> PoseOutlierTest:
    """Test every view's reported pose against the other views.

    Views without six free corrections with priors have distance 0 and p-value 1.

    Args:
        problem: the problem with priors on the corrections, in the parameters' own units.
        z: its optimum.
        matrix: matrix of the normal equations there.
        sigmas_known: whether the priors' standard deviations are given, not estimated from these
            views.
    """
    reduced = reduced_equations(matrix)
    column_norms = np.sqrt(np.diagonal(reduced.schur_complement))
    inverse_norms = 1.0 / np.where(column_norms > 0.0, column_norms, 1.0)
    shared_covariance = np.outer(inverse_norms, inverse_norms) * np.linalg.inv(
        reduced.schur_complement * np.outer(inverse_norms, inverse_norms)
    )
    # V_i = C_i^-1 + G_i P G_i^T, with G_i = C_i^-1 B_i and P = R^-1 the shared covariance.
    covariance = reduced.per_view_covariance(shared_covariance)

    weight, per_view_free = map(np.asarray, (problem.prior_weight.per_view, problem.per_view_free))
    # Whitened by W = S^-1/2, the `weight`:     whitened_correction = W (c - mean),
    # explained_covariance = I - W V W,     squared_distance = whitened_correction^T
    # explained_covariance^-1 whitened_correction in the eigenvectors of explained_covariance.
    # Directions about which the view has no information have an eigenvalue of zero and are left
    # out.
    correction = np.where(per_view_free, np.asarray(z.per_view), 0.0)
    whitened_correction = weight * (correction - np.nan_to_num(problem.prior_mean.per_view))
    explained_covariance = np.eye(6) - weight[..., None] * covariance * weight[:, None]
    explained_fractions, eigenvectors = np.linalg.eigh(explained_covariance)
    components = np.einsum("vki,vk->vi", eigenvectors, whitened_correction)
    testable = np.all(per_view_free & (weight > 0.0), axis=1)
    informative = (explained_fractions > MIN_EXPLAINED_VARIANCE_FRACTION) & testable[:, None]
    squared_distance = np.sum(
        np.where(informative, components**2 / np.where(informative, explained_fractions, 1.0), 0.0),
        axis=1,
    )
    degrees_of_freedom = informative.sum(axis=1)
    positive_degrees_of_freedom = np.maximum(degrees_of_freedom, 1)
    p_value = np.where(
        degrees_of_freedom > 0, chdtrc(positive_degrees_of_freedom, squared_distance), 1.0
    )
    if not sigmas_known:
        # Externally studentised, as in regression: with nu degrees of freedom over all views and k
        # of this view, the variance without it is (nu - d^2) / (nu - k), so
        #     d^2 <- d^2 (nu - k) / (nu - d^2).
        total_degrees_of_freedom = np.sum(np.where(informative, explained_fractions, 0.0))
        remaining = np.maximum(
            total_degrees_of_freedom - squared_distance, 1e-3 * total_degrees_of_freedom
        )
        squared_distance = (
            squared_distance
            * np.maximum(total_degrees_of_freedom - positive_degrees_of_freedom, 1.0)
            / np.where(remaining > 0.0, remaining, 1.0)
        )
    return PoseOutlierTest(np.sqrt(squared_distance), p_value)
