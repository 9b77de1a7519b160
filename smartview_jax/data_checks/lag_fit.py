"""Fit both transforms of the chain together with a part of every move by which the poses lag.

The closure of a view is linear in small twists of the transforms and nearly linear in the lag, so a
few Gauss-Newton steps fit all of them. The standard deviations of translation and rotation are
estimated with them. Errors are independent at the tool if the robot makes them, and at the target
if a tracker or the pictures do; of these two models the likelier one counts.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..calibration import mount_from_holder_matrices
from ..dataset import undetermined_twists
from ..geometry import host_adjoints, host_cross_matrices, host_exponentials, host_logarithms
from ..hand_eye import determined_steps
from .closure import Poses
from .misfit_evidence import error_variances, in_parts
from .transform_fit import fit_transforms

MAX_FRACTION = 0.3
"""Largest part of a move that is tried. Farther behind they look like poses of other views."""

CORRECTION_ROUNDS = 8
"""Number of rounds in which poses are corrected. Each leaves a part f / (1 - f) of the error, with
the lag f."""

DIFFERENCE = 1e-4
"""Part of a move over which the change of the closures with the lag is taken."""

MAX_STEPS, STEP_TOLERANCE = 12, 1e-5
"""Largest number of Gauss-Newton steps, and the step of the lag that ends them."""

NOISE_ROUNDS = 3
"""Number of rounds in which a step and the standard deviations are estimated in turn."""


class LaggingViews(NamedTuple):
    """Views whose poses may lag.

    Attributes:
        robot: `base_from_tool` of all views with a pose, in the order in which they were taken.
        camera: `camera_from_world` of them.
        views: mask of the views to fit.
        mount: where the camera is stated to be.
        direction: 1.0 for poses that may lie behind, -1.0 for poses that may lie ahead.
    """

    robot: Poses
    camera: Poses
    views: Bool[np.ndarray, "views"]
    mount: str
    direction: float

    def mount_from_holder(self, fraction: float) -> Poses:
        """Return the robot's part of the chain of the views to fit, with a lag removed."""
        poses = without_lag(self.robot, self.direction * fraction)
        return mount_from_holder_matrices(self.mount, poses)[self.views]


class LagEstimate(NamedTuple):
    """A lag, as a part of every move in the direction that is asked.

    Attributes:
        fraction: the lag.
        std: its standard deviation; infinite where the views do not tell it.
        errors: what is left over in each view with the lag, of translation (m) and rotation (rad).
        errors_without: the same without a lag.
    """

    fraction: float
    std: float
    errors: Float[np.ndarray, "views 2 3"]
    errors_without: Float[np.ndarray, "views 2 3"]


class LagFit:
    """A fit of chain and lag to some views, which starts without a lag.

    Attributes:
        closure: closure error of each view without a lag.
    """

    def __init__(self, data: LaggingViews):
        self.data, self.fraction = data, 0.0
        self.camera = data.camera[data.views]
        robot = data.mount_from_holder(0.0)
        chain = fit_transforms(robot, self.camera)
        self.camera_from_mount, self.holder_from_world, self.closure = chain
        self.free_steps = determined_steps(robot, undetermined_twists(robot))

    def step(self) -> LagEstimate:
        """Move chain and lag by a Gauss-Newton step, and return the lag after it."""
        solved = (_solved(model) for model in self._models())
        estimate, step = min(solved, key=lambda pair: _deviance(pair[0].errors))
        moved = self.free_steps @ step[:-1]
        self.camera_from_mount = self.camera_from_mount @ host_exponentials(moved[:6])
        self.holder_from_world = host_exponentials(moved[6:]) @ self.holder_from_world
        stepped = self.fraction + estimate.fraction
        self.fraction = min(max(stepped, 0.0), MAX_FRACTION)
        return estimate._replace(fraction=stepped)

    def likeliest(self, first: LagEstimate) -> LagEstimate:
        """Return the likeliest lag, after a first step."""
        estimate = first
        for _ in range(MAX_STEPS):
            before = self.fraction
            estimate = self.step()
            if abs(self.fraction - before) < STEP_TOLERANCE:
                break
        return estimate._replace(fraction=self.fraction, errors_without=first.errors_without)

    def _models(self) -> tuple[Float[np.ndarray, "views 6 columns"], ...]:
        """Return the linear models of both noises: columns of the steps, and the closure last.

        With steps a and b of the transforms and f of the lag, the closure of a view is
        `exp(-a) closure exp(-Ad(T) b - f change)`.
        """
        robot = self.data.mount_from_holder(self.fraction)
        later = self.data.mount_from_holder(self.fraction + DIFFERENCE)
        change = host_logarithms(later @ np.linalg.inv(robot)) / DIFFERENCE
        from_camera = np.linalg.inv(self.camera_from_mount) @ self.camera
        closure = host_logarithms(from_camera @ np.linalg.inv(robot @ self.holder_from_world))
        by_mount = np.tile(np.eye(6), (len(robot), 1, 1))
        by_chain = np.concatenate([by_mount, host_adjoints(robot)], axis=2) @ self.free_steps
        at_tool = np.concatenate([by_chain, change[:, :, None], closure[:, :, None]], axis=2)
        # A twist (v, w) of the mount moves the target by v + w x place.
        at_target = at_tool.copy()
        at_target[:, :3] -= host_cross_matrices(from_camera[:, :3, 3]) @ at_tool[:, 3:]
        return at_tool, at_target


