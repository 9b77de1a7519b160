"""List the parameters of a joint fit with their uncertainty, in mm, degrees and px."""

from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import SHAPE_NAMES, Calibration
from ..engine import DEPTH_BIAS_NAMES, PIXEL_ASPECT, ROBOT_ERROR
from ..geometry import host_logarithms, host_matrices
from ..robot_errors import nominal_arm

if TYPE_CHECKING:
    from .joint_fit import JointFit


class ParameterEstimate(NamedTuple):
    """The estimate of one parameter, in the unit for printing.

    Attributes:
        name: as in `JointFit.std`.
        value: the estimate.
        unit: mm, deg, px, or empty for a plain number.
        std: standard deviation; None for a held parameter, infinite for an undetermined one.
        half_width: half width of the 95 % confidence interval; None or infinite as `std`.
    """

    name: str
    value: float
    unit: str
    std: float | None
    half_width: float | None


def parameter_estimates(fit: "JointFit") -> tuple[ParameterEstimate, ...]:
    """Return the parameters of camera, transforms, target and arm, with their uncertainty.

    Coefficients of a robot error field are included only for a known arm, because in other fields
    single coefficients have no meaning.
    """
    estimates, whole_stds = [], whole_error_stds(fit)
    values = list(_values_with_units(fit.calibration).items())
    if PIXEL_ASPECT in fit.std:
        # After both focal lengths.
        values.insert(2, (PIXEL_ASPECT, (pixel_aspect(fit.calibration), 1.0, "")))
    for name, (value, factor, unit) in values:
        # Pose corrections are in `std` too, but only common parameters have an interval.
        std = half_width = None
        if name in fit.std:
            # The parameter of the target's scale is its logarithm.
            unit_size = value if name == "target_scale" else factor
            if name in whole_stds:
                unit_size *= whole_stds[name] / fit.std[name]
            std, half_width = unit_size * fit.std[name], unit_size * fit.confidence_half_width(name)
        estimates.append(ParameterEstimate(name, factor * value, unit, std, half_width))
    return tuple(estimates)


def pixel_aspect(calibration: Calibration) -> float:
    """Return the ratio of the focal lengths, alpha_v / alpha_u."""
    camera = calibration.camera
    return float(camera.alpha_v) / float(camera.alpha_u)


def whole_error_stds(fit: "JointFit") -> dict[str, float]:
    """Return the standard deviations of an arm's errors about zero, if it was fitted about a type.

    `JointFit.std` has the deviations from the errors that the type has in common. Empty for a fit
    without such errors.
    """
    field = fit.calibration.field
    if field is None or not field.is_about_type:
        return {}
    names, by_parameters = whole_errors_by_parameters(fit)
    covariance = by_parameters @ np.asarray(fit.covariance) @ by_parameters.T
    paths = [f"{ROBOT_ERROR}.{name}" for name in names]
    stds = np.sqrt(np.diagonal(covariance))
    return {path: float(std) for path, std in zip(paths, stds, strict=True) if path in fit.std}


def whole_errors_by_parameters(
    fit: "JointFit",
) -> tuple[tuple[str, ...], Float[np.ndarray, "errors parameters"]]:
    """Return the names of the robot's errors, and their derivatives by the fit's parameters.

    The whole errors of an arm depend on its deviations and on the errors that its type has in
    common.
    """
    field = fit.calibration.field
    assert field is not None
    by_coefficients = field.by_coefficients
    fitted = {name: k for k, name in enumerate(fit.parameter_names)}
    result = np.zeros((len(by_coefficients), len(fitted)))
    for column, name in enumerate(field.names):
        if f"{ROBOT_ERROR}.{name}" in fitted:
            result[:, fitted[f"{ROBOT_ERROR}.{name}"]] = by_coefficients[:, column]
    return field.whole.names, result


def displayed_values(calibration: Calibration) -> dict[str, tuple[float, str]]:
    """Return the value and the unit of every parameter by name, as in `parameter_estimates`."""
    return {
        name: (factor * value, unit)
        for name, (value, factor, unit) in _values_with_units(calibration).items()
    }


