"""Fit the cameras of a rig together, arm by arm and then all arms."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar, Unpack

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import listed, require_instance
from ..calibration import Calibration
from ..dataset import (
    MINIMUM_RELIABLE_VIEWS,
    Dataset,
    Rig,
    chain_residuals,
    digests_to_keep,
    distinct_poses,
    view_residuals,
)
from ..engine import (
    BuiltRig,
    FitCovariance,
    FittedChain,
    Noise,
    ParameterChoice,
    ParameterOptions,
    choices_of_arms,
    require_starts,
    with_depth_bias,
)
from ..fit_result import Rejection
from ..geometry import host_matrices
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..staged import with_region
from ..variance import SmallSampleCorrection
from .arm_fit import ArmOptions, SolvedArm, bases_of_pair, fit_arm
from .consistent_views import is_plausible
from .fitted_depth_sensor import fitted_depth_sensor
from .held_parameters import held_camera_test
from .open_directions import OpenDirections
from .plausibility import MIN_SCALE_PROBABILITY, principal_point_warnings
from .rig_fit import RigFit
from .several_arms import JoinedArms, added_by_estimation, join_arms
from .stated_priors import stated_prior_test
from .told_by_others import with_told_by_others
from .undetermined_motion import UndeterminedMotion
from .undetermined_rig import undetermined_motion_of_rig
from .view_fit import MAX_INLIER_CHI_SQUARE, solver_result

_Option = TypeVar("_Option")


def fit_rig(
    rig: Rig,
    starts: Mapping[str, Calibration],
    *,
    noise: str | Noise | Mapping[str, Noise] = "estimated",
    field: FieldChoice | Mapping[str, FieldChoice] = "auto",
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
    rejected: Sequence[tuple[str, Rejection]] = (),
    devices: Sequence[Any] | None = None,
    **parameters: Unpack[ParameterOptions],
) -> RigFit:
    """Fit all cameras of a rig, their targets and the robots' errors to all pixels at once.

    The noise and the errors of several arms are estimated one arm after the other, each from its
    own states; then all are fitted together.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera near the solution, with the lens to fit. Cameras on one
            arm that see the same target must agree on its pose, and so must all that see a target
            on a hand (`calibrate` takes care of it).
        noise: `"estimated"`, or a `Noise` that states the standard deviations; of several arms, one
            for all or one for each by its name.
        field: robot error field, as in `fit_joint`; of several arms, one for all or one for each.
        progress: called with a line of text for each stage.
        robot_prior: prior on the sizes of the robot's errors.
        rejected: what was left out before, for the result.
        devices: devices over which the views of the fits are distributed, as in `fit_joint`; the
            noise is estimated on the default device.
        parameters: `fixed`, paths of parameters that keep the start's value, such as `left.camera`
            or `base_from_world` (see `build_rig`, and `build_arms` for several arms); `free`, paths
            to free that are held by default: `target_scale`; `priors`, a `Prior` by path, such as
            `left.camera.pixel_aspect` for the square pixels of one camera.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: an unknown path, or a start at which no point of a view can be projected.

    For example, with one camera in the place of two:

        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> both = sv.fit_rig(rig, {"left": truth, "right": truth}, noise=noise)
        >>> std = both.relative("left", "right").std
        >>> print(f"{1e3 * std[2]:.1f} mm along the optical axis")
        0.9 mm along the optical axis
    """
    require_instance("rig", rig, Rig)
    choice, prior = ParameterChoice.of(**parameters), robot_prior or RobotPrior()
    require_starts(rig, starts)
    starts = {name: with_depth_bias(given, rig.cameras[name]) for name, given in starts.items()}
    several, arms = len(rig.arm_names) > 1, {}
    choices = choices_of_arms(rig, starts, choice)
    for arm in rig.arm_names:
        own_noise = _option_of(arm, "noise", noise)
        if own_noise != "estimated" and not isinstance(own_noise, Noise):
            raise ValueError(f'noise is "estimated" or a Noise for a rig; found {own_noise!r}')
        own_field = checked_field_choice(_option_of(arm, "field", field))
        arms[arm] = fit_arm(
            rig.of_arm(arm),
            {name: start for name, start in starts.items() if rig.arms.get(name, arm) == arm},
            ArmOptions(
                own_noise, own_field, choices[arm], prior, devices, "mounts" if several else "poses"
            ),
            _named(progress, arm) if several else progress,
        )
    judged = [arm.judged or arm for arm in arms.values()]
    joined = None
    tests = [test(arm) for arm in judged for test in (held_camera_test, stated_prior_test)]
    if several:
        joined = join_arms(rig, arms, choice.priors, devices)
        motion = _undetermined_motion(rig, arms, starts, choice, joined.bases)
        # Of what each arm holds alone, enough stays held for what all arms together leave open.
        held_alone = {name for arm in arms.values() for name in arm.undetermined.held}
        held_together = motion.pinned_by(held_alone)
        told = {name: with_told_by_others(arm, held_together) for name, arm in arms.items()}
        if any(told[name] is not arm for name, arm in arms.items()):
            arms, joined = told, join_arms(rig, told, choice.priors, devices)
    fit = _assembled(rig, arms, joined, tuple(rejected), choice)
    disagreement = () if joined is None else joined.disagreement
    held = [text for test in tests for text in test.warnings]
    wider = fit.covariance, fit.std
    for test in tests:
        wider = test.widened(*wider, fit.parameter_names)
    return dataclasses.replace(
        fit,
        covariance=wider[0],
        std=wider[1],
        contradicted_covariance=wider[0] - fit.covariance if held else None,
        warnings=(*held, *rig_warnings(fit, prior), *disagreement),
        picture_digests={name: digests_to_keep(data) for name, data in rig.cameras.items()},
    )


def _named(progress: Callable[[str], None] | None, arm: str) -> Callable[[str], None] | None:
    """Return a function that reports progress with the arm's name."""
    return None if progress is None else lambda text: progress(f"{arm}: {text}")


