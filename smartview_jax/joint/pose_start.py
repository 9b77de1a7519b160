"""Find where a fit to tracked poses starts, and what is wrong with them, by closed forms."""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..calibration import Calibration
from ..cameras import Camera, Pinhole
from ..data_checks import (
    ConventionReport,
    RobotAndCamera,
    check_conventions,
    find_shared_fault,
    listed_views,
)
from ..dataset import MINIMUM_RELIABLE_VIEWS, PoseDataset
from ..engine import ParameterChoice
from ..geometry import PoseLike, host_matrices, host_transforms
from ..hand_eye import solve_hand_eye
from ..robot_errors import RobotPrior
from ..runtime.array_namespace import to_device
from ..runtime.blas_threads import on_one_blas_thread
from ..staged import known_transforms
from .drifting_tracker import LikeliestDrift, likeliest_drift
from .few_pairs import others_are_wrong
from .gross_errors import without_views
from .robust_hand_eye import likeliest_agreement, robust_hand_eye
from .tracker_noise import TrackedChain, TrackerPrior, likeliest_noise, measured_in_metres
from .undetermined import require_moving_robot

MIN_SHARE_WITHOUT_DOUBT = 2.0 / 3.0
"""Share of agreeing pairs below which a mistake in all pairs is asked for, at some cost, and a
warning says that the others are left out."""

NO_CAMERA = Camera(1.0, 1.0, 0.0, 0.0, Pinhole(), (1, 1))
"""The camera of a calibration whose camera nobody stated."""


class PoseStart(NamedTuple):
    """The start of a fit to tracked poses.

    Attributes:
        calibration: near the solution, by closed forms.
        consistent: mask of the pairs that agree with it.
        ambiguities: what makes many pairs wrong together or inaccurate, and what they cannot tell,
            in sentences.
        unit_doubt: difference of the ratio of motions from one, in its standard deviations.
        in_own_unit: whether the tracker's unit turned out to be its own.
        drift: of the tracker in this unit, if it was asked for.
    """

    calibration: Calibration
    consistent: Bool[np.ndarray, "views"]
    ambiguities: tuple[str, ...]
    unit_doubt: float
    in_own_unit: bool = False
    drift: LikeliestDrift | None = None


@on_one_blas_thread
def start_from_poses(data: PoseDataset) -> PoseStart:
    """Return the start of a fit, with no choice of the user's.

    Raises:
        ValueError: as `fit_poses`.
    """
    blank = blank_calibration(data)
    require_moving_robot(data, blank, ParameterChoice.of())
    return start_of_poses(data, blank, None, False, RobotPrior(), TrackerPrior())


