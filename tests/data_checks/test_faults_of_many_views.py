"""Of several faults that make many views wrong, the one that was made is named.

The poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
from robot_motions import (
    CAMERA_FROM_MOUNT,
    HOLDER_FROM_WORLD,
    UNCHANGED,
    VIEWS,
    moving_alike,
    transform,
)

from smartview_jax.data_checks import RobotAndCamera, SeenDistances, find_shared_fault
from smartview_jax.geometry import as_se3

IDS = [f"v{view}" for view in range(VIEWS)]
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
AFTER = (np.arange(VIEWS) >= 8)[:, None, None]


def fault_of(robot, camera, length_ratio=1.0, distances=None):
    reported = as_se3(np.linalg.inv(robot))
    poses = RobotAndCamera(reported, as_se3(camera), "eye_in_hand", IDS, length_ratio)
    return find_shared_fault(poses._replace(distances=distances), EVERY_VIEW)


def test_a_target_of_another_size_is_no_change():
    """Where the robot works in two places, lengths that are too short look like a moved target."""
    robot, _ = moving_alike(3)
    robot[8:] = robot[8:] @ transform([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    camera = CAMERA_FROM_MOUNT @ robot @ HOLDER_FROM_WORLD
    camera[:, :3, 3] *= 1.1
    as_reported = fault_of(robot, camera)
    assert as_reported is not None
    assert "the target had been moved" in as_reported.sentence
    assert fault_of(robot, camera, length_ratio=1.1) is None


def test_a_change_that_looks_like_another_size_is_named():
    push = transform([0.0, 0.0, 0.0], [0.05, 0.0, 0.0])
    robot, camera = moving_alike(0, UNCHANGED, np.where(AFTER, push, UNCHANGED), noise=(2e-4, 0.02))
    fault = fault_of(robot, camera, length_ratio=0.95)
    assert fault.sentence.startswith("from view v8 on")
    assert fault.contradicts


def test_a_change_with_views_that_fit_nothing_is_no_mixture():
    """Without the two views there are two groups, one after the other."""
    knock = transform([0.0, 2.0, 0.0], [0.02, 0.0, 0.0])
    robot, camera = moving_alike(0, np.where(AFTER, knock, UNCHANGED), noise=(2e-4, 0.02))
    for view in (3, 11):
        camera[view] = transform([1.0, -1.5, 0.5], [0.01, 0.02, -0.02]) @ camera[view]
    fault = fault_of(robot, camera)
    assert fault.sentence.startswith("from view v8 on")


def test_a_lens_that_zoomed_once_is_not_one_that_changes_all_the_time():
    """A weak robot's errors leave much with either: the zoom tells from which view on."""
    robot, camera = moving_alike(0, noise=(4e-3, 0.4))
    camera[8:, 2, 3] /= 1.08
    distances = SeenDistances(np.zeros(3), np.full(VIEWS, 1e-4))
    fault = fault_of(robot, camera, distances=distances)
    assert "the lens had zoomed" in fault.sentence


def test_a_camera_pushed_along_its_axis_by_little_is_no_focus_that_changed_once():
    """In most views the robot errs by as much, and a focus explains the depths as well."""
    knock = np.array([transform([0.0, 0.0, 0.0], [0.0, 0.0, 5e-3 * (k >= 12)]) for k in range(24)])
    robot, camera = moving_alike(6, noise=(1e-3, 0.1), views=24, errs_at="holder")
    poses = RobotAndCamera(
        as_se3(np.linalg.inv(robot)),
        as_se3(knock @ camera),
        "eye_in_hand",
        [f"v{view}" for view in range(24)],
        distances=SeenDistances(np.zeros(3), np.full(24, 1e-4)),
    )
    fault = find_shared_fault(poses, np.ones(24, dtype=bool))
    assert "from view v12 on, the views contradict the earlier ones" in fault.sentence
    assert "as if the camera had been moved" in fault.sentence
