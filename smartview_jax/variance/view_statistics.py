"""Reduce the observations to statistics per view, and linearise them at any parameters.

The statistics are the best free pose of each view, and the camera of the fit with free poses; see
`likelihood.py`. They change with the linearisation only, not with the standard deviations.
"""

import copy
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..calibration import BOW, PRINT, SHAPE_NAMES, TargetShape
from ..engine import (
    ROBOT_ERROR,
    SIGMA_FLOOR,
    AbstractBuiltProblem,
    AbstractProblem,
    JointProblem,
    NormalEquations,
    RigProblem,
    Step,
    chain_without_padding,
    equations_without_padding,
    host_step,
    padded,
    padded_step,
)
from ..runtime.compilation import compiled
from ..runtime.modules import with_fields
from .linearised_views import LinearisedViews
from .model_selection import SHAPE_GROUPS, TARGET_SHAPE
from .standard_deviations import StandardDeviations

_Problem = TypeVar("_Problem", bound=AbstractProblem)

HOLDING_SIGMA = 1e-6
"""Prior standard deviation, in m, rad or no unit, that holds the chain while all poses are free.

The value hardly matters, since with free poses no view acts on the chain. But the prior is
subtracted again from the normal equations, which must keep their significant digits.
"""


class ViewStatistics:
    """The statistics of the views from the fit with free poses, for any linearisation.

    Attributes:
        problem: the joint problem.
        group_index: group of unknown standard deviation of each free shared parameter, and of the
            coefficients of the target's shape after these; -1 for none.
        within_sum_of_squares: sum of squared residuals of the fit with free poses and a free
            camera, px^2.
        group_names: names of the groups.
        statistic_count: number of statistics: free parameters of the camera and of the views'
            poses (`pose_parameters`).
        white_sigma: standard deviation of the noise within views, px.
        has_white_noise: whether the views tell the noise within them. A tracked pose alone does not
            tell the noise of the tracker.
        known_weight: one over the standard deviation of the priors with known standard deviations.
        shape: shape of the target, with which the points of the problem were computed; None if it
            is held as stated.
        shape_names: names of the shape's parameters.
    """

    def __init__(
        self,
        built: AbstractBuiltProblem,
        pose_parameters: int,
        within_sum_of_squares: float,
        sizes: tuple[str, ...] = (),
        shape: TargetShape | None = None,
    ):
        problem = built.problem
        self._stated_problem = problem
        self.problem: AbstractProblem = problem
        self.shape: TargetShape | None = None
        self.group_names: tuple[str, ...] = _group_names(built, sizes, shape)
        self.group_index: Int[np.ndarray, "shared"] = _group_index(built, self.group_names, shape)
        self.free: Int[np.ndarray, "free"] = np.asarray(problem.free)
        camera_count = int(np.sum(np.asarray(problem.is_camera)[self.free]))
        self.within_sum_of_squares: float = within_sum_of_squares
        self.per_view_free: Bool[np.ndarray, "corrected 6"] = np.asarray(problem.per_view_free)
        self.shape_names: tuple[str, ...] = () if shape is None else shape_parameter_names()
        self.statistic_count: int = camera_count + len(self.shape_names) + pose_parameters
        # White sigma: sum of squared residuals over degrees of freedom, the measured numbers minus
        # the parameters of camera and free poses.
        freedom = max(problem.number_count - self.statistic_count, 1)
        white = np.sqrt(within_sum_of_squares / freedom)
        self.white_sigma: float = max(float(white), SIGMA_FLOOR)
        self.has_white_noise: bool = problem.has_pixels
        free_weight = np.asarray(problem.prior_weight.shared)[self.free]
        free_weight = np.append(free_weight, np.zeros(len(self.shape_names)))
        self.known_weight: Float[np.ndarray, "free"] = np.where(
            self.group_index < 0, free_weight, 0.0
        )
        at_start = problem.host_offset_at_start()[self.free]
        per_view_at_start = -np.nan_to_num(problem.prior_mean.per_view)
        self._offset_at_start = host_step(at_start, per_view_at_start)
        if shape is not None:
            self._set_shape(shape)

    @property
    def initial_sigma(self) -> float:
        """The pixel sigma with which the search for the effective one begins, px.

        It is a little above the white one, or one unit of the tracker's noise.
        """
        return 1.1 * self.white_sigma if self.has_white_noise else 1.0

    @property
    def one_camera(self) -> JointProblem:
        """The problem of a data set; a rig's targets are flat, and its lenses not questioned."""
        assert isinstance(self.problem, JointProblem)
        return self.problem

    def with_noise_corrections(self, corrections: Float[np.ndarray, "views 6"]) -> "ViewStatistics":
        """Return the statistics with the robot error field at poses corrected for noise."""
        views = copy.copy(self)
        views.problem = self.problem.with_noise_corrections(corrections)
        return views

    def with_correction_roots(self, roots: Float[np.ndarray, "views 6 6"]) -> "ViewStatistics":
        """Return the statistics with other axes of the views' own parameters."""
        views = copy.copy(self)
        problem = self.problem
        assert isinstance(problem, JointProblem | RigProblem)
        views.problem = problem.with_correction_roots(roots)
        return views

    def corrections(self, per_view: Float[np.ndarray, "views 6"]) -> Float[np.ndarray, "views 6"]:
        """Return the twists at the tool, given each view's own parameters."""
        return self.problem.host_corrections(per_view)

    def _set_shape(self, shape: TargetShape) -> None:
        """Set the target's shape, and displace the points of the problem by it."""
        self.shape = shape
        stated = self._stated_problem
        assert isinstance(stated, JointProblem)
        observations = stated.observations.of_shape(shape)
        self.problem = with_fields(self.one_camera, observations=observations)

    def with_shape(self, shape: TargetShape) -> "ViewStatistics":
        """Return the statistics for a different shape of the target."""
        views = copy.copy(self)
        views._set_shape(shape)
        return views

    def moved(self, z: Step, step: Step) -> tuple["ViewStatistics", Step]:
        """Return the statistics and the step of the problem after a step of all parameters.

        Args:
            z: step of the problem at the linearisation.
            step: change of its parameters, and after them of the target's shape.
        """
        count = len(self.free)
        shared, per_view = np.asarray(step.shared), np.asarray(step.per_view)
        z = jax.tree.map(np.asarray, z)
        moved = Step(z.shared + shared[:count], z.per_view + per_view)
        if self.shape is None:
            return self, moved
        coefficients = np.asarray(self.shape.coefficients) + shared[count:]
        return self.with_shape(self.shape.with_coefficients(coefficients)), moved

    def linearise(self, z: Step) -> LinearisedViews:
        """Linearise the problem at a step, by another pass over the pixels."""
        problem = padded(self.problem)
        equations = _equations_without_priors(problem, padded_step(z, problem), self.shape)
        if self.shape is None:
            return self._with_equations(equations_without_padding(equations, self.problem), z)
        return self._with_equations(self._without_padding(equations), z)

    def linearised_at_fit(
        self, fitted: AbstractProblem, z: Step, equations: NormalEquations
    ) -> LinearisedViews:
        """Return the views linearised at the result of a fit, without another pass over the pixels.

        Args:
            fitted: the problem with the pixel sigma and the priors of the fit.
            z: step of the fit.
            equations: its normal equations, with these priors.
        """
        if self.shape is not None:
            # The fit holds the shape, whose derivatives need another pass.
            return self.linearise(z)
        equations, weight = jax.tree.map(np.asarray, (equations, fitted.prior_weight))
        offset = self._offset_from_prior(z)
        # A prior adds w^2 o^2 / 2 to the cost, w^2 o to the gradient and w^2 to the diagonal. To
        # the diagonal of a held correction the fit adds 1, which keeps the equations solvable.
        shared = weight.shared[self.free] ** 2
        per_view = np.where(self.per_view_free, weight.per_view**2, 0.0)
        diagonal = np.where(self.per_view_free, per_view, 1.0)
        penalty = shared @ offset.shared**2 + np.sum(per_view * offset.per_view**2)
        gradient, matrix = equations.gradient, equations.matrix
        without_priors = with_fields(
            equations,
            cost=equations.cost - 0.5 * penalty,
            gradient=Step(
                gradient.shared - shared * offset.shared,
                gradient.per_view - per_view * offset.per_view,
            ),
            matrix=with_fields(
                matrix,
                shared=matrix.shared - np.diag(shared),
                per_view=matrix.per_view - np.eye(6) * diagonal[:, None],
            ),
        )
        # From the pixel sigma of the fit to 1 px.
        pixel_variance = np.square(fitted.pixel_sigma)
        return self._with_equations(jax.tree.map(lambda x: pixel_variance * x, without_priors), z)

    def _offset_from_prior(self, z: Step) -> Step:
        """Return the differences of the free parameters from their prior means at a step."""
        shared, per_view = jax.tree.map(np.add, self._offset_at_start, z)
        if self.shape is not None:
            shared = np.append(shared, np.asarray(self.shape.coefficients))
        return host_step(shared, per_view)

    def _without_padding(self, equations: NormalEquations) -> NormalEquations:
        """Return the equations without parameters and views that were added to the problem."""
        equations = jax.tree.map(np.asarray, equations)
        gradient, matrix = equations.gradient, equations.matrix
        added = len(gradient.shared) - len(self.shape_names)
        kept = np.append(np.arange(len(self.free)), np.arange(added, len(gradient.shared)))
        views = len(self.per_view_free)
        return with_fields(
            equations,
            gradient=Step(gradient.shared[kept], gradient.per_view[:views]),
            matrix=with_fields(
                matrix,
                shared=matrix.shared[np.ix_(kept, kept)],
                border=matrix.border[:views, :, kept],
                per_view=matrix.per_view[:views],
            ),
        )

    def _with_equations(self, equations: NormalEquations, z: Step) -> LinearisedViews:
        """Return the views with the normal equations of the observations alone at a step."""
        equations = jax.tree.map(np.asarray, equations)
        return LinearisedViews(
            matrix=equations.matrix,
            gradient=equations.gradient,
            residual_sum_of_squares=float(2.0 * equations.cost - self.within_sum_of_squares),
            offset_from_prior=self._offset_from_prior(z),
            known_weight=self.known_weight,
            group_index=self.group_index,
            per_view_free=self.per_view_free,
            statistic_count=float(self.statistic_count),
            white_sigma=self.white_sigma,
        )

    def select_groups(
        self, sigmas: StandardDeviations, names: tuple[str, ...]
    ) -> StandardDeviations:
        """Return the standard deviations with the groups selected and ordered by name."""
        return sigmas._replace(field=sigmas.field[[self.group_names.index(name) for name in names]])