def start_of_poses(
    data: PoseDataset,
    blank: Calibration,
    start: Mapping[str, PoseLike] | None,
    scale: bool,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> PoseStart:
    """Return a calibration near the solution, and the pairs that agree with it.

    Args:
        data: the pairs.
        blank: a calibration with the tracker's camera.
        start, scale, robot_prior, tracker_prior: as in `fit_poses`.
    """
    agreement = _agreement(data, blank, scale, robot_prior, tracker_prior)
    ambiguities, unit_doubt = _check_conventions(data, agreement)
    calibration = _step3(data, blank, start, agreement)
    return PoseStart(calibration, agreement.consistent, ambiguities, unit_doubt)


class _Agreement(NamedTuple):
    """The unit and the pairs in which robot and tracker agree.

    Attributes:
        factor: metres in the tracker's unit; one where it is stated.
        consistent: mask of the pairs that agree with one another.
    """

    factor: float
    consistent: Bool[np.ndarray, "views"]


def _agreement(
    data: PoseDataset,
    blank: Calibration,
    scale: bool,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> _Agreement:
    """Return where robot and tracker agree, with the tracker's unit as stated or unknown."""
    poses = host_matrices(data.mount_from_holder), data.tracked_matrices, data.seen
    agreement = _Agreement(*robust_hand_eye(*poses, scale))
    if data.seen.sum() > MINIMUM_RELIABLE_VIEWS:
        return agreement
    found = likeliest_agreement(*poses, scale)
    if found is None:
        return agreement

    def chain_of(pairs: _Agreement) -> TrackedChain:
        others = dict.fromkeys(np.flatnonzero(data.seen & ~pairs.consistent).tolist(), "")
        calibration = _step3(data, blank, None, pairs)
        errors = robot_prior, tracker_prior
        return TrackedChain(without_views(data, others), calibration, scale, *errors)

    of_most = _Agreement(*found)
    return of_most if others_are_wrong(chain_of(of_most), chain_of(agreement)) else agreement


def _many_left_out(data: PoseDataset, agreement: _Agreement) -> tuple[str, ...]:
    """Return that many of the pairs are left out, or some of few, in a sentence."""
    wrong = np.flatnonzero(data.seen & ~agreement.consistent)
    total, rest = int(data.seen.sum()), int(agreement.consistent.sum())
    if total <= MINIMUM_RELIABLE_VIEWS:
        advice = "Measure again: of so few pairs each counts"
    elif rest < MIN_SHARE_WITHOUT_DOUBT * total:
        advice = "Where so many are wrong, the others may be wrong instead"
    else:
        return ()
    if not len(wrong):
        return ()
    names = listed_views([data.view_ids[view] for view in wrong])
    verbs = ("contradicts", "is") if len(wrong) == 1 else ("contradict", "are")
    return (
        f"{names} {verbs[0]} the other {rest} pairs and {verbs[1]} left out: were robot and "
        f"tracker read at the same time, or was another target tracked? {advice}",
    )


def _step3(
    data: PoseDataset,
    blank: Calibration,
    start: Mapping[str, PoseLike] | None,
    agreement: _Agreement,
) -> Calibration:
    """Return the calibration of Step 3 for the pairs that agree, with what is known."""
    given = known_transforms(start, data.mount)
    step3 = solve_hand_eye(
        data.mount_from_holder,
        measured_in_metres(data, agreement.factor),
        weights=agreement.consistent.astype(float),
        start=given,
        camera_on_hand=data.mount == "eye_in_hand",
    )
    return dataclasses.replace(
        blank,
        camera_from_mount=given[0] or step3.camera_from_mount,
        holder_from_world=given[1] or step3.holder_from_world,
        target_scale=to_device(np.array(agreement.factor)),
    )


def start_in_likelier_unit(
    data: PoseDataset,
    blank: Calibration,
    start: Mapping[str, PoseLike] | None,
    given: PoseStart,
    robot_prior: RobotPrior,
    tracker_prior: TrackerPrior,
) -> PoseStart:
    """Return the start with a unit of the tracker's own, or as given, whichever is likelier.

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
    agreement = _agreement(data, blank, True, robot_prior, tracker_prior)
    scaled = _step3(data, blank, start, agreement)
    others = np.flatnonzero(~(given.consistent & agreement.consistent))
    agreeing = without_views(data, dict.fromkeys(others.tolist(), ""))
    stated = TrackedChain(agreeing, given.calibration, False, robot_prior, tracker_prior)
    likelier = _likelier_unit(stated, stated._replace(calibration=scaled, scale=True))
    if likelier is None or not likelier.chain.scale:
        return given._replace(drift=likelier)
    try:
        ambiguities, unit_doubt = _check_conventions(data, agreement)
    except ValueError:
        return given
    size = float(scaled.target_scale)
    text = (
        f"the tracker's unit of length is its own, {size:.3g} m, as of a single moving camera: it "
        "is estimated with the transforms, as scale=True asks"
    )
    return PoseStart(scaled, agreement.consistent, (text, *ambiguities), unit_doubt, True, likelier)


def _check_conventions(data: PoseDataset, agreement: _Agreement) -> tuple[tuple[str, ...], float]:
    """Return in sentences what makes many pairs wrong or inaccurate, and what they cannot tell.

    Returns:
        The sentences, and `PoseStart.unit_doubt`.

    Raises:
        ValueError: robot and tracker do not move alike, with the likeliest mistake.
    """
    camera_from_world = measured_in_metres(data, agreement.factor)
    consistent = agreement.consistent

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
    if fault is not None and (
        report.is_contradicted or (fault.contradicts and fault.divides(consistent))
    ):
        raise ValueError(fault.sentence)
    if report.problems:
        raise ValueError("; ".join(report.problems))
    unit_doubt = abs(report.length_ratio - 1.0) / report.length_ratio_std
    of_views = _many_left_out(data, agreement) if fault is None else (fault.sentence,)
    return of_views + report.doubts, unit_doubt


def blank_calibration(data: PoseDataset) -> Calibration:
    """Return a calibration without a camera, whose transforms are not known yet."""
    identity = host_transforms(np.eye(4))
    return Calibration(NO_CAMERA, identity, identity, data.mount)


def _likelier_unit(given: TrackedChain, scaled: TrackedChain) -> LikeliestDrift | None:
    """Return the drift of the tracker in metres or in a unit of its own, whichever is likelier.

    Returns:
        The drift in the likelier unit; None where this is not asked for.

    Args:
        given, scaled: the same pairs, which agree with the calibrations of both, in metres and in
            a unit of the tracker's own.
    """
    prior = given.robot_prior
    probability, std = prior.wrong_target_probability, prior.wrong_target_scale_std
    if probability == 0.0:
        return None
    as_stated, in_own_unit = _likeliest_drift(given), _likeliest_drift(scaled)
    # Of a steady tracker the joint fit asks whether the target has its stated size.
    if not any(known is not None and known.drift is not None for known in (as_stated, in_own_unit)):
        return as_stated
    if as_stated is None or in_own_unit is None:
        return as_stated or in_own_unit
    # The likelihood is of positions in the tracker's unit, and the size's logarithm is normal.
    size = float(np.log(scaled.calibration.target_scale))
    log_prior = -0.5 * (size / std) ** 2 - np.log(std * np.sqrt(2.0 * np.pi))
    odds = np.log(probability / (1.0 - probability))
    more = 3.0 * np.count_nonzero(given.data.seen) * size + log_prior + odds
    return in_own_unit if in_own_unit.evidence + more > as_stated.evidence else as_stated


def _likeliest_drift(chain: TrackedChain) -> LikeliestDrift | None:
    """Return whether the tracker drifts; None if no chain is found with or without a drift."""
    try:
        return likeliest_drift(chain, likeliest_noise(chain))
    except np.linalg.LinAlgError:
        # In a wrong unit the drift may be so large that the chain is lost in rounding errors.
        return None
