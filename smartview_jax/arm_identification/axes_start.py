"""Find initial joint axes of an arm in the frame of a camera that observes its motion.

The pose model is a product of exponentials,

    camera_from_target(q) = prod_k F_k exp(r_k q_k z) F_k^-1 @ home

with `F_k` a frame on joint axis k, `r_k` the gear ratio, and `z` the unit twist of a rotation
about, or a translation along, the z axis.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..robots import SerialArm

STILL = 2e-3
"""The largest change of a reading between two views of a joint at rest, rad or m."""

LEAST, MOST = 0.05, 2.5
"""The smallest (rad or m) and largest (rad) joint motion from which an axis is found.

The upper limit stays below pi: a rotation by more than pi has the opposite axis.
"""

MOST_VIEWS = 300
"""The largest number of views of which all pairs are examined."""


class Axes(eqx.Module):
    """A product of exponentials: an arm's joint axes, their ratios and the target pose at zero.

    Attributes:
        frames: `(joints)` frames whose z axes are the joint axes where all joints read zero, in the
            camera's frame.
        ratios: true joint motion per unit of its reading.
        home: the pose of the target where all joints read zero, in the camera's frame.
    """

    frames: SE3
    ratios: Float[Array, "joints"]
    home: SE3

    def camera_from_target(
        self, joints: Float[Array, "views joints"], slides: tuple[bool, ...]
    ) -> SE3:
        """Return the target's pose in the camera's frame at the given joint readings."""
        pose = SE3.identity((len(joints),))
        for k, slide in enumerate(slides):
            frame = SE3(jnp.broadcast_to(self.frames.wxyz_xyz[k], (len(joints), 7)))
            pose = pose @ frame @ _motion(self.ratios[k] * joints[:, k], slide) @ frame.inverse()
        return pose @ SE3(jnp.broadcast_to(self.home.wxyz_xyz, (len(joints), 7)))

    def moved(self, step: Float[Array, "numbers"]) -> "Axes":
        """Return the axes after a parameter step.

        The step has five numbers per joint (translation along x and y of the axis frame, rotation
        about x and y, change of the ratio), then the six of a twist of `home`. Translation along an
        axis and rotation about it leave the axis as it is and are not parameters.
        """
        each = step[:-6].reshape(-1, 5)
        nothing = jnp.zeros(len(each))
        # F_k <- F_k exp((v_x, v_y, 0, w_x, w_y, 0)), r_k <- r_k + dr_k, home <- home exp(twist)
        twists = [each[:, 0], each[:, 1], nothing, each[:, 2], each[:, 3], nothing]
        return Axes(
            self.frames @ SE3.exp(jnp.stack(twists, axis=-1)),
            self.ratios + each[:, 4],
            self.home @ SE3.exp(step[-6:]),
        )


def axes_of_motions(
    joints: Float[np.ndarray, "views joints"], poses: SE3, slides: tuple[bool, ...]
) -> Axes:
    """Find the joint axes in order, each from views between which no later joint moves.

    Once the motion of the earlier joints is removed, the target moves about (or along) that axis
    alone between two such views.

    Raises:
        ValueError: no pair of views determines a joint's axis; the message names the joint.
    """
    few = np.unique(np.linspace(0, len(joints) - 1, MOST_VIEWS).astype(int))
    rest, found = np.asarray(poses.as_matrix()), []
    for k, slide in enumerate(slides):
        frame = _axis(joints[few, k], joints[few, k + 1 :], rest[few], slide)
        if frame is None:
            raise ValueError(
                f"no two views tell the axis of joint {1 + k}: it has to move by {LEAST} rad or "
                "more, or m, while those after it rest; or give start=, the arm as it should be"
            )
        found.append(frame)
        # Remove this joint's motion: rest <- F_k exp(-q_k z) F_k^-1 rest. What remains is the
        # motion of the later joints and the constant pose `home`.
        motion = np.asarray(_motion(jnp.asarray(-joints[:, k]), slide).as_matrix())
        rest = frame @ motion @ np.linalg.inv(frame) @ rest
    # With all joints removed every view gives an estimate of `home`; one is enough to start.
    middle = SE3.from_matrix(jnp.asarray(rest[len(rest) // 2])).normalize()
    frames = SE3.from_matrix(jnp.asarray(np.stack(found))).normalize()
    return Axes(frames, jnp.ones(len(slides)), middle)


def axes_of_arm(start: SerialArm, joints: Float[np.ndarray, "views joints"], poses: SE3) -> Axes:
    """Return a known arm's axes, its base and the target positioned to match measured poses.

    The model is `P = X B Y` for every view, with P the measured pose, B the arm's forward
    kinematics, X the pose of its base and Y that of the target on its flange. The rotation part is
    linear in the rotation matrices of X and of inverse Y; given these, the translation part is
    linear in their translations.
    """
    B, P = (np.asarray(p.as_matrix()) for p in (start.base_from_tool(joints), poses))
    # Rotation part, stacked by rows: R_P R_Y^-1 - R_X R_B = 0. The solution is the right singular
    # vector of the smallest singular value, up to a factor; both halves are then projected onto
    # rotations.
    eye = np.eye(3)
    rows = [
        np.hstack([np.kron(p, eye), -np.kron(eye, b.T)])
        for p, b in zip(P[:, :3, :3], B[:, :3, :3], strict=True)
    ]
    both = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(2, 3, 3)
    both = both * np.sign(np.linalg.det(both[0]))
    turned_y, X = (_rotation(m) for m in both)
    # Translation part: t_P - R_X t_B = R_X R_B t_Y + t_X.
    A = np.concatenate([np.hstack([X @ b[:3, :3], eye]) for b in B])
    shift = np.linalg.lstsq(A, (P[:, :3, 3] - B[:, :3, 3] @ X.T).ravel(), rcond=None)[0]
    camera_from_base, tool_from_target = np.eye(4), np.eye(4)
    camera_from_base[:3, :3], camera_from_base[:3, 3] = X, shift[3:]
    tool_from_target[:3, :3], tool_from_target[:3, 3] = turned_y.T, shift[:3]
    home = np.asarray(start.base_from_tool(np.zeros(start.size)).as_matrix())
    frames = SE3.from_matrix(jnp.asarray(camera_from_base @ start_axes(start))).normalize()
    whole = SE3.from_matrix(jnp.asarray(camera_from_base @ home @ tool_from_target)).normalize()
    return Axes(frames, jnp.ones(start.size), whole)


def start_axes(arm: SerialArm) -> Float[np.ndarray, "joints 4 4"]:
    """Return frames whose z axes are an arm's joint axes at zero readings, in its base frame."""
    frames, at = [], arm.base_from_first
    for k in range(arm.size):
        x = SE3.from_rotation_and_translation(
            SO3.from_x_radians(arm.alpha[k]), jnp.array([1.0, 0.0, 0.0]) * arm.a[k]
        )
        z = SE3.from_rotation_and_translation(
            SO3.from_z_radians(arm.theta[k]), jnp.array([0.0, 0.0, 1.0]) * arm.d[k]
        )
        # One link is Rz Tz Tx Rx (standard) or Rx Tx Rz Tz (modified): in the modified convention
        # the joint axis comes after the link's own twist and length.
        axis = at if arm.convention == "standard" else at @ x
        frames.append(np.asarray(axis.as_matrix()))
        at = at @ z @ x if arm.convention == "standard" else axis @ z
    return np.stack(frames)