def displayed_values_and_aspect(calibration: Calibration) -> dict[str, tuple[float, str]]:
    """Return `displayed_values` with the ratio of the focal lengths, which has no unit."""
    return displayed_values(calibration) | {PIXEL_ASPECT: (pixel_aspect(calibration), "")}


def _values_with_units(calibration: Calibration) -> dict[str, tuple[float, float, str]]:
    """Return the value in SI units, the factor to the unit for printing, and this unit."""
    prismatic_offsets = _prismatic_offset_names(calibration)
    values = _parameter_values(calibration) | _arm_error_coefficients(calibration)
    return {name: (value, *display_unit(name, prismatic_offsets)) for name, value in values.items()}


def _parameter_values(calibration: Calibration) -> dict[str, float]:
    """Return the camera's, the transforms' (m, rad) and the target's parameters by name."""
    # The names are the keys of `JointFit.std`, so that both can be combined.
    camera = calibration.camera
    values = {
        f"camera.{key}": float(getattr(camera, key)) for key in ("alpha_u", "alpha_v", "u0", "v0")
    }
    values |= {
        f"camera.lens.{key}": float(value)
        for key, value in vars(camera.lens).items()
        if np.ndim(value) == 0
    }
    for name, transform in calibration.transforms.items():
        matrix = host_matrices(transform)
        # The last three numbers of a transform's logarithm are its rotation vector.
        rotation_vector = host_logarithms(matrix)[3:]
        for part, numbers in (("translation", matrix[:3, 3]), ("rotation", rotation_vector)):
            values |= {
                f"{name}.{part}.{axis}": float(x) for axis, x in zip("xyz", numbers, strict=True)
            }
    values["target_scale"] = float(calibration.target_scale)
    if calibration.target_shape is not None:
        values |= {
            f"target_shape.{name}": float(x)
            for name, x in zip(SHAPE_NAMES, calibration.target_shape.coefficients, strict=True)
        }
    if (bias := calibration.depth_bias) is not None:
        values |= dict(zip(DEPTH_BIAS_NAMES, map(float, bias.host_values), strict=True))
    return values


def _arm_error_coefficients(calibration: Calibration) -> dict[str, float]:
    """Return the robot error coefficients by name, for an arm with known joints; else none."""
    error = calibration.robot_error
    if error is None or nominal_arm(calibration.field) is None:
        return {}
    error = error.whole
    coefficients = np.asarray(error.coefficients)
    return {
        f"{ROBOT_ERROR}.{name}": float(coefficient)
        for name, coefficient in zip(error.field.names, coefficients, strict=True)
    }


def _prismatic_offset_names(calibration: Calibration) -> set[str]:
    """Return the names of the joint offsets of prismatic joints, whose unit is a length."""
    arm = nominal_arm(calibration.field)
    if arm is None:
        return set()
    return {
        f"{ROBOT_ERROR}.joint_offset.{1 + k}"
        for k, is_prismatic in enumerate(arm.prismatic)
        if is_prismatic
    }


def display_unit(name: str, prismatic_offsets: Collection[str] = frozenset()) -> tuple[float, str]:
    """Return the factor from SI units, and the unit to print, of a parameter by its name.

    Args:
        name: name of the parameter.
        prismatic_offsets: names of joint offsets that are lengths.
    """
    is_length = ".translation." in name or ".link_length." in name or name in prismatic_offsets
    if is_length or name.startswith("target_shape.") or name == "depth_bias.offset":
        return 1e3, "mm"
    angles = (".rotation.", ".joint_offset.", ".link_twist.", ".joint_compliance.")
    if any(part in name for part in angles):
        return float(np.rad2deg(1.0)), "deg"
    if name.split(".")[-1] in ("alpha_u", "alpha_v", "u0", "v0"):
        return 1.0, "px"
    return 1.0, ""
