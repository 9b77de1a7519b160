"""Compare a wrong target size with a wrong scale of the robot's motion as causes of smooth error.

Each is a single number, and data hardly distinguish them. So both are fitted, instead of the robot
error field and in addition to it, and reported with their log-likelihood ratios. Here a
log-likelihood ratio includes the factor of two: it is a decrease of the deviance.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array

from ...calibration import Calibration, mount_frames
from ...dataset import Dataset
from ...engine import TARGET_SCALE as TARGET_SCALE
from ...engine import parameter_names
from ...joint import JointFit, fit_joint
from ...robot_errors import LinearInPose, LinearInPoseWithScales, RobotPrior
from ...runtime.array_namespace import to_device
from ...variance import WHITE_NOISE, ModelName
from ..held_out import held_out
from ..measures import predict

HYPOTHESIS_GROUPS: Mapping[str, str] = {
    "target scale": LinearInPoseWithScales.TARGET_SCALE,
    "robot stretch": LinearInPoseWithScales.ROBOT_SCALE,
}
"""The group of `LinearInPoseWithScales` that belongs to each hypothesis."""


class ScaleHypothesis(NamedTuple):
    """A single number that may explain all of the robot's smooth error.

    Attributes:
        name: "target scale" or "robot stretch".
        scale: true over stated size of the target, or true over reported motion of the robot.
        std: standard deviation of `scale`.
        log_likelihood_ratio: decrease of the deviance against a robot with white noise alone.
        field_log_likelihood_ratio: the same for a field linear in the pose (in the position, with
            few views).
        log_likelihood_ratio_given_field: further decrease of the deviance when added to that field.
        rms_displacement: RMS by which it displaces the points seen, px.
        fit: the fit with it as the only systematic error.
        region_rms: held-out RMS by region of the workspace with it as the only systematic error;
            None if not requested.
    """

    name: str
    scale: float
    std: float
    log_likelihood_ratio: float
    field_log_likelihood_ratio: float
    log_likelihood_ratio_given_field: float
    rms_displacement: float
    fit: JointFit
    region_rms: float | None = None


def scale_hypotheses(
    data: Dataset, fit: JointFit, progress: Callable[[str], None] | None = None
) -> tuple[ScaleHypothesis, ...]:
    """Return both hypotheses, fitted to the same data.

    Args:
        data: the data set that `fit` was fitted to.
        fit: a joint fit with `noise="estimated"`. Held parameters stay held; priors are not used.
        progress: called with a line of text for each fit.

    Returns:
        Nothing if the fit considered no field, or if the user had freed the target's scale.
    """
    report = progress or (lambda _: None)
    noise_estimate = fit.noise_estimate
    if noise_estimate is None or (
        TARGET_SCALE in fit.parameter_names and not target_scale_differs(fit)
    ):
        return ()
    fit = _with_stated_target(fit)
    fields = {candidate.model.field for candidate in noise_estimate.candidates}
    # With no field among the candidates there is no smooth error for a hypothesis to explain.
    if fields == {WHITE_NOISE}:
        return ()
    # The hypotheses are compared with the field that the views support: by position, or by pose.
    field_group_count = 4 if "pose" in fields else 2
    report("error budget: field")
    # All ratios are against white noise on the same data and from the same start, so that they are
    # comparable.
    field_ratio = _log_likelihood_ratio(fit_scale_hypothesis(data, fit, None, field_group_count))
    hypotheses = []
    for name, group in HYPOTHESIS_GROUPS.items():
        report(f"error budget: {name}")
        alone = fit_scale_hypothesis(data, fit, group)
        with_field = fit_scale_hypothesis(data, fit, group, field_group_count)
        scale, std = _scale_and_std(alone, group)
        hypotheses.append(
            ScaleHypothesis(
                name,
                scale,
                std,
                _log_likelihood_ratio(alone),
                field_ratio,
                _log_likelihood_ratio(with_field) - field_ratio,
                rms_displacement(alone.calibration, data),
                alone,
            )
        )
    return tuple(hypotheses)


def target_scale_differs(fit: JointFit) -> bool:
    """Return whether a fit estimated a target size that differs from the stated one."""
    return fit.noise_estimate is not None and TARGET_SCALE in fit.noise_estimate.free


def region_held_out_rms(data: Dataset, fit: JointFit, name: str, folds: int = 5) -> float:
    """Return the held-out RMS by region, px, of one hypothesis as the only systematic error."""
    fit = _with_stated_target(fit)
    held_out_errors = held_out(
        data,
        lambda part: fit_scale_hypothesis(part, fit, HYPOTHESIS_GROUPS[name]),
        folds,
        by="region",
    )
    return held_out_errors.errors.rms


def fit_scale_hypothesis(
    data: Dataset, fit: JointFit, group: str | None, field_group_count: int = 0
) -> JointFit:
    """Return the joint fit with one hypothesis and some groups of a field linear in the pose.

    Args:
        data: the data to fit.
        fit: where to start, and which parameters to hold.
        group: the hypothesis's group of `LinearInPoseWithScales`; None for the field alone.
        field_group_count: number of groups of the field, its first ones: 0, 2 (by position) or 4
            (by orientation too).
    """
    start = fit.calibration.uncorrected
    views = data.usable_views()
    pose = LinearInPose.from_poses(SE3(to_device(np.asarray(data.base_from_tool.wxyz_xyz)[views])))
    all_groups_field = LinearInPoseWithScales(pose, _scale_center(start), to_device(np.ones(6)))
    active = [
        k < field_group_count or name == group
        for k, (name, _) in enumerate(all_groups_field.groups)
    ]
    field = dataclasses.replace(
        all_groups_field, active_groups=to_device(np.array(active, dtype=float))
    )
    free_names = {TARGET_SCALE, *fit.parameter_names}
    fixed_names = tuple(name for name in parameter_names(start) if name not in free_names)
    # The target's size is one of the hypotheses, so `fit_joint` must not estimate it by itself.
    prior = RobotPrior(wrong_target_probability=0.0)
    return fit_joint(
        data,
        start,
        noise="estimated",
        field=field,
        fixed=fixed_names,
        gross_errors="keep",
        robot_prior=prior,
    )


def _with_stated_target(fit: JointFit) -> JointFit:
    """Return the fit from which both hypotheses start, with the target at its stated size."""
    if not target_scale_differs(fit):
        return fit
    stated = dataclasses.replace(fit.calibration, target_scale=jnp.ones(()))
    return dataclasses.replace(fit, calibration=stated)


def _scale_center(calibration: Calibration) -> Array:
    """Return the point, in the tool's frame, that a wrong target scale keeps in proportion."""
    if mount_frames(calibration.mount)[0] == "tool":
        return calibration.camera_from_mount.inverse().translation()
    return calibration.holder_from_world.translation()


