"""Views of two cameras, tools or base frames, mixed in any order, are named; good ones never.

The poses are made by SciPy's rotations and plain products of matrices.
"""

import dataclasses

import numpy as np
import pytest
from robot_motions import CAMERA_FROM_MOUNT, UNCHANGED, VIEWS, mirrored, moving_alike, transform

from smartview_jax.data_checks import find_groups
from smartview_jax.data_checks.picture_turns import PictureTurn
from smartview_jax.data_checks.view_groups import GroupOptions
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.staged import fit_staged

IDS = [f"v{view}" for view in range(VIEWS)]
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
SECOND = np.arange(VIEWS) % 3 == 1
OTHER_CAMERA = transform([0.0, 3.0, 0.0], [0.06, 0.0, 0.0])


def mixed(second=SECOND, camera=UNCHANGED, target=UNCHANGED, seed=0, noise=(2e-4, 0.02)):
    """Robot poses and camera poses, some of them with another camera or target."""
    chosen = second[:, None, None]
    changes = (np.where(chosen, change, UNCHANGED) for change in (camera, target))
    return tuple(map(as_se3, moving_alike(seed, *changes, noise=noise)))


@pytest.mark.parametrize("kind", ["camera", "target"])
@pytest.mark.parametrize("noise", [(2e-4, 0.02), (1e-3, 0.2)])
def test_mixed_views_are_named_with_their_group_and_change(kind, noise):
    found = find_groups(*mixed(**{kind: OTHER_CAMERA}, noise=noise), EVERY_VIEW)
    assert found.kind == kind
    assert [group.views for group in found.groups] == [
        tuple(np.flatnonzero(~SECOND)),
        tuple(np.flatnonzero(SECOND)),
    ]
    assert np.rad2deg(found.groups[1].rotation) == pytest.approx(3.0, abs=0.3)
    sentence = found.sentence("eye_in_hand", IDS)
    assert "views v1, v4, v7, v10, v13, as if" in sentence
    assert ("tool frame" in sentence, "base frame" in sentence) == (
        kind == "camera",
        kind == "target",
    )


def test_three_stations_of_a_linear_axis_are_three_groups():
    station = np.arange(VIEWS) // 5
    robot, camera = moving_alike(0)
    # With the camera on the hand the holder is the base, which the axis carried.
    carried = np.array([transform([0.0, 0.0, 0.0], [0.2 * k, 0.0, 0.0]) for k in station])
    reported = as_se3(robot @ carried)
    found = find_groups(reported, as_se3(camera), EVERY_VIEW)
    assert found.kind == "target"
    assert {group.views for group in found.groups} == {
        tuple(np.flatnonzero(station == k)) for k in range(3)
    }
    assert "linear axis" in found.sentence("eye_in_hand", IDS)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turned_pictures_are_named_as_such(turns):
    turn = transform([0.0, 0.0, 90.0 * turns], [0.0, 0.0, 0.0])
    on_mount = np.linalg.inv(CAMERA_FROM_MOUNT) @ turn @ CAMERA_FROM_MOUNT
    found = find_groups(*mixed(camera=on_mount), EVERY_VIEW)
    assert [group.turn for group in found.groups] == [None, PictureTurn(turns)]
    assert f"turned by {90 * turns} degrees" in found.sentence("eye_in_hand", IDS)


def test_mirrored_pictures_are_named_as_such():
    robot, camera = mixed()
    seen = host_matrices(camera).copy()
    seen[SECOND] = mirrored(seen[SECOND])
    sentence = find_groups(robot, as_se3(seen), EVERY_VIEW).sentence("eye_in_hand", IDS)
    assert "views v1, v4, v7, v10, v13, as if the pictures had been mirrored" in sentence
    assert sentence.endswith("Mirror them back")


@pytest.mark.parametrize("noise", [(2e-4, 0.02), (5e-3, 0.5), (2e-2, 2.0)])
def test_errors_and_single_wrong_views_are_no_groups(noise):
    for seed in range(4):
        assert find_groups(*mixed(seed=seed, noise=noise), EVERY_VIEW) is None
    robot, camera = (host_matrices(poses).copy() for poses in mixed(noise=noise))
    rng = np.random.default_rng(1)
    for view in np.flatnonzero(SECOND):
        camera[view] = transform(rng.normal(0.0, 40.0, 3), rng.normal(0.0, 0.3, 3)) @ camera[view]
    assert find_groups(as_se3(robot), as_se3(camera), EVERY_VIEW) is None


def test_a_single_wrong_view_does_not_make_groups_of_the_rest():
    """It bends a fit to all views, from which any two groups of the good ones would differ."""
    robot, camera = moving_alike(1, noise=(3e-3, 0.3))
    robot[5] = robot[5] @ transform([0.0, 0.0, 0.0], [0.25, 0.0, 0.0])
    options = GroupOptions(tolerance=0.008)
    assert find_groups(as_se3(robot), as_se3(camera), EVERY_VIEW, options) is None


def test_the_staged_fit_refuses_pictures_of_two_cameras(scene):
    poses = host_matrices(scene.data.base_from_tool).copy()
    poses[1::2] = poses[1::2] @ transform([0.0, 0.0, 40.0], [0.02, 0.0, 0.1])
    data = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    with pytest.raises(ValueError, match=r"the views agree in 2 groups, .* poses of several tools"):
        fit_staged(data)
