"""Motions that fit a camera on the hand and one next to the arm are told to the user."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.data_checks import both_inverted_doubt, check_conventions
from smartview_jax.data_checks.transform_fit import fit_transforms
from smartview_jax.geometry import host_transforms


def pose(rotation_vector, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


CAMERA_FROM_TOOL = pose([0.2, -0.1, 0.3], [0.03, -0.05, 0.08])
BASE_FROM_WORLD = pose([0.1, 0.2, 1.0], [0.5, 0.1, 0.05])


def camera_from_world(views, turned):
    """A camera that looks at the target from 0.4 m, tilted and perhaps turned about its axis."""
    rng = np.random.default_rng(0)
    tilts = np.column_stack([rng.uniform(-0.5, 0.5, (views, 2)), np.zeros(views)])
    rolls = turned * rng.uniform(-1.0, 1.0, views)
    return np.stack(
        [
            pose([0.0, 0.0, roll], [0.0, 0.0, 0.4]) @ pose(tilt, [0.0, 0.0, 0.0])
            for roll, tilt in zip(rolls, tilts, strict=True)
        ]
    )


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
@pytest.mark.parametrize(
    ("views", "turned", "doubted"), [(3, True, True), (10, False, True), (10, True, False)]
)
def test_views_that_fit_inverted_poses_as_well_are_told(mount, views, turned, doubted):
    seen = camera_from_world(views, turned)
    # C = X T^-1 W, where T is base_from_tool; stated the other way round it must be T^-1.
    robot = np.linalg.inv(np.linalg.inv(CAMERA_FROM_TOOL) @ seen @ np.linalg.inv(BASE_FROM_WORLD))
    in_hand = mount == "eye_in_hand"
    given = robot if in_hand else np.linalg.inv(robot)
    report = check_conventions(host_transforms(given), host_transforms(seen), mount)
    assert report.problems == ()
    inverted = [text for text in report.ambiguities if "with every pose inverted" in text]
    assert bool(inverted) == doubted
    if doubted:
        # X X2^-1 turns half about the common perpendicular: the camera is where X puts it.
        distance = 1e3 * np.linalg.norm(CAMERA_FROM_TOOL[:3, 3])
        assert f"as given the camera is {distance:.0f} mm from" in inverted[0]


def test_a_wrong_mount_is_named_by_views_that_tell_it():
    seen = camera_from_world(10, turned=True)
    robot = np.linalg.inv(np.linalg.inv(CAMERA_FROM_TOOL) @ seen @ np.linalg.inv(BASE_FROM_WORLD))
    report = check_conventions(host_transforms(robot), host_transforms(seen), "eye_to_hand")
    assert "every pose is inverted" in report.problems[0]
    assert report.ambiguities == ()


def test_turns_about_one_axis_are_no_closure_error():
    """Nothing tells where along the axis the camera is: that is no disagreement."""
    rng = np.random.default_rng(1)
    turns = [pose([0.0, 0.0, a], rng.uniform(-0.1, 0.1, 3)) for a in rng.uniform(-1.0, 1.0, 10)]
    noise = [pose(rng.normal(0.0, 3e-4, 3), rng.normal(0.0, 2e-4, 3)) for _ in turns]
    seen = CAMERA_FROM_TOOL @ np.linalg.inv(turns) @ np.linalg.inv(noise) @ BASE_FROM_WORLD
    report = check_conventions(
        host_transforms(np.array(turns)), host_transforms(seen), "eye_in_hand"
    )
    assert report.is_close
    assert report.problems == ()


@pytest.mark.parametrize("in_hand", [True, False])
def test_robot_and_tracked_poses_that_are_both_inverted_are_told(in_hand):
    seen = camera_from_world(10, turned=True)
    holder_from_mount = BASE_FROM_WORLD @ np.linalg.inv(seen) @ CAMERA_FROM_TOOL
    if not in_hand:
        # The camera stands where the target was, and the target is where the camera was.
        seen, holder_from_mount = np.linalg.inv(seen), np.linalg.inv(holder_from_mount)
    mount = ("eye_to_hand", "eye_in_hand")[in_hand]
    for inverted in (False, True):
        robot, tracked = (np.linalg.inv(p) if inverted else p for p in (holder_from_mount, seen))
        base_from_tool = robot if in_hand else np.linalg.inv(robot)
        report = check_conventions(host_transforms(base_from_tool), host_transforms(tracked), mount)
        assert report.problems == ()
        assert not [text for text in report.ambiguities if "inverted" in text]
        found = fit_transforms(np.linalg.inv(robot), tracked, np.ones(10, bool))
        doubt = both_inverted_doubt(
            np.linalg.inv(found.camera_from_mount), found.holder_from_world, in_hand
        )
        assert bool(doubt) == inverted
        if inverted:
            assert all(
                f"{1e3 * np.linalg.norm(place[:3, 3]):.0f} mm" in doubt
                for place in (BASE_FROM_WORLD, CAMERA_FROM_TOOL)
            )
