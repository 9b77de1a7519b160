"""Fit the views that agree, and leave out each view whose reported pose contradicts the others.

One view is left out at a time: a view rejected by its posterior pose correction or, if all poses
look poor, the view without which the pose standard deviations collapse. Then the noise is estimated
again, since one wrong pose inflates it for all views. A view is left out, not down-weighted: a pose
of another picture has no information.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from ..dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ..engine import BlockArrow, Noise
from ..robot_errors import RobotPrior
from .gross_errors import without_views
from .influence import pose_outlier_test
from .joint_fit import JointFit
from .plausibility import MAX_PRIOR_SIGMAS
from .view_fit import FitOptions, ViewFit, fit_views

FALSE_ALARM_PROBABILITY = 1e-6
"""The family-wise significance level, over all views, at which a view is left out.

It is far below the usual level because real robots' errors have longer tails than the normal
distribution.
"""

MAX_POSE_SIGMA_RATIO = 3.0
"""The ratio of pose standard deviations with and without a view above which its pose is wrong."""


class ConsistentFit(NamedTuple):
    """A fit to the views that agree.

    Attributes:
        fit: the fit.
        judged: the fit for errors that are alike in all directions, with which views and held
            values are judged; the same one if the errors of `fit` are.
        data: the data, without the views that were left out.
    """

    fit: JointFit
    judged: JointFit
    data: Dataset


def fit_consistent_views(
    data: Dataset, options: FitOptions, robot_prior: RobotPrior | None, keeps_all: bool
) -> ConsistentFit:
    """Fit the views that agree.

    Args:
        data: the data, without gross errors.
        options: the options of the fit.
        robot_prior: prior on the sizes of the robot's errors.
        keeps_all: whether all views are kept.
    """
    first = judged = fit_views(data, options, robot_prior)
    estimate, judging = first.fit.noise_estimate, robot_prior
    alike = None if estimate is None else estimate.alike
    if alike is not None:
        judging = judging_prior(robot_prior)
        judged = fit_views(data, options, judging, alike)
    used_data = data
    while not keeps_all and (wrong := _wrong_view(used_data, judged, options, judging)):
        used_data = without_views(used_data, wrong)
        judged = fit_views(used_data, options, judging)
    if alike is None:
        final = judged
    elif used_data is data:
        final = first
    else:
        final = fit_views(used_data, options, robot_prior)
    return ConsistentFit(final.fit, judged.fit, used_data)


def _wrong_view(
    data: Dataset, fitted: ViewFit, options: FitOptions, robot_prior: RobotPrior | None
) -> dict[int, str]:
    """Return the view that contradicts the others most, with the reason; empty if none does."""
    if (inconsistent := _inconsistent_view(data, *fitted)) is not None:
        return dict([inconsistent])
    if (suspect := _suspect_view(data, *fitted)) is None:
        return {}
    # One wrong pose inflates the pose standard deviations of all views, so that no view fails the
    # test. Compare the fits with and without the suspect instead.
    without = fit_views(without_views(data, {suspect: ""}), options, robot_prior)
    reason = inflation_reason(fitted.fit.noise, without.fit.noise)
    return {} if reason is None else {suspect: reason}


def _inconsistent_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> tuple[int, str] | None:
    """Return the view whose pose is least compatible with the others, and why.

    None if the incompatibility is not significant, if poses have no prior, or with too few views to
    decide which is wrong.
    """
    if fit.noise is None or len(data.usable_views()) <= MINIMUM_RELIABLE_VIEWS:
        return None
    scores = pose_outlier_test(fit.problem, fit.solution.z, matrix, fit.noise_estimate is None)
    distance, p_values = np.asarray(scores.distance), np.asarray(scores.p_value)
    worst = int(np.argmin(p_values))
    # Bonferroni: the smallest of n p-values is tested at the level FALSE_ALARM_PROBABILITY / n.
    if not p_values[worst] * len(data.usable_views()) < FALSE_ALARM_PROBABILITY:
        return None
    return worst, (
        f"its pose lies {distance[worst]:.0f} standard deviations from where the other views put "
        f"it: mispaired or moved?"
    )


def _suspect_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> int | None:
    """Return the view whose pose is least compatible with the others, if pose errors are too large.

    None if the pose standard deviations are plausible for robots.
    """
    noise_estimate, noise = fit.noise_estimate, fit.noise
    if (
        noise_estimate is None
        or noise is None
        or len(data.usable_views()) <= MINIMUM_RELIABLE_VIEWS
        or is_plausible(noise, noise_estimate.robot_prior)
    ):
        return None
    scores = pose_outlier_test(fit.problem, fit.solution.z, matrix, sigmas_known=False)
    return int(np.argmin(np.asarray(scores.p_value)))


def judging_prior(prior: RobotPrior | None) -> RobotPrior:
    """Return the prior of robots' errors with which views and held values are judged.

    A wrong pose, and a wrong value that is held, look like errors along one direction: they are
    judged by errors that are alike in all.
    """
    return dataclasses.replace(prior or RobotPrior(), directional_probability=0.0)


def is_plausible(noise: Noise, prior: RobotPrior) -> bool:
    """Return whether the standard deviations of reported poses are plausible for robots."""
    # The log-normal prior's upper limit: median times exp(MAX_PRIOR_SIGMAS * spread).
    limits = prior.medians(None) * np.exp(MAX_PRIOR_SIGMAS * prior.log_stds(None))
    return bool(noise.translation <= limits[0] and noise.rotation <= limits[1])


def inflation_reason(noise: Noise | None, without: Noise | None) -> str | None:
    """Return why to leave out a view, from the other views' pose errors with and without it.

    None to keep the view.
    """
    assert noise is not None
    assert without is not None
    for name, unit, unit_scale in (
        ("translation", "mm", 1e3),
        ("rotation", "degrees", float(np.rad2deg(1.0))),
    ):
        before, after = (unit_scale * getattr(each, name) for each in (noise, without))
        if before > MAX_POSE_SIGMA_RATIO * after:
            return (
                f"its pose contradicts the others: with it reported poses err by {before:.3g} "
                f"{unit}, without it by {after:.3g}: mispaired or moved?"
            )
    return None
