"""Fit the kinematics of an arm to measured poses of a target on it, from a tracker or a camera.

    camera_from_target = camera_from_base @ arm.base_from_tool(ratios * joints) @ flange_from_target

Every joint is an axis in space, and the fit adjusts these lines directly, because
Denavit-Hartenberg parameters are discontinuous where neighbouring axes become parallel and lines
are not. The Denavit-Hartenberg parameters are computed from the fitted lines. Two freedoms that no
data determine are fixed by convention: the base's z axis is the first joint's, with its origin and
x axis taken from the camera's frame, and the flange is on the last axis.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Float, Int

from ..geometry import (
    PoseLike,
    as_se3,
    host_inverse_left_jacobians,
    host_matrices,
    host_rotation_vectors,
)
from ..robots import JointsLike, SerialArm, arm_from_axes
from ..runtime.array_namespace import to_device_together
from .initial_axes import axes_from_arm, axes_from_motions
from .product_of_exponentials import ProductOfExponentials

MAX_STEPS = 200
"""The largest number of Levenberg-Marquardt steps."""

FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-6, 1e-14, 1e6
"""The damping of the first step, the least, and the one at which a fit ends.

It is relative to the largest squared column of the Jacobian. Even the least holds directions that
count as not observable, whose squared singular values are smaller by far.
"""

RELATIVE_DECREASE = 1e-14
"""The fraction of the cost by which a step has to decrease it for the fit to go on."""

SINGULAR_VALUE_TOLERANCE = 1e-9
"""The fraction of the largest singular value below which a direction counts as not observable."""


class KinematicFit(eqx.Module):
    """The result of fitting an arm's kinematics to poses of a target on it.

    Attributes:
        arm: the arm with `standard` Denavit-Hartenberg parameters, from its first axis to its
            flange.
        ratios: true joint motion per unit of its reading.
        camera_from_base: the pose of the arm's base in the frame that poses were measured in.
        flange_from_target: the pose of the target on the flange.
        residuals: measured minus fitted: translation in the camera's frame, m, then rotation at the
            target, rad.
        std: standard deviations of the fitted parameters by name: `axis_tilt.k`, `axis_shift.k`
            (two directions across axis k), `joint_ratio.k`, `target`; infinite for parameters that
            the data do not determine.
        unobservable: the directions that the data do not determine, each as the names of its
            parameters.
        result: the solver's exit status.
    """

    arm: SerialArm
    ratios: Float[Array, "joints"]
    camera_from_base: SE3
    flange_from_target: SE3
    residuals: Float[Array, "views 6"]
    std: dict[str, Float[np.ndarray, "parameters"]]
    unobservable: tuple[str, ...]
    result: optx.RESULTS

    def camera_from_target(self, joints: JointsLike) -> SE3:
        """Return the target's pose in the camera's frame at given readings, `(*views)`."""
        joints = jnp.asarray(joints, dtype=float)
        poses = self.arm.base_from_tool(joints * jnp.broadcast_to(self.ratios, joints.shape))
        end_transforms = (self.camera_from_base, self.flange_from_target)
        shape = poses.wxyz_xyz.shape
        first, last = (SE3(jnp.broadcast_to(end.wxyz_xyz, shape)) for end in end_transforms)
        return first @ poses @ last

    @property
    def rms_mm(self) -> float:
        """The root mean square distance between measured and fitted origins of the target, mm."""
        return 1e3 * _rms(self.residuals[:, :3])

    @property
    def rms_degrees(self) -> float:
        """The root mean square angle between measured and fitted orientations, degrees."""
        return float(np.rad2deg(_rms(self.residuals[:, 3:])))


def fit_kinematics(
    joints: JointsLike,
    camera_from_target: PoseLike,
    *,
    start: SerialArm | None = None,
    free_ratios: bool = True,
    prismatic: Sequence[bool] | None = None,
    metres_per_radian: float = 1.0,
) -> KinematicFit:
    """Fit an arm's axes and ratios, and the poses of its base and of the target, to measured poses.

    Args:
        joints: readings, `(views, joints)`, rad or m.
        camera_from_target: measured poses, `(views)`.
        start: the nominal arm. Without it each axis is initialised from views between which no
            later joint moves.
        free_ratios: whether the joint ratios are fitted; if not, they are one, and the direction of
            each axis gives the sign of its motion.
        prismatic: which joints are prismatic; by default as in `start`, or none.
        metres_per_radian: weight of orientations: an error of 1 rad counts as this many metres.

    Raises:
        ValueError: the shapes do not match, `metres_per_radian` is not positive, the free
            parameters outnumber the measured numbers, or no axis is found without `start`; the
            message names the joint.

    For example:

        >>> arm = sv.robots.SerialArm([0.0, 0.0], [0.1, 0.3], [0.05, 0.0], [1.5, 0.0])
        >>> grid = np.meshgrid(np.linspace(-1.0, 1.0, 4), np.linspace(-2.0, 2.0, 5))
        >>> joints = np.stack(grid, axis=-1).reshape(-1, 2)
        >>> measured = arm.base_from_tool(joints * [1.01, 1.0])  # the first joint turns 1 % too far
        >>> np.round(sv.fit_kinematics(joints, measured).ratios, 2).tolist()  # doctest: +SKIP
        [1.01, 1.0]
    """
    joints, poses = np.asarray(joints, dtype=float), host_matrices(as_se3(camera_from_target))
    if joints.ndim != 2 or poses.shape[:-2] != joints.shape[:1]:
        raise ValueError(
            f"expected joints (views, joints) and as many poses; found {joints.shape} and "
            f"{poses.shape[:-2]}"
        )
    if not (np.isfinite(joints).all() and np.isfinite(poses).all()):
        raise ValueError("joints or poses contain NaN or infinity")
    if not 0.0 < metres_per_radian < np.inf:
        raise ValueError(
            f"metres_per_radian: expected a positive number, found {metres_per_radian}"
        )
    if start is not None and start.joint_count != joints.shape[1]:
        raise ValueError(f"start has {start.joint_count} joints, the readings {joints.shape[1]}")
    if prismatic is None:
        prismatic_flags = (False,) * joints.shape[1] if start is None else start.prismatic
    else:
        prismatic_flags = tuple(map(bool, prismatic))
    axes = (
        axes_from_motions(joints, poses, prismatic_flags)
        if start is None
        else axes_from_arm(start, joints, poses)
    )
    names, free = _free_parameters(prismatic_flags, free_ratios)
    if 6 * len(joints) < len(free):
        raise ValueError(
            f"{len(joints)} poses give {6 * len(joints)} numbers; {len(free)} parameters are free"
        )
    measured = _Measurements(joints, poses, prismatic_flags, float(metres_per_radian))
    fitted_axes, result = _minimise(axes, measured, free)
    weighted_residuals = measured.residuals(fitted_axes)
    residuals = weighted_residuals / measured.weights
    std, unobservable = _uncertainty(
        residuals, measured.jacobian(fitted_axes)[..., free], names, metres_per_radian
    )
    return _as_fit(fitted_axes, prismatic_flags, residuals, std, unobservable, result)


def _free_parameters(
    prismatic: tuple[bool, ...], free_ratios: bool
) -> tuple[list[str], Int[np.ndarray, "n"]]:
    """Return the names of the free parameters, and their indices among all.

    The parameters are five per joint and six of the target. Of a prismatic joint's axis only the
    direction is free, because its position has no effect.
    """
    names, free = [], []
    for k, is_prismatic in enumerate(prismatic):
        parameter_kinds = ["axis_shift"] * 2 + ["axis_tilt"] * 2 + ["joint_ratio"]
        for offset, kind in enumerate(parameter_kinds):
            if not (is_prismatic and kind == "axis_shift") and (
                free_ratios or kind != "joint_ratio"
            ):
                names.append(f"{kind}.{1 + k}")
                free.append(5 * k + offset)
    first_target_index = 5 * len(prismatic)
    return [*names, *["target"] * 6], np.array(
        [*free, *range(first_target_index, first_target_index + 6)]
    )


class _Measurements(NamedTuple):
    """Measured poses of a target, to which axes are fitted.

    Attributes:
        joints: readings.
        poses: camera_from_target as measured.
        prismatic: which joints are prismatic.
        metres_per_radian: weight of orientations.
    """

    joints: Float[np.ndarray, "views joints"]
    poses: Float[np.ndarray, "views 4 4"]
    prismatic: tuple[bool, ...]
    metres_per_radian: float

    @property
    def weights(self) -> Float[np.ndarray, "6"]:
        """Weights of a view's six residuals."""
        return np.repeat([1.0, self.metres_per_radian], 3)

    def residuals(self, axes: ProductOfExponentials) -> Float[np.ndarray, "views 6"]:
        """Return the weighted residuals of axes."""
        # r = (t_measured - t_predicted, w log(R_predicted^-1 R_measured)), w = metres_per_radian.
        predicted = axes.camera_from_target(self.joints, self.prismatic)
        translation = self.poses[:, :3, 3] - predicted[:, :3, 3]
        rotation = host_rotation_vectors(self._turns(predicted))
        return np.hstack([translation, rotation]) * self.weights

    def jacobian(self, axes: ProductOfExponentials) -> Float[np.ndarray, "views 6 parameters"]:
        """Return the derivatives of the weighted residuals by a parameter step."""
        predicted = axes.camera_from_target(self.joints, self.prismatic)
        twists = axes.target_twists(self.joints, self.prismatic)
        # With P exp((v, w)) for the predicted pose P: dt = -R_P v, and d log(R_P^-1 R) is
        # -J_l(r)^-1 w at the rotation vector r, where J_l is the left Jacobian of exp.
        by_translation = predicted[:, :3, :3] @ twists[:, :3]
        vectors = host_rotation_vectors(self._turns(predicted))
        by_rotation = host_inverse_left_jacobians(vectors) @ twists[:, 3:]
        derivatives = np.concatenate([by_translation, by_rotation], axis=1)
        return -self.weights[:, None] * derivatives

    def _turns(self, predicted: Float[np.ndarray, "views 4 4"]) -> Float[np.ndarray, "views 3 3"]:
        """Return the rotations from measured to predicted orientations."""
        return predicted[:, :3, :3].swapaxes(1, 2) @ self.poses[:, :3, :3]


