"""Estimate how far the poses of cameras are off from objects that each view alone shows elsewhere.

The poses of an object in each view alone differ by their own errors, by the errors of the
calibration with a known covariance, and by errors of the camera poses that nobody stated. The last
ones are a random twist of each view, with one variance for translations and one for rotations.
Their likelihood is restricted: the poses of the objects are unknown, and integrated out (Patterson
and Thompson, "Recovery of inter-block information when block sizes are unequal", 1971).

The rig is as stated, or its camera poses err: as the poses of good arms or, rarely, of weak ones
(`RobotPrior`); where a noise of the robot is stated, by about as much more. Before the pictures
tell, both are equally likely.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from ..geometry import host_exponentials, host_logarithms
from ..modeling import CalibrationUncertainty, SeenViews
from ..robot_errors import RobotPrior

GRID = np.linspace(-2.5, 2.5, 11)
"""Standard deviations of a logarithm at which its distribution is summed."""

LEAST_FREEDOM = 3
"""Smallest number of measurements beyond a pose for which its covariance has an expectation."""

DEFAULT_PRIOR = RobotPrior()
"""How far the poses of arms are off."""


class PoseInView(NamedTuple):
    """The pose of an object as a single view shows it.

    Attributes:
        view: index of the view.
        world_from_object: pose.
        covariance: of the tangent of this pose, translation first, by pictures and model; m, rad.
        by_calibration: derivatives of that tangent by the numbers of the calibration's uncertainty.
        by_camera: derivatives by the twist of the true `camera_from_world` from the given one, in
            the camera frame, translation first.
        freedom: number of measurements beyond the six numbers of the pose.
    """

    view: int
    world_from_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    by_calibration: Float[np.ndarray, "6 numbers"]
    by_camera: Float[np.ndarray, "6 6"]
    freedom: int


class ViewDisagreement(NamedTuple):
    """By how much views disagree about the places of objects, beyond what is stated.

    Attributes:
        as_stated: posterior probability that camera poses have no further errors.
        views: indices of the two views whose relative pose is off most.
        shift, turn: error of the pose of one of them in the other, m and rad.
        excess: largest of the two over what is usual, in standard deviations of a logarithm: 1.28
            is exceeded by one arm in ten. Where a noise is stated, over that noise.
    """

    as_stated: float
    views: tuple[int, int]
    shift: float
    turn: float
    excess: float

    @property
    def is_likely(self) -> bool:
        """Whether there are errors beyond the stated ones, with 95 % probability."""
        return self.as_stated < 0.05

    def is_unusual(self, share: float) -> bool:
        """Return whether a share of all arms have smaller errors."""
        return self.excess > float(ndtri(share))

    @property
    def message(self) -> str:
        """The disagreement in words."""
        first, second = self.views
        return (
            f"views {first} and {second} disagree by {np.degrees(self.turn):.2g} degrees and "
            f"{1e3 * self.shift:.2g} mm: the pose of one of them or the transform between their "
            "cameras is wrong, or the object has another size than its model"
        )


class RigNoise(NamedTuple):
    """The errors of the camera poses, if there are any beyond the stated ones.

    Attributes:
        disagreement: of the views; it says whether there are such errors.
        translation, rotation: standard deviations of each view's error, per axis of the camera, m
            and rad.
        errors: likeliest twists of the true `camera_from_world` from the given ones, in the camera
            frames, translation first.
    """

    disagreement: ViewDisagreement
    translation: float
    rotation: float
    errors: Float[np.ndarray, "views 6"]


def rig_noise(
    objects: Sequence[Sequence[PoseInView]],
    views: SeenViews,
    uncertainty: CalibrationUncertainty,
    prior: RobotPrior = DEFAULT_PRIOR,
) -> RigNoise | None:
    """Return how far the camera poses are off; None where no object shows in two views.

    Args:
        objects: poses of each object in views alone.
        views: cameras and poses.
        uncertainty: of the calibration in these views.
        prior: how far the poses of arms are off.
    """
    usable = [[pose for pose in seen if pose.freedom >= LEAST_FREEDOM] for seen in objects]
    by_object = [_equations(seen, views, uncertainty) for seen in usable if len(seen) > 1]
    if not by_object:
        return None
    residuals, by_errors = (np.concatenate(part) for part in zip(*by_object, strict=True))
    # An orthogonal transform leaves unit noise as it is, and the errors in no more residuals than
    # there are errors: many objects take no more memory than a few.
    orthogonal, triangular = np.linalg.qr(by_errors)
    equations = _Equations(orthogonal.T @ residuals, triangular)
    numbers = len(uncertainty.names)
    medians = _usual_medians(views, uncertainty, prior)
    log_std = float(np.log(prior.group_geometric_std))
    weak = np.array([prior.weak_translation_median, prior.weak_rotation_median])
    is_weak = prior.weak_robot_probability
    grids = [
        _weighted_sizes(medians, log_std, 1.0 - is_weak),
        _weighted_sizes(weak, float(np.log(prior.geometric_std)), is_weak),
    ]
    sizes, log_prior = (np.concatenate(part) for part in zip(*grids, strict=True))
    covariances = _covariances(equations, uncertainty, np.vstack([np.zeros(2), sizes]))
    exact, *likelihoods = _log_likelihoods(equations.residuals, covariances)
    logs = log_prior + likelihoods
    evidence = np.logaddexp.reduce(logs)
    typical = np.sqrt(np.exp(logs - evidence) @ sizes**2)
    (covariance,) = _covariances(equations, uncertainty, typical[None])
    by_views = equations.by_errors[:, numbers:]
    prediction = by_views.T @ np.linalg.solve(covariance, equations.residuals)
    errors = prediction.reshape(-1, 6) * np.repeat(typical**2, 3)
    pair, shift, turn = _largest_relative_error(views, errors, medians)
    # A relative pose has the errors of two views, and each of them three axes.
    ratio = max(np.array([shift, turn]) / (np.sqrt(6.0) * medians))
    disagreement = ViewDisagreement(
        float(np.exp(exact - np.logaddexp(exact, evidence))),
        pair,
        shift,
        turn,
        float(np.log(max(ratio, 1e-9)) / log_std),
    )
    return RigNoise(disagreement, float(typical[0]), float(typical[1]), errors)


class _Equations(NamedTuple):
    """Equations with unit noise about the errors of the calibration and of each view.

    Attributes:
        residuals: measured.
        by_errors: their derivatives by all errors.
    """

    residuals: Float[np.ndarray, "n"]
    by_errors: Float[np.ndarray, "n errors"]


def _equations(
    seen: Sequence[PoseInView], views: SeenViews, uncertainty: CalibrationUncertainty
) -> _Equations:
    """Return what the poses of one object in several views say, whatever its true pose is."""
    numbers = len(uncertainty.names)
    rows = []
    # y = x + Z u + e in each view, with the pose x of the object and the common errors u.
    for pose in seen:
        y = host_logarithms(np.linalg.inv(seen[0].world_from_object) @ pose.world_from_object)
        Z = np.zeros((6, numbers + 6 * len(views.camera_from_world)))
        # The derivatives lead from the pose in this view to the true one, and y the other way.
        Z[:, :numbers] = -pose.by_calibration
        place = numbers + 6 * pose.view
        Z[:, place : place + 6] = -pose.by_camera
        # The covariance is an estimate: the errors have Student's t distribution.
        factor = np.linalg.cholesky(pose.covariance * pose.freedom / (pose.freedom - 2.0))
        rows.append(np.linalg.solve(factor, np.column_stack([np.eye(6), Z, y])))
    # An orthogonal transform leaves the noise as it is, and x only in the first six rows.
    triangular = np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))[6:, 6:]
    return _Equations(triangular[:, -1], triangular[:, :-1])


def _covariances(
    equations: _Equations, uncertainty: CalibrationUncertainty, sizes: Float[np.ndarray, "sizes 2"]
) -> Float[np.ndarray, "sizes n n"]:
    """Return the covariance of the residuals for standard deviations of the camera poses.

    Args:
        equations: from all objects.
        uncertainty: of the calibration.
        sizes: standard deviations along and about the axes of each camera, m and rad.
    """
    n, numbers = len(equations.residuals), len(uncertainty.names)
    B, by_views = np.split(equations.by_errors, [numbers], axis=1)
    stated = np.eye(n) + B @ uncertainty.covariance @ B.T
    shifts, turns = by_views.reshape(n, -1, 2, 3).transpose(2, 0, 1, 3).reshape(2, n, -1)
    parts = np.stack([shifts @ shifts.T, turns @ turns.T])
    return stated + np.tensordot(sizes**2, parts, axes=1)


def _log_likelihoods(
    residuals: Float[np.ndarray, "n"], covariances: Float[np.ndarray, "sizes n n"]
) -> Float[np.ndarray, "sizes"]:
    """Return the restricted log-likelihoods of covariances of residuals, but for a constant."""
    factors = np.linalg.cholesky(covariances)
    whitened = np.linalg.solve(factors, residuals[:, None])[..., 0]
    log_determinants = 2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    return -0.5 * ((whitened**2).sum(axis=1) + log_determinants)


def _usual_medians(
    views: SeenViews, uncertainty: CalibrationUncertainty, prior: RobotPrior
) -> Float[np.ndarray, "2"]:
    """Return typical standard deviations of camera poses beyond the stated ones, m and rad.

    A stated noise of the robot may be too small by some factor. Where none is stated, the errors of
    an arm grow with its way from view to view.
    """
    noise = np.diagonal(uncertainty.covariance)[uncertainty.shared_count :].reshape(-1, 6)
    if len(noise):
        return np.sqrt([noise[:, :3].mean(), noise[:, 3:].mean()])
    way = np.linalg.norm(views.centres[:, None] - views.centres[None], axis=2).max()
    by_way = [prior.group_medians[f"{kind}_by_position"] for kind in ("translation", "rotation")]
    least = np.array([prior.translation_median, prior.rotation_median])
    return np.hypot(least, way * np.array(by_way))


def _weighted_sizes(
    medians: Float[np.ndarray, "2"], log_std: float, probability: float
) -> tuple[Float[np.ndarray, "sizes 2"], Float[np.ndarray, "sizes"]]:
    """Return pairs of log-normal standard deviations, and the logarithms of their probabilities."""
    steps = np.stack(np.meshgrid(GRID, GRID), axis=-1).reshape(-1, 2)
    logs = -0.5 * (steps**2).sum(axis=1)
    logs += np.log(max(probability, 1e-300)) - np.logaddexp.reduce(logs)
    return medians * np.exp(log_std * steps), logs


def _largest_relative_error(
    views: SeenViews, errors: Float[np.ndarray, "views 6"], medians: Float[np.ndarray, "2"]
) -> tuple[tuple[int, int], float, float]:
    """Return the two views whose relative pose is off most, over what is usual; shift and turn."""
    given = views.camera_from_world
    true = host_exponentials(errors) @ given
    ranked = []
    for i, j in combinations(range(len(given)), 2):
        # first_from_second, the true one over the given one.
        relative = [cameras[i] @ np.linalg.inv(cameras[j]) for cameras in (true, given)]
        twist = host_logarithms(relative[0] @ np.linalg.inv(relative[1]))
        sizes = np.linalg.norm(twist.reshape(2, 3), axis=1)
        ranked.append((max(sizes / medians), (i, j), *sizes.tolist()))
    return max(ranked)[1:]
