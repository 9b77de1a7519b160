"""Fit tracked poses in rounds: first the pairs that agree, then also those that fit them."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..dataset import PoseDataset
from ..engine import TARGET_SCALE, ParameterChoice
from ..geometry import PoseLike, host_transforms
from ..robot_errors import FieldChoice, RobotPrior
from ..runtime.array_namespace import to_device
from ..staged import check_start
from .chain_covariance import widened_to
from .drifting_tracker import TrackerDrift, tracker_drift, with_uncertain_drift
from .fit import fit_joint
from .gross_errors import without_views
from .joint_fit import JointFit
from .pose_start import PoseStart, blank_calibration, start_in_likelier_unit, start_of_poses
from .robust_hand_eye import chain_errors
from .tracker_noise import (
    TrackedChain,
    TrackerNoise,
    TrackerPrior,
    in_tracker_units,
    likeliest_noise,
    with_noise,
)
from .undetermined import require_moving_robot

MAX_ROUNDS = 3
"""Largest number of fits after which views that fit again are taken back."""

CONSISTENT_ERROR = 3.5
"""Largest error of a view that is taken back, over the root mean square of the used views' errors.

Of a normal distribution in three dimensions, one error in two million is larger.
"""

MIN_UNIT_DOUBT = 3.0
"""Smallest difference of the ratio of motions from one, in its standard deviations, from which a
unit of the tracker's own is considered. It saves time: the evidence decides."""


class PosesFitted(NamedTuple):
    """The result of a round.

    Attributes:
        used: the pairs that agree, without the tracker's drift, and with its noise.
        fit: the joint fit to them.
        noise: the tracker's white noise; None if the data state the covariance of each pose.
        drift: the tracker's drift; None if it has none.
    """

    used: PoseDataset
    fit: JointFit
    noise: TrackerNoise | None
    drift: TrackerDrift | None


class PoseFitOptions(NamedTuple):
    """The options of a fit to tracked poses.

    Attributes:
        scale: whether the tracker's unit of length is fitted.
        choice: parameters to hold and to free, and priors.
        robot_prior, tracker_prior: priors on the errors, as of `fit_poses`.
        field: robot error field.
        progress: called with a line of text for each stage.
    """

    scale: bool
    choice: ParameterChoice
    robot_prior: RobotPrior
    tracker_prior: TrackerPrior
    field: FieldChoice
    progress: Callable[[str], None] | None

    def fitting_scale(self) -> "PoseFitOptions":
        """Return the options of a fit of the tracker's unit of length, too."""
        return self._replace(scale=True, choice=self.choice.freeing(TARGET_SCALE))

    def without_target(self) -> "PoseFitOptions":
        """Return the options without a target's shape and a lens, which tracked poses lack."""
        wrong_target = 0.0 if self.scale else self.robot_prior.wrong_target_probability
        prior = dataclasses.replace(
            self.robot_prior,
            target_bow_median=0.0,
            target_print_median=0.0,
            wrong_lens_probability=0.0,
            wrong_target_probability=wrong_target,
        )
        return self._replace(robot_prior=prior)


