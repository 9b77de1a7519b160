"""The bound that no unbiased estimator can pass, for any set-up, before any picture is taken."""

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
    """The Cramer-Rao bound of a set-up; `std_of` says what it means for anything computed from it.

    Attributes:
        calibration: where it holds.
        covariance: least covariance of the free parameters, in the order of `parameter_names`.
        std: least standard deviation by name; infinite where the data do not tell.
        observability: what the data cannot tell.
        parameter_names: of the free parameters that all views share.
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
    """The Cramer-Rao bound of everything that a joint fit estimates.

    Errors of reported poses, and the coefficients of a field, are integrated out under their
    priors, so that for them it is the bound on average over robots (van Trees).

    Args:
        calibration: the truth, as far as it is known.
        data: poses, points, and which of them are seen. The pixels do not matter: planned poses
            will do, through `simulation.simulate(calibration, poses, points, pixel_noise=0.0)`.
        noise: sizes of all errors; a number is that of pixels, px, with a robot that is exact.
        field: of the robot's error, with one deviation for each of its groups in the noise.
        fixed: paths that are known, as for `fit_joint`; and so are `free` and `priors`.
        free: see there.
        priors: see there.

    Raises:
        ValueError: as `fit_joint` does.
    """
    robot = noise if isinstance(noise, Noise) else "trusted"
    built = build_problem(
        data, calibration, noise=robot, field=field, fixed=fixed, free=free, priors=priors
    )
    if not isinstance(noise, Noise):
        sigma = np.asarray(float(noise))
        built = eqx.tree_at(lambda b: b.problem.pixel_sigma, built, sigma)
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
    """With the views' own numbers eliminated, and the length of each column before."""
    matrix = problem.normal_equations(problem.start()).matrix
    return eliminate(matrix).reduced, matrix.diagonal().shared ** 0.5
