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

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..dataset import evenly_spaced, undetermined_twists
from ..geometry import (
    host_adjoints,
    host_cross_matrices,
    host_exponentials,
    host_logarithms,
    host_poses,
)
from .closed_form import mean_camera_from_mount

_Matrix = Float[np.ndarray, "4 4"]
_Matrices = Float[np.ndarray, "views 4 4"]
_Starts = Float[np.ndarray, "starts 4 4"]

MAX_STEPS = 50
"""The largest number of steps from one start."""

MAX_SEARCHED_VIEWS = 60
"""The number of views, evenly spaced, among which the best of the starts is searched."""

SEARCH_TOLERANCE = 1e-3
"""The relative decrease of the cost by a step at which one of the starts is not followed further.

The best of them is followed to the last digits.
"""

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
    some = evenly_spaced(len(mount_from_holder), MAX_SEARCHED_VIEWS)
    T, C = mount_from_holder[some], camera_from_world[some]
    translation = np.zeros(3) if start[1] is None else start[1][:3, 3]
    # One of the 24 rotations of a cube is within 63 degrees of any rotation.
    starts = host_poses(Rotation.create_group("O").as_matrix(), translation)
    costs, _, worlds = _search(T, C, starts, twists, SEARCH_TOLERANCE)
    best = worlds[[np.argmin(costs)]]
    _, (camera,), (world,) = _search(mount_from_holder, camera_from_world, best, twists, 1e-12)
    return _shifted_to_start(camera, world, mount_from_holder[0], twists, start, camera_on_hand)


def _search(
    T: _Matrices,
    C: _Matrices,
    worlds: _Starts,
    twists: Float[np.ndarray, "twists 6"],
    tolerance: float,
) -> tuple[Float[np.ndarray, "starts"], _Starts, _Starts]:
    """Return costs and both transforms after damped Gauss-Newton steps of minimum norm.

    Args:
        T, C: `mount_from_holder` and `camera_from_world`.
        worlds: starts of `holder_from_world`; `camera_from_mount` follows from each. The searches
            are made together, which takes a third of the time.
        twists: undetermined twists of the holder, along which no step goes.
        tolerance: relative decrease of the cost by a step at which a search ends.
    """
    cameras, worlds = mean_camera_from_mount(worlds, T, C, np.ones(len(T))), worlds.copy()
    unit = float(np.median(np.linalg.norm(C[:, :3, 3], axis=1)))
    allowed = determined_steps(T, twists)
    costs = _costs(cameras, worlds, T, C, unit)
    damping = np.full(len(worlds), 1e-3)
    going = np.arange(len(worlds))
    for _ in range(MAX_STEPS):
        camera, world, cost = cameras[going], worlds[going], costs[going]
        matrix, gradient = _normal_equations(camera, world, T, C, unit)
        matrix, gradient = allowed.T @ matrix @ allowed, gradient @ allowed
        diagonal = np.diagonal(matrix, axis1=1, axis2=2)
        diagonal = np.maximum(diagonal, 1e-12 * matrix.max(axis=(1, 2))[:, None])
        damped = matrix + (damping[going, None] * diagonal)[:, None] * np.eye(len(matrix[0]))
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0] @ allowed.T
        # exp(step) from the right of the one, from the left of the other.
        camera = camera @ host_exponentials(step[:, :6])
        world = host_exponentials(step[:, 6:]) @ world
        trial_cost = _costs(camera, world, T, C, unit)
        better = trial_cost < cost
        kept = going[better]
        cameras[kept], worlds[kept], costs[kept] = camera[better], world[better], trial_cost[better]
        damping[going] *= np.where(better, 0.1, 10.0)
        at_minimum = better & (cost - trial_cost <= tolerance * trial_cost)
        going = going[~at_minimum & (better | (damping[going] <= MAX_DAMPING))]
        if not len(going):
            break
    return costs, cameras, worlds


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


def _misfits(
    cameras: _Starts, worlds: _Starts, T: _Matrices, C: _Matrices, unit: float
) -> tuple[Float[np.ndarray, "starts views 4 3"], Float[np.ndarray, "starts views 4 3"]]:
    """Return the columns of `camera T_i world`, and those less the columns of `C_i`, in units."""
    columns = (cameras[:, None] @ T @ worlds[:, None])[:, :, :3].swapaxes(2, 3)
    misfits = columns - C[:, :3].swapaxes(1, 2)
    misfits[:, :, 3] /= unit
    return columns, misfits


def _costs(
    cameras: _Starts, worlds: _Starts, T: _Matrices, C: _Matrices, unit: float
) -> Float[np.ndarray, "starts"]:
    """Return the sums of squares of the entries of `camera T_i world - C_i`."""
    return np.square(_misfits(cameras, worlds, T, C, unit)[1]).sum(axis=(1, 2, 3))


def _normal_equations(
    cameras: _Starts, worlds: _Starts, T: _Matrices, C: _Matrices, unit: float
) -> tuple[Float[np.ndarray, "starts 12 12"], Float[np.ndarray, "starts 12"]]:
    """Return `J^T J` and `J^T r` for a twist at the mount and one at the holder."""
    columns, misfits = _misfits(cameras, worlds, T, C, unit)
    rotations = columns[:, :, None, :3].swapaxes(3, 4)
    crosses = -host_cross_matrices(np.eye(3))
    # A twist (v, w) from the left of the chain moves column p by w x p, and the last also by v; one
    # from the right moves column j by R (w x e_j), and the last by R v.
    jacobian = np.zeros((*columns.shape, 12))
    jacobian[..., 3:6] = -host_cross_matrices(columns)
    jacobian[..., :3, :, 9:] = rotations @ crosses
    jacobian[..., 3, :, :3] = np.eye(3)
    jacobian[..., 3, :, 6:9] = rotations[:, :, 0]
    jacobian[..., 3, :, :] /= unit
    rows = jacobian.reshape(len(cameras), -1, 12)
    transposed = rows.swapaxes(1, 2)
    gradients = transposed @ misfits.reshape(len(cameras), -1, 1)
    # Twists at mount and holder act between the factors: they pass through camera and world.
    passed = np.zeros((len(cameras), 12, 12))
    passed[:, :6, :6] = host_adjoints(cameras)
    passed[:, 6:, 6:] = host_adjoints(np.linalg.inv(worlds))
    back = passed.swapaxes(1, 2)
    return back @ (transposed @ rows) @ passed, (back @ gradients)[..., 0]


def _shifted_to_start(
    camera: _Matrix,
    world: _Matrix,
    mount_from_holder: _Matrix,
    twists: Float[np.ndarray, "twists 6"],
    start: tuple[_Matrix | None, _Matrix | None],
    camera_on_hand: bool,
) -> tuple[_Matrix, _Matrix]:
    """Return the transforms moved along undetermined twists of the holder to where they start.

    The pose `mount_from_holder` is of any view.
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