def with_free_poses(problem: JointProblem) -> JointProblem:
    """Return the problem with a free pose for every view, by changing only the priors.

    Only arrays change, so that the same compiled program is used.
    """
    # The shared parameters except the camera's get priors that hold them, and the corrections of
    # the views get none.
    shared, free = np.array(problem.prior_weight.shared), np.asarray(problem.free)
    shared[free[~problem.is_camera[free]]] = 1.0 / HOLDING_SIGMA
    per_view = np.zeros(problem.per_view_free.shape)
    return with_fields(problem, prior_weight=host_step(shared, per_view))


def with_prior_sigmas(
    problem: _Problem, sigmas: StandardDeviations, group_index: Int[np.ndarray, "shared"]
) -> _Problem:
    """Return the problem with priors of the given standard deviations."""
    shared, free = np.array(problem.prior_weight.shared), np.asarray(problem.free)
    # The index ends with the target's shape, which is not a parameter of the problem.
    weights = sigmas.prior_weights(group_index[: len(free)], shared[free])
    shared[free] = weights.shared
    per_view = np.tile(weights.per_view, (len(problem.per_view_free), 1))
    return with_fields(
        problem,
        pixel_sigma=np.asarray(sigmas.pixel),
        prior_weight=host_step(shared, per_view),
    )


