"""Fit the hand-eye transform to poses that a tracker measured, without pixels.

The measured poses enter the joint fit in the place of the points of the pictures: the same engine,
the same errors of the robot and the same likelihood. The tracker has a noise of its own, whose size
is estimated with the robot's; `tracker_noise` finds the ratios of its parts.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

import smartview_jax as sv

from ..argument_checks import require_instance, require_names
from ..calibration import Calibration
from ..cameras import Camera
from ..data_checks import both_inverted_doubt
from ..dataset import PoseDataset, chain_residuals, repeated_pairs
from ..engine import TARGET_SCALE, ParameterChoice, Prior
from ..geometry import PoseLike, host_matrices, host_transforms
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..staged import check_start
from .chain_covariance import widened_to
from .drifting_tracker import TrackerDrift, tracker_drift, with_uncertain_drift
from .fit import fit_joint
from .fit_text import robot_noise_text
from .gross_errors import without_views
from .joint_fit import JointFit
from .pose_start import blank_calibration, start_in_likelier_unit, start_of_poses
from .robust_hand_eye import chain_errors
from .sensor_error import with_sensor_error
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


@runtime_checkable
class TrackedPoses(Protocol):
    """Pairs of poses, such as `io.PoseSamples` of easy_handeye."""

    @property
    def base_from_tool(self) -> SE3: ...
    @property
    def camera_from_world(self) -> SE3: ...
    @property
    def mount(self) -> str: ...


class PoseFit(JointFit):
    """A joint fit to tracked poses.

    It is a `JointFit` whose `residuals` and `pixel_sigma` are in units of the tracker's noise, and
    whose `problem` and `solution` are without the camera.

    Attributes:
        has_camera: whether the camera of the calibration was given.
        tracker_noise: standard deviation of a tracked pose: translation per axis (m), rotation per
            axis (rad).
        drift: of the tracker; None if it has none. Its poses were fitted without it.
        pose_errors: distance (m) and angle (rad) of each measured pose from its prediction by the
            chain; NaN where the target was not seen.
        data: the pairs of poses, with the noise that was found.
    """

    has_camera: bool = eqx.field(static=True, kw_only=True)
    tracker_noise: tuple[float, float] = eqx.field(static=True, kw_only=True)
    drift: TrackerDrift | None = eqx.field(kw_only=True)
    pose_errors: Float[np.ndarray, "views 2"] = eqx.field(kw_only=True)
    data: PoseDataset = eqx.field(kw_only=True)

    @classmethod
    def of(
        cls, fit: JointFit, data: PoseDataset, has_camera: bool, drift: TrackerDrift | None
    ) -> "PoseFit":
        """Return the fit of tracked poses, given as a joint fit in units of the tracker's noise."""
        values = {field.name: getattr(fit, field.name) for field in dataclasses.fields(JointFit)}
        # Also of the pairs that the fit does not use.
        values["residuals"] = to_device(chain_residuals(fit.calibration, data.observations))
        values |= {"pose_format": data.pose_format, "sensor": data.sensor}
        errors = tracked_pose_errors(data, fit.calibration)
        errors[~data.seen] = np.nan
        translation, rotation = data.typical_noise
        # A drift follows some of the white noise, which the poses without it lack.
        sigma = float(fit.pixel_sigma) if drift is None else 1.0
        if data.sensor is not None:
            values |= with_sensor_error(fit, data)
        return cls(
            **values,
            has_camera=has_camera,
            tracker_noise=(sigma * translation, sigma * rotation),
            drift=drift,
            pose_errors=errors,
            data=data,
        )

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write a page with the result, its errors, its warnings and plots (HTML)."""
        sv.report.write_pose_page(Path(path), self, self.data)

    @property
    def fits_camera(self) -> bool:
        """Whether the camera is fitted and shown: poses contain no information on it."""
        return False

    @property
    def rms(self) -> tuple[float, float]:
        """RMS distance (m) and angle (rad) of the fitted pairs from their predictions."""
        return pose_rms(self.pose_errors[self.used_views])

    @property
    def described(self) -> str:
        """The number of pairs and their errors, in words."""
        distance, angle = self.rms
        return (
            f"joint fit of {self.used_views.sum()} pairs of poses, {1e3 * distance:.3g} mm and "
            f"{np.rad2deg(angle):.3g} deg RMS"
        )

    @property
    def described_noise(self) -> str:
        """The standard deviations of tracked and reported poses in words."""
        translation, rotation = self.tracker_noise
        text = (
            f"tracked poses +- {1e3 * translation:.2g} mm, {np.rad2deg(rotation):.2g} deg"
            f"{'' if self.drift is None else f', drifting by {self.drift.described_steps}'}; "
            f"{robot_noise_text(self)}"
        )
        return text if self.sensor is None else f"{text}\ndepth sensor: {self.sensor.described}"

    def save(self, path: Any, *args: Any, **kwargs: Any) -> None:
        """Write the calibration, as `JointFit.save` does.

        Raises:
            ValueError: the camera was not given, without which a calibration is incomplete.
        """
        if not self.has_camera:
            raise ValueError(
                f"{path}: a calibration has a camera, which poses do not tell: give "
                "fit_poses(camera=...), or use the fit's calibration.camera_from_mount"
            )
        super().save(path, *args, **kwargs)


@on_one_blas_thread
def fit_poses(
    samples: TrackedPoses | PoseDataset,
    *,
    camera: Camera | None = None,
    start: Mapping[str, PoseLike] | None = None,
    scale: bool = False,
    field: FieldChoice = "auto",
    fixed: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    robot_prior: RobotPrior | None = None,
    tracker_prior: TrackerPrior | None = None,
    progress: Callable[[str], None] | None = None,
) -> PoseFit:
    """Fit the hand-eye transform and the target's pose to tracked poses of the target.

    The noise of the tracker and of the robot, and the robot's systematic errors, are estimated as
    in `fit_joint`. Pairs that contradict the others are left out and listed in `rejected`. A
    tracker that drifts, as visual odometry does, is recognised by its evidence; then its drift is
    estimated with the chain, and the covariance allows for it (not with `fixed` or `priors`, nor
    for data with covariances).

    Args:
        samples: at least three pairs of a robot pose and a tracked pose, in the order in which they
            were measured: a `PoseDataset`, or the `PoseSamples` of a file. Where the data set
            states each pose's covariance, poses count by it, and one factor of all covariances is
            estimated.
        camera: the tracker's camera, if the calibration is to be saved; it is not fitted. By
            default the data set's.
        start: transforms that are known roughly, by name, such as
            `{"camera_from_tool": matrix}`; by default from closed forms.
        scale: whether the tracker's unit of length is unknown, as of a single moving camera without
            a target of known size; the fit's `calibration.target_scale` is metres per unit.
        field: the robot error field, as in `fit_joint`.
        fixed: paths of parameters that keep the start's value.
        priors: a `Prior` by path.
        robot_prior: prior on the standard deviations of the robot's errors.
        tracker_prior: prior on the tracker's noises and on its drift; not for data with
            covariances, which state them.
        progress: called with a line of text for each stage.

    Raises:
        TypeError: an argument of a wrong type.
        ValueError: an unknown path or name, too few pairs, a robot that does not move enough, or
            poses of robot and tracker that contradict each other, with the likeliest mistake.

    For example:

        >>> from smartview_jax.dataset import PoseDataset
        >>> tracked = truth.camera_from_world(scene.base_from_tool)
        >>> pairs = PoseDataset.from_poses(data.base_from_tool, tracked)
        >>> x = "camera_from_tool.translation.x"
        >>> print(f"+- {1e3 * sv.fit_poses(pairs).std[x]:.3f} mm")  # doctest: +SKIP
        +- 0.038 mm
    """
    hint = "a PoseDataset, or the PoseSamples of read_easy_handeye"
    require_instance("samples", samples, TrackedPoses, hint)
    require_names("fixed", fixed)
    field, report = checked_field_choice(field), progress or (lambda _: None)
    data = (
        samples
        if isinstance(samples, PoseDataset)
        else PoseDataset.from_poses(
            samples.base_from_tool, samples.camera_from_world, samples.mount
        )
    )
    data = without_views(data, repeated_pairs(data))
    prior = _without_target(robot_prior or RobotPrior(), scale)
    if (count := int(data.seen.sum())) < 3:
        raise ValueError(f"samples: expected at least 3 pairs of poses, found {count}")
    if data.states_covariance and tracker_prior is not None:
        raise ValueError("tracker_prior: the data set states the covariance of each pose already")
    camera = data.camera if camera is None else camera
    # Fitted without it: poses do not tell of a camera, and each size of picture and each lens would
    # be another program.
    blank = blank_calibration(data)
    check_start(start, data)
    choice = ParameterChoice.of(fixed, (TARGET_SCALE,) if scale else (), priors)
    require_moving_robot(data, blank, choice)
    tracker = tracker_prior or TrackerPrior()
    # A drift is estimated with the whole chain.
    may_drift = not (data.states_covariance or fixed or priors)
    begin = start_of_poses(data, blank, start, scale)
    if may_drift and not scale and begin.unit_doubt > MIN_UNIT_DOUBT:
        begin = start_in_likelier_unit(data, blank, start, begin, prior, tracker)
        if begin.in_own_unit:
            scale, prior = True, _without_target(prior, True)
            choice = ParameterChoice.of((), (TARGET_SCALE,), None)
    calibration, consistent, ambiguities = begin.calibration, begin.consistent, begin.ambiguities
    report(f"start: {consistent.sum()} of {len(data.usable_views())} pairs agree")

    def chain_of(used: PoseDataset) -> TrackedChain:
        """Return the chain of transforms for some pairs."""
        return TrackedChain(used, calibration, scale, prior, tracker)

    def fit_consistent() -> tuple[PoseDataset, JointFit, TrackerNoise | None, TrackerDrift | None]:
        """Return the pairs that agree, the fit to them, and the tracker's noise and drift."""
        used = without_views(data, _contradictions(data, calibration, consistent))
        noise = drift = None
        if not data.states_covariance:
            chain = chain_of(used)
            known = begin.drift if begin.drift is not None and begin.drift.is_of(chain) else None
            noise = likeliest_noise(chain) if known is None else known.noise
            if may_drift:
                drift = tracker_drift(chain, noise, known)
            if drift is not None:
                without = host_transforms(drift.camera_from_world)
                used = dataclasses.replace(used, camera_from_world=without)
            covariance = noise.covariance if drift is None else drift.covariance
            used = with_noise(used, covariance, float(calibration.target_scale))
        fit = fit_joint(
            used,
            calibration,
            field=field,
            robot_prior=prior,
            gross_errors="leave_out",
            progress=progress,
            **choice.holding("camera")._asdict(),
        )
        return used, fit, noise, drift

    used, fit, noise, drift = fit_consistent()
    for _ in range(MAX_ROUNDS - 1):
        again = _consistent_again(used, fit, data.seen) & ~consistent
        if not again.any():
            break
        consistent = consistent | again
        used, fit, noise, drift = fit_consistent()
    if drift is not None:
        fit = with_uncertain_drift(fit, drift)
    elif noise is not None and not (fixed or priors):
        fit = _with_uncertain_noise(fit, chain_of(used), noise)
    doubts = (*ambiguities, *_doubt_of_direction(data, fit.calibration, start, priors))
    fit = dataclasses.replace(fit, warnings=(*doubts, *fit.warnings))
    covariance = used.covariance
    if drift is not None:
        scaled = in_tracker_units(drift.covariance, float(calibration.target_scale))
        covariance = to_device(scaled)
    data = dataclasses.replace(data, covariance=covariance)
    fit = PoseFit.of(fit, data, camera is not None, drift)
    if camera is None:
        return fit
    calibration, begun_at = (
        dataclasses.replace(each, camera=camera) for each in (fit.calibration, fit.start)
    )
    return dataclasses.replace(fit, calibration=calibration, start=begun_at)


