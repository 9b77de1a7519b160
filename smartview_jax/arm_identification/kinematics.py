"""The kinematics of an arm from measured poses of a target on it: a tracker's, or a camera's.

    camera_from_target = camera_from_base @ arm.base_from_tool(ratios * joints) @ flange_from_target

Every joint is an axis in space, wherever it may be, and the fit moves these lines: Denavit and
Hartenberg's numbers jump where axes come to be parallel, lines do not. The numbers are read off the
answer. Two freedoms are no one's to know and are settled by them: the base's z axis is the first
joint's, with its origin and x axis taken from the camera's frame, and the flange is on the last.
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
"""Of Levenberg-Marquardt, at most."""

UNSEEN = 1e-9
"""Singular value, as a share of the largest, below which data say nothing of a direction."""


class KinematicFit(eqx.Module):
    """An arm as poses of a target on it show it to be.

    Attributes:
        arm: with `standard` numbers, from its first axis to its flange.
        ratios: how far each joint goes per unit of its reading.
        camera_from_base: where the arm's base is, in the frame that poses were measured in.
        flange_from_target: where the target is on it.
        residuals: measured less fitted, m in the camera's frame, then rad at the target.
        std: of the fitted numbers by name: `axis_tilt.k`, `axis_shift.k` (two directions across
            axis k), `joint_ratio.k`, `target`; infinite for what the data do not tell.
        unseen: what that is: the numbers that each such direction moves.
        result: how the solver ended.
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
        """Where the target is at given readings, `(*views)`."""
        joints = jnp.asarray(joints, dtype=float)
        poses = self.arm.base_from_tool(joints * jnp.broadcast_to(self.ratios, joints.shape))
        ends = (self.camera_from_base, self.flange_from_target)
        shape = poses.wxyz_xyz.shape
        first, last = (SE3(jnp.broadcast_to(end.wxyz_xyz, shape)) for end in ends)
        return first @ poses @ last

    @property
    def rms_mm(self) -> float:
        """Root of the mean squared distance between measured and fitted origins, mm."""
        return 1e3 * _rms(self.residuals[:, :3])

    @property
    def rms_degrees(self) -> float:
        """Root of the mean squared angle between measured and fitted orientations, degrees."""
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
    """Fit the axes of an arm, the ratios of its joints and its two ends to measured poses.

    Args:
        joints: readings, `(views, joints)`, rad or m.
        camera_from_target: measured, `(views)`.
        start: the arm as it is believed to be. Without it each axis is found from views between
            which no later joint moves.
        free_ratios: whether a joint may go further than it reads; the sign of its axis is free.
        prismatic: which joints slide; by default those of `start`, or none.
        metres_per_radian: weight of orientations: an error of 1 rad counts as so many metres.

    Raises:
        ValueError: shapes that do not fit, fewer numbers measured than fitted, or no start given
            and none found; the message names the joint.
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
    """Names of the free numbers, and their places among five a joint and six of the target.

    Of a sliding joint's axis only the direction matters.
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
    size = 5 * len(slides) + 6

    def moved(step: Float[Array, "n"]) -> Axes:
        return axes.moved(jnp.zeros(size).at[free].set(step))

    def residuals(step: Float[Array, "n"], _: None = None) -> Float[Array, "views 6"]:
        predicted = moved(step).camera_from_target(joints, slides)
        shift = poses.translation() - predicted.translation()
        turn = (predicted.rotation().inverse() @ poses.rotation()).log()
        return jnp.concatenate([shift, metres_per_radian * turn], axis=-1)

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
    """Deviations by name, and what cannot be told.

    The weights are not the noise's: translations and rotations each have their own, found from the
    residuals, and the covariance is that of the weighted estimate under it.
    """
    rows = jacobian.reshape(-1, len(names))
    U, values, Vt = np.linalg.svd(rows, full_matrices=False)
    seen = values > UNSEEN * values[0]
    share = 1.0 - np.sum(U[:, seen] ** 2, axis=1).reshape(residuals.shape)
    noise = np.repeat(
        [
            np.sum(residuals[:, part] ** 2) / max(np.sum(share[:, part]), 1e-9)
            for part in (slice(0, 3), slice(3, 6))
        ],
        3,
    ) * np.repeat([1.0, metres_per_radian**2], 3)
    inverse = (Vt[seen].T / values[seen]) @ U[:, seen].T
    variance = np.sum(inverse**2 * np.tile(noise, len(residuals)), axis=1)
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
    return float(jnp.sqrt(jnp.mean(jnp.sum(errors**2, axis=-1))))
