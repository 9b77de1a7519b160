"""Target points that a depth camera measured are poses of the target."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracked_scene import tracked

from smartview_jax.dataset import PoseDataset

POINTS = np.array([[x, y, 0.0] for x in (0.0, 0.04, 0.08) for y in (0.0, 0.03, 0.06)])


def seen_by_sensor(poses, noise=0.0, scale=1.0):
    """The points in the sensor's frame, all too large by a factor."""
    exact = POINTS @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    return scale * exact + noise * np.random.default_rng(0).normal(size=exact.shape)


def test_poses_are_those_that_the_points_have():
    robot, poses = tracked(0)
    data = PoseDataset.from_points(robot, POINTS, seen_by_sensor(poses))
    np.testing.assert_allclose(data.tracked_matrices, poses, atol=1e-12)
    assert data.notes == ("the measured points are 1.0000 times as far apart as the target's",)


def test_scipy_finds_the_same_rotation_from_noisy_points():
    robot, poses = tracked(0)
    measured = seen_by_sensor(poses, noise=1e-3, scale=1.02)
    measured[3, :4] = np.nan
    data = PoseDataset.from_points(robot, POINTS, measured)
    for k in (0, 3):
        used = np.isfinite(measured[k]).all(axis=1)
        a, b = POINTS[used], measured[k][used]
        turn = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))[0].as_matrix()
        np.testing.assert_allclose(data.tracked_matrices[k][:3, :3], turn, atol=1e-12)
        shift = b.mean(axis=0) - turn @ a.mean(axis=0)
        np.testing.assert_allclose(data.tracked_matrices[k][:3, 3], shift, atol=1e-12)
    assert "the measured points are 1.0" in data.notes[0]


def test_a_view_whose_points_do_not_tell_a_pose_is_left_out_with_the_reason():
    robot, poses = tracked(0)
    measured = seen_by_sensor(poses)
    measured[2, 2:] = np.nan
    # The points of one edge of the target.
    measured[5, 3:] = np.nan
    data = PoseDataset.from_points(robot, POINTS, measured)
    reason = "points measured; expected 3 that are not on one line"
    assert data.masked_views == (("2", f"2 {reason}"), ("5", f"3 {reason}"))
    with pytest.raises(ValueError, match=r"view 0: 0 points measured.*so are all views"):
        PoseDataset.from_points(robot, POINTS, np.full_like(measured, np.nan))
    with pytest.raises(ValueError, match=r"expected shape \(views, points, 3\)"):
        PoseDataset.from_points(robot, POINTS[:4], measured)
