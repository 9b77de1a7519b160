"""Compute the Cramer-Rao bound of a set-up before any image is taken.

No unbiased estimator has a smaller covariance.
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...compilation import compiled
from ...dataset import Dataset
from ...engine import (
    JointProblem,
    Noise,
    Observability,
    Prior,
    UnitColumns,
    build_problem,
    covariance,
    eliminate,
    observability,
)
from ...robot_errors import AbstractField


class Bound(eqx.Module):
    """The Cramer-Rao bound of a set-up; `std_of` carries it to any function of a calibration.

    Attributes:
        calibration: the calibration at which the bound holds.
        covariance: smallest possible covariance of the free parameters, in the order of
            `parameter_names`.
        std: smallest possible standard deviation by name; infinite where the data do not determine
            a parameter.
        observability: the directions that the data do not determine.
        parameter_names: names of the free parameters that all views have in common.
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    std: dict[str, float]
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)


def cramer_rao(
    calibration: Calibration,
    data: Dataset,
    noise: Noise | float,
    field: AbstractField | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
) -> Bound:
    """Return the Cramer-Rao bound of all parameters that a joint fit estimates.

    Errors of reported poses, and the coefficients of a field, are marginalised under their priors,
    so that for them it is the bound on average over robots (van Trees).

    Args:
        calibration: the truth, as far as it is known.
        data: poses, points, and which of them are seen. The pixels do not matter: planned poses
            will do, through `simulation.simulate(calibration, poses, points, pixel_noise=0.0)`.
        noise: the noise model; a number is the standard deviation of pixels, px, with an exact
            robot.
        field: the robot error field, with one standard deviation for each of its groups in the
            noise.
        fixed: paths of known parameters, as for `fit_joint`.
        free: as for `fit_joint`.
        priors: as for `fit_joint`.

    Raises:
        ValueError: as `fit_joint` does.
    """
    robot = noise if isinstance(noise, Noise) else "trusted"
    built = build_problem(
        data, calibration, noise=robot, field=field, fixed=fixed, free=free, priors=priors
    )
    # An exact robot has no noise model to hold the pixel sigma, so it is set in the problem.
    if not isinstance(noise, Noise):
        sigma = np.asarray(float(noise))
        built = eqx.tree_at(lambda b: b.problem.pixel_sigma, built, sigma)
    # Bound: covariance >= I^-1, with I = J^T S^-1 J + priors the Fisher information matrix.
    reduced, lengths = _information(built.problem)
    columns = UnitColumns(np.asarray(reduced), np.asarray(lengths))
    least, std = covariance(columns, 1.0)
    truth = built.problem.parameters.start
    return Bound(
        truth,
        least,
        dict(zip(built.names, map(float, std), strict=True)),
        observability(columns, built.names, truth),
        built.names,
    )


@compiled
def _information(problem: JointProblem) -> tuple:
    """Return the information matrix, pose corrections marginalised, and its columns' lengths."""
    # Marginalising Gaussian corrections is the Schur complement: I = A - sum_v B_v^T C_v^-1 B_v.
    matrix = problem.normal_equations(problem.start()).matrix
    return eliminate(matrix).reduced, matrix.diagonal().shared ** 0.5
