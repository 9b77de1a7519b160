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
from jaxtyping import Float

import smartview_jax as sv

from ..argument_checks import require_instance, require_names
from ..calibration import Calibration
from ..cameras import Camera
from ..data_checks import both_inverted_doubt
from ..dataset import PoseDataset, chain_residuals, repeated_pairs
from ..engine import TARGET_SCALE, ParameterChoice, Prior
from ..geometry import PoseLike, host_matrices
from ..robot_errors import FieldChoice, RobotPrior, checked_field_choice
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..runtime.modules import fields_of
from .drifting_tracker import TrackerDrift
from .fit_text import robot_noise_text
from .fitted_depth_sensor import with_sensor_error
from .gross_errors import without_views
from .joint_fit import JointFit
from .pose_rounds import PoseFitOptions, PoseRounds, pose_rms, tracked_pose_errors
from .tracker_noise import TrackerPrior


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
        values = fields_of(fit, JointFit)
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
    data = _as_pairs(samples)
    for path in priors or ():
        if path.split(".")[0] == "camera":
            raise ValueError(f"prior on {path!r}: tracked poses have no camera that is fitted")
    if (count := int(data.seen.sum())) < 3:
        raise ValueError(f"samples: expected at least 3 pairs of poses, found {count}")
    if data.states_covariance and tracker_prior is not None:
        raise ValueError("tracker_prior: the data set states the covariance of each pose already")
    options = PoseFitOptions(
        scale,
        ParameterChoice.of(fixed, (TARGET_SCALE,) if scale else (), priors),
        robot_prior or RobotPrior(),
        tracker_prior or TrackerPrior(),
        field,
        progress,
    )
    rounds = PoseRounds.of(data, start, options)
    agreeing = rounds.start.consistent.sum()
    report(f"start: {agreeing} of {len(data.usable_views())} pairs agree")
    found = rounds.fitted()
    fit = rounds.with_uncertain_noise(found)
    doubts = (*rounds.start.ambiguities, *_doubt_of_direction(data, fit.calibration, start, priors))
    fit = dataclasses.replace(fit, warnings=(*doubts, *fit.warnings))
    data = dataclasses.replace(data, covariance=rounds.covariance_of_poses(found))
    camera = data.camera if camera is None else camera
    fit = PoseFit.of(fit, data, camera is not None, found.drift)
    if camera is None:
        return fit
    calibration, begun_at = (
        dataclasses.replace(each, camera=camera) for each in (fit.calibration, fit.start)
    )
    return dataclasses.replace(fit, calibration=calibration, start=begun_at)


def _as_pairs(samples: TrackedPoses | PoseDataset) -> PoseDataset:
    """Return samples as a data set, without pairs that repeat others."""
    data = (
        samples
        if isinstance(samples, PoseDataset)
        else PoseDataset.from_poses(
            samples.base_from_tool, samples.camera_from_world, samples.mount
        )
    )
    return without_views(data, repeated_pairs(data))


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