class PoseRounds(NamedTuple):
    """The pairs of poses, the start, and the options: what the rounds of a fit have in common.

    Attributes:
        data: all pairs.
        start: calibration near the solution, with the pairs that agree there.
        may_drift: whether a drift is considered, which is estimated with the whole chain.
        options: the options of the fit.
    """

    data: PoseDataset
    start: PoseStart
    may_drift: bool
    options: PoseFitOptions

    @classmethod
    def of(
        cls, data: PoseDataset, start: Mapping[str, PoseLike] | None, options: PoseFitOptions
    ) -> "PoseRounds":
        """Return the rounds of a fit, with the start that its options ask for.

        Raises:
            ValueError: see `fit_poses`.
        """
        options = options.without_target()
        # Fitted without the camera: poses do not tell of it, and each size of picture and each lens
        # would be another program.
        blank = blank_calibration(data)
        check_start(start, data)
        scale, choice = options.scale, options.choice
        require_moving_robot(data, blank, choice)
        may_drift = not (data.states_covariance or choice.fixed or choice.priors)
        errors = options.robot_prior, options.tracker_prior
        begin = start_of_poses(data, blank, start, scale, *errors)
        if may_drift and not scale and begin.unit_doubt > MIN_UNIT_DOUBT:
            begin = start_in_likelier_unit(data, blank, start, begin, *errors)
            if begin.in_own_unit:
                options = options.fitting_scale().without_target()
        return cls(data, begin, may_drift, options)

    @property
    def factor(self) -> float:
        """Metres in the tracker's unit of length, at the start."""
        return float(self.start.calibration.target_scale)

    def fitted(self) -> PosesFitted:
        """Return the fit to all pairs that agree with it, as far as they are found."""
        consistent = self.start.consistent
        found = self._fitted_to(consistent)
        for _ in range(MAX_ROUNDS - 1):
            again = _consistent_again(found.used, found.fit, self.data.seen) & ~consistent
            if not again.any():
                break
            consistent = consistent | again
            found = self._fitted_to(consistent)
        return found

    def with_uncertain_noise(self, found: PosesFitted) -> JointFit:
        """Return the fit with a covariance over all drifts, or over all sizes of the noises.

        The fit itself takes the drift and the ratios of noises as known.
        """
        fit, data = found.fit, found.used
        if found.drift is not None:
            return with_uncertain_drift(fit, found.drift)
        if found.noise is None or not self.may_drift:
            return fit
        noise, rejected = found.noise, {rejection.view for rejection in fit.rejected}
        wrong = {int(k): "" for k in np.flatnonzero(data.seen) if data.view_ids[k] in rejected}
        if wrong:
            # Pairs that contradict the others make the noise look larger.
            noise = likeliest_noise(self._chain(without_views(data, wrong)))
        return widened_to(fit, noise.chain_covariance())

    def covariance_of_poses(self, found: PosesFitted) -> Float[Array, "views 6 6"] | None:
        """Return the covariance of all tracked poses by the noise that was found."""
        if found.drift is None:
            return found.used.covariance
        return to_device(in_tracker_units(found.drift.covariance, self.factor))

    def _chain(self, used: PoseDataset) -> TrackedChain:
        """Return the chain of transforms for some pairs."""
        options = self.options
        errors = options.robot_prior, options.tracker_prior
        return TrackedChain(used, self.start.calibration, options.scale, *errors)

    def _fitted_to(self, consistent: Bool[np.ndarray, "views"]) -> PosesFitted:
        """Return the fit to the pairs that agree."""
        data, calibration = self.data, self.start.calibration
        used = without_views(data, _contradictions(data, calibration, consistent))
        noise = drift = None
        if not data.states_covariance:
            chain, known = self._chain(used), self.start.drift
            known = known if known is not None and known.is_of(chain) else None
            noise = likeliest_noise(chain) if known is None else known.noise
            if self.may_drift:
                drift = tracker_drift(chain, noise, known)
            if drift is not None:
                without = host_transforms(drift.camera_from_world)
                used = dataclasses.replace(used, camera_from_world=without)
            covariance = noise.covariance if drift is None else drift.covariance
            used = with_noise(used, covariance, self.factor)
        options = self.options
        fit = fit_joint(
            used,
            calibration,
            field=options.field,
            robot_prior=options.robot_prior,
            gross_errors="leave_out",
            progress=options.progress,
            **options.choice.holding("camera")._asdict(),
        )
        return PosesFitted(used, fit, noise, drift)


def tracked_pose_errors(
    data: PoseDataset, calibration: Calibration
) -> Float[np.ndarray, "views 2"]:
    """Return the distance (m) and angle (rad) of each tracked pose from its prediction."""
    measured = data.tracked_matrices.copy()
    measured[:, :3, 3] *= float(calibration.target_scale)
    predicted = np.asarray(calibration.camera_from_world_matrices(data.command))
    return chain_errors(measured, predicted)


def pose_rms(errors: Float[np.ndarray, "views 2"]) -> tuple[float, float]:
    """Return the RMS distance (m) and angle (rad) of some errors."""
    distance, angle = np.sqrt(np.mean(errors**2, axis=0))
    return float(distance), float(angle)


def _contradictions(
    data: PoseDataset, calibration: Calibration, consistent: Bool[np.ndarray, "views"]
) -> dict[int, str]:
    """Return the pairs that are left out from the start, with the reason."""
    errors = tracked_pose_errors(data, calibration)
    return {
        int(view): (
            f"{1e3 * errors[view, 0]:.3g} mm and {np.rad2deg(errors[view, 1]):.3g} degrees from "
            "where the other pairs put it: mispaired, or another target?"
        )
        for view in np.flatnonzero(data.seen & ~consistent)
    }


def _consistent_again(
    data: PoseDataset, fit: JointFit, seen: Bool[np.ndarray, "views"]
) -> Bool[np.ndarray, "views"]:
    """Return the pairs that agree with a fit to some of them, among all that were seen."""
    errors = tracked_pose_errors(data, fit.calibration)
    typical = np.array(pose_rms(errors[fit.used_views]))
    return seen & (errors <= CONSISTENT_ERROR * typical).all(axis=1)
