"""Solve `A X = X B` where the robot's motion leaves directions of both transforms undetermined.

An arm that turns about one axis only tells nothing of the camera's place along that axis: camera
and target can be shifted along it together. The closed forms divide by the noise of such a
direction and put the camera hundreds of metres away. Here no step has a part along it: both
transforms are found by Gauss-Newton steps of minimum norm, and stay along an undetermined direction
where they start. By default that is the target at the origin of its holder, the paper's start.
A tracker may follow a target anywhere in the room, but a camera on a hand is near it: the camera
can be put as near as possible to the origin of its mount instead.

The cost is the Frobenius norm of `camera_from_mount T_i holder_from_world - C_i` (Eq. 10), lengths
over the distance to the target.
"""

import itertools

import numpy as np
from jaxtyping import Float

from ..dataset import undetermined_twists
from ..geometry import host_adjoints, host_cross_matrices, host_exponentials, host_logarithms
from .closed_form import mean_camera_from_mount

_Matrix = Float[np.ndarray, "4 4"]
_Matrices = Float[np.ndarray, "views 4 4"]

MAX_STEPS = 50
"""The largest number of steps from one start."""

MAX_SEARCHED_VIEWS = 60
"""The number of views, evenly spaced, among which the best of the starts is searched."""

MAX_DAMPING = 1e8
"""The damping, relative to the diagonal, at which a search has come to its end."""


def minimum_norm_transforms(
    mount_from_holder: _Matrices,
    camera_from_world: _Matrices,
    start: tuple[_Matrix | None, _Matrix | None] = (None, None),
    camera_on_hand: bool = False,
) -> tuple[_Matrix, _Matrix]:
    """Return `camera_from_mount` and `holder_from_world`, undetermined directions as at the start.

    Args:
        mount_from_holder, camera_from_world: of the views to use, finite.
        start: both transforms as far as they are known. The first that is given keeps its place
            along the undetermined directions.
        camera_on_hand: without a start, whether the camera comes as near as possible to the origin
            of its mount, or the target to the origin of its holder.
    """
    twists = undetermined_twists(mount_from_holder)
    spaced = np.linspace(0, len(mount_from_holder) - 1, MAX_SEARCHED_VIEWS)
    some = np.unique(spaced.astype(int))
    T, C = mount_from_holder[some], camera_from_world[some]
    translation = np.zeros(3) if start[1] is None else start[1][:3, 3]
    found = [_search(T, C, _pose(turn, translation), twists) for turn in _cube_rotations()]
    _, _, world = min(found, key=lambda search: search[0])
    _, camera, world = _search(mount_from_holder, camera_from_world, world, twists)
    return _shifted_to_start(camera, world, mount_from_holder[0], twists, start, camera_on_hand)


def _cube_rotations() -> list[Float[np.ndarray, "3 3"]]:
    """Return the 24 rotations of a cube: one of them is within 63 degrees of any rotation."""
    matrices = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return [matrix for matrix in matrices if np.linalg.det(matrix) > 0.0]