def _with_uncertain_noise(fit: JointFit, chain: TrackedChain, noise: TrackerNoise) -> JointFit:
    """Return the fit, which takes the ratios of noises as known, with a covariance over all sizes.

    Args:
        fit: the fit.
        chain: the pairs that it was given.
        noise: as they tell it.
    """
    rejected = {rejection.view for rejection in fit.rejected}
    data = chain.data
    wrong = {int(k): "" for k in np.flatnonzero(data.seen) if data.view_ids[k] in rejected}
    if wrong:
        # Pairs that contradict the others make the noise look larger.
        noise = likeliest_noise(chain._replace(data=without_views(data, wrong)))
    return widened_to(fit, noise.chain_covariance())


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


def _without_target(prior: RobotPrior, scale: bool) -> RobotPrior:
    """Return the prior without a target's shape and a lens, which tracked poses do not have."""
    return dataclasses.replace(
        prior,
        target_bow_median=0.0,
        target_print_median=0.0,
        wrong_lens_probability=0.0,
        wrong_target_probability=0.0 if scale else prior.wrong_target_probability,
    )


def _doubt_of_direction(
    data: PoseDataset,
    calibration: Calibration,
    start: Mapping[str, PoseLike] | None,
    priors: Mapping[str, Prior] | None,
) -> tuple[str, ...]:
    """Return a sentence if robot and tracked poses are likely both inverted.

    A depth sensor's poses are the library's own, and a start or a prior says where camera or target
    are.
    """
    is_placed = any(path.startswith(calibration.transform_names) for path in priors or ())
    if start or is_placed or data.sensor is not None:
        return ()
    mount_from_camera = np.linalg.inv(host_matrices(calibration.camera_from_mount))
    holder_from_world = host_matrices(calibration.holder_from_world)
    positions = host_matrices(data.base_from_tool)[data.seen][:, :3, 3]
    tool_distance = float(np.median(np.linalg.norm(positions, axis=1)))
    in_hand = data.mount == "eye_in_hand"
    doubt = both_inverted_doubt(mount_from_camera, holder_from_world, tool_distance, in_hand)
    return (doubt,) if doubt else ()


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
