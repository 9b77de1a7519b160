"""Fit the average of the error models again, with errors that differ by direction."""

import numpy as np
from jaxtyping import Float

from ..engine import JointProblem, RigProblem, host_step
from ..geometry import host_matrices
from ..robot_errors import RobotPrior
from .averaged_fit import (
    AveragedFit,
    SecondPass,
    iterate_to_convergence,
    probabilities_by_field,
)
from .directional_noise import DirectionalNoise
from .directional_search import DirectionalPrior, estimate_directions
from .model_selection import WHITE_NOISE
from .standard_deviations import StandardDeviations

DIRECTIONAL_FITS = 2
"""Largest number of fits with errors that differ by direction, each with a new estimate of them."""


def fit_by_direction(second: SecondPass, prior: RobotPrior) -> SecondPass | None:
    """Return the fit with errors of poses that differ by direction; None if they are alike in all.

    It is None, too, if no model of the robot's error remains possible with these errors.

    Args:
        second: the fit for errors that are alike in all directions.
        prior: prior of the robot's errors.
    """
    problem, average, views = second.views.problem, second.average, second.views
    # The errors of two hands, and of a tracker, have no common axes.
    if (
        not prior.directional_probability
        or not isinstance(problem, JointProblem | RigProblem)
        or not (problem.has_pixels and average.fitted)
        or problem.command.hands is not None
        or not _is_white(average)
    ):
        return None
    of_directions = DirectionalPrior(
        prior.directional_geometric_std, prior.geometric_std, prior.directional_probability
    )
    base_from_tool = host_matrices(problem.command.base_from_tool)
    tool_from_base = base_from_tool[:, :3, :3].swapaxes(1, 2)
    for _ in range(DIRECTIONAL_FITS):
        linearised = average.views
        if average.directions is not None:
            linearised = linearised.in_own_axes(np.linalg.inv(average.directions.roots))
        sigmas = average.maximum.sigmas
        directions = estimate_directions(linearised, sigmas, tool_from_base, of_directions)
        if directions is None:
            return None
        twists = views.corrections(np.asarray(average.z.per_view))
        views = views.with_correction_roots(directions.roots)
        per_view = np.linalg.solve(directions.roots, twists[..., None])[..., 0]
        if average.shape is not None:
            views = views.with_shape(average.shape)
        average = iterate_to_convergence(
            views,
            host_step(np.asarray(average.z.shared), per_view),
            sigmas._replace(
                translation=np.asarray(directions.translation),
                rotation=np.asarray(directions.rotation),
            ),
            second.comparison,
        )
        if not average.fitted:
            return None
        average = _in_mean_sizes(average, directions)
        assert average.directions is not None
        views = views.with_correction_roots(average.directions.roots)
    return second._replace(views=views, average=average)


def _is_white(average: AveragedFit) -> bool:
    """Return whether poses without a smooth error are the most probable model.

    What a smooth error leaves over is what its field cannot describe, which follows the views and
    not the axes of the robot: on rct_circle10x10 an ellipsoid of it predicts unseen views a fifth
    worse.
    """
    probabilities = probabilities_by_field(average.probabilities)
    return max(probabilities, key=lambda name: probabilities[name]) == WHITE_NOISE


def _in_mean_sizes(average: AveragedFit, directions: DirectionalNoise) -> AveragedFit:
    """Return the fit whose standard deviations of poses are means over axes and views.

    The fit estimates the sizes of independent parameters: of rotations, that part which the
    translations do not tell.

    Args:
        average: the fit.
        directions: the directions along which it was made.
    """
    sigmas = average.maximum.sigmas
    sizes = np.array([float(sigmas.translation), float(sigmas.rotation)])
    directions = directions.with_sizes(sizes)
    factors = np.array([directions.translation, directions.rotation]) / sizes

    def scaled(sigmas: StandardDeviations) -> StandardDeviations:
        return sigmas._replace(
            translation=sigmas.translation * factors[0], rotation=sigmas.rotation * factors[1]
        )

    per_parameter: Float[np.ndarray, "6"] = np.repeat(factors, 3)
    return average._replace(
        statistics=average.statistics.with_correction_roots(directions.roots),
        z=host_step(np.asarray(average.z.shared), np.asarray(average.z.per_view) * per_parameter),
        views=average.views.in_own_axes(
            np.broadcast_to(np.diag(1.0 / per_parameter), directions.roots.shape)
        ),
        fitted={
            name: each._replace(maximum=each.maximum._replace(sigmas=scaled(each.maximum.sigmas)))
            for name, each in average.fitted.items()
        },
        maximum=average.maximum._replace(sigmas=scaled(sigmas)),
        directions=directions,
    )