def _solved(
    model: Float[np.ndarray, "views 6 columns"],
) -> tuple[LagEstimate, Float[np.ndarray, "steps"]]:
    """Return the steps that leave least over, the lag's last, with the noise that they leave."""
    estimate, steps = _solved_with_noise(model, error_variances(in_parts(model[:, :, -1])))
    for _ in range(NOISE_ROUNDS - 1):
        estimate, steps = _solved_with_noise(model, error_variances(estimate.errors))
    return estimate, steps


def _solved_with_noise(
    model: Float[np.ndarray, "views 6 columns"], variances: Float[np.ndarray, "2"]
) -> tuple[LagEstimate, Float[np.ndarray, "steps"]]:
    """Return `_solved` with given variances of translation (m^2) and rotation (rad^2)."""
    count, _, columns = model.shape
    lag, closure = columns - 2, columns - 1
    sigmas = np.repeat(np.sqrt(variances), 3)
    rows = (model / sigmas[:, None]).reshape(6 * count, columns)
    # In the triangle of a QR factorisation the lag's row is free of the chain's steps.
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    with_lag, without = (
        np.linalg.lstsq(triangle[:size, :size], triangle[:size, closure])[0]
        for size in (closure, lag)
    )
    errors, errors_without = (
        in_parts((rows[:, closure] - rows[:, : len(steps)] @ steps).reshape(count, 6) * sigmas)
        for steps in (with_lag, without)
    )
    unit_variance = triangle[closure, closure] ** 2 / max(6 * count - closure, 1)
    size = abs(triangle[lag, lag])
    std = float(np.sqrt(unit_variance) / size) if size > 0.0 else np.inf
    return LagEstimate(float(with_lag[lag]), std, errors, errors_without), with_lag


def _deviance(errors: Float[np.ndarray, "views 2 3"]) -> float:
    """Return minus twice the logarithm of the likelihood of a view's errors, up to a constant."""
    return 3.0 * float(np.sum(np.log(error_variances(errors))))


def without_lag(robot: Poses, fraction: float) -> Poses:
    """Return poses that were logged with a lag where they should have been.

    Args:
        robot: the poses as logged.
        fraction: part of every move by which they lie behind; negative for poses on the way to the
            next view. The first pose has no previous one and stays, or the last.
    """
    if fraction < 0.0:
        return without_lag(robot[::-1], -fraction)[::-1]
    corrected = robot.copy()
    if fraction == 0.0:
        return corrected
    # logged = previous + (1 - fraction) (true - previous): with the previous poses as logged, then
    # with the better ones.
    stretch = 1.0 / (1.0 - fraction)
    for _ in range(CORRECTION_ROUNDS):
        before = corrected[:-1].copy()
        turns = Rotation.from_matrix(before[:, :3, :3].swapaxes(1, 2) @ robot[1:, :3, :3])
        turned = Rotation.from_rotvec(stretch * turns.as_rotvec()).as_matrix()
        corrected[1:, :3, :3] = before[:, :3, :3] @ turned
        corrected[1:, :3, 3] = before[:, :3, 3] + stretch * (robot[1:, :3, 3] - before[:, :3, 3])
    return corrected
