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
        tool_distance = np.median(np.linalg.norm(base_from_tool[:, :3, 3], axis=1))
        mount_from_camera = np.linalg.inv(found.camera_from_mount)
        doubt = both_inverted_doubt(
            mount_from_camera, found.holder_from_world, tool_distance, in_hand
        )
        assert bool(doubt) == inverted
        if inverted:
            assert all(
                f"{1e3 * np.linalg.norm(place[:3, 3]):.0f} mm" in doubt
                for place in (BASE_FROM_WORLD, CAMERA_FROM_TOOL)
            )


def doubt_of_cell(from_tool, from_base, tool_distance, in_hand):
    """The doubt where things are so far from tool and base, and the tool from the base, in m."""
    on_hand, in_cell = (pose([0.1, 0.2, 0.3], [0.0, 0.0, d]) for d in (from_tool, from_base))
    camera, target = (on_hand, in_cell) if in_hand else (in_cell, on_hand)
    return both_inverted_doubt(camera, target, tool_distance, in_hand)


@pytest.mark.parametrize("in_hand", [True, False])
@pytest.mark.parametrize(
    "distances",
    [
        # A target on a long tool, and a camera close to the arm.
        (0.45, 0.40, 0.60),
        # A base frame that was set at the target, or at the camera.
        (0.12, 0.03, 0.50),
        (0.15, 0.00, 0.80),
        # A small arm.
        (0.12, 0.10, 0.20),
        # A pan-tilt unit: its axes meet where base and tool are.
        (0.05, 1.00, 0.00),
    ],
)
def test_unusual_cells_are_not_doubted(distances, in_hand):
    assert doubt_of_cell(*distances, in_hand) == ""


REAL_CELLS = {
    "rct_circle10x10": (0.108, 0.976, 1.244),
    "tampere_kuka_2": (0.136, 1.831, 1.446),
    "lwr4_joint": (0.110, 0.764, 0.890),
    "koide_charuco": (0.057, 0.336, 0.596),
    "visp_franka_eih": (0.078, 0.434, 0.570),
    "ur5e_kinect_78": (0.247, 1.296, 0.963),
    "visp_franka_eth": (0.060, 1.068, 0.934),
    "metric_workcell": (0.117, 2.631, 0.787),
}
"""Distances of hand-held camera or target from the tool, of the other, and of the tool, from the
base, m, by a closed form."""


@pytest.mark.parametrize("cell", REAL_CELLS)
def test_real_cells_are_doubted_only_when_inverted(cell):
    from_tool, from_base, tool_distance = REAL_CELLS[cell]
    in_hand = cell not in ("visp_franka_eth", "metric_workcell")
    assert doubt_of_cell(from_tool, from_base, tool_distance, in_hand) == ""
    # With both inverted, camera and target exchange their places.
    assert doubt_of_cell(from_base, from_tool, tool_distance, in_hand) != ""
