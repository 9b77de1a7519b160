"""Find where a fit to tracked poses starts, and what is wrong with them, by closed forms."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration import Calibration, host_mount_from_holder
from ..cameras import Camera, Pinhole
from ..data_checks import (
    ConventionReport,
    RobotAndCamera,
    check_conventions,
    find_shared_fault,
)
from ..dataset import PoseDataset
from ..engine import ParameterChoice
from ..geometry import PoseLike, host_matrices, host_transforms
from ..hand_eye import solve_hand_eye
from ..robot_errors import RobotPrior
from ..runtime.array_namespace import to_device
from ..staged import known_transforms
from .drifting_tracker import likeliest_drift
from .gross_errors import without_views
from .robust_hand_eye import robust_hand_eye
from .tracker_noise import TrackedChain, TrackerPrior, likeliest_noise
from .undetermined import require_moving_robot

MIN_SHARE_WITHOUT_DOUBT = 2.0 / 3.0
"""Share of agreeing pairs below which a mistake in all pairs is asked for, at some cost."""

NO_CAMERA = Camera(1.0, 1.0, 0.0, 0.0, Pinhole(), (1, 1))
"""The camera of a calibration whose camera nobody stated."""


class PoseStart(NamedTuple):
    """The start of a fit to tracked poses.

    Attributes:
        calibration: near the solution, by closed forms.
        consistent: mask of the pairs that agree with it.
        ambiguities: what makes many pairs wrong together, and what they cannot tell, in sentences.
        unit_doubt: difference of the ratio of motions from one, in its standard deviations.
    """

    calibration: Calibration
    consistent: Bool[np.ndarray, "views"]
    ambiguities: tuple[str, ...]
    unit_doubt: float


def start_from_poses(data: PoseDataset) -> PoseStart:
    """Return the start of a fit, with no choice of the user's.

    Raises:
        ValueError: as `fit_poses`.
    """
    blank = blank_calibration(data, None)
    require_moving_robot(data, blank, ParameterChoice.of())
    return start_of_poses(data, blank, None, False)


def start_of_poses(
    data: PoseDataset, blank: Calibration, start: Mapping[str, PoseLike] | None, scale: bool
) -> PoseStart:
    """Return a calibration near the solution, and the pairs that agree with it.

    Args:
        data: the pairs.
        blank: a calibration with the tracker's camera.
        start, scale: as in `fit_poses`.
    """
    mount_from_holder = host_matrices(host_mount_from_holder(data.mount, data.base_from_tool))
    measured = data.tracked_matrices
    factor, consistent = robust_hand_eye(mount_from_holder, measured, data.seen, scale)
    measured = measured.copy()
    measured[:, :3, 3] *= factor
    ambiguities, unit_doubt = _check_conventions(data, measured, consistent)
    given = known_transforms(start, data.mount)
    step3 = solve_hand_eye(
        host_transforms(mount_from_holder),
        host_transforms(measured),
        weights=consistent.astype(float),
        start=given,
        camera_on_hand=data.mount == "eye_in_hand",
    )
    found = dataclasses.replace(
        blank,
        camera_from_mount=given[0] or step3.camera_from_mount,
        holder_from_world=given[1] or step3.holder_from_world,
        target_scale=to_device(np.array(factor)),
    )
    return PoseStart(found, consistent, ambiguities, unit_doubt)


def start_in_own_unit(
    data: PoseDataset,
    blank: Calibration,
    start: Mapping[str, PoseLike] | None,
    given: PoseStart,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> PoseStart | None:
    """Return the start with a unit of the tracker's own, if the poses are rather in one.

    The positions of a single moving camera have an unknown unit. Measured against a robot in metres
    they go astray more and more, as with a tracker that drifts, and a drift that is estimated
    absorbs most of it: robot and tracker then seem to agree, with a camera far from its place. So
    both models are compared by their evidence, with the prior of a target of another size.

    Args:
        data: the pairs in the order in which they were measured.
        blank, start: as in `start_of_poses`.
        given: the start with the tracker's unit as stated.
        robot_prior, tracker_prior: as in `fit_poses`.
    """
    try:
        scaled = start_of_poses(data, blank, start, True)
    except ValueError:
        return None
    others = np.flatnonzero(~(given.consistent & scaled.consistent))
    agreeing = without_views(data, dict.fromkeys(others.tolist(), ""))
    chain = TrackedChain(agreeing, given.calibration, False, robot_prior, tracker_prior)
    if not _has_own_unit(chain, chain._replace(calibration=scaled.calibration, scale=True)):
        return None
    size = float(scaled.calibration.target_scale)
    text = (
        f"the tracker's unit of length is its own, {size:.3g} m, as of a single moving camera: it "
        "is estimated with the transforms, as scale=True asks"
    )
    return scaled._replace(ambiguities=(text, *scaled.ambiguities))


def _check_conventions(
    data: PoseDataset,
    measured: Float[np.ndarray, "views 4 4"],
    consistent: Bool[np.ndarray, "views"],
) -> tuple[tuple[str, ...], float]:
    """Return in sentences what makes many pairs wrong together, and what they cannot tell.

    Returns:
        The sentences, and `PoseStart.unit_doubt`.

    Raises:
        ValueError: robot and tracker do not move alike, with the likeliest mistake.
    """
    camera_from_world = host_transforms(measured)

    def report_on(views: Bool[np.ndarray, "views"]) -> ConventionReport:
        return check_conventions(
            data.base_from_tool,
            camera_from_world,
            data.mount,
            views.astype(float),
            view_ids=data.view_ids,
            tracked=True,
        )

    # With a mistake in all pairs some agree by chance.
    if consistent.sum() < MIN_SHARE_WITHOUT_DOUBT * data.seen.sum():
        everything = report_on(data.seen)
        if everything.explained:
            raise ValueError("; ".join(everything.problems))
    report = report_on(consistent)
    if report.problems and report.explained:
        raise ValueError("; ".join(report.problems))
    poses = RobotAndCamera(
        data.base_from_tool,
        camera_from_world,
        data.mount,
        data.view_ids,
        report.length_ratio,
        tracked=True,
        # Trackers drift, whose poses then change or bend in part; depth sensors do not.
        drifts=data.sensor is None,
    )
    fault = find_shared_fault(poses, data.seen, consistent)
    if fault is not None and poses.drifts and not fault.explains_most:
        fault = None
    if fault is not None and (report.problems or (fault.contradicts and fault.divides(consistent))):
        raise ValueError(fault.sentence)
    if report.problems:
        raise ValueError("; ".join(report.problems))
    unit_doubt = abs(report.length_ratio - 1.0) / report.length_ratio_std
    return (() if fault is None else (fault.sentence,)) + report.ambiguities, unit_doubt


def blank_calibration(data: PoseDataset, camera: Camera | None) -> Calibration:
    """Return a calibration whose transforms are not known yet."""
    identity = host_transforms(np.eye(4))
    return Calibration(camera or NO_CAMERA, identity, identity, data.mount)


def _has_own_unit(given: TrackedChain, scaled: TrackedChain) -> bool:
    """Return whether the tracker's unit is rather its own than the metre.

    The pairs agree with the calibrations of both, in metres and in a unit of the tracker's own.
    """
    prior = given.robot_prior
    probability, std = prior.wrong_target_probability, prior.wrong_target_scale_std
    if probability == 0.0:
        return False
    drifts, in_metres = _drift_and_evidence(given)
    drifts_in_own_unit, in_own_unit = _drift_and_evidence(scaled)
    # Of a steady tracker the joint fit asks whether the target has its stated size.
    if not (drifts or drifts_in_own_unit):
        return False
    # The likelihood is of positions in the tracker's unit, and the size's logarithm is normal.
    size = float(np.log(scaled.calibration.target_scale))
    in_own_unit += 3.0 * np.count_nonzero(given.data.seen) * size
    log_prior = -0.5 * (size / std) ** 2 - np.log(std * np.sqrt(2.0 * np.pi))
    odds = np.log(probability / (1.0 - probability))
    return bool(in_own_unit + log_prior + odds > in_metres)


def _drift_and_evidence(chain: TrackedChain) -> tuple[bool, float]:
    """Return whether the tracker drifts, and the logarithm of the likelier answer's evidence."""
    try:
        drift, evidence = likeliest_drift(chain, likeliest_noise(chain))
    except np.linalg.LinAlgError:
        # In a wrong unit the drift may be so large that the chain is lost in rounding errors.
        return False, -np.inf
    return drift is not None, evidence
