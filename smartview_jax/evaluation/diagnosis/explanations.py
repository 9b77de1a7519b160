"""Compare a wrong target size with a stretch of the robot's motion as causes of the smooth error.

Both are one number each, and the same data hardly distinguish them. So both are fitted, instead of
the robot error field and in addition to it, and reported with their gain in likelihood.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array

from ...calibration import Calibration
from ...dataset import Dataset
from ...engine import parameter_names
from ...joint import JointFit, fit_joint
from ...robot_errors import LinearInPose, PoseOrStretch, RobotPrior
from ...variance import SCALE as TARGET_SCALE
from ..held_out import held_out
from ..measures import predict

CANDIDATES: Mapping[str, str] = {
    "target scale": PoseOrStretch.SCALE,
    "robot stretch": PoseOrStretch.STRETCH,
}
"""The group of the robot error field that belongs to each candidate cause."""


class Explanation(NamedTuple):
    """One number that may explain all of the robot's smooth error.

    Attributes:
        name: "target scale" or "robot stretch".
        size: true size of the target over its stated one, or true motion of the robot over the
            reported motion.
        std: standard deviation of `size`.
        gain: decrease of the deviance against a robot with white noise alone.
        field_gain: the same for a field linear in the pose (in the position, with few views).
        beside_field: further decrease of the deviance when added to that field.
        px: RMS by which it displaces the points seen.
        fit: the fit with it as the only systematic error.
        region_px: held-out RMS by region of the workspace with it as the only systematic error;
            None if not requested.
    """

    name: str
    size: float
    std: float
    gain: float
    field_gain: float
    beside_field: float
    px: float
    fit: JointFit
    region_px: float | None = None


def explanations(
    data: Dataset, fit: JointFit, progress: Callable[[str], None] | None = None
) -> tuple[Explanation, ...]:
    """Return both candidates, fitted to the same data.

    Args:
        data: the data set that `fit` was fitted to.
        fit: with `noise="estimated"`. Held parameters stay held; priors are not known here. Nothing
            is compared where no field was considered, or the target's scale was to be free.
        progress: called with a line of text for each fit.
    """
    say = progress or (lambda _: None)
    estimate = fit.estimate
    if estimate is None or (TARGET_SCALE in fit.parameter_names and not scale_found(fit)):
        return ()
    fit = _with_stated_target(fit)
    gains = {other.name: other.gain for other in estimate.alternatives}
    if all(name.startswith("white") for name in gains):
        return ()
    # The candidates are compared beside the field that the views support: by position, or by pose.
    groups = 4 if "pose" in gains else 2
    say("error budget: field")
    # Gains are against white noise on the same data and from the same start, so they are
    # comparable.
    field_gain = _gain(fit_candidate(data, fit, None, groups))
    found = []
    for name, group in CANDIDATES.items():
        say(f"error budget: {name}")
        alone = fit_candidate(data, fit, group)
        beside = _gain(fit_candidate(data, fit, group, groups)) - field_gain
        px = moved(alone.calibration, data)
        sizes = _size(alone, group)
        found.append(Explanation(name, *sizes, _gain(alone), field_gain, beside, px, alone))
    return tuple(found)


def scale_found(fit: JointFit) -> bool:
    """Return whether a fit found that the target is not of its stated size."""
    return fit.estimate is not None and TARGET_SCALE in fit.estimate.free


def region_error(data: Dataset, fit: JointFit, name: str, folds: int = 5) -> float:
    """Return the held-out RMS by region, px, of one candidate as the only systematic error."""
    fit = _with_stated_target(fit)
    unseen = held_out(
        data, lambda part: fit_candidate(part, fit, CANDIDATES[name]), folds, by="region"
    )
    return unseen.deviations.rms


def fit_candidate(
    data: Dataset, fit: JointFit, group: str | None, field_groups: int = 0
) -> JointFit:
    """Return the joint fit with one candidate and some groups of a field linear in the pose.

    Args:
        data: the data to fit.
        fit: where to start, and which parameters to hold.
        group: the candidate's group of `PoseOrStretch`; None for the field alone.
        field_groups: 0, 2 (by position) or 4 (by orientation too).
    """
    start = fit.calibration.uncorrected
    views = data.usable_views()
    pose = LinearInPose.over(SE3(data.base_from_tool.wxyz_xyz[views]))
    whole = PoseOrStretch(pose, _seen_from(start), jnp.ones(6))
    counts = [k < field_groups or name == group for k, (name, _) in enumerate(whole.groups)]
    field = dataclasses.replace(whole, counts=jnp.array(counts, dtype=float))
    known = {TARGET_SCALE, *fit.parameter_names}
    held = tuple(name for name in parameter_names(start) if name not in known)
    # The candidates are compared here: no other size of the target in addition.
    prior = RobotPrior(wrong_target=0.0)
    return fit_joint(
        data,
        start,
        noise="estimated",
        field=field,
        fixed=held,
        bad_views="keep",
        robot_prior=prior,
    )


def _with_stated_target(fit: JointFit) -> JointFit:
    """Return the fit from which both candidates start, with the target at its stated size."""
    if not scale_found(fit):
        return fit
    stated = dataclasses.replace(fit.calibration, target_scale=jnp.ones(()))
    return dataclasses.replace(fit, calibration=stated)


def _seen_from(calibration: Calibration) -> Array:
    """Return the point, in the tool's frame, that a wrong target scale keeps in proportion."""
    if calibration.mount == "eye_in_hand":
        return calibration.camera_from_mount.inverse().translation()
    return calibration.holder_from_world.translation()


def _gain(fit: JointFit) -> float:
    """Return the gain of a fit's field over white noise alone.

    Both are from one start, so that fits are comparable.
    """
    assert fit.estimate is not None
    gains = {other.name: other.gain for other in fit.estimate.alternatives}
    return gains[fit.estimate.name] - gains["white"]


def _size(fit: JointFit, group: str) -> tuple[float, float]:
    """Return the size that a candidate states, and its standard deviation."""
    error = fit.calibration.robot_error
    assert error is not None
    assert isinstance(error.field, PoseOrStretch)
    reach = float(error.field.pose.reach)
    name = f"{group}.0"
    share = float(error.coefficients[error.field.names.index(name)]) / reach
    std = fit.std[f"robot_error.{name}"] / reach
    # The robot travels 1 - s of what it reports; a target seen from too near looks too large by 1 /
    # (1 - s), with the standard deviation divided by (1 - s)^2.
    if group == PoseOrStretch.SCALE:
        return 1.0 / (1.0 - share), std / (1.0 - share) ** 2
    return 1.0 - share, std


def moved(calibration: Calibration, data: Dataset) -> float:
    """Return the RMS by which the correction displaces points that were seen, px."""
    pixels, valid, _ = predict(calibration, data.command, data.points)
    bare, also, _ = predict(calibration.uncorrected, data.command, data.points)
    seen = np.asarray(data.visible & valid & also)
    way = np.asarray(pixels - bare)[seen]
    return float(np.sqrt(np.mean(np.sum(way**2, axis=-1))))
