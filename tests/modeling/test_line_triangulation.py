import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import smartview_jax as sv
from smartview_jax.engine import Parameters, Step
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import Lines, PointStatus, triangulate_lines

SIGMA = 0.3
CENTRE = np.array([0.02, 0.0175, 0.01])


@pytest.fixture(scope="module")
def poses(calibration):
    five = five_viewpoints(CENTRE, 0.2, roll=np.array([0.3, 0, -0.2, 0.5, 1.0]), pattern="L")
    return host_matrices(calibration.command_for(five))


def drawn(calibration, poses, count, seed=0, sigma=SIGMA):
    """Lines, and a segment of each in every view, whose ends are other points in each view."""
    rng = np.random.default_rng(seed)
    middle = CENTRE + rng.uniform(-0.005, 0.005, (count, 3))
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ends = rng.uniform(0.004, 0.007, (len(poses), count, 2)) * [-1.0, 1.0]
    points = middle[:, None] + ends[..., None] * direction[:, None]
    segments = np.asarray(calibration.project(poses, points.reshape(len(poses), -1, 3))[0])
    segments = segments.reshape(len(poses), count, 2, 2)
    return Lines(middle, direction), segments + sigma * rng.standard_normal(segments.shape)


def errors(triangulated, truth):
    """The shifts and turns that bring the true lines to the found ones, at the found points."""
    lines = triangulated.lines
    sign = np.sign(np.einsum("li,li->l", lines.directions, truth.directions))[:, None]
    # The true line's point nearest to the found one.
    t = np.einsum("li,li->l", lines.points - truth.points, truth.directions)[:, None]
    shift = lines.points - truth.points - t * truth.directions
    turn = lines.directions - sign * truth.directions
    axes = lines.perpendicular
    return np.concatenate([np.einsum("lij,li->lj", axes, e) for e in (shift, turn)], axis=1)


def test_exact_segments_give_the_line(calibration, poses):
    truth, segments = drawn(calibration, poses, 20, sigma=0.0)
    triangulated = triangulate_lines(calibration, poses, segments)
    assert triangulated.ok.all()
    assert np.abs(errors(triangulated, truth)).max() < 1e-8
    assert triangulated.rms < 1e-6
    np.testing.assert_allclose(
        np.linalg.norm(triangulated.ends[:, 1] - triangulated.ends[:, 0], axis=1),
        0.0125,
        atol=0.002,
    )


def test_the_pictures_covariance_is_true(calibration, poses):
    truth, segments = drawn(calibration, poses, 300)
    triangulated = triangulate_lines(calibration, poses, segments, pixel_sigma=SIGMA)
    ok = triangulated.ok
    assert ok.mean() > 0.9
    statistic = mean_nees(
        nees(errors(triangulated, truth)[ok], triangulated.picture_covariance[ok]), 4
    )
    assert statistic.is_consistent


def test_a_line_is_the_one_whose_picture_scipy_finds_nearest(calibration, poses):
    """By sampling the picture of the line densely, without any plane or ray."""
    _, segments = drawn(calibration, poses, 1, seed=3)
    triangulated = triangulate_lines(calibration, poses, segments, pixel_sigma=SIGMA)
    axes, t = triangulated.lines.perpendicular[0], np.linspace(-0.02, 0.02, 400)

    def distances(step):
        point = triangulated.lines.points[0] + axes @ step[:2]
        direction = triangulated.lines.directions[0] + axes @ step[2:] * 100.0
        curve = np.asarray(calibration.project(poses, point + t[:, None] * direction)[0])
        result = []
        for view in range(len(poses)):
            a, b = curve[view, :-1], curve[view, 1:]
            for end in segments[view, 0]:
                along = b - a
                part = np.clip(np.sum((end - a) * along, 1) / np.sum(along**2, 1), 0, 1)
                foot = a + part[:, None] * along
                best = np.argmin(np.linalg.norm(end - foot, axis=1))
                normal = np.array([-along[best, 1], along[best, 0]])
                result.append((end - foot[best]) @ normal / np.linalg.norm(normal))
        return np.array(result)

    np.testing.assert_allclose(
        np.abs(distances(np.zeros(4))), np.abs(triangulated.residuals[:, 0].ravel()), atol=2e-3
    )
    best = least_squares(distances, np.zeros(4), x_scale=1e-5, diff_step=1e-3)
    # To a hundredth of a standard deviation.
    std = np.sqrt(np.diagonal(triangulated.picture_covariance[0])) * [1.0, 1.0, 0.01, 0.01]
    assert (np.abs(best.x) / std).max() < 0.02