def _option_of(arm: str, name: str, option: _Option | Mapping[str, _Option]) -> _Option:
    """Return an option for one arm, of a value for all arms or of one for each.

    Raises:
        ValueError: the arm has no value.
    """
    if not isinstance(option, Mapping):
        return option
    if arm not in option:
        raise ValueError(f"{name}: expected a value for arm {arm!r}, found {', '.join(option)}")
    return option[arm]


def _assembled(
    rig: Rig,
    arms: Mapping[str, SolvedArm],
    joined: JoinedArms | None,
    rejected: tuple[tuple[str, Rejection], ...],
    choice: ParameterChoice,
) -> RigFit:
    """Build the result from the fits of the arms alone and of all, which is None for one arm."""
    first = next(iter(arms.values()))
    together = joined or first
    built, solution, equations = together.built, together.solution, together.equations
    by_fitted, correction = built.problem.host_named_by_fitted(solution.z), None
    # The noise is stated or estimated: the variance factor is one.
    of_fitted = FitCovariance.of(equations.matrix)
    uncertainty = of_fitted.by_names(by_fitted)
    estimated = (
        _added_by_estimation(first)
        if joined is None
        else added_by_estimation(joined, arms, of_fitted.shared)
    )
    if estimated is not None:
        added, correction = estimated
        if by_fitted is not None:
            added = by_fitted @ added @ by_fitted.T
            correction = correction.by_names(by_fitted, of_fitted.shared)
        uncertainty = uncertainty.with_added(added, correction.degrees_of_freedom)
    cameras: dict[str, _CameraFit] = {}
    chains = (solution.chain,) if joined is None else solution.chain
    for arm, of_cameras in zip(arms.values(), chains, strict=True):
        cameras |= _camera_fits(arm, of_cameras)
    calibrations = {name: camera.calibration for name, camera in cameras.items()}
    sensors = {
        name: fitted_depth_sensor(
            camera.data, camera.calibration, built.shared_names, uncertainty.shared, f"{name}."
        )
        for name, camera in cameras.items()
    }
    left_out = [entry for arm in arms.values() for entry in arm.rejected]
    bases = bases_of_pair(rig, calibrations) if joined is None else joined.bases
    motion = _undetermined_motion(rig, arms, calibrations, choice, bases)
    std, freedom = uncertainty.std_by_name(built), uncertainty.freedom_by_name(built)
    for name in motion.undetermined_names:
        std[name] = freedom[name] = np.inf
    return RigFit(
        calibrations=calibrations,
        covariance=uncertainty.shared,
        parameter_names=built.shared_names,
        std=std,
        degrees_of_freedom=freedom,
        noises={
            name: arm.built.noise if arm.estimate is None else arm.estimate.noise
            for name, arm in arms.items()
        },
        pixel_sigmas={name: camera.pixel_sigma for name, camera in cameras.items()},
        noise_estimates={
            name: arm.estimate for name, arm in arms.items() if arm.estimate is not None
        },
        residuals={name: camera.residuals for name, camera in cameras.items()},
        inliers={name: camera.inliers for name, camera in cameras.items()},
        pose_corrections=built.problem.host_corrections(np.asarray(solution.z.per_view)),
        view_ids=rig.view_ids,
        rejected=(*rejected, *left_out),
        built=built,
        solution=solution,
        smallest_singular_value=float(uncertainty.jacobian.singular_values[-1]),
        result=solver_result(solution),
        bases=bases,
        arms={camera: name for name, arm in arms.items() for camera in arm.rig.cameras},
        data=rig,
        small_sample_correction=correction,
        sensors={name: sensor for name, sensor in sensors.items() if sensor is not None},
        undetermined=(
            OpenDirections.of_motion(motion),
            OpenDirections.of_jacobian(built.shared_names, uncertainty.jacobian),
        ),
    )


