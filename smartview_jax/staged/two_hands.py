"""Find where the bases of two arms are to each other, from a camera on one hand and a target on the
other.

With X the camera on its hand, Z the target on the other hand and B the base of the other arm in the
base of the camera's, each picture gives the equation

    camera_from_world = X @ tool_from_base @ B @ other_base_from_other_tool @ Z

For a given rotation of B it is an equation X A Z = C, whose rotations follow from the largest
singular value of a matrix of 9 x 9 numbers (Shah, Solving the robot-world/hand-eye calibration
problem using the Kronecker product, 2013); this value says how well the rotation of B fits. So many
rotations are tried, the best are refined, and the translations are linear. Reference for the
equation: Wu, Wang, Qi and Ren, Simultaneous hand-eye, tool-flange, and robot-robot calibration
for comanipulation by solving the AXB = YCZ problem, 2016.
"""

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ..geometry import (
    host_logarithms,
    host_matrices,
    host_nearest_rotation,
    host_poses,
    host_transforms,
)
from ..robots import HandPoses

TRIED_ROTATIONS, REFINED_ROTATIONS = 1000, 5
"""Numbers of rotations of the other base that are tried, some 15 degrees apart, and refined."""

MIN_TURN = 0.05
"""Smallest root of the mean square of the rotation about the second axis of a hand, rad.

About three degrees; with less, the noise of arm and pictures decides where the bases are.
"""

SMALLEST_MISS = 1e-9
"""Smallest unit of misses, m or rad, for poses without any noise."""


def place_bases(hands: HandPoses, camera_from_world: SE3, used: Bool[np.ndarray, "views"]) -> SE3:
    """Return the base of the target's arm in the base of the camera's arm.

    Args:
        hands: what both arms reported.
        camera_from_world: target in the frame of the camera, by the pictures.
        used: mask of the views to use.

    Raises:
        ValueError: a hand that did not turn about two axes.
    """
    poses = camera_from_world, hands.base_from_tool, hands.other_base_from_other_tool
    return solve_bases(*(host_matrices(pose)[used] for pose in poses))


def solve_bases(
    camera_from_world: Float[np.ndarray, "views 4 4"],
    base_from_tool: Float[np.ndarray, "views 4 4"],
    other_base_from_other_tool: Float[np.ndarray, "views 4 4"],
) -> SE3:
    """Return the base of the other arm in the base of the camera's arm.

    Args:
        camera_from_world: target in the frame of the camera, by the pictures.
        base_from_tool: poses of the hand with the camera in its base.
        other_base_from_other_tool: poses of the hand with the target in its base.

    Raises:
        ValueError: a hand that did not turn about two axes.
    """
    left, right = np.linalg.inv(base_from_tool), other_base_from_other_tool
    for name, poses in (("with the camera", left), ("with the target", right)):
        _require_turns(name, poses[:, :3, :3])
    turns = _rotations(camera_from_world[:, :3, :3], left[:, :3, :3], right[:, :3, :3])
    ends = host_poses(turns, _translations(camera_from_world, left, right, turns))
    return host_transforms(_refined(camera_from_world, left, right, ends)[1])


def _require_turns(name: str, rotations: Float[np.ndarray, "views 3 3"]) -> None:
    """Raise a ValueError if a hand did not turn about two axes."""
    from_first = Rotation.from_matrix(rotations[1:] @ rotations[0].T).as_rotvec()
    spread = np.linalg.svd(from_first, compute_uv=False)
    if len(spread) < 2 or spread[1] < MIN_TURN * np.sqrt(len(rotations)):
        raise ValueError(
            f"the hand {name} did not turn about two axes: where the bases of two arms are to each "
            "other follows only if both hands turn. Turn both hands; or, if one stands still, give "
            "the poses of the other alone (mount eye_in_hand or eye_to_hand)"
        )


