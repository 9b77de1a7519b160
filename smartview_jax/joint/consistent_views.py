"""Fit the views that agree, and leave out each view whose reported pose contradicts the others.

One view is left out at a time: a view rejected by its posterior pose correction or, if all poses
look poor, the view without which the pose standard deviations collapse. Then the noise is estimated
again, since one wrong pose inflates it for all views. A view is left out, not down-weighted: a pose
of another picture has no information.
"""

from typing import NamedTuple

from ..dataset import Dataset
from ..robot_errors import RobotPrior
from .gross_errors import without_views
from .joint_fit import JointFit
from .view_fit import FitOptions, ViewFit, fit_views
from .view_rejection import inconsistent_view, inflation_reason, judging_prior, suspect_view


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
    if (inconsistent := inconsistent_view(data, *fitted)) is not None:
        return dict([inconsistent])
    if (suspect := suspect_view(data, *fitted)) is None:
        return {}
    # One wrong pose inflates the pose standard deviations of all views, so that no view fails the
    # test. Compare the fits with and without the suspect instead.
    without = fit_views(without_views(data, {suspect: ""}), options, robot_prior)
    reason = inflation_reason(fitted.fit.noise, without.fit.noise)
    return {} if reason is None else {suspect: reason}
