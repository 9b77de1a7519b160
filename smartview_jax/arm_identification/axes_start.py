"""Axes of an arm in the frame of a camera that sees it move, and where to begin their fit."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..robots import SerialArm

STILL = 2e-3
"""By which a joint that rests may differ between two readings, rad or m."""

LEAST, MOST = 0.05, 2.5
"""Turns between two views, rad, that tell an axis; a rotation by more than pi has another one."""

MOST_VIEWS = 300
"""Of which all pairs are looked at."""


class Axes(eqx.Module):
    """A product of exponentials.

    Attributes:
        frames: `(joints)`, whose z axes are those of the joints where all read zero, in the
            camera's frame.
        ratios: how far each joint goes per unit of its reading.
        home: where the target then is.
    """

    frames: SE3
    ratios: Float[Array, "joints"]
    home: SE3

    def camera_from_target(
        self, joints: Float[Array, "views joints"], slides: tuple[bool, ...]
    ) -> SE3:
        """Where the target is at given readings."""
        pose = SE3.identity((len(joints),))
        for k, slide in enumerate(slides):
            frame = SE3(jnp.broadcast_to(self.frames.wxyz_xyz[k], (len(joints), 7)))
            pose = pose @ frame @ _motion(self.ratios[k] * joints[:, k], slide) @ frame.inverse()
        return pose @ SE3(jnp.broadcast_to(self.home.wxyz_xyz, (len(joints), 7)))

    def moved(self, step: Float[Array, "numbers"]) -> "Axes":
        """Five numbers a joint: shifts and tilts across its axis, and its ratio; six of home."""
        each = step[:-6].reshape(-1, 5)
        nothing = jnp.zeros(len(each))
        twists = [each[:, 0], each[:, 1], nothing, each[:, 2], each[:, 3], nothing]
        return Axes(
            self.frames @ SE3.exp(jnp.stack(twists, axis=-1)),
            self.ratios + each[:, 4],
            self.home @ SE3.exp(step[-6:]),
        )


def axes_of_motions(
    joints: Float[np.ndarray, "views joints"], poses: SE3, slides: tuple[bool, ...]
) -> Axes:
    """Axes one after the other, each from views between which no later joint moves.

    Between two such views, the joints before it undone, the target turns about the axis alone.

    Raises:
        ValueError: no two views tell a joint's axis; it is named.
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
        motion = np.asarray(_motion(jnp.asarray(-joints[:, k]), slide).as_matrix())
        rest = frame @ motion @ np.linalg.inv(frame) @ rest
    middle = SE3.from_matrix(jnp.asarray(rest[len(rest) // 2])).normalize()
    frames = SE3.from_matrix(jnp.asarray(np.stack(found))).normalize()
    return Axes(frames, jnp.ones(len(slides)), middle)


def axes_of_arm(start: SerialArm, joints: Float[np.ndarray, "views joints"], poses: SE3) -> Axes:
    """An arm's own axes, and where its base and the target have to be for measured poses.

    With `P = X B Y` for every view, the rotation parts are linear in those of X and inverse Y, and
    so are the translations after them.
    """
    B, P = (np.asarray(p.as_matrix()) for p in (start.base_from_tool(joints), poses))
    # R_P R_Y^-1 = R_X R_B, stacked by rows.
    eye = np.eye(3)
    rows = [
        np.hstack([np.kron(p, eye), -np.kron(eye, b.T)])
        for p, b in zip(P[:, :3, :3], B[:, :3, :3], strict=True)
    ]
    both = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(2, 3, 3)
    both = both * np.sign(np.linalg.det(both[0]))
    turned_y, X = (_rotation(m) for m in both)
    # t_P = R_X R_B t_Y + R_X t_B + t_X.
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
    """Frames whose z axes are an arm's joints at zero, in its base."""
    frames, at = [], arm.base_from_first
    for k in range(arm.size):
        x = SE3.from_rotation_and_translation(
            SO3.from_x_radians(arm.alpha[k]), jnp.array([1.0, 0.0, 0.0]) * arm.a[k]
        )
        z = SE3.from_rotation_and_translation(
            SO3.from_z_radians(arm.theta[k]), jnp.array([0.0, 0.0, 1.0]) * arm.d[k]
        )
        axis = at if arm.convention == "standard" else at @ x
        frames.append(np.asarray(axis.as_matrix()))
        at = at @ z @ x if arm.convention == "standard" else axis @ z
    return np.stack(frames)


def _motion(way: Float[Array, "views"], slide: bool) -> SE3:
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
    """A frame on the axis that rigid motions between pairs of views share; None without a pair."""
    i, j = np.triu_indices(len(readings), 1)
    way = readings[j] - readings[i]
    alone = (np.abs(later[j] - later[i]) < STILL).all(axis=1)
    use = alone & (np.abs(way) > LEAST) & (slide | (np.abs(way) < MOST))
    if not use.any():
        return None
    motion = rest[j[use]] @ np.linalg.inv(rest[i[use]])
    turn = motion[:, :3, :3]
    if slide:
        axis, point = np.mean(motion[:, :3, 3] / way[use, None], axis=0), rest[0, :3, 3]
    else:
        about = np.asarray(SO3.from_matrix(jnp.asarray(turn)).log())
        axis = np.sum(about * np.sign(way[use])[:, None], axis=0)
        # A turn leaves its axis where it is: t = (I - R) p, for the point nearest the origin.
        A = np.concatenate([*(np.eye(3) - turn), axis[None] / np.linalg.norm(axis)])
        point = np.linalg.lstsq(A, np.append(motion[:, :3, 3].ravel(), 0.0), rcond=None)[0]
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3] = np.stack([x, np.cross(z, x), z, point], axis=1)
    return frame


def _rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