def _motion(way: Float[Array, "views"], slide: bool) -> SE3:
    """Return exp(amount * z): a rotation about the z axis, or a translation along it."""
    nothing = jnp.zeros_like(way)
    if slide:
        return SE3.from_translation(jnp.stack([nothing, nothing, way], axis=-1))
    return SE3.from_rotation(SO3.from_z_radians(way))


def _axis(
    readings: Float[np.ndarray, "views"],
    later: Float[np.ndarray, "views others"],
    rest: Float[np.ndarray, "views 4 4"],
    slide: bool,
) -> Float[np.ndarray, "4 4"] | None:
    """Return a frame on the axis common to the rigid motions between pairs of views, or None.

    None means that no pair of views has a large enough motion of this joint with all later joints
    at rest.
    """
    i, j = np.triu_indices(len(readings), 1)
    way = readings[j] - readings[i]
    alone = (np.abs(later[j] - later[i]) < STILL).all(axis=1)
    use = alone & (np.abs(way) > LEAST) & (slide | (np.abs(way) < MOST))
    if not use.any():
        return None
    # M_ij = T_j T_i^-1 = F exp((q_j - q_i) z) F^-1: a rotation about, or a translation along, the
    # axis.
    motion = rest[j[use]] @ np.linalg.inv(rest[i[use]])
    turn = motion[:, :3, :3]
    if slide:
        # The position of a prismatic joint's axis has no effect on the motion; any point will do.
        axis, point = np.mean(motion[:, :3, 3] / way[use, None], axis=0), rest[0, :3, 3]
    else:
        # Rotation vectors are summed with the sign of the joint's motion, so that long rotations
        # weigh most.
        about = np.asarray(SO3.from_matrix(jnp.asarray(turn)).log())
        axis = np.sum(about * np.sign(way[use])[:, None], axis=0)
        # A rotation M = (R, t) leaves the points p of its axis fixed: t = (I - R) p. The extra row
        # a . p = 0 selects the point nearest the origin.
        A = np.concatenate([*(np.eye(3) - turn), axis[None] / np.linalg.norm(axis)])
        point = np.linalg.lstsq(A, np.append(motion[:, :3, 3].ravel(), 0.0), rcond=None)[0]
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3] = np.stack([x, np.cross(z, x), z, point], axis=1)
    return frame


def _rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix nearest to a matrix in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