def _minimise(
    axes: ProductOfExponentials, measured: _Measurements, free: Int[np.ndarray, "n"]
) -> tuple[ProductOfExponentials, optx.RESULTS]:
    """Minimise the weighted pose residuals by Levenberg-Marquardt over the free parameters.

    Returns:
        Fitted axes, and the solver's exit status.
    """
    residuals = measured.residuals(axes).ravel()
    damping = FIRST_DAMPING
    for _ in range(MAX_STEPS):
        jacobian = measured.jacobian(axes)[..., free].reshape(len(residuals), -1)
        cost, scale = residuals @ residuals, np.max(np.sum(jacobian**2, axis=0))
        # Each step solves (J^T J + lambda I) step = -J^T r; the damping lambda falls where the cost
        # does. It holds what the data do not determine.
        singular = np.linalg.svd(jacobian, full_matrices=False)
        trial, trial_residuals, decrease = axes, residuals, -1.0
        while decrease < 0.0 and damping < MAX_DAMPING:
            step = np.zeros(5 * len(axes.ratios) + 6)
            step[free] = -_damped_solution(singular, residuals, damping * scale)
            trial = axes.displaced(step)
            trial_residuals = measured.residuals(trial).ravel()
            decrease = cost - trial_residuals @ trial_residuals
            damping = max(damping * (0.1 if decrease >= 0.0 else 10.0), MIN_DAMPING)
        if decrease >= 0.0:
            axes, residuals = trial, trial_residuals
        if decrease <= RELATIVE_DECREASE * cost:
            return axes, optx.RESULTS.successful
    return axes, optx.RESULTS.nonlinear_max_steps_reached


