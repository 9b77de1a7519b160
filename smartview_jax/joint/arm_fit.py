"""Fit the cameras of one arm of a rig, and leave out the states that contradict the others."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxlie import SE3

from ..calibration import Calibration
from ..dataset import Rig
from ..engine import (
    BlockArrow,
    BuiltRig,
    Noise,
    NormalEquations,
    ParameterChoice,
    Solution,
    Step,
    build_rig,
    solve_rig_on,
)
from ..fit_result import Rejection
from ..geometry import host_transforms
from ..robot_errors import FieldChoice, RobotPrior
from ..variance import RigNoiseEstimate, estimate_rig_noise
from .consistent_views import inflation_reason, is_plausible, judging_prior
from .fitted_depth_sensor import weighed_depths
from .gross_errors import without_views
from .rig_rejection import Contradiction, contradiction, suspect_state
from .undetermined_motion import UndeterminedMotion
from .undetermined_rig import undetermined_motion_of_rig


class SolvedArm(NamedTuple):
    """The rig of one arm, its problem, and the problem's solution.

    Attributes:
        rig: the data sets, without what was left out.
        built: the problem.
        estimate: the estimate of the noise; None if the noise was given.
        solution: the solution.
        equations: the normal equations at the solution.
        undetermined: what the robot's motion does not determine, and is held.
        rejected: what was left out, with the camera's name.
        judged: the fit for errors that are alike in all directions, with which states and held
            values are judged; None if this is it.
    """

    rig: Rig
    built: BuiltRig
    estimate: RigNoiseEstimate | None
    solution: Solution
    equations: NormalEquations
    undetermined: UndeterminedMotion
    rejected: tuple[tuple[str, Rejection], ...] = ()
    judged: "SolvedArm | None" = None

    @property
    def at_optimum(self) -> tuple[Rig, BuiltRig, Step, BlockArrow]:
        """The arguments of `contradiction` and `suspect_state`."""
        return self.rig, self.built, self.solution.z, self.equations.matrix


class ArmOptions(NamedTuple):
    """The options of `fit_rig` that concern one arm.

    Attributes:
        noise: `"estimated"`, or the noise.
        field: robot error field.
        choice: parameters to hold and to free, and priors.
        robot_prior: prior on the sizes of the robot's errors.
        devices: devices over which the views are distributed; None for the default one.
        held_first: whose parameters are held where the motion determines none of them, as in
            `find_undetermined_motion`.
    """

    noise: str | Noise
    field: FieldChoice
    choice: ParameterChoice
    robot_prior: RobotPrior
    devices: Sequence[Any] | None = None
    held_first: str = "poses"


def fit_arm(
    rig: Rig,
    starts: Mapping[str, Calibration],
    options: ArmOptions,
    progress: Callable[[str], None] | None,
) -> SolvedArm:
    """Fit the cameras of one arm, without the states that contradict the others.

    Args:
        rig: data sets of the cameras.
        starts: calibration of each camera near the solution.
        options: options of the fit.
        progress: called with a line of text for each stage.

    Raises:
        ValueError: an unknown path, or a start at which no point of a view can be projected.
    """

    def fit_once(
        rig: Rig, prior: RobotPrior, estimate: RigNoiseEstimate | None = None
    ) -> SolvedArm:
        """Fit the rig as it is, with a known estimate of the noise if there is one."""
        bases = bases_of_pair(rig, starts)
        motion = undetermined_motion_of_rig(rig, starts, choice, bases, options.held_first)
        if estimate is not None:
            solved = solve_rig_on(options.devices, estimate.built.problem, estimate.step)
            return SolvedArm(rig, estimate.built, estimate, *solved, motion)
        holding = options._replace(choice=choice.holding(*motion.held), robot_prior=prior)
        built, start, estimate = _built(rig, starts, holding, progress)
        if progress is not None:
            count = sum(int(np.asarray(data.visible).sum()) for data in rig.cameras.values())
            shared = len(built.shared_names)
            progress(f"joint fit of the rig: {shared} shared parameters, {count} points")
        solved = solve_rig_on(options.devices, built.problem, start)
        return SolvedArm(rig, built, estimate, *solved, motion)

    noise, field, choice, *_ = options
    weighed = {
        name: weighed_depths(data, starts[name], choice.of_camera(name), noise, field)
        for name, data in rig.cameras.items()
    }
    rig = rig.with_cameras(weighed)
    first = fitted = fit_once(rig, options.robot_prior)
    judging, left_out = options.robot_prior, []
    if first.estimate is not None and first.estimate.alike is not None:
        judging = judging_prior(options.robot_prior)
        fitted = fit_once(rig, judging, first.estimate.alike)
    # The noise is estimated again without a wrong pose, since one inflates it for all states.
    while (estimate := fitted.estimate) is not None:
        wrong = contradiction(*fitted.at_optimum)
        if wrong is not None:
            fitted = fit_once(_without(fitted.rig, wrong), judging)
        else:
            # One wrong pose may inflate the noise so much that no state fails the test.
            plausible = is_plausible(estimate.noise, options.robot_prior)
            suspect = None if plausible else suspect_state(*fitted.at_optimum)
            if suspect is None:
                break
            refitted = fit_once(_without(fitted.rig, suspect), judging)
            assert refitted.estimate is not None
            reason = inflation_reason(estimate.noise, refitted.estimate.noise)
            if reason is None:
                break
            fitted, wrong = refitted, suspect._replace(reason=reason)
        left_out += [(name, Rejection(wrong.view_id, None, wrong.reason)) for name in wrong.cameras]
    if judging is options.robot_prior:
        return fitted._replace(rejected=tuple(left_out))
    final = fit_once(fitted.rig, options.robot_prior) if left_out else first
    return final._replace(rejected=tuple(left_out), judged=fitted)


def _built(
    rig: Rig,
    starts: Mapping[str, Calibration],
    options: ArmOptions,
    progress: Callable[[str], None] | None,
) -> tuple[BuiltRig, Step, RigNoiseEstimate | None]:
    """Build the problem, with estimated noise unless it is given; return the first step too."""
    noise, field, choice, robot_prior, *_ = options
    if isinstance(noise, Noise):
        built = build_rig(rig, starts, noise=noise, field=field, **choice._asdict())
        return built, built.problem.zero_step(), None
    estimate = estimate_rig_noise(
        rig,
        starts,
        field=field,
        choice=choice,
        progress=progress,
        robot_prior=robot_prior,
    )
    return estimate.built, estimate.step, estimate


def bases_of_pair(rig: Rig, calibrations: Mapping[str, Calibration]) -> dict[str, SE3]:
    """Return the bases of the only pair of arms in the base of the first; empty for one arm."""
    base = next(iter(calibrations.values())).base_from_other_base
    if base is None:
        return {}
    first, other = rig.robot_names
    return {first: host_transforms(np.eye(4)), other: base}


def _without(rig: Rig, wrong: Contradiction) -> Rig:
    """Return the rig without some cameras' views of a state."""
    cameras = dict(rig.cameras)
    for name in wrong.cameras:
        view = cameras[name].view_ids.index(wrong.view_id)
        cameras[name] = without_views(cameras[name], {view: wrong.reason})
    return rig.with_cameras(cameras)
