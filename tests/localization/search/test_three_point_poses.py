import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from smartview_jax.localization.search.three_point_poses import three_point_poses


def problems(count, seed=0):
    """Triples of points before a camera at random poses, and the rays along which they are."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.03, 0.03, (count, 3, 3))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform([-0.1, -0.1, 0.15], [0.1, 0.1, 0.6], (count, 3))
    seen = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    return points, poses, seen / np.linalg.norm(seen, axis=2, keepdims=True)


def gaps(solutions, good, pose):
    """The largest differences of all solutions from a pose."""
    return np.where(good, np.abs(solutions - pose).max(axis=(-1, -2)), np.inf)


def test_the_true_pose_is_among_the_solutions_and_all_solutions_fit():
    points, poses, rays = problems(5000)
    solutions, good = three_point_poses(rays, points)
    nearest = gaps(solutions, good, poses[:, None]).min(axis=1)
    # Where two solutions meet, both are ill-defined: a few in a thousand.
    assert (nearest < 1e-6).mean() > 0.998
    n, k = np.nonzero(good)
    seen = points[n] @ solutions[n, k, :3, :3].transpose(0, 2, 1) + solutions[n, k, None, :3, 3]
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    assert np.abs(seen - rays[n]).max() < 1e-4
    rotations = solutions[n, k, :3, :3]
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)


def test_solutions_are_those_of_opencv():
    points, _, rays = problems(400, seed=1)
    poses, good = three_point_poses(rays, points)
    missed = extra = total = 0
    for k in range(len(points)):
        pixels = rays[k, :, :2] / rays[k, :, 2:]
        _, turns, shifts = cv2.solveP3P(points[k], pixels, np.eye(3), None, cv2.SOLVEPNP_AP3P)
        theirs = np.tile(np.eye(4), (len(turns), 1, 1))
        for i, (turn, shift) in enumerate(zip(turns, shifts, strict=True)):
            theirs[i, :3, :3], theirs[i, :3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        ours = poses[k, good[k]]
        apart = np.abs(ours[:, None] - theirs).max(axis=(-1, -2))
        missed += (apart.min(axis=0, initial=np.inf) > 1e-4).sum()
        extra += (apart.min(axis=1, initial=np.inf) > 1e-4).sum()
        total += len(theirs)
    assert total > 600
    assert missed < 0.01 * total
    assert extra < 0.01 * total


def test_points_on_one_line_have_no_solutions():
    points, _, rays = problems(2, seed=2)
    points[1, 2] = 2.0 * points[1, 1] - points[1, 0]
    poses, good = three_point_poses(rays, points)
    assert good[0].any()
    assert not good[1].any()
    assert np.isnan(poses[1]).all()
