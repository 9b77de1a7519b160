"""Tell whether poses of robot and camera belong together in pairs, however inaccurate they are.

The size of an error does not tell this: a small marker far away leaves 15 degrees between two
views, and a wrong convention may leave less. But poses that belong together agree less in any other
order, and noise is in all views alike, whatever the pose, whereas of wrong pairs the others agree
as well as ever.
"""

import numpy as np
from scipy.special import fdtrc

from ..geometry import (
    host_logarithms,
    host_pairwise_rotation_angles,
    host_rotation_vectors,
    mean_matrix,
)
from .closure import (
    Poses,
    RelativeMotions,
    closure_error,
    closure_errors,
    relative_motions,
    spread_views,
)
from .largest_group import disagreements, largest_group
from .transform_fit import TransformFit, fit_transforms, median_distance

SHUFFLES = 199
"""Number of random orders: the given one is better than all of them by chance once in 200."""

MIN_EXACT, MIN_EXACT_SHARE = 5, 1.0 / 3.0
"""Smallest number of views, and their smallest share, that agree as with a good arm although others
do not, and that are no chance."""

MAX_CHANCE = 1e-3
"""Probability by chance below which errors follow the pose."""

ORDERS_AT_ONCE = 20
"""Number of orders whose motions are computed at once: a few megabytes."""

MIN_ANGLE = 1e-9
"""Smallest angle whose logarithm is compared, rad: a rounding error."""


def are_paired(mount_from_holder: Poses, camera_from_world: Poses) -> bool:
    """Return whether robot and camera belong together in every view, with errors like noise.

    Three or four views have too few other orders, so that the answer is no.

    Args:
        mount_from_holder: the robot's part of the chain, finite.
        camera_from_world: finite.
    """
    compared = spread_views(len(mount_from_holder))
    robot, camera = mount_from_holder[compared], camera_from_world[compared]
    motions = relative_motions(robot, camera)
    if not _differ_like_noise(robot, camera, motions):
        return False
    fit = fit_transforms(robot, camera)
    return (
        _fit_their_own_pose(robot, camera, fit)
        and not _follow_the_pose(robot, fit)
        and not _some_agree_exactly(robot, camera)
        and _agree_better_than_in_any_order(robot, camera, motions)
    )


def _differ_like_noise(robot: Poses, camera: Poses, given: RelativeMotions) -> bool:
    """Return whether small motions differ as much as large ones.

    Errors of a convention are in proportion to the motion, so that their ratio to it varies less
    than they do; with noise it varies more.
    """
    pairs = np.triu_indices(len(robot), 1)
    motions = [host_pairwise_rotation_angles(poses, poses)[pairs] for poses in (robot, camera)]
    *turned, left_over = (
        np.log(np.maximum(angle, MIN_ANGLE)) for angle in (*motions, given.rotation_error)
    )
    # The noise of one of them makes its own motion larger, too.
    return bool(left_over.var() < max((left_over - angle).var() for angle in turned))


def _fit_their_own_pose(robot: Poses, camera: Poses, fit: TransformFit) -> bool:
    """Return whether every view fits its own robot pose better than most poses of other views.

    A wrong pose does so as often as not, whatever the transforms are.
    """
    expected = fit.camera_from_mount @ robot @ fit.holder_from_world
    closures = camera[:, None] @ np.linalg.inv(expected)
    misfit = disagreements(closures, median_distance(camera))
    return bool((np.diagonal(misfit) <= np.median(misfit, axis=1)).all())


def _follow_the_pose(robot: Poses, fit: TransformFit) -> bool:
    """Return whether the views' rotation errors are linear in the robot's rotation, by an F test.

    Noise does not depend on the pose. Where one component of each rotation has a wrong scale, the
    errors are noise in all other respects.
    """
    errors = host_logarithms(fit.closure)[:, 3:]
    middle = mean_matrix(robot, np.ones(len(robot)))
    columns = np.ones((len(robot), 4))
    columns[:, 1:] = host_rotation_vectors(robot @ np.linalg.inv(middle))
    if (freedom := 3 * (len(robot) - 4)) <= 0:
        return False
    left_over = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    squares = max(float(np.sum(left_over**2)), 1e-300)
    explained = float(np.sum((errors - errors.mean(axis=0)) ** 2)) - squares
    return bool(fdtrc(9, freedom, max(explained, 0.0) / 9.0 * freedom / squares) < MAX_CHANCE)


def _some_agree_exactly(robot: Poses, camera: Poses) -> bool:
    """Return whether some views agree as with a good arm, so that the others are wrong."""
    exact = largest_group(robot, camera, median_distance(camera))
    return exact.sum() >= max(MIN_EXACT, MIN_EXACT_SHARE * len(robot))


def _agree_better_than_in_any_order(robot: Poses, camera: Poses, given: RelativeMotions) -> bool:
    """Return whether the closure error is smaller than in `SHUFFLES` random orders of the robot.

    This permutation test needs no assumption on the errors.
    """
    rng = np.random.default_rng(0)
    least = closure_error(given).score
    orders = np.stack([rng.permutation(len(robot)) for _ in range(SHUFFLES)])
    for part in np.array_split(orders, range(ORDERS_AT_ONCE, SHUFFLES, ORDERS_AT_ONCE)):
        shuffled = robot[part]
        motions = relative_motions(shuffled, np.broadcast_to(camera, shuffled.shape))
        if not least < closure_errors(motions)[:, 2].min():
            return False
    return True
