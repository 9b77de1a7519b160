"""Find out whether the robot's poses lag the pictures by the same part of every move.

A controller that filters its poses, or is asked before the arm has settled, reports a pose between
the previous view's and the picture's own; one that is asked too late reports a pose on the way to
the next view's. Every view is then wrong by a few percent of its move, and no single view looks
wrong. The part is found by the smallest misfit of robot and camera over all views that have a
neighbour on that side, with positions on a straight line between two poses and rotations about one
axis, as arms move from pose to pose. It is named where it is likely, by Schwarz's criterion, and
removes most of the misfit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from ..calibration import mount_from_holder_matrices
from ..geometry import host_matrices
from .changes import ChangeOptions
from .closure import MAX_CLOSURE_SCORE, MAX_CORRECTED_SCORE_RATIO, Poses
from .misfit_evidence import closure_variances, evidence
from .transform_fit import fit_transforms, mean_misfit, median_distance, misfit_text

MIN_VIEWS = 6
"""Smallest number of views in which a lag is looked for: a third of the views may not tell it."""

MAX_FRACTION = 0.3
"""Largest part of a move that is tried. Farther behind they look like poses of other views."""

FRACTION_TOLERANCE = 1e-3
"""Accuracy of the part of a move that is searched for."""

ROUNDS = 8
"""Number of rounds in which poses are corrected. Each leaves a part f / (1 - f) of the error, with
the lag f."""


class PoseLag(NamedTuple):
    """A part of every move by which the robot's poses are not where the pictures were taken.

    Attributes:
        fraction: how far the poses lie behind, as a part of the move from the previous view;
            negative for poses on the way to the next view.
        misfit: mean misfit over the views without the lag, m and rad.
        given_misfit: the same with the poses as given.
        score, given_score: rotation plus translation over the distance to the target, of both.
    """

    fraction: float
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float

    @property
    def contradicts(self) -> bool:
        """Whether the poses are too far from the pictures for any calibration to be right."""
        return self.given_score > MAX_CLOSURE_SCORE

    @property
    def sentence(self) -> str:
        """The lag in words, with the misfit that it explains, and what to do."""
        percent = f"about {100.0 * abs(self.fraction):.2g} % of each move"
        how = (
            f"lag the pictures by {percent}: each lies between the previous view's pose and its own"
            if self.fraction > 0.0
            else f"lead the pictures by {percent}: each lies between its own and the next view's"
        )
        return (
            f"the poses {how}. Without that, robot and camera agree to {misfit_text(self.misfit)} "
            f"instead of {misfit_text(self.given_misfit)} (means over the views). Read the pose "
            "when the arm has settled, with the picture; for pictures taken in motion, give times "
            "and a log of poses"
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
    robot, camera = host_matrices(base_from_tool), host_matrices(camera_from_world)
    # A pose without a picture was on the way as well.
    logged = np.flatnonzero(np.isfinite(robot).all(axis=(1, 2)))
    used = used[logged] & np.isfinite(camera[logged]).all(axis=(1, 2))
    robot, camera = robot[logged], camera[logged]
    robot[:, :3, 3] *= length_ratio
    if used.sum() < MIN_VIEWS:
        return None
    distance = median_distance(camera[used])

    def closure_at(views: np.ndarray, poses: Poses) -> Poses:
        """Return the closure errors of the views with these poses of the tool."""
        holder = mount_from_holder_matrices(mount, poses)[views]
        return fit_transforms(holder, camera[views], np.ones(np.count_nonzero(views), bool)).closure

    if mean_misfit(closure_at(used, robot), distance)[1] < options.min_score:
        return None
    lags = []
    for sign, end in ((1.0, 0), (-1.0, -1)):
        # Nothing is known of the move to the first view, or from the last.
        views = used.copy()
        views[end] = False
        given = closure_at(views, robot)
        given_misfit, given_score = mean_misfit(given, distance)

        def without(fraction: float, views: np.ndarray = views, sign: float = sign) -> Poses:
            """Return the closure errors of the views with a lag removed."""
            return closure_at(views, without_lag(robot, sign * fraction))

        fraction = _least(lambda part: float(np.sum(np.log(closure_variances(without(part))))))
        corrected = without(fraction)
        misfit, score = mean_misfit(corrected, distance)
        is_likely = evidence(closure_variances(given), corrected, 1) > 2.0 * np.log(
            options.min_odds
        )
        if is_likely and score < MAX_CORRECTED_SCORE_RATIO * given_score:
            lags.append(PoseLag(sign * fraction, misfit, given_misfit, score, given_score))
    return min(lags, key=lambda lag: lag.score, default=None)


def without_lag(robot: Poses, fraction: float) -> Poses:
    """Return poses that were logged with a lag where they should have been.

    Args:
        robot: the poses as logged.
        fraction: as in `PoseLag`. The first pose has no previous one and stays, or the last.
    """
    if fraction < 0.0:
        return without_lag(robot[::-1], -fraction)[::-1]
    corrected = robot.copy()
    # logged = previous + (1 - fraction) (true - previous): with the previous poses as logged, then
    # with the better ones.
    stretch = 1.0 / (1.0 - fraction)
    for _ in range(ROUNDS):
        before = corrected[:-1].copy()
        turns = Rotation.from_matrix(before[:, :3, :3].swapaxes(1, 2) @ robot[1:, :3, :3])
        turned = Rotation.from_rotvec(stretch * turns.as_rotvec()).as_matrix()
        corrected[1:, :3, :3] = before[:, :3, :3] @ turned
        corrected[1:, :3, 3] = before[:, :3, 3] + stretch * (robot[1:, :3, 3] - before[:, :3, 3])
    return corrected


def _least(function: Callable[[float], float]) -> float:
    """Return the part of a move for which a function is least."""
    found = minimize_scalar(
        function,
        bounds=(0.0, MAX_FRACTION),
        method="bounded",
        options={"xatol": FRACTION_TOLERANCE},
    )
    return float(found.x)  # pyright: ignore[reportAttributeAccessIssue]
