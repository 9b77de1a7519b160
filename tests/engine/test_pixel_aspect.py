"""A prior on the ratio of the focal lengths has the effect that SciPy's least squares finds."""

import dataclasses

import cv2
import jax
import numpy as np
import pytest
from fit_scenes import POINTS, VIEWS, scene_of, scene_with
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation
from starts import nudged

from smartview_jax import Dataset, Noise, Prior, Rig, fit_joint
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.engine import (
    PIXEL_ASPECT,
    BlockArrow,
    FitCovariance,
    build_problem,
    build_rig,
    host_step,
    inverse_of_covariance,
)
from smartview_jax.engine.pixel_aspect import with_aspect, without_aspect
from smartview_jax.geometry import host_matrices
from smartview_jax.runtime.array_namespace import to_device
from smartview_jax.simulation import paper_calibration

NOISE = Noise(0.15, 1e-4, 2e-4)


def square(std, mean=1.0):
    return {PIXEL_ASPECT: Prior(mean=mean, std=std)}


@pytest.fixture(scope="module")
def seen_by_opencv():
    """Views of a camera whose pixels are not quite square, as OpenCV projects them."""
    camera = Camera(1933.0, 1932.8, 320.0, 240.0, Pinhole(), (640, 480))
    truth = dataclasses.replace(paper_calibration(), camera=camera)
    data = scene_with(truth, 0).data
    poses = host_matrices(truth.camera_from_world(data.base_from_tool))
    board = np.ascontiguousarray(POINTS)
    pixels = [
        cv2.projectPoints(board, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], truth.camera.K, None)
        for pose in poses
    ]
    noise = 0.15 * np.random.default_rng(0).normal(size=(VIEWS, len(board), 2))
    pixels = np.array([found[:, 0] for found, _ in pixels]) + noise
    seen = Dataset.from_arrays(POINTS, pixels, data.base_from_tool, (640, 480))
    return truth, seen


def scipy_fit(truth, data, sigma, std):
    """SciPy's two focal lengths, their covariance, and both poses, with an exact robot."""
    poses = [host_matrices(p) for p in (truth.camera_from_mount, truth.holder_from_world)]
    board = np.asarray(data.points)
    tools, pixels = np.linalg.inv(host_matrices(data.base_from_tool)), np.asarray(data.pixels)

    def moved(pose, step):
        turned = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
        return np.vstack([np.column_stack([turned, pose[:3, 3] + step[:3]]), pose[3:]])

    def residuals(x):
        focal = 1e3 * x[0] * np.array([1.0, 1.0 + 1e-3 * x[1]])
        camera_from_tool, base_from_world = moved(poses[0], x[4:10]), moved(poses[1], x[10:])
        chain = camera_from_tool @ tools @ base_from_world
        places = np.einsum("vij,vpj->vpi", chain[:, :3, :3], board) + chain[:, None, :3, 3]
        predicted = focal * places[..., :2] / places[..., 2:] + 1e2 * x[2:4]
        return np.append((pixels - predicted).ravel() / sigma, 1e-3 * x[1] / std)

    start = np.append([1.9, 0.0, 3.2, 2.4], np.zeros(12))
    found = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    ratio = 1.0 + 1e-3 * found.x[1]
    by_x = 1e3 * np.array([[1.0, 0.0], [ratio, 1e-3 * found.x[0]]])
    focal = 1e3 * found.x[0] * np.array([1.0, ratio])
    return focal, by_x @ covariance[:2, :2] @ by_x.T, moved(poses[0], found.x[4:10])


@pytest.mark.parametrize("std", [1e-4, 1e-9])
def test_scipy_finds_the_same_from_pixels_of_opencv(seen_by_opencv, std):
    """A loose prior moves the focal lengths towards each other, a tight one makes them one."""
    truth, data = seen_by_opencv
    fit = fit_joint(data, nudged(truth), noise="trusted", priors=square(std))
    camera, sigma = fit.calibration.camera, float(fit.problem.pixel_sigma)
    focal, covariance, camera_from_tool = scipy_fit(truth, data, sigma, std)
    found = np.array([float(camera.alpha_u), float(camera.alpha_v)])
    np.testing.assert_allclose(found, focal, atol=2e-3)
    np.testing.assert_allclose(
        host_matrices(fit.calibration.camera_from_tool), camera_from_tool, atol=1e-6
    )
    factor = (fit.pixel_sigma / sigma) ** 2
    np.testing.assert_allclose(fit.covariance[:2, :2], factor * covariance, rtol=2e-3)
    assert fit.std[PIXEL_ASPECT] <= 1.001 * std
    assert fit.std["camera.alpha_v"] == pytest.approx(np.sqrt(fit.covariance[1, 1]), rel=1e-12)
    alone = fit_joint(data, nudged(truth), noise="trusted").calibration.camera
    ratio, free = found[1] / found[0], float(alone.alpha_v / alone.alpha_u)
    assert abs(ratio - 1.0) < (1e-12 if std < 1e-6 else 0.9 * abs(free - 1.0))


