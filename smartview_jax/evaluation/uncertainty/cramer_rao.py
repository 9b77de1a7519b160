"""Compute the Cramer-Rao bound of a set-up before any picture is taken.

No unbiased estimator has a smaller covariance.
"""

from collections.abc import Mapping
from typing import Unpack, overload

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...dataset import Dataset, Rig
from ...engine import (
    AbstractBuiltProblem,
    AbstractProblem,
    Noise,
    Observability,
    ParameterOptions,
    ScaledJacobian,
    build_problem,
    build_rig,
    covariance,
    covariance_by_names,
    eliminate,
    observability,
    padded,
    with_weighed_depths,
)
from ...joint import OpenDirections, RelativePose, RigUncertainty, relative_pose
from ...robot_errors import FieldChoice
from ...runtime.array_namespace import to_device
from ...runtime.compilation import compiled


class CramerRaoBound(eqx.Module):
    """The Cramer-Rao bound of a set-up; `std_of` propagates it to any function of a calibration.

    Attributes:
        calibration: the calibration at which the bound holds.
        covariance: smallest possible covariance of the free parameters, in the order of
            `parameter_names`.
        std: smallest possible standard deviation by name; infinite for an undetermined parameter.
        observability: the directions that the data do not determine.
        parameter_names: names of the free parameters that all views have in common.
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    std: dict[str, float]
    observability: Observability = eqx.field(static=True)
    parameter_names: tuple[str, ...] = eqx.field(static=True)


class RigBound(eqx.Module):
    """The Cramer-Rao bound of a rig.

    Attributes:
        calibrations: calibration of each camera at which the bound holds, by its name.
        covariance: smallest possible covariance of the free parameters, in the order of
            `parameter_names`.
        std: smallest possible standard deviation by name; infinite for an undetermined parameter.
        parameter_names: names of the free parameters that all states have in common.
        undetermined: combinations of parameters that the data do not determine.
    """

    calibrations: dict[str, Calibration]
    covariance: Float[np.ndarray, "free free"]
    std: dict[str, float]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    undetermined: OpenDirections

    def relative(self, first: str, second: str) -> RelativePose:
        """Return the pose of the second camera in the frame of the first, with its bound.

        Raises:
            ValueError: no such camera, or cameras that the robot moves against each other.
        """
        known = RigUncertainty(
            self.parameter_names, self.covariance, undetermined=[self.undetermined]
        )
        return relative_pose(self.calibrations, known, first, second)


@overload
def cramer_rao(
    calibration: Calibration,
    data: Dataset,
    noise: Noise | float,
    *,
    field: FieldChoice = "auto",
    **parameters: Unpack[ParameterOptions],
) -> CramerRaoBound: ...


@overload
def cramer_rao(
    calibration: Mapping[str, Calibration],
    data: Rig,
    noise: Noise,
    *,
    field: FieldChoice = "auto",
    **parameters: Unpack[ParameterOptions],
) -> RigBound: ...


def cramer_rao(
    calibration: Calibration | Mapping[str, Calibration],
    data: Dataset | Rig,
    noise: Noise | float,
    *,
    field: FieldChoice = "auto",
    **parameters: Unpack[ParameterOptions],
) -> CramerRaoBound | RigBound:
    """Return the Cramer-Rao bound of all parameters that a joint fit estimates.

    Errors of reported poses and coefficients of a field are marginalised under their priors: for
    them it is the bound on average over robots (van Trees).

    Args:
        calibration: the truth, or the best guess; of a `Rig`, by the camera's name.
        data: poses, points and their visibility. The pixels do not matter: for planned poses use
            `simulation.simulate(calibration, poses, points, pixel_noise=0.0)`.
        noise: the noise model; a number is the standard deviation of pixels, px, with an exact
            robot.
        field: the robot error field, with one standard deviation for each of its groups in the
            noise; by default the calibration's own error is taken as known.
        parameters: `fixed`, paths of known parameters, `free` and `priors`, as for `fit_joint`.

    Raises:
        ValueError: as for `fit_joint`.

    For example:

        >>> bound = sv.cramer_rao(truth, data, noise)
        >>> print(f"{1e3 * bound.std['camera_from_tool.translation.x']:.1f} mm at best")
        0.6 mm at best
    """
    if isinstance(data, Rig):
        if not isinstance(noise, Noise) or not isinstance(calibration, Mapping):
            raise TypeError("cramer_rao: a rig needs a Noise, and calibrations by camera")
        built = build_rig(data, calibration, noise=noise, field=field, **parameters)
        scaled_jacobian, bound_covariance, std = _bound(built)
        names = built.shared_names
        undetermined = OpenDirections.of_jacobian(names, scaled_jacobian)
        return RigBound(dict(calibration), bound_covariance, std, names, undetermined)
    if not isinstance(calibration, Calibration):
        raise TypeError("cramer_rao: calibrations by camera are for a Rig")
    if isinstance(noise, Noise):
        built = build_problem(data, calibration, noise=noise, field=field, **parameters)
    else:
        # Without a noise model the pixel sigma is set in the problem.
        data = with_weighed_depths(data, float(noise))
        built = build_problem(data, calibration, noise="trusted", field=field, **parameters)
        sigma = to_device(float(noise))
        built = eqx.tree_at(lambda b: b.problem.pixel_sigma, built, sigma)
    scaled_jacobian, bound_covariance, std = _bound(built)
    truth = built.problem.parameters.start
    return CramerRaoBound(
        truth,
        bound_covariance,
        std,
        observability(scaled_jacobian, built.shared_names, truth),
        built.shared_names,
    )


def _bound(
    built: AbstractBuiltProblem,
) -> tuple[ScaledJacobian, Float[np.ndarray, "free free"], dict[str, float]]:
    """Return the scaled Jacobian, the smallest covariance and the standard deviations by name."""
    # Bound: covariance >= I^-1, with I = J^T S^-1 J + priors the Fisher information matrix.
    free = len(built.problem.free)
    reduced, column_norms = jax.tree.map(np.asarray, _information_matrix(padded(built.problem)))
    scaled_jacobian = ScaledJacobian(reduced[:free, :free], column_norms[:free])
    bound_covariance, std = covariance_by_names(
        *covariance(scaled_jacobian, 1.0),
        built.problem.host_named_by_fitted(built.problem.zero_step()),
    )
    by_name = dict(zip(built.shared_names, map(float, std), strict=True))
    return scaled_jacobian, bound_covariance, by_name


@compiled
def _information_matrix(problem: AbstractProblem) -> tuple:
    """Return the information matrix, pose corrections marginalised, and its columns' lengths."""
    # Marginalising Gaussian corrections is the Schur complement: I = A - sum_v B_v^T C_v^-1 B_v.
    matrix = problem.normal_equations(problem.zero_step()).matrix
    return eliminate(matrix).schur_complement, matrix.diagonal().shared ** 0.5
