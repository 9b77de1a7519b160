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
from jaxtyping import Array, Float, Int

from ..compilation import compiled
from ..geometry import PoseLike, as_se3
from ..robots import JointsLike, SerialArm, arm_from_axes
from .axes_start import Axes, axes_of_arm, axes_of_motions

STEPS = 200
"""The largest number of Levenberg-Marquardt steps."""

UNSEEN = 1e-9
"""The fraction of the largest singular value below which a direction counts as not observable."""


class KinematicFit(eqx.Module):
    """The result of fitting an arm's kinematics to poses of a target on it.

    Attributes:
        arm: the arm with `standard` Denavit-Hartenberg numbers, from its first axis to its flange.
        ratios: true joint motion per unit of its reading.
        camera_from_base: the pose of the arm's base in the frame that poses were measured in.
        flange_from_target: the pose of the target on the flange.
        residuals: measured minus fitted: translation in the camera's frame, m, then rotation at the
            target, rad.
        std: standard deviations of the fitted numbers by name: `axis_tilt.k`, `axis_shift.k` (two
            directions across axis k), `joint_ratio.k`, `target`; infinite for parameters that the
            data do not determine.
        unseen: the directions that the data do not determine, each as the names of its parameters.
        result: the solver's exit status.
    """

    arm: SerialArm
    ratios: Float[Array, "joints"]
    camera_from_base: SE3
    flange_from_target: SE3
    residuals: Float[Array, "views 6"]
    std: dict[str, Float[np.ndarray, "numbers"]]
    unseen: tuple[str, ...]
    result: optx.RESULTS

    def camera_from_target(self, joints: JointsLike) -> SE3:
        """Return the target's pose in the camera's frame at given readings, `(*views)`."""
        joints = jnp.asarray(joints, dtype=float)
        poses = self.arm.base_from_tool(joints * jnp.broadcast_to(self.ratios, joints.shape))
        ends = (self.camera_from_base, self.flange_from_target)
        shape = poses.wxyz_xyz.shape
        first, last = (SE3(jnp.broadcast_to(end.wxyz_xyz, shape)) for end in ends)
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
        prismatic: which joints are prismatic; by default those of `start`, or none.
        metres_per_radian: weight of orientations: an error of 1 rad counts as this many metres.

    Raises:
        ValueError: shapes that do not match, fewer measured numbers than free ones, or no start
            given and none found; the message names the joint.
    """
    joints, poses = np.asarray(joints, dtype=float), as_se3(camera_from_target)
    if joints.ndim != 2 or poses.get_batch_axes() != joints.shape[:1]:
        raise ValueError(
            f"expected joints (views, joints) and as many poses; found {joints.shape} and "
            f"{poses.get_batch_axes()}"
        )
    if not (np.isfinite(joints).all() and np.isfinite(poses.wxyz_xyz).all()):
        raise ValueError("joints or poses contain NaN or infinity")
    if start is not None and start.size != joints.shape[1]:
        raise ValueError(f"start has {start.size} joints, the readings {joints.shape[1]}")
    if prismatic is None:
        slides = (False,) * joints.shape[1] if start is None else start.prismatic
    else:
        slides = tuple(map(bool, prismatic))
    axes = (
        axes_of_motions(joints, poses, slides)
        if start is None
        else axes_of_arm(start, joints, poses)
    )
    names, free = _numbers(slides, free_ratios)
    if 6 * len(joints) < len(free):
        raise ValueError(
            f"{len(joints)} poses tell {6 * len(joints)} numbers; {len(free)} are free"
        )
    found, residuals, jacobian, result = _solve(
        axes, jnp.asarray(joints), poses, jnp.asarray(free), slides, metres_per_radian
    )
    std, unseen = _uncertainty(
        np.asarray(residuals), np.asarray(jacobian), names, metres_per_radian
    )
    return _as_fit(found, slides, residuals, std, unseen, result)


def _numbers(slides: tuple[bool, ...], free_ratios: bool) -> tuple[list[str], Int[np.ndarray, "n"]]:
    """Return the names of the free parameters, and their indices among all.

    All are five per joint, then six of the target. Of a prismatic joint's axis only the direction
    is free: its position has no effect.
    """
    names, free = [], []
    for k, slide in enumerate(slides):
        parts = ["axis_shift"] * 2 + ["axis_tilt"] * 2 + ["joint_ratio"]
        for place, part in enumerate(parts):
            if not (slide and part == "axis_shift") and (free_ratios or part != "joint_ratio"):
                names.append(f"{part}.{1 + k}")
                free.append(5 * k + place)
    last = 5 * len(slides)
    return [*names, *["target"] * 6], np.array([*free, *range(last, last + 6)])


@compiled
def _solve(
    axes: Axes,
    joints: Float[Array, "views joints"],
    poses: SE3,
    free: Int[Array, "n"],
    slides: tuple[bool, ...],
    metres_per_radian: float,
) -> tuple[Axes, Float[Array, "views 6"], Float[Array, "views 6 n"], optx.RESULTS]:
    """Minimise the weighted pose residuals by Levenberg-Marquardt.

    Returns:
        Fitted axes, unweighted residuals (m, rad), Jacobian of the weighted residuals, and the
        solver's exit status.
    """
    size = 5 * len(slides) + 6

    def moved(step: Float[Array, "n"]) -> Axes:
        return axes.moved(jnp.zeros(size).at[free].set(step))

    def residuals(step: Float[Array, "n"], _: None = None) -> Float[Array, "views 6"]:
        # r = (t_measured - t_predicted, w log(R_predicted^-1 R_measured)), w in metres per radian.
        predicted = moved(step).camera_from_target(joints, slides)
        shift = poses.translation() - predicted.translation()
        turn = (predicted.rotation().inverse() @ poses.rotation()).log()
        return jnp.concatenate([shift, metres_per_radian * turn], axis=-1)

    # Each step solves (J^T J + lambda I) step = -J^T r; the damping lambda falls where the cost
    # does. Dense, since an arm has some forty numbers.
    solver = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
    first = jnp.zeros(len(free))
    found = optx.least_squares(residuals, solver, first, max_steps=STEPS, throw=False)
    left = residuals(found.value) / jnp.array([[1.0] * 3 + [metres_per_radian] * 3])
    return moved(found.value), left, jax.jacfwd(residuals)(found.value), found.result


def _uncertainty(
    residuals: Float[np.ndarray, "views 6"],
    jacobian: Float[np.ndarray, "views 6 n"],
    names: list[str],
    metres_per_radian: float,
) -> tuple[dict[str, Float[np.ndarray, "numbers"]], tuple[str, ...]]:
    """Return standard deviations by name, and the directions that the data do not determine.

    The weights are not the inverse noise variances. Translations and rotations each have their own
    variance, estimated from the residuals, and the covariance is that of the weighted estimate
    under this noise: `J^+ S J^+^T`, with `J^+` the pseudo-inverse of the weighted Jacobian and S
    the noise covariance of the weighted residuals.
    """
    rows = jacobian.reshape(-1, len(names))
    U, values, Vt = np.linalg.svd(rows, full_matrices=False)
    # J = U diag(s) V^T; directions with a singular value of about zero are left out of J^+.
    seen = values > UNSEEN * values[0]
    # 1 - leverage, each residual's degrees of freedom: sigma^2 = sum(r^2) / sum(1 - leverage).
    share = 1.0 - np.sum(U[:, seen] ** 2, axis=1).reshape(residuals.shape)
    noise = np.repeat(
        [
            np.sum(residuals[:, part] ** 2) / max(np.sum(share[:, part]), 1e-9)
            for part in (slice(0, 3), slice(3, 6))
        ],
        3,
    ) * np.repeat([1.0, metres_per_radian**2], 3)
    # Diagonal of J^+ S J^+^T, with S = diag(noise).
    inverse = (Vt[seen].T / values[seen]) @ U[:, seen].T
    variance = np.sum(inverse**2 * np.tile(noise, len(residuals)), axis=1)
    # A parameter with any component in an unobservable direction has no finite variance.
    lost = np.sum(Vt[~seen] ** 2, axis=0) > 1e-6
    deviations = np.where(lost, np.inf, np.sqrt(variance))
    std = {
        name: np.array([d for n, d in zip(names, deviations, strict=True) if n == name])
        for name in dict.fromkeys(names)
    }
    unseen = tuple(
        ", ".join(dict.fromkeys(n for n, w in zip(names, way, strict=True) if abs(w) > 0.1))
        for way in Vt[~seen]
    )
    return std, unseen


def _as_fit(
    axes: Axes,
    slides: tuple[bool, ...],
    residuals: Float[Array, "views 6"],
    std: dict[str, Float[np.ndarray, "numbers"]],
    unseen: tuple[str, ...],
    result: optx.RESULTS,
) -> KinematicFit:
    """Return the result with the axes expressed as Denavit-Hartenberg numbers."""
    frames = np.asarray(axes.frames.as_matrix())
    whole = arm_from_axes(
        frames[:, :3, 3], frames[:, :3, 2], np.asarray(axes.home.as_matrix()), slides
    )
    arm = eqx.tree_at(
        lambda a: (a.base_from_first, a.flange_from_tool), whole, (SE3.identity(), SE3.identity())
    )
    ends = whole.base_from_first, whole.flange_from_tool
    return KinematicFit(arm, axes.ratios, *ends, residuals, std, unseen, result)


def _rms(errors: Float[Array, "views 3"]) -> float:
    """Return the root mean square length of error vectors."""
    return float(jnp.sqrt(jnp.mean(jnp.sum(errors**2, axis=-1))))