def _damped_solution(
    singular: tuple[np.ndarray, np.ndarray, np.ndarray],
    residuals: Float[np.ndarray, "rows"],
    damping: float,
) -> Float[np.ndarray, "n"]:
    """Return the solution of `(J^T J + damping I) x = J^T r` by the singular values of J."""
    U, values, Vt = singular
    return Vt.T @ (values / (values**2 + damping) * (U.T @ residuals))


def _uncertainty(
    residuals: Float[np.ndarray, "views 6"],
    jacobian: Float[np.ndarray, "views 6 n"],
    names: list[str],
    metres_per_radian: float,
) -> tuple[dict[str, Float[np.ndarray, "parameters"]], tuple[str, ...]]:
    """Return standard deviations by name, and the directions that the data do not determine.

    The weights are not the inverse noise variances. Translations and rotations each have their own
    variance, estimated from the residuals. Under this noise the covariance of the weighted estimate
    is `J^+ S J^+^T`, with `J^+` the pseudo-inverse of the weighted Jacobian and S the noise
    covariance of the weighted residuals.
    """
    rows = jacobian.reshape(-1, len(names))
    U, singular_values, Vt = np.linalg.svd(rows, full_matrices=False)
    # J = U diag(s) V^T; directions with a singular value of about zero are left out of J^+.
    observable = singular_values > SINGULAR_VALUE_TOLERANCE * singular_values[0]
    # 1 - leverage, each residual's degrees of freedom: sigma^2 = sum(r^2) / sum(1 - leverage).
    degrees_of_freedom = 1.0 - np.sum(U[:, observable] ** 2, axis=1).reshape(residuals.shape)
    noise_variance = np.repeat(
        [
            np.sum(residuals[:, part] ** 2) / max(np.sum(degrees_of_freedom[:, part]), 1e-9)
            for part in (slice(0, 3), slice(3, 6))
        ],
        3,
    ) * np.repeat([1.0, metres_per_radian**2], 3)
    # Diagonal of J^+ S J^+^T, with S = diag(noise_variance) in every view.
    pseudo_inverse = (Vt[observable].T / singular_values[observable]) @ U[:, observable].T
    variance = np.sum(pseudo_inverse**2 * np.tile(noise_variance, len(residuals)), axis=1)
    # A parameter with any component in an unobservable direction has no finite variance.
    undetermined = np.sum(Vt[~observable] ** 2, axis=0) > 1e-6
    stds = np.where(undetermined, np.inf, np.sqrt(variance))
    std = {
        name: np.array([std for n, std in zip(names, stds, strict=True) if n == name])
        for name in dict.fromkeys(names)
    }
    unobservable = tuple(
        ", ".join(dict.fromkeys(n for n, c in zip(names, direction, strict=True) if abs(c) > 0.1))
        for direction in Vt[~observable]
    )
    return std, unobservable