def _pose(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> _Matrix:
    """Return the 4x4 matrix of a rotation and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def _search(
    T: _Matrices, C: _Matrices, world: _Matrix, twists: Float[np.ndarray, "twists 6"]
) -> tuple[float, _Matrix, _Matrix]:
    """Return the cost and both transforms after damped Gauss-Newton steps of minimum norm.

    Args:
        T, C: `mount_from_holder` and `camera_from_world`.
        world: start of `holder_from_world`; `camera_from_mount` follows from it.
        twists: undetermined twists of the holder, along which no step goes.
    """
    camera = mean_camera_from_mount(world, T, C, np.ones(len(T)))
    unit = float(np.median(np.linalg.norm(C[:, :3, 3], axis=1)))
    allowed = determined_steps(T, twists)
    residual, cost = _residual(camera, world, T, C, unit)
    damping = 1e-3
    for _ in range(MAX_STEPS):
        jacobian = _jacobian(camera, world, T, unit) @ allowed
        matrix, gradient = jacobian.T @ jacobian, jacobian.T @ residual
        diagonal = np.diag(np.maximum(np.diagonal(matrix), 1e-12 * matrix.max()))
        step = -allowed @ np.linalg.solve(matrix + damping * diagonal, gradient)
        # exp(step) from the right of the one, from the left of the other, see `_jacobian`.
        trial = camera @ host_exponentials(step[:6]), host_exponentials(step[6:]) @ world
        trial_residual, trial_cost = _residual(*trial, T, C, unit)
        if trial_cost < cost:
            gained = cost - trial_cost
            (camera, world), residual, cost = trial, trial_residual, trial_cost
            damping *= 0.1
            if gained <= 1e-12 * cost:
                break
        else:
            damping *= 10.0
            if damping > MAX_DAMPING:
                break
    return cost, camera, world


def determined_steps(
    mount_from_holder: _Matrices, twists: Float[np.ndarray, "twists 6"]
) -> Float[np.ndarray, "12 determined"]:
    """Return an orthonormal basis of the steps of both transforms without undetermined ones.

    A step is a twist of `camera_from_mount` from its right and one of `holder_from_world` from its
    left, each translation (m) first, then rotation (rad).

    Args:
        mount_from_holder: of the views to use.
        twists: undetermined twists of the holder.
    """
    # exp(a) T_i exp(b) = T_i for every view if a = -Ad(T_i) b.
    moved = -host_adjoints(mount_from_holder).mean(axis=0) @ twists.T
    undetermined = np.concatenate([moved, twists.T])
    return np.linalg.svd(undetermined, full_matrices=True)[0][:, len(twists) :]


def _residual(
    camera: _Matrix, world: _Matrix, T: _Matrices, C: _Matrices, unit: float
) -> tuple[Float[np.ndarray, "rows"], float]:
    """Return the entries of `camera T_i world - C_i` and the sum of their squares."""
    difference = (camera @ T @ world - C)[:, :3]
    difference[:, :, 3] /= unit
    residual = difference.ravel()
    return residual, float(residual @ residual)


def _jacobian(
    camera: _Matrix, world: _Matrix, T: _Matrices, unit: float
) -> Float[np.ndarray, "rows 12"]:
    """Return the derivative of the residual by a twist at the mount and one at the holder."""
    generators = np.zeros((6, 4, 4))
    generators[[0, 1, 2], [0, 1, 2], 3] = 1.0
    generators[3:, :3, :3] = host_cross_matrices(np.eye(3))
    chain, before = (T @ world)[:, None], (camera @ T)[:, None]
    derivative = np.concatenate(
        [camera @ generators @ chain, before @ (generators @ world)], axis=1
    )
    derivative = derivative[:, :, :3].copy()
    derivative[..., 3] /= unit
    return derivative.reshape(len(T), 12, 12).swapaxes(1, 2).reshape(-1, 12)


def _shifted_to_start(
    camera: _Matrix,
    world: _Matrix,
    mount_from_holder: _Matrix,
    twists: Float[np.ndarray, "twists 6"],
    start: tuple[_Matrix | None, _Matrix | None],
    camera_on_hand: bool,
) -> tuple[_Matrix, _Matrix]:
    """Return the transforms moved along undetermined twists to where they start.

    Args:
        camera, world: the transforms found.
        mount_from_holder: of any view.
        twists: undetermined twists of the holder.
        start, camera_on_hand: as in `minimum_norm_transforms`.
    """
    if not len(twists):
        return camera, world
    adjoint = host_adjoints(mount_from_holder)
    for _ in range(MAX_STEPS):
        if start[0] is not None:
            # A twist of the holder is one of the mount, on the other side of the robot.
            offset = host_logarithms(np.linalg.inv(camera) @ start[0])
            along = -adjoint @ twists.T
        elif start[1] is not None:
            offset, along = host_logarithms(start[1] @ np.linalg.inv(world)), twists.T
        # Of an origin alone: without a start nothing says how camera or target is turned.
        elif camera_on_hand:
            offset, along = -camera[:3, 3], camera[:3, :3] @ (-adjoint @ twists.T)[:3]
        else:
            offset = -world[:3, 3]
            along = (twists[:, :3] + np.cross(twists[:, 3:], world[:3, 3])).T
        step = np.linalg.lstsq(along, offset)[0] @ twists
        camera = camera @ host_exponentials(-adjoint @ step)
        world = host_exponentials(step) @ world
        if np.linalg.norm(step) < 1e-12:
            break
    return camera, world
