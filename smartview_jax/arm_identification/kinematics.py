"""Fit the kinematics of an arm to measured poses of a target on it, from a tracker or a camera.

    camera_from_target = camera_from_base @ arm.base_from_tool(ratios * joints) @ flange_from_target

Every joint is an axis in space, and the fit adjusts these lines directly, because
Denavit-Hartenberg parameters are discontinuous where neighbouring axes become parallel and lines
are not. The Denavit-Hartenberg parameters are computed from the fitted lines. Two freedoms that no
data determine are fixed by convention: the base's z axis is the first joint's, with its origin and
x axis taken from the camera's frame, and the flange is on the last axis.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..geometry import PoseLike, as_se3
from ..robots import JointsLike, SerialArm, arm_from_axes
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from .initial_axes import ProductOfExponentials, axes_from_arm, axes_from_motions

MAX_STEPS = 200
"""The largest number of Levenberg-Marquardt steps."""

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
        ValueError: the shapes do not match, the free parameters outnumber the measured numbers, or
            no axis is found without `start`; the message names the joint.

    For example:

        >>> arm = sv.robots.SerialArm([0.0, 0.0], [0.1, 0.3], [0.05, 0.0], [1.5, 0.0])
        >>> grid = np.meshgrid(np.linspace(-1.0, 1.0, 4), np.linspace(-2.0, 2.0, 5))
        >>> joints = np.stack(grid, axis=-1).reshape(-1, 2)
        >>> measured = arm.base_from_tool(joints * [1.01, 1.0])  # the first joint turns 1 % too far
        >>> np.round(sv.fit_kinematics(joints, measured).ratios, 2).tolist()  # doctest: +SKIP
        [1.01, 1.0]
    """
    joints, poses = np.asarray(joints, dtype=float), as_se3(camera_from_target)
    if joints.ndim != 2 or poses.get_batch_axes() != joints.shape[:1]:
        raise ValueError(
            f"expected joints (views, joints) and as many poses; found {joints.shape} and "
            f"{poses.get_batch_axes()}"
        )
    if not (np.isfinite(joints).all() and np.isfinite(poses.wxyz_xyz).all()):
        raise ValueError("joints or poses contain NaN or infinity")
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
    is_free = np.zeros(5 * joints.shape[1] + 6, dtype=bool)
    is_free[free] = True
    fitted_axes, residuals, jacobian, result = _solve(
        axes,
        to_device(joints),
        poses,
        to_device(is_free),
        to_device(np.array(prismatic_flags)),
        to_device(float(metres_per_radian)),
    )
    std, unobservable = _uncertainty(
        np.asarray(residuals), np.asarray(jacobian)[..., free], names, metres_per_radian
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


@compiled
def _solve(
    axes: ProductOfExponentials,
    joints: Float[Array, "views joints"],
    poses: SE3,
    is_free: Bool[Array, "n"],
    is_prismatic: Bool[Array, "joints"],
    metres_per_radian: Float[Array, ""],
) -> tuple[ProductOfExponentials, Float[Array, "views 6"], Float[Array, "views 6 n"], optx.RESULTS]:
    """Minimise the weighted pose residuals by Levenberg-Marquardt.

    Parameters that are not free have zero derivatives, and the damping keeps them unchanged: one
    program serves any free parameters and any kinds of joints.

    Returns:
        Fitted axes, unweighted residuals (m, rad), Jacobian of the weighted residuals, and the
        solver's exit status.
    """

    def displaced_axes(step: Float[Array, "n"]) -> ProductOfExponentials:
        return axes.displaced(jnp.where(is_free, step, 0.0))

    def residuals(step: Float[Array, "n"], _: None = None) -> Float[Array, "views 6"]:
        # r = (t_measured - t_predicted, w log(R_predicted^-1 R_measured)), w = metres_per_radian.
        predicted = displaced_axes(step).camera_from_target(joints, is_prismatic)
        translation = poses.translation() - predicted.translation()
        rotation = (predicted.rotation().inverse() @ poses.rotation()).log()
        return jnp.concatenate([translation, metres_per_radian * rotation], axis=-1)

    # Each step solves (J^T J + lambda I) step = -J^T r; the damping lambda falls where the cost
    # does. The system is dense, since an arm has only some forty parameters.
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    initial_step = jnp.zeros(len(is_free))
    solution = optx.least_squares(residuals, solver, initial_step, max_steps=MAX_STEPS, throw=False)
    weighted_residuals = residuals(solution.value)
    unweighted_residuals = jnp.concatenate(
        [weighted_residuals[:, :3], weighted_residuals[:, 3:] / metres_per_radian], axis=-1
    )
    return (
        displaced_axes(solution.value),
        unweighted_residuals,
        jax.jacfwd(residuals)(solution.value),
        solution.result,
    )


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
    residuals: Float[Array, "views 6"],
    std: dict[str, Float[np.ndarray, "parameters"]],
    unobservable: tuple[str, ...],
    result: optx.RESULTS,
) -> KinematicFit:
    """Return the result with the axes expressed as Denavit-Hartenberg parameters."""
    frames = np.asarray(axes.frames.as_matrix())
    arm_with_ends = arm_from_axes(
        frames[:, :3, 3], frames[:, :3, 2], np.asarray(axes.home.as_matrix()), prismatic
    )
    # The fixed transforms at both ends of the arm become the poses of the base and of the target.
    arm = eqx.tree_at(
        lambda a: (a.base_from_first, a.flange_from_tool),
        arm_with_ends,
        (SE3.identity(), SE3.identity()),
    )
    end_transforms = arm_with_ends.base_from_first, arm_with_ends.flange_from_tool
    return KinematicFit(arm, axes.ratios, *end_transforms, residuals, std, unobservable, result)


def _rms(errors: Float[Array, "views 3"]) -> float:
    """Return the root mean square length of error vectors."""
    return float(jnp.sqrt(jnp.mean(jnp.sum(errors**2, axis=-1))))