def _as_fit(
    axes: ProductOfExponentials,
    prismatic: tuple[bool, ...],
    residuals: Float[np.ndarray, "views 6"],
    std: dict[str, Float[np.ndarray, "parameters"]],
    unobservable: tuple[str, ...],
    result: optx.RESULTS,
) -> KinematicFit:
    """Return the result with the axes expressed as Denavit-Hartenberg parameters."""
    arm_with_ends = arm_from_axes(
        axes.frames[:, :3, 3], axes.frames[:, :3, 2], axes.home, prismatic
    )
    # The fixed transforms at both ends of the arm become the poses of the base and of the target.
    arm = eqx.tree_at(
        lambda a: (a.base_from_first, a.flange_from_tool),
        arm_with_ends,
        (SE3.identity(), SE3.identity()),
    )
    end_transforms = arm_with_ends.base_from_first, arm_with_ends.flange_from_tool
    ratios, residuals_on_device = to_device_together((axes.ratios, residuals))
    return KinematicFit(
        arm, ratios, *end_transforms, residuals_on_device, std, unobservable, result
    )


def _rms(errors: Float[Array, "views 3"]) -> float:
    """Return the root mean square length of error vectors."""
    return float(jnp.sqrt(jnp.mean(jnp.sum(errors**2, axis=-1))))
