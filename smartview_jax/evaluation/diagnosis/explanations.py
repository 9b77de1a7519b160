"""Is the target not of its stated size, or are the robot's ways? What either would explain.

Both are one number each, and the same data hardly tell them apart. So both are fitted, in place of
the field of the robot's error and beside it, and told with what they gain.
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


class Explanation(NamedTuple):
    """One number that may be all there is to the robot's smooth error.

    Attributes:
        name: "target scale" or "robot stretch".
        size: true size of the target over its stated one, or ways that the robot goes over those
            that it reports.
        std: of `size`.
        gain: deviance below a robot with white noise alone.
        field_gain: of a field linear in the pose (in the position, where views are few) instead.
        beside_field: deviance below that field, by what it adds to it.
        px: RMS by which it moves the points that were seen.
        fit: in which it is the only systematic error.
        region_px: held-out RMS by region of the workspace where it is the only one; None where
            nobody asked.
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
    """Both candidates, fitted to the same data.

    Args:
        data: what `fit` was fitted to.
        fit: with `noise="estimated"`. What it held is held; priors are not known here. Nothing is
            compared where it knew no field, or was asked to free the target's scale.
        progress: told what is being fitted.
    """
    say = progress or (lambda _: None)
    estimate = fit.estimate
    if estimate is None or (TARGET_SCALE in fit.parameter_names and not scale_found(fit)):
        return ()
    fit = _with_stated_target(fit)
    gains = {other.name: other.gain for other in estimate.alternatives}
    if all(name.startswith("white") for name in gains):
        return ()
    groups = 4 if "pose" in gains else 2
    say("error budget: field")
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
    """Held-out RMS by region, px, of one candidate as the only systematic error."""
    fit = _with_stated_target(fit)
    unseen = held_out(
        data, lambda part: fit_candidate(part, fit, CANDIDATES[name]), folds, by="region"
    )
    return unseen.deviations.rms


def fit_candidate(
    data: Dataset, fit: JointFit, group: str | None, field_groups: int = 0
) -> JointFit:
    """The joint fit with one candidate, and so many groups of a field linear in the pose.

    Args:
        data: to fit.
        fit: where to start, and what to hold.
        group: the candidate's, of `PoseOrStretch`; None for the field alone.
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
    # The candidates are told apart here: no other size of the target besides.
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
    """Return the fit from which both candidates start: the target is as it is stated to be."""
    if not scale_found(fit):
        return fit
    stated = dataclasses.replace(fit.calibration, target_scale=jnp.ones(()))
    return dataclasses.replace(fit, calibration=stated)


def _seen_from(calibration: Calibration) -> Array:
    """What keeps its proportion to the target, in the tool's frame."""
    if calibration.mount == "eye_in_hand":
        return calibration.camera_from_mount.inverse().translation()
    return calibration.holder_from_world.translation()


def _gain(fit: JointFit) -> float:
    """Of a fit's field over white noise alone: from one start, so that they are comparable."""
    assert fit.estimate is not None
    gains = {other.name: other.gain for other in fit.estimate.alternatives}
    return gains[fit.estimate.name] - gains["white"]


def _size(fit: JointFit, group: str) -> tuple[float, float]:
    error = fit.calibration.robot_error
    assert error is not None
    assert isinstance(error.field, PoseOrStretch)
    reach = float(error.field.pose.reach)
    name = f"{group}.0"
    share = float(error.coefficients[error.field.names.index(name)]) / reach
    std = fit.std[f"robot_error.{name}"] / reach
    # The robot goes 1 - share of what it reports; a target seen from too near looks too large.
    if group == PoseOrStretch.SCALE:
        return 1.0 / (1.0 - share), std / (1.0 - share) ** 2
    return 1.0 - share, std


def moved(calibration: Calibration, data: Dataset) -> float:
    """RMS by which the correction moves points that were seen, px."""
    pixels, valid, _ = predict(calibration, data.command, data.points)
    bare, also, _ = predict(calibration.uncorrected, data.command, data.points)
    seen = np.asarray(data.visible & valid & also)
    way = np.asarray(pixels - bare)[seen]
    return float(np.sqrt(np.mean(np.sum(way**2, axis=-1))))