class _CameraFit(NamedTuple):
    """The fit of one camera of a rig.

    Attributes:
        data: its data set, without the views that were left out.
        calibration: its calibration.
        pixel_sigma: standard deviation of its pixels.
        residuals: measured minus predicted pixels by the calibration alone.
        inliers: mask of the points that agree with the fit.
    """

    data: Dataset
    calibration: Calibration
    pixel_sigma: float
    residuals: Float[Array, "views points 2"]
    inliers: Bool[np.ndarray, "views points"]


def _camera_fits(arm: SolvedArm, of_cameras: tuple[FittedChain, ...]) -> dict[str, _CameraFit]:
    """Return the fit of each camera of an arm, from their chains at the solution."""
    estimate, fits = arm.estimate, {}
    sigma = float(arm.built.problem.pixel_sigma)
    relative = {} if estimate is None else estimate.relative_sigmas
    for name, chain in _chains(arm.built, of_cameras).items():
        data, calibration = arm.rig.cameras[name], chain.calibration
        if estimate is not None and (error := calibration.robot_error) is not None:
            fitted = None if estimate.field is None else error.converted_to(estimate.field)
            calibration = dataclasses.replace(calibration, robot_error=fitted)
        pixel_sigma = sigma * relative.get(name, 1.0)
        squares = np.sum(_residuals_at(chain, data) ** 2, axis=-1)
        fits[name] = _CameraFit(
            data,
            with_region(calibration, data),
            pixel_sigma,
            to_device(chain_residuals(calibration, data.observations)),
            np.asarray(data.visible) & (squares <= MAX_INLIER_CHI_SQUARE * pixel_sigma**2),
        )
    return fits


def _undetermined_motion(
    rig: Rig,
    arms: Mapping[str, SolvedArm],
    calibrations: Mapping[str, Calibration],
    choice: ParameterChoice,
    bases: Mapping[str, SE3],
) -> UndeterminedMotion:
    """Return what the robots' motions do not determine, in the names of all arms together."""
    first, *others = arms.values()
    if not others:
        return first.undetermined
    used = {name: data for arm in arms.values() for name, data in arm.rig.cameras.items()}
    used_rig = rig.with_cameras({name: used[name] for name in rig.cameras})
    return undetermined_motion_of_rig(used_rig, calibrations, choice, bases, "mounts")


