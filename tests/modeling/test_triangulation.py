import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from programs import programs_added
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.engine import GemanMcClure, Noise, Parameters, Step
from smartview_jax.evaluation import cramer_rao, mean_nees, nees
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import PointStatus, triangulate_points
from smartview_jax.modeling.point_estimation import estimate_points
from smartview_jax.robot_errors import LinearInPose, RobotError
from smartview_jax.simulation import paper_calibration, random_scene

FIVE = five_viewpoints(np.array([0.02, 0.02, 0.01]), 0.2, roll=np.array([0.3, 0, -0.2, 0.5, 1.0]))
SIGMA = 0.3


@pytest.fixture(scope="module")
def poses(calibration):
    return host_matrices(calibration.command_for(FIVE))


def clicks(calibration, poses, count, seed=0, sigma=SIGMA):
    """Points in space, and pixels of them with noise."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([0.005, 0.005, 0.0], [0.035, 0.03, 0.02], (count, 3))
    pixels, _ = calibration.project(poses, points)
    return points, np.asarray(pixels) + sigma * rng.standard_normal(pixels.shape)


def test_a_point_is_the_optimum_that_scipy_finds(calibration, poses):
    _, pixels = clicks(calibration, poses, 12)
    triangulated = triangulate_points(calibration, poses, pixels, pixel_sigma=SIGMA)
    commands = SE3.from_matrix(jnp.asarray(poses))
    project = jax.jit(lambda x: calibration.project(commands, x[None])[0][:, 0])
    for k in (0, 5):
        best = least_squares(
            lambda x, k=k: np.ravel(project(x) - pixels[:, k]),
            triangulated.points[k] + 1e-3,
            xtol=1e-14,
        )
        np.testing.assert_allclose(triangulated.points[k], best.x, atol=1e-9)
        np.testing.assert_allclose(
            triangulated.picture_covariance[k],
            SIGMA**2 * np.linalg.inv(best.jac.T @ best.jac),
            rtol=1e-3,
        )


def test_a_pinhole_without_noise_is_opencvs_triangulation(poses):
    camera = sv.Camera(800.0, 810.0, 320.0, 240.0, sv.cameras.Pinhole(), (640, 480))
    calibration = dataclasses.replace(paper_calibration(), camera=camera)
    points, pixels = clicks(calibration, poses, 12, sigma=0.0)
    K = np.array([[800.0, 0, 320.0], [0, 810.0, 240.0], [0, 0, 1]])
    P = [K @ host_matrices(FIVE)[k, :3] for k in range(2)]
    theirs = cv2.triangulatePoints(*P, pixels[0].T, pixels[1].T)
    triangulated = triangulate_points(calibration, poses[:2], pixels[:2])
    np.testing.assert_allclose(triangulated.points, (theirs[:3] / theirs[3]).T, atol=1e-9)
    np.testing.assert_allclose(triangulated.points, points, atol=1e-9)


def test_the_pictures_covariance_is_true_for_unequal_errors(calibration, poses):
    count = 256
    points, _ = clicks(calibration, poses, count)
    rng = np.random.default_rng(1)
    roots = 0.3 * np.eye(2) + rng.uniform(-0.2, 0.2, (5, count, 2, 2))
    noise = np.einsum("vpij,vpj->vpi", roots, rng.standard_normal((5, count, 2)))
    pixels = np.asarray(calibration.project(poses, points)[0]) + noise
    covariances = roots @ roots.swapaxes(-1, -2)
    triangulated = triangulate_points(calibration, poses, pixels, pixel_sigma=covariances)
    assert triangulated.ok.all()
    assert mean_nees(
        nees(triangulated.points - points, triangulated.picture_covariance), 3
    ).is_consistent


def test_what_fails_is_named(calibration, poses):
    _, pixels = clicks(calibration, poses, 6)
    visible = np.ones((5, 6), dtype=bool)
    visible[1:, 0] = False
    pixels[2, 1] = np.nan
    visible[2, 1] = False
    triangulated = triangulate_points(calibration, poses, pixels, visible)
    assert triangulated.status[0] == PointStatus.TOO_FEW_VIEWS
    assert triangulated.ok[1:].all()
    assert "fewer than two views" in triangulated.failures[0]
    failed = ~triangulated.ok
    assert np.isnan(triangulated.points[failed]).all()
    assert np.isfinite(triangulated.points[~failed]).all()
    assert np.isfinite(triangulated.residuals[2, 1]).sum() == 0


def test_views_from_one_place_are_degenerate(calibration, poses):
    _, pixels = clicks(calibration, poses, 3)
    same = np.repeat(poses[:1], 5, axis=0)
    near = same.copy()
    near[1:, :3, 3] += 1e-5 * np.random.default_rng(0).uniform(-1.0, 1.0, (4, 3))
    for place in (same, near):
        triangulated = triangulate_points(calibration, place, np.repeat(pixels[:1], 5, axis=0))
        assert (triangulated.status == PointStatus.DEGENERATE_BASELINE).all()
        assert np.isnan(triangulated.points).all()


def test_rays_that_meet_behind_a_camera_are_named():
    camera = sv.Camera(500.0, 500.0, 320.0, 240.0, sv.cameras.Pinhole(), (640, 480))
    calibration = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    poses = np.repeat(np.eye(4)[None], 2, axis=0)
    poses[1, 0, 3] = 0.1
    pixels = np.array([[[300.0, 240.0]], [[340.0, 240.0]]])
    triangulated = triangulate_points(calibration, poses, pixels)
    assert triangulated.status[0] == PointStatus.BEHIND_CAMERA
    right = triangulate_points(calibration, poses, pixels[::-1])
    np.testing.assert_allclose(right.points, [[0.05, 0.0, 1.25]], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["pixels"].__setitem__((1, 2, 0), 700.0), "view 1, feature 2"),
        (lambda a: a["poses"].__setitem__((3, 0, 0), 2.0), "view 3: not a rotation"),
        (lambda a: a["pixels"].__setitem__((1, 2, 0), np.nan), "view 1, feature 2"),
        (lambda a: a.update(pixels=a["pixels"][:4]), "expected 5 views"),
        (lambda a: a.update(visible=np.ones((5, 3), dtype=bool)), "visible: expected shape"),
        (lambda a: a.update(pixel_sigma=0.0), "positive numbers"),
        (lambda a: a.update(pixel_sigma=np.ones((2, 2))), "pixel_sigma: expected"),
    ],
)
def test_bad_input_is_named(calibration, poses, change, message):
    _, pixels = clicks(calibration, poses, 6)
    visible = np.ones((5, 6), dtype=bool)
    arguments = {"poses": poses.copy(), "pixels": pixels, "visible": visible}
    change(arguments)
    with pytest.raises(ValueError, match=message):
        triangulate_points(calibration, **arguments)


def test_a_robust_loss_resists_a_gross_error(calibration, poses):
    points, pixels = clicks(calibration, poses, 12)
    pixels[3, :, 0] += 15.0
    plain, robust = (
        triangulate_points(calibration, poses, pixels, pixel_sigma=SIGMA, loss=loss)
        for loss in (None, GemanMcClure())
    )
    errors = [np.linalg.norm(result.points - points, axis=1) for result in (plain, robust)]
    assert np.median(errors[1]) < 0.2 * np.median(errors[0])


@pytest.fixture(scope="module")
def erring(calibration, poses):
    """A robot with an error field, and the bound on the calibration that its views allow."""
    field = LinearInPose.from_poses(SE3.from_matrix(jnp.asarray(poses)))
    size = 1e-4 * np.random.default_rng(1).normal(size=field.size)
    robot = dataclasses.replace(calibration, robot_error=RobotError(field, jnp.asarray(size)))
    noise = Noise(0.15, 1e-4, 2e-4, field=(1e-3,) * 4)
    return robot, cramer_rao(robot, random_scene(0, 8).data, noise, field=field), noise


def test_the_calibrations_jacobian_is_what_another_calibration_gives(erring, poses):
    robot, bound, noise = erring
    _, pixels = clicks(robot, poses, 3)
    start = triangulate_points(robot, poses, pixels, covariance=bound, noise=noise)
    names = sv.engine.parameter_names(robot)
    for name in ("camera.alpha_u", "camera.lens.k1", "camera_from_tool.rotation.x",
                 "base_from_world.translation.y", "base_from_world.rotation.z",
                 "robot_error.rotation_by_position.2"):  # fmt: skip
        assert name in start.calibration_names
        scale = max(np.sqrt(np.diag(start.calibration_covariance))[
            start.calibration_names.index(name)] * 1e-2, 1e-7)  # fmt: skip
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(len(names))
            step[names.index(name)] = sign * scale
            other, _ = Parameters(robot).retract(Step(jnp.asarray(step), jnp.zeros((0, 6))))
            ends.append(triangulate_points(other, poses, pixels).points)
        column = start.calibration_jacobian[:, :, start.calibration_names.index(name)]
        expected = (ends[0] - ends[1]) / (2.0 * scale)
        np.testing.assert_allclose(column, expected, rtol=2e-2, atol=2e-2 * np.abs(expected).max())


def test_the_robots_noise_in_a_view_is_a_column_of_its_own(erring, poses):
    robot, bound, noise = erring
    _, pixels = clicks(robot, poses, 3)
    start = triangulate_points(robot, poses, pixels, covariance=bound, noise=noise)
    index = start.calibration_names.index("pose_corrections.2.rotation.y")
    # The pose that the chain takes is the corrected one: disturb that one.
    actual = robot.robot_error.actual_pose(SE3.from_matrix(jnp.asarray(poses)))
    ends = []
    for sign in (1.0, -1.0):
        twist = np.zeros((5, 6))
        twist[2, 4] = -sign * 1e-5
        moved = actual @ SE3.exp(jnp.asarray(twist))
        ends.append(triangulate_points(robot.uncorrected, moved, pixels).points)
    expected = (ends[0] - ends[1]) / 2e-5
    np.testing.assert_allclose(
        start.calibration_jacobian[:, :, index], expected, atol=2e-2 * np.abs(expected).max()
    )
    sigma = np.sqrt(start.calibration_covariance[index, index])
    assert sigma == pytest.approx(noise.rotation)
    assert start.covariance()[0].trace() > start.picture_covariance[0].trace()


def test_what_is_common_does_not_blur_a_distance(erring, poses):
    robot, bound, noise = erring
    _, pixels = clicks(robot, poses, 2)
    triangulated = triangulate_points(robot, poses, pixels, covariance=bound, noise=noise)
    joint = triangulated.joint_covariance()
    np.testing.assert_allclose(joint[3:, 3:], triangulated.covariance()[1], rtol=1e-12)
    difference = np.hstack([np.eye(3), -np.eye(3)])
    together = difference @ joint @ difference.T
    apart = joint[:3, :3] + joint[3:, 3:]
    assert np.trace(together) < 0.5 * np.trace(apart)


def test_a_covariance_of_another_calibration_is_refused(erring, calibration, poses):
    _, bound, _ = erring
    _, pixels = clicks(calibration, poses, 2)
    with pytest.raises(ValueError, match="its parameters are"):
        triangulate_points(calibration, poses, pixels, covariance=bound)


def test_triangulation_is_differentiable_and_batched(calibration, poses):
    """By the pixels, against finite differences; several sets of clicks at once."""
    _, pixels = clicks(calibration, poses, 1)
    extrinsics = calibration.camera_from_world(poses).as_matrix()
    rest = (np.eye(2)[None, None], np.ones((5, 1), dtype=bool))

    @jax.jit
    @jax.vmap
    def depth_and_slopes(z):
        def depth(z):
            return estimate_points(calibration.camera, extrinsics, z, *rest).points[0, 2]

        value, linear = jax.linearize(depth, z)
        (reverse,) = jax.linear_transpose(linear, z)(jnp.ones(()))
        forward = jax.vmap(linear)(jnp.eye(z.size).reshape(z.size, *z.shape))
        return value, forward.reshape(z.shape), reverse

    shift = np.zeros_like(pixels)
    shift[1, 0, 0] = 1e-2
    sets = np.stack([pixels, pixels + shift, pixels - shift])
    depths, forward, reverse = map(np.asarray, depth_and_slopes(sets))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    slope = (depths[1] - depths[2]) / 2e-2
    assert reverse[0, 1, 0, 0] == pytest.approx(slope, rel=1e-3)
    alone = [triangulate_points(calibration, poses, clicks).points[0, 2] for clicks in sets]
    np.testing.assert_allclose(depths, alone, rtol=1e-12, atol=1e-15)


def test_one_more_click_compiles_nothing(poses):
    """No other test has pictures of this size, so that no program is there yet."""
    camera = sv.Camera(2100.0, 2100.0, 320.0, 240.0, sv.cameras.Pinhole(), (632, 480))
    calibration = dataclasses.replace(paper_calibration(), camera=camera)
    pixels = np.full((5, 40, 2), 250.0) + np.arange(40.0)[:, None]
    with programs_added() as seconds:
        triangulate_points(calibration, poses, pixels)
        first = len(seconds)
        triangulate_points(calibration, poses, pixels[:, :3])
        assert len(seconds) == first
    assert 1 <= first <= 3


def test_an_eye_to_hand_camera_measures_in_the_tools_frame():
    camera = paper_calibration().camera
    away = np.eye(4)
    away[:3, :3] = Rotation.from_euler("x", np.pi).as_matrix()
    away[2, 3] = 0.3
    calibration = sv.Calibration.eye_to_hand(camera, away, np.eye(4))
    # As many views as in the other tests, of three poses.
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[1, :3, :3] = Rotation.from_euler("y", 0.3).as_matrix()
    poses[2:, :3, :3] = Rotation.from_euler("x", 0.3).as_matrix()
    points = np.array([[0.01, 0.0, 0.02], [-0.01, 0.01, 0.0]])
    pixels = np.asarray(calibration.project(poses, points)[0])
    np.testing.assert_allclose(
        triangulate_points(calibration, poses, pixels).points, points, atol=1e-9
    )