def _log_likelihood_ratio(fit: JointFit) -> float:
    """Return twice the log-likelihood ratio of a fit's field to white noise alone.

    Both are from one start, so that fits are comparable.
    """
    assert fit.noise_estimate is not None
    ratios = {
        candidate.model: candidate.log_likelihood_ratio
        for candidate in fit.noise_estimate.candidates
    }
    return ratios[ModelName(fit.noise_estimate.name)]


def _scale_and_std(fit: JointFit, group: str) -> tuple[float, float]:
    """Return the scale of a hypothesis, and its standard deviation."""
    error = fit.calibration.robot_error
    assert error is not None
    assert isinstance(error.field, LinearInPoseWithScales)
    reach = float(error.field.linear_in_pose.reach)
    name = f"{group}.0"
    relative_error = float(error.coefficients[error.field.names.index(name)]) / reach
    std = fit.std[f"robot_error.{name}"] / reach
    # With s the relative error of the reported displacements, the robot moves 1 - s times as far as
    # reported. Then a target looks too large by 1 / (1 - s), whose derivative is 1 / (1 - s)^2.
    if group == LinearInPoseWithScales.TARGET_SCALE:
        return 1.0 / (1.0 - relative_error), std / (1.0 - relative_error) ** 2
    return 1.0 - relative_error, std


def rms_displacement(calibration: Calibration, data: Dataset) -> float:
    """Return the RMS by which the correction displaces points that were seen, px."""
    pixels, valid, _ = predict(calibration, data.command, data.points)
    uncorrected_pixels, uncorrected_valid, _ = predict(
        calibration.uncorrected, data.command, data.points
    )
    projected = np.asarray(data.visible & valid & uncorrected_valid)
    displacement = np.asarray(pixels - uncorrected_pixels)[projected]
    return float(np.sqrt(np.mean(np.sum(displacement**2, axis=-1))))