def _added_by_estimation(
    arm: SolvedArm,
) -> tuple[Float[np.ndarray, "free free"], SmallSampleCorrection] | None:
    """Return what estimated noise adds to one arm's covariance, and the correction it is due to."""
    if arm.estimate is None:
        return None
    correction = arm.estimate.small_sample_correction
    added = correction.added_covariance + arm.estimate.between_models_covariance
    return added, correction


def _residuals_at(chain: FittedChain, data: Dataset) -> Float[np.ndarray, "views points 2"]:
    """Return measured minus predicted pixels at a fit, with all corrections."""
    camera, size = chain.calibration.camera, chain.calibration.target_scale
    poses = np.asarray(chain.camera_from_world)[: data.view_count]
    return np.asarray(view_residuals(camera, size, poses, data.observations))


def _chains(built: BuiltRig, of_groups: tuple[FittedChain, ...]) -> dict[str, FittedChain]:
    """Return the chain of each camera, by its name."""
    return {
        name: jax.tree.map(lambda x, row=row: to_device(np.asarray(x)[row]), chains)
        for cameras, chains in zip(built.cameras, of_groups, strict=True)
        for row, name in enumerate(cameras)
    }


def rig_warnings(fit: RigFit, prior: RobotPrior) -> tuple[str, ...]:
    """Return the reasons to doubt the fit of a rig, a sentence each, gravest first.

    Args:
        fit: the fit to judge.
        prior: prior on the sizes of the robot's errors.
    """
    warnings = [] if fit.result.converged else [fit.result.message]
    # Held parameters have no entry among the names, but one in `std` if nothing determines them.
    undetermined = [name for name, std in fit.std.items() if np.isinf(std)]
    if undetermined:
        warnings.append(
            f"the data do not determine {listed(undetermined)}: turn the robot about "
            "other axes, hold them by fixed=, or give priors"
        )
    for name, calibration in fit.calibrations.items():
        warnings += principal_point_warnings(calibration.camera, fit.std, f"{name}.camera")
    for arm, built in fit.built_by_arm.items():
        named = f"{arm}: " if fit.bases else ""
        warnings += [f"{named}{text}" for text in _estimate_warnings(fit, arm, prior)]
        # Several pictures from one pose have no more information on the robot than one.
        poses = host_matrices(built.problem.command.base_from_tool)
        used = np.asarray(built.problem.per_view_free).any(axis=1)
        states = len(distinct_poses(poses[used]))
        if states < MINIMUM_RELIABLE_VIEWS:
            warnings.append(
                f"{named}{states} states of the robot are few: no figure is reliable with fewer "
                f"than {MINIMUM_RELIABLE_VIEWS}"
            )
    return tuple(warnings)


def _estimate_warnings(fit: RigFit, arm: str, prior: RobotPrior) -> list[str]:
    """Return warnings about the estimated sizes of an arm's errors, and about the target's size."""
    estimate = fit.noise_estimates.get(arm)
    if estimate is None:
        return []
    warnings, noise = [], estimate.largest_noise
    for name, size in estimate.target_scales.items():
        if size.probability >= MIN_SCALE_PROBABILITY:
            target = " ".join(["the target", *name.split(".")[:-1]])
            warnings.append(
                f"{target} may be {size.scale:.4f} +- {size.std:.4f} of its stated size "
                f"(probability {size.probability:.2f}): measure it"
            )
    along = "" if estimate.directions is None else " in their worst direction"
    if not is_plausible(noise, prior):
        warnings.append(
            f"the robot's poses err by {1e3 * noise.translation:.3g} mm and "
            f"{np.degrees(noise.rotation):.3g} degrees{along}, which is much for a robot: "
            "mispaired views, a camera or a target that moved?"
        )
    if not estimate.converged:
        warnings.append("the estimate of the errors' sizes did not converge: take more views")
    return warnings
