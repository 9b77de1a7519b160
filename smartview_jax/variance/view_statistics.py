"""Reduce the observations to statistics per view, and linearise them at any parameters.

The statistics are the best free pose of each view, and the camera of the fit with free poses; see
`likelihood.py`. They change with the linearisation only, not with the standard deviations.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..compilation import compiled
from ..engine import (
    ROBOT_ERROR,
    SIGMA_FLOOR,
    BuiltProblem,
    JointProblem,
    NormalEquations,
    Step,
)
from .likelihood import ROBOT_SIGMA_FLOOR, LinearisedViews, StandardDeviations
from .model_selection import TARGET_SCALE


class ViewStatistics:
    """The statistics of the views from the fit with free poses, for any linearisation.

    Attributes:
        problem: the joint problem.
        group_index: group of unknown standard deviation of each free shared parameter, -1 for none.
        within_sum_of_squares: sum of squared residuals of the fit with free poses and a free
            camera, px^2.
        group_names: names of the groups.
        statistic_count: number of statistics: free parameters of the camera and of the views'
            poses.
        white_sigma: standard deviation of the noise within views, px.
        known_weight: one over the standard deviation of the priors with known standard deviations.
    """

    def __init__(
        self,
        built: BuiltProblem,
        usable_views: Int[np.ndarray, "placed"],
        within_sum_of_squares: float,
        scale_is_group=False,
    ):
        problem, group_index = built.problem, _group_index(built, scale_is_group)
        camera_count = sum(k < problem.parameters.layout.camera.stop for k in problem.free)
        self.problem, self.group_index = problem, jnp.asarray(group_index)
        self.within_sum_of_squares = within_sum_of_squares
        error = problem.parameters.start.robot_error
        field_groups = () if error is None else tuple(name for name, _ in error.field.groups)
        self.group_names = (*field_groups, TARGET_SCALE) if scale_is_group else field_groups
        self.statistic_count = camera_count + int(
            np.asarray(problem.per_view_free)[usable_views].sum()
        )
        visible_count = int(np.asarray(problem.observations.visible).sum())
        # White sigma: sum of squared residuals over degrees of freedom, 2 n - (camera and free
        # poses).
        white = np.sqrt(within_sum_of_squares / max(2 * visible_count - self.statistic_count, 1))
        self.white_sigma = max(float(white), SIGMA_FLOOR)
        free_weight = np.asarray(problem.prior_weight.shared)[list(problem.free)]
        self.known_weight = jnp.asarray(np.where(group_index < 0, free_weight, 0.0))

    def linearise(self, z: Step) -> LinearisedViews:
        """Linearise the problem at a step."""
        equations, offset = _equations_and_offset(self.problem, z)
        return LinearisedViews(
            matrix=equations.matrix,
            gradient=equations.gradient,
            residual_sum_of_squares=2.0 * equations.cost - self.within_sum_of_squares,
            offset_from_prior=offset,
            known_weight=self.known_weight,
            group_index=self.group_index,
            per_view_free=self.problem.per_view_free,
            statistic_count=jnp.asarray(float(self.statistic_count)),
            white_sigma=jnp.asarray(self.white_sigma),
        )

    def select_groups(
        self, sigmas: StandardDeviations, names: tuple[str, ...]
    ) -> StandardDeviations:
        """Return the standard deviations with the groups selected and ordered by name."""
        indices = [3 + self.group_names.index(name) for name in names]
        return StandardDeviations.from_vector(sigmas.vector[jnp.array([0, 1, 2, *indices])])


def with_free_poses(problem: JointProblem) -> JointProblem:
    """Return the problem with a free pose for every view, by changing only the priors.

    Only arrays differ, so that the same compiled program is used.
    """
    # The shared parameters except the camera's get priors so narrow that they are held, and the
    # corrections of the views get none.
    weight, free = problem.prior_weight, np.array(problem.free, dtype=int)
    fixed_indices = free[free >= problem.parameters.layout.camera.stop]
    return eqx.tree_at(
        lambda p: p.prior_weight,
        problem,
        Step(
            weight.shared.at[fixed_indices].set(1.0 / ROBOT_SIGMA_FLOOR),
            jnp.zeros_like(weight.per_view),
        ),
    )


@compiled
def with_prior_sigmas(
    problem: JointProblem, sigmas: StandardDeviations, group_index: Array
) -> JointProblem:
    """Return the problem with priors of the given standard deviations."""
    free_indices, shared = problem.free_indices, problem.prior_weight.shared
    weights = sigmas.prior_weights(group_index, shared[free_indices])
    per_view = jnp.broadcast_to(weights.per_view, problem.per_view_free.shape)
    weight = Step(shared.at[free_indices].set(weights.shared), per_view)
    return eqx.tree_at(lambda p: (p.pixel_sigma, p.prior_weight), problem, (sigmas.pixel, weight))


@compiled
def _equations_and_offset(problem: JointProblem, z: Step) -> tuple[NormalEquations, Step]:
    """Return the normal equations of the observations, and the differences from the prior means."""
    offset = problem.offset_from_prior(problem.unscaled_step(z))
    return problem.normal_equations_without_priors(z), Step(
        offset.shared[problem.free_indices], offset.per_view
    )


def _group_index(built: BuiltProblem, scale_is_group: bool) -> Int[np.ndarray, "free"]:
    """Return the group of unknown standard deviation of each free shared parameter; -1 for none.

    Args:
        built: problem with the names of its parameters.
        scale_is_group: whether the target's scale is a group of its own, the last one.
    """
    error = built.problem.parameters.start.robot_error
    groups = () if error is None else error.field.groups
    prefixes = [f"{ROBOT_ERROR}.{group}." for group, _ in groups]
    prefixes += [TARGET_SCALE] if scale_is_group else []
    return np.array(
        [
            next((k for k, prefix in enumerate(prefixes) if name.startswith(prefix)), -1)
            for name in built.shared_names
        ],
        dtype=int,
    )