def _rotations(
    seen: Float[np.ndarray, "views 3 3"],
    left: Float[np.ndarray, "views 3 3"],
    right: Float[np.ndarray, "views 3 3"],
) -> Float[np.ndarray, "3 3 3"]:
    """Return the rotations of X, B and Z."""
    tried = Rotation.random(TRIED_ROTATIONS, np.random.default_rng(0)).as_matrix()
    between = left[None] @ tried[:, None] @ right[None]
    # The sum of tr(C^T X A Z) over the views is vec(X)^T K vec(Z).
    kernel = np.einsum("vij,bvkl->bikjl", seen, between).reshape(-1, 9, 9)
    mounts, values, holders = np.linalg.svd(kernel)
    best = np.argsort(-values[:, 0])[:REFINED_ROTATIONS]

    def misses(vector: np.ndarray) -> np.ndarray:
        """Return the rotation vectors by which the views are missed."""
        x, b, z = Rotation.from_rotvec(vector.reshape(3, 3)).as_matrix()
        missed = x @ left @ b @ right @ z @ seen.swapaxes(1, 2)
        return Rotation.from_matrix(missed).as_rotvec().ravel()

    results = []
    for k in best:
        x, z = (
            host_nearest_rotation(matrix * np.sign(np.linalg.det(matrix)))
            for matrix in (mounts[k, :, 0].reshape(3, 3), holders[k, 0].reshape(3, 3))
        )
        start = Rotation.from_matrix(np.stack([x, tried[k], z.T])).as_rotvec().ravel()
        results.append(least_squares(misses, start, loss="soft_l1", f_scale=0.01))
    likeliest = min(results, key=lambda result: result.cost)
    return Rotation.from_rotvec(likeliest.x.reshape(3, 3)).as_matrix()


def _translations(
    seen: Float[np.ndarray, "views 4 4"],
    left: Float[np.ndarray, "views 4 4"],
    right: Float[np.ndarray, "views 4 4"],
    turns: Float[np.ndarray, "3 3 3"],
) -> Float[np.ndarray, "3 3"]:
    """Return the translations of X, B and Z for given rotations."""
    # t_C = t_X + X (t_L + L (t_B + B (t_R + R t_Z)))
    x, b, _ = turns
    after_left = x @ left[:, :3, :3]
    after_right = after_left @ b @ right[:, :3, :3]
    known = left[:, :3, 3] @ x.T + (after_left @ b @ right[:, :3, 3:])[..., 0]
    identity = np.broadcast_to(np.eye(3), after_left.shape)
    columns = np.concatenate([identity, after_left, after_right], axis=2).reshape(-1, 9)
    return np.linalg.lstsq(columns, (seen[:, :3, 3] - known).ravel())[0].reshape(3, 3)


def _refined(
    seen: Float[np.ndarray, "views 4 4"],
    left: Float[np.ndarray, "views 4 4"],
    right: Float[np.ndarray, "views 4 4"],
    ends: Float[np.ndarray, "3 4 4"],
) -> list[Float[np.ndarray, "4 4"]]:
    """Return X, B and Z that fit rotations and translations together, wrong views counting less."""

    def moved(vector: np.ndarray) -> list[np.ndarray]:
        """Return the transforms after a step: rotations from the left, translations added."""
        poses = [pose.copy() for pose in ends]
        for pose, step in zip(poses, vector.reshape(3, 6), strict=True):
            pose[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
            pose[:3, 3] += step[:3]
        return poses

    def missed(vector: np.ndarray) -> np.ndarray:
        """Return the translations and rotations by which the views are missed."""
        x, b, z = moved(vector)
        predicted = x @ left @ b @ right @ z
        turned = predicted @ np.linalg.inv(seen)
        turned[:, :3, 3] = 0.0
        turn = host_logarithms(turned)[:, 3:]
        return np.hstack([predicted[:, :3, 3] - seen[:, :3, 3], turn])

    step = np.zeros(18)
    for loss in ("soft_l1", "cauchy"):
        # In units of the median miss of a coordinate, of translations and of rotations.
        size = np.median(np.abs(missed(step)).reshape(-1, 2, 3), axis=(0, 2)).repeat(3)
        size = np.maximum(size, SMALLEST_MISS)

        def in_units(step: np.ndarray, size: np.ndarray = size) -> np.ndarray:
            return (missed(step) / size).ravel()

        step = least_squares(in_units, step, loss=loss, x_scale="jac").x
    return moved(step)