def chain_at(problem: AbstractProblem, z: Step) -> Any:
    """Return the chain of every view at a step; of a rig, the chains of each group."""
    whole = padded(problem)
    return chain_without_padding(_chain_at(whole, padded_step(z, whole)), problem)


@compiled
def _chain_at(problem: AbstractProblem, z: Step) -> Any:
    """Return the chain of every view at a step, compiled for the given array shapes."""
    return problem.chain(z)


@compiled
def _equations_without_priors(
    problem: AbstractProblem, z: Step, shape: TargetShape | None
) -> NormalEquations:
    """Return the normal equations of the observations alone at a step; the shape is free."""
    if shape is None:
        return problem.normal_equations_without_priors(z)
    assert isinstance(problem, JointProblem)
    return problem.normal_equations_without_priors(z, shape)


def shape_parameter_names() -> tuple[str, ...]:
    """Return the names of the parameters of the target's shape."""
    return tuple(f"{TARGET_SHAPE}.{name}" for name in SHAPE_NAMES)


def _group_names(
    built: AbstractBuiltProblem, sizes: tuple[str, ...], shape: TargetShape | None
) -> tuple[str, ...]:
    """Return the names of the groups of unknown standard deviation that have free parameters.

    Args:
        built: problem with the names of its parameters.
        sizes: names of the targets' sizes that are groups, the last ones.
        shape: shape of the target, whose groups come before the sizes; None if it is held.
    """
    error = built.problem.robot_error
    groups = () if error is None else error.field.group_names
    free_groups = {name.split(".")[1] for name in built.shared_names if _is_field_name(name)}
    names = tuple(name for name in groups if name in free_groups)
    names = names if shape is None else (*names, *SHAPE_GROUPS)
    return (*names, *sizes)


def _group_index(
    built: AbstractBuiltProblem, group_names: Sequence[str], shape: TargetShape | None
) -> Int[np.ndarray, "shared"]:
    """Return the group of unknown standard deviation of each free shared parameter; -1 for none."""
    index = {name: k for k, name in enumerate(group_names)}
    groups = [name.split(".")[1] if _is_field_name(name) else name for name in built.shared_names]
    if shape is not None:
        for group, coefficients in zip(SHAPE_GROUPS, (BOW, PRINT), strict=True):
            groups += [group] * len(SHAPE_NAMES[coefficients])
    return np.array([index.get(group, -1) for group in groups], dtype=int)


def _is_field_name(name: str) -> bool:
    """Return whether a parameter is a coefficient of the robot error field."""
    return name.startswith(f"{ROBOT_ERROR}.")