def test_a_line_in_the_epipolar_plane_is_named():
    camera = sv.Camera(500.0, 500.0, 320.0, 240.0, sv.cameras.Pinhole(), (640, 480))
    calibration = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[1, 0, 3], poses[2, 1, 3] = 0.1, 0.1
    along = np.array([[-0.05, 0.02, 0.5], [0.08, 0.02, 0.5]])
    across = np.array([[0.05, -0.05, 0.5], [0.05, 0.1, 0.5]])
    points = np.stack([along, across]).reshape(1, 4, 3)
    segments = np.asarray(calibration.project(poses, points.repeat(3, 0))[0]).reshape(3, 2, 2, 2)
    two = triangulate_lines(calibration, poses[:2], segments[:2])
    assert two.status.tolist() == [PointStatus.EPIPOLAR_PLANE, PointStatus.OK]
    assert "epipolar plane" in two.failures[0]
    assert np.isnan(two.lines.points[0]).all()
    noisy = segments + 0.2 * np.random.default_rng(0).standard_normal(segments.shape)
    assert triangulate_lines(calibration, poses[:2], noisy[:2]).status[0] == 5
    # A third view from outside the plane determines it.
    assert triangulate_lines(calibration, poses, segments).ok.all()


def test_what_fails_is_named(calibration, poses):
    _, segments = drawn(calibration, poses, 3)
    visible = np.ones((5, 3), dtype=bool)
    visible[1:, 0] = False
    triangulated = triangulate_lines(calibration, poses, segments, visible)
    assert triangulated.status[0] == PointStatus.TOO_FEW_VIEWS
    assert triangulated.ok[1:].all()
    segments[2, 1, 1] = segments[2, 1, 0] + 0.1
    with pytest.raises(ValueError, match="view 2, line 1"):
        triangulate_lines(calibration, poses, segments, visible)
    with pytest.raises(ValueError, match="shape"):
        triangulate_lines(calibration, poses, segments[..., 0])


def test_the_calibrations_jacobian_is_what_another_calibration_gives(calibration, poses, uncertain):
    bound, _ = uncertain
    # Terms in the residuals are left out of the Jacobian.
    _, segments = drawn(calibration, poses, 3, sigma=0.02)
    start = triangulate_lines(calibration, poses, segments, covariance=bound)
    names = sv.engine.parameter_names(calibration)
    for name in ("camera.v0", "camera.lens.k1", "base_from_world.rotation.z",
                 "camera_from_tool.translation.y"):  # fmt: skip
        k = start.calibration_names.index(name)
        scale = np.sqrt(start.calibration_covariance[k, k]) * 1e-2
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(len(names))
            step[names.index(name)] = sign * scale
            other, _ = Parameters(calibration).retract(Step(jnp.asarray(step), jnp.zeros((0, 6))))
            ends.append(triangulate_lines(other, poses, segments))
        moved = errors(ends[0], ends[1].lines) / (2.0 * scale)
        column = start.calibration_jacobian[:, :, k]
        np.testing.assert_allclose(column, moved, atol=3e-2 * np.abs(moved).max())
    assert (
        np.trace(start.covariance(), axis1=1, axis2=2)
        > np.trace(start.picture_covariance, axis1=1, axis2=2)
    ).all()
