"""Find out whether the robot's poses lag the camera's by the same part of every move.

A controller that filters its poses, or is asked before the arm has settled, reports a pose between
the previous view's and its own; one that is asked too late reports a pose on the way to the next
view's. Every view is then wrong by a few percent of its move, and no single view looks wrong. The
likeliest part is fitted with the chain (`lag_fit.py`), with positions on a straight line between
two poses and rotations about one axis, as arms move from pose to pose. The question is the same for
pictures and for tracked poses.

The first step from no lag answers it for most data: where it is not larger than twice its own
standard deviation, nothing else is computed.
"""

from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool

from ..calibration import ONE_ARM_MOUNTS
from ..geometry import host_matrices
from .changes import ChangeOptions
from .closure import MAX_CLOSURE_SCORE
from .lag_fit import MAX_FRACTION, LagFit, LaggingViews
from .misfit_evidence import evidence
from .transform_fit import mean_misfit, mean_size, median_distance, misfit_text

MIN_VIEWS = 6
"""Smallest number of views in which a lag is looked for: a third of the views may not tell it."""

MIN_STEP = 2.0
"""Smallest first step from no lag, in its own standard deviations, after which a lag is fitted."""

MAX_CORRECTED_RATIO = 0.5
"""Largest ratio of the misfit without the lag to the given one with which a lag is named.

An error that is linear in the pose, such as a wrong scale, resembles a lag: of independent poses
half of the variance of a move is the variance of its end. A lag fitted to such an error leaves 0.71
of it.
"""


class PoseLag(NamedTuple):
    """A part of every move by which the robot's poses are not where the camera's were measured.

    Attributes:
        fraction: how far the poses lie behind, as a part of the move from the previous view;
            negative for poses on the way to the next view.
        std: its standard deviation.
        misfit: mean misfit over the views without the lag, m and rad.
        given_misfit: the same with the poses as given.
        score, given_score: rotation plus translation over the distance to the target, of both.
        evidence: difference of Schwarz's criterion, with the poses as given minus without the lag:
            twice the logarithm of the odds of the lag.
    """

    fraction: float
    std: float
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float
    evidence: float

    @property
    def contradicts(self) -> bool:
        """Whether the poses are too far from the camera's for any calibration to be right."""
        return self.given_score > MAX_CLOSURE_SCORE

    def sentence(self, tracked: bool = False) -> str:
        """Return in words the lag, the misfit that it explains, and what to do.

        Args:
            tracked: whether a tracker gave the camera's poses, without pictures.
        """
        size, std = 100.0 * abs(self.fraction), 100.0 * self.std
        part = f"about {size:.2g} +- {std:.1g} % of each move"
        whose, measured = ("robot's ", "tracked pose") if tracked else ("", "picture")
        how = (
            f"lag the {measured}s by {part}: each lies between the previous view's pose and its own"
            if self.fraction > 0.0
            else f"lead the {measured}s by {part}: each lies between its own and the next view's"
        )
        return (
            f"the {whose}poses {how}. Without that, robot and camera agree to "
            f"{misfit_text(self.misfit)} instead of {misfit_text(self.given_misfit)} (means over "
            f"the views). Read the pose when the arm has settled, with the {measured}; for "
            f"{measured}s taken in motion, give times and a log of poses"
        )


def find_lag(
    base_from_tool: SE3,
    camera_from_world: SE3,
    used: Bool[np.ndarray, "views"],
    mount: str,
    length_ratio: float = 1.0,
    options: ChangeOptions | None = None,
) -> PoseLag | None:
    """Return the lag of the poses that explains most of the misfit of robot and camera, if any.

    Args:
        base_from_tool: as reported, `(views)`, in the order in which the views were taken.
        camera_from_world: from the pictures alone, `(views)`.
        used: mask of the views to use.
        mount: where the camera is stated to be.
        length_ratio: of the camera's motion to the robot's, as in `find_change`.
        options: the odds and the misfit from which a fault is looked for.
    """
    options = options or ChangeOptions()
    # Between two hands that both move, no pose is on a straight way.
    if mount not in ONE_ARM_MOUNTS:
        return None
    robot, camera = host_matrices(base_from_tool), host_matrices(camera_from_world)
    # A pose without a picture was on the way as well.
    logged = np.flatnonzero(np.isfinite(robot).all(axis=(1, 2)))
    used = used[logged] & np.isfinite(camera[logged]).all(axis=(1, 2))
    robot, camera = robot[logged], camera[logged]
    robot[:, :3, 3] *= length_ratio
    if used.sum() < MIN_VIEWS:
        return None
    distance = median_distance(camera[used])
    lags = []
    for direction, end in ((1.0, 0), (-1.0, -1)):
        # Nothing is known of the move to the first view, or from the last.
        views = used.copy()
        views[end] = False
        data = LaggingViews(robot, camera, views, mount, direction)
        fit = LagFit(data)
        if mean_misfit(fit.closure, distance)[1] < options.min_score:
            continue
        first = fit.step()
        if not first.fraction > MIN_STEP * first.std:
            continue
        fraction, std, errors, errors_without = fit.likeliest(first)
        # Where they are likelier, as for the other faults.
        misfit, score = mean_size(errors.reshape(-1, 6), distance)
        given_misfit, given_score = mean_size(errors_without.reshape(-1, 6), distance)
        odds = evidence(errors_without, errors, 1)
        if (
            odds > 2.0 * np.log(options.min_odds)
            and score < MAX_CORRECTED_RATIO * given_score
            and abs(fraction) < MAX_FRACTION
        ):
            scores = misfit, given_misfit, score, given_score, odds
            lags.append(PoseLag(direction * fraction, std, *scores))
    return min(lags, key=lambda lag: lag.score, default=None)
