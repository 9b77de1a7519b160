"""Find the view whose reported pose contradicts the other views, after a joint fit.

A view is rejected by its posterior pose correction. But one wrong pose may inflate the estimated
pose standard deviations so much that no view fails the test: then the fits with and without the
most suspect view are compared.
"""

import dataclasses

import numpy as np

from ..dataset import MINIMUM_RELIABLE_VIEWS, Dataset
from ..engine import BlockArrow, Noise
from ..robot_errors import RobotPrior
from .influence import pose_outlier_test
from .joint_fit import JointFit
from .plausibility import MAX_PRIOR_SIGMAS

FALSE_ALARM_PROBABILITY = 1e-6
"""The family-wise significance level, over all views, at which a view is left out.

It is far below the usual level because real robots' errors have longer tails than the normal
distribution.
"""

MAX_POSE_SIGMA_RATIO = 3.0
"""The ratio of pose standard deviations with and without a view above which its pose is wrong."""


def inconsistent_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> tuple[int, str] | None:
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


def suspect_view(data: Dataset, fit: JointFit, matrix: BlockArrow) -> int | None:
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