def test_named_parameters_follow_the_fitted_ones():
    """By differences; a step of the ratio moves alpha_v, and one of alpha_u both."""
    scene = scene_of(0)
    built = build_problem(scene.data, scene.calibration, priors=square(1e-3, 1.01))
    problem, names, here = built.problem, built.shared_names, np.array(True)
    z = host_step(1e-3 * np.arange(1.0, 1.0 + len(names)), np.zeros((0, 6)))
    camera = np.array([2133.0, 2133.0, 320.0, 240.0, 0.3])

    def focal_lengths(x):
        return without_aspect(with_aspect(camera, here) + x, here)[:2]

    by_fitted = problem.host_named_by_fitted(z)
    np.testing.assert_allclose(
        by_fitted[:2, :5], approx_fprime(z.shared[:5], focal_lengths, 1e-7), atol=1e-3
    )
    assert not by_fitted[:2, 5:].any()
    np.testing.assert_array_equal(by_fitted[2:], np.eye(len(names))[2:])
    # Where nothing determines a parameter, a program states an infinite covariance.
    by_names = jax.jit(lambda covariance: problem.covariance_by_names(z, covariance))
    unknown, known = np.full(by_fitted.shape, np.inf), np.eye(len(names))
    np.testing.assert_array_equal(by_names(unknown), unknown)
    np.testing.assert_allclose(by_names(known), by_fitted @ by_fitted.T, rtol=1e-9)
    weights = np.asarray(problem.prior_weight.shared)
    assert names[1] == "camera.alpha_v"
    assert weights[1] == 1e3
    assert not np.delete(weights, 1).any()


def test_a_ratio_is_as_certain_as_its_prior_where_focal_lengths_are_hardly_known():
    """The focal lengths are known to 300 px and the ratio to 1e-12."""
    scene, held = scene_of(0), ("u0", "v0", "lens")
    built = build_problem(
        scene.data,
        scene.calibration,
        fixed=("camera_from_tool", "base_from_world", *(f"camera.{name}" for name in held)),
        priors=square(1e-12),
    )
    problem = built.problem
    blocks = np.diag([300.0**-2, 1e24]), np.zeros((0, 6, 2)), np.zeros((0, 6, 6))
    fitted = FitCovariance.of(BlockArrow(*map(to_device, blocks)))
    known = fitted.by_names(problem.host_named_by_fitted(problem.zero_step()))
    stds = {"camera.alpha_u": 300.0, "camera.alpha_v": 300.0, PIXEL_ASPECT: 1e-12}
    assert known.std_by_name(built) == pytest.approx(stds, rel=1e-6, abs=0.0)
    # What the estimation of the noise adds to one focal length alone, it adds to the ratio.
    more = known.with_added(np.diag([0.0, 2.133**2]), np.full(2, 10.0))
    assert more.std_by_name(built)[PIXEL_ASPECT] == pytest.approx(1e-3)


def test_a_held_alpha_u_leaves_alpha_v_to_the_prior(seen_by_opencv):
    truth, data = seen_by_opencv
    fit = fit_joint(
        data, truth, noise="trusted", fixed=("camera.alpha_u",), priors=square(1e-6, 1.0001)
    )
    camera = fit.calibration.camera
    assert float(camera.alpha_u) == 1933.0
    assert float(camera.alpha_v) == pytest.approx(1.0001 * 1933.0, abs=0.01)
    assert fit.std["camera.alpha_v"] == pytest.approx(1.933e-3, rel=1e-2)


def test_without_a_mean_it_is_the_ratio_of_the_start(seen_by_opencv):
    truth, data = seen_by_opencv
    fit = fit_joint(data, truth, noise="trusted", priors={PIXEL_ASPECT: Prior(std=1e-9)})
    camera = fit.calibration.camera
    assert float(camera.alpha_v / camera.alpha_u) == pytest.approx(1932.8 / 1933.0, abs=1e-9)


def test_of_a_held_camera_the_ratio_has_no_prior(seen_by_opencv):
    truth, data = seen_by_opencv
    built = build_problem(data, truth, fixed=("camera",), priors=square(1e-9, 1.1))
    assert not np.asarray(built.problem.prior_weight.shared).any()
    assert built.problem.fitted_aspects is None
    rig = build_rig(
        Rig({"left": data, "right": data}),
        {"left": truth, "right": truth},
        noise=NOISE,
        fixed=("left.camera",),
        priors={f"{name}.camera.pixel_aspect": Prior(std=1e-3) for name in ("left", "right")},
    )
    counting = np.flatnonzero(np.asarray(rig.problem.prior_weight.shared))
    assert [rig.parameter_names[k] for k in counting] == ["right.camera.alpha_v"]
    assert rig.problem.fitted_aspects.fits_aspect.tolist() == [False, True]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fixed": (PIXEL_ASPECT,)}, r"to hold it give priors=.*std=1e-9"),
        ({"free": (PIXEL_ASPECT,)}, "neither held nor freed"),
        ({"priors": square(1e-3, -1.0)}, "a ratio is positive; found a mean of -1.0"),
        ({"priors": square(1e-3) | {"camera.alpha_v": Prior(std=1.0)}}, "not on both"),
        ({"priors": square(1e-3) | {"camera": Prior(std=1.0)}}, "not on both"),
        ({"priors": square(1e-3), "fixed": ("camera.alpha_v",)}, "hold 'camera.alpha_u' instead"),
        ({"priors": {"camera.pixel_aspct": Prior(std=1.0)}}, "did you mean camera.pixel_aspect"),
        ({"priors": {"left.camera.pixel_aspect": Prior(std=1.0)}}, "no parameter is called"),
    ],
)
def test_what_cannot_be_meant_is_refused(options, words):
    scene = scene_of(0)
    with pytest.raises(ValueError, match=words):
        build_problem(scene.data, scene.calibration, **options)


def test_a_combination_that_is_known_exactly_has_an_information():
    """Equal focal lengths have a singular covariance; all other variances are kept."""
    covariance = np.array([[4.0, 4.0, 1.0], [4.0, 4.0, 1.0], [1.0, 1.0, 9.0]])
    information = inverse_of_covariance(covariance)
    np.testing.assert_allclose(np.linalg.inv(information), covariance, atol=1e-3)
