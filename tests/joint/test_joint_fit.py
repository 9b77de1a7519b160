import dataclasses
import inspect
from typing import get_type_hints

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
import pytest
from fit_scenes import MANY_VIEWS, POINTS, VIEWS, scene_of
from jaxlie import SE3
from scipy.spatial.transform import Rotation
from scipy_optimum import scipy_optimum
from shared_data import shared_pairs
from starts import nudged, reference_start

from smartview_jax import Noise, Prior, fit_joint
from smartview_jax.engine import StructuredLM, optimum
from smartview_jax.engine.problem_builder import build_problem
from smartview_jax.evaluation import cramer_rao, reprojection_errors
from smartview_jax.fit_result import FitCode
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.joint import JointOptions


def test_a_real_set_reaches_the_reference():
    """joint_px with everything free, he_only_refined_px with the camera held.

    The others are in `benchmarks/real_sets.py`: each shape costs its own compilation.
    """
    data, reference = shared_pairs("rct_circle10x10")
    start = reference_start(reference)
    joint = fit_joint(data, start, noise="trusted")
    assert joint.result.converged
    rounding = 5e-4
    assert reprojection_errors(joint.calibration, data).rms == pytest.approx(
        reference["joint_px"], rel=0.01, abs=rounding
    )
    held = fit_joint(data, start, fixed=("camera",), noise="trusted")
    assert reprojection_errors(held.calibration, data).rms == pytest.approx(
        reference["he_only_refined_px"], rel=0.01, abs=rounding
    )


def test_eye_to_hand_with_the_camera_held():
    data, reference = shared_pairs("visp_franka_eth")
    held = fit_joint(
        data, reference_start(reference, [0.0] * 4), fixed=("camera",), noise="trusted"
    )
    assert reprojection_errors(held.calibration, data).rms == pytest.approx(
        reference["he_only_refined_px"], rel=0.01
    )


def test_without_noise_it_finds_the_truth():
    scene = scene_of(1, pixel_noise=0.0)
    fit = fit_joint(scene.data, nudged(scene.calibration), noise="trusted")
    assert fit.result.converged
    assert fit.calibration.region is not None
    assert fit.calibration.region.above is True
    numbers = dataclasses.replace(fit.calibration, region=None)
    for found, truth in zip(
        jax.tree.leaves(numbers), jax.tree.leaves(scene.calibration), strict=True
    ):
        np.testing.assert_allclose(found, truth, rtol=1e-7, atol=1e-9)


def test_scipy_reaches_the_same_cost_and_covariance(scene, trusted):
    problem = build_problem(scene.data, nudged(scene.calibration)).problem
    found, _ = scipy_optimum(problem, problem.zero_step())
    assert trusted.solution.costs[-1] == pytest.approx(found.cost, rel=1e-9)
    dof = 2 * scene.data.observation_count - len(problem.free)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / dof
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(list(trusted.std.values()), std, rtol=1e-5)
    # The deviation is told by `dof` residuals: three deviations of their root mean square.
    assert trusted.pixel_sigma == pytest.approx(0.15, rel=3.0 / np.sqrt(2.0 * dof))


def test_the_optimum_is_differentiable_in_the_data_and_solved_in_batches(scene):
    """d hand-eye / d pixels of two data sets at once: forward, reverse, and by refitting."""
    start, pixels, visible = scene.calibration, scene.data.pixels, scene.data.visible[..., None]
    problem = build_problem(scene.data, start).problem
    rng, thorough = np.random.default_rng(0), StructuredLM(rtol=1e-15)
    direction = jnp.where(visible, jnp.asarray(rng.normal(size=pixels.shape)), 0.0)
    weights = jnp.asarray(rng.normal(size=3))

    def hand_eye(problem, pixels):
        moved = eqx.tree_at(lambda p: p.observations.pixels, problem, pixels)
        calibration, _ = moved.calibration(optimum(moved, thorough))
        return calibration.camera_from_tool.translation()

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(None, 0))
    def together(problem, pixels):
        found, derivative = jax.linearize(lambda pixels: hand_eye(problem, pixels), pixels)
        (reverse,) = jax.linear_transpose(derivative, pixels)(weights)
        return found, derivative(direction), jnp.sum(reverse * direction)

    def refitted(pixels):
        data = dataclasses.replace(scene.data, pixels=pixels)
        fit = fit_joint(data, start, noise="trusted", solver=thorough)
        return np.asarray(fit.calibration.camera_from_tool.translation())

    shifted, h = [pixels, pixels + 0.3], 1e-3
    both = together(problem, jnp.stack(shifted))
    for moved, found, forward, reverse in zip(shifted, *both, strict=True):
        np.testing.assert_allclose(found, refitted(moved), rtol=1e-6, atol=1e-9)
        # The equations are ill-conditioned: small derivatives have the errors of the largest.
        size = np.abs(forward).max()
        np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-6, atol=1e-6 * size)
        ahead, behind = (refitted(moved + step * direction) for step in (h, -h))
        expected = (ahead - behind) / (2.0 * h)
        np.testing.assert_allclose(forward, expected, rtol=1e-4, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("loss", ["cauchy", "geman_mcclure"])
def test_robust_losses_shrug_at_outliers(loss):
    """The others differ by their cost alone, which `test_view_normal_equations` looks at."""
    scene = scene_of(3, outlier_fraction=0.1)
    visible = scene.data.visible & ~scene.outliers
    clean = eqx.tree_at(lambda d: d.visible, scene.data, visible)
    start = nudged(scene.calibration)
    best = fit_joint(clean, start, noise="trusted")
    robust = fit_joint(scene.data, start, loss=loss, noise=Noise(0.15, 1e-9, 1e-9))
    plain = fit_joint(scene.data, start, noise="trusted")

    def error(fit):
        gap = fit.calibration.camera_from_tool.inverse() @ best.calibration.camera_from_tool
        return float(jnp.linalg.norm(gap.log()))

    assert error(robust) < 0.3 * error(plain)
    assert not np.asarray(robust.inliers & scene.outliers).any()


def test_robot_noise_that_is_known_makes_the_mount_better():
    scene = scene_of(4, translation_noise=2e-3, rotation_noise=1e-4)
    start = nudged(scene.calibration)
    trusted = fit_joint(scene.data, start, noise="trusted")
    known = fit_joint(scene.data, start, noise=Noise(0.15, 2e-3, 1e-4))

    def error(fit):
        return abs(float(fit.calibration.camera.alpha_u - 2133.0))

    assert error(known) < 0.5 * error(trusted)
    assert known.pose_corrections.shape == (VIEWS, 6)
    # Residuals are through the chain as reported: corrections never flatter them.
    seen = np.asarray(known.residuals)[np.asarray(scene.data.visible)]
    assert reprojection_errors(known.calibration, scene.data).rms == pytest.approx(
        np.sqrt(np.mean(np.sum(seen**2, axis=-1))), rel=1e-9
    )


def test_paths_fix_free_and_bind(scene, trusted):
    start = nudged(scene.calibration)
    held = fit_joint(
        scene.data, start, fixed=("camera", "base_from_world.translation.z"), noise="trusted"
    )
    assert eqx.tree_equal(held.calibration.camera, start.camera)
    assert float(held.calibration.base_from_world.translation()[2]) == float(
        start.base_from_world.translation()[2]
    )
    assert "camera.u0" not in held.parameter_names
    scaled = fit_joint(
        scene.data, start, free=("target_scale",), fixed=("camera",), noise="trusted"
    )
    assert float(scaled.calibration.target_scale) == pytest.approx(1.0, abs=1e-3)
    bound = fit_joint(
        scene.data, start, priors={"camera.u0": Prior(mean=300.0, std=1e-6)}, noise="trusted"
    )
    assert float(bound.calibration.camera.u0) == pytest.approx(300.0, abs=1e-3)
    u0 = float(trusted.calibration.camera.u0)
    assert u0 == pytest.approx(322.0, abs=4.0 * trusted.std["camera.u0"])


def test_any_optimistix_solver_will_do(scene, trusted):
    other = fit_joint(
        scene.data,
        nudged(scene.calibration),
        solver=optx.Dogleg(rtol=1e-10, atol=1e-10),
        noise="trusted",
    )
    assert other.solution.costs[-1] == pytest.approx(trusted.solution.costs[-1], rel=1e-8)


def test_a_fit_that_stopped_early_says_so_and_raises_on_request(scene, trusted):
    assert trusted.result.code is FitCode.CONVERGED
    trusted.result.require_convergence()
    careless = StructuredLM(rtol=1e9, atol=1e9)
    stopped = fit_joint(scene.data, nudged(scene.calibration), solver=careless, noise="trusted")
    assert stopped.result.code is FitCode.STOPPED_EARLY
    with pytest.raises(RuntimeError, match=r"stopped_early: .* would still lower the cost"):
        stopped.result.require_convergence()


def test_one_rotation_axis_is_named(scene):
    turns = np.zeros((6, 6))
    turns[:, 5] = np.linspace(-0.6, 0.6, 6)
    turns[:, :2] = 0.01 * np.random.default_rng(0).normal(size=(6, 2))
    commands = SE3(scene.base_from_tool.wxyz_xyz[0][None]) @ SE3.exp(jnp.asarray(turns))
    pixels, valid = scene.calibration.project(commands, POINTS)
    data = eqx.tree_at(
        lambda d: (d.pixels, d.visible, d.base_from_tool),
        scene.data.select(range(6)),
        (pixels, valid, commands),
    )
    fit = fit_joint(data, scene.calibration, fixed=("camera",), noise="trusted")
    assert fit.observability.rank == 11
    assert fit.observability.parameter_count == 12
    (direction,) = fit.observability.null_directions
    assert direction.description.startswith(
        "camera offset along the tool's z axis: all rotations share that axis (for each mm of "
    )
    assert np.isinf(fit.std["camera_from_tool.translation.z"])
    with pytest.raises(ValueError, match=r"the data do not determine .*translation\.z"):
        fit.p_value(scene.calibration)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"noise": "guessed"}, 'noise is "trusted", "estimated" or a Noise'),
        ({"fixed": ("camera.alpha",)}, r"no parameter is called 'camera.alpha'; did you mean"),
        ({"loss": "l7", "noise": "trusted"}, "loss is one of huber, cauchy"),
        ({"lens": "bottle"}, "lens is one of pinhole"),
        (
            {
                "priors": {"camera_from_tool.rotation": Prior(std=0.1, mean=0.0)},
                "noise": "trusted",
            },
            "a rotation's prior is centred at the start",
        ),
    ],
)
def test_wrong_options_are_named(scene, options, message):
    with pytest.raises(ValueError, match=message):
        fit_joint(scene.data, scene.calibration, **options)


def test_a_start_that_sees_nothing_is_refused(scene):
    behind = eqx.tree_at(
        lambda c: c.camera_from_mount,
        scene.calibration,
        SE3.from_rotation(jaxlie.SO3.from_x_radians(jnp.pi)) @ scene.calibration.camera_from_tool,
    )
    with pytest.raises(ValueError, match=r"every point of view 0, 1, .* behind the camera"):
        fit_joint(scene.data, behind, noise="trusted")


def test_noise_and_priors_must_be_positive():
    with pytest.raises(ValueError, match=r"Noise\.pixel: expected a positive number, found 0"):
        Noise(0.0, 1e-3, 1e-3)
    with pytest.raises(ValueError, match=r"Prior\.std"):
        Prior(std=-1.0)


@pytest.mark.parametrize("sigma", [0.02, 1.5])
def test_priors_weigh_as_much_as_they_say_where_the_residuals_tell_the_sigma(sigma):
    scene = scene_of(5, pixel_noise=sigma)
    priors = {"camera.u0": Prior(std=1.0), "camera_from_tool.translation.z": Prior(std=1e-4)}
    fit = fit_joint(scene.data, scene.calibration, noise="trusted", priors=priors)
    assert fit.pixel_sigma == pytest.approx(sigma, rel=0.05)
    bound = cramer_rao(fit.calibration, scene.data, fit.pixel_sigma, priors=priors)
    for name in ("camera.u0", "camera_from_tool.translation.z", "camera.alpha_u"):
        assert fit.std[name] == pytest.approx(bound.std[name], rel=0.02)


def test_priors_about_the_start_stay_there_while_the_noise_is_estimated():
    """What is estimated moves the start; a prior that moved along would weigh half."""
    scene = scene_of(1, translation_noise=1e-4)
    free = fit_joint(scene.data, scene.calibration, field=None)
    path = "camera_from_tool.rotation.x"
    std, mount = free.std[path], free.calibration.camera_from_tool
    turned = jaxlie.SO3.from_x_radians(3.0 * std) @ mount.rotation()
    start = dataclasses.replace(
        free.calibration,
        camera_from_mount=SE3.from_rotation_and_translation(turned, mount.translation()),
    )
    known = {path: Prior(std=std), "camera.u0": Prior(std=0.01)}
    estimated = fit_joint(scene.data, start, field=None, priors=known)
    of_shape = dataclasses.replace(start, target_shape=estimated.calibration.target_shape)
    stated = fit_joint(scene.data, of_shape, field=None, priors=known, noise=estimated.noise)
    moved = (estimated.calibration.camera_from_tool.rotation() @ mount.rotation().inverse()).log()
    # Halfway between the data's answer and the prior's, which weigh the same.
    assert float(moved[0]) == pytest.approx(1.5 * std, rel=0.15)
    np.testing.assert_allclose(
        estimated.calibration.camera_from_tool.log(),
        stated.calibration.camera_from_tool.log(),
        atol=0.02 * std,
    )


def test_a_robust_loss_has_its_scale_in_deviations_of_the_residuals():
    """The same picture, a tenth of the size: the same answer, and the same sigmas."""
    scene = scene_of(3, outlier_fraction=0.06)
    predicted, _ = scene.calibration.project(scene.data.base_from_tool, scene.data.points)
    errors, found = scene.data.pixels - predicted, []
    for share in (1.0, 0.1):
        data = eqx.tree_at(lambda d: d.pixels, scene.data, predicted + share * errors)
        fit = fit_joint(data, scene.calibration, noise="trusted", loss="cauchy")
        assert fit.pixel_sigma == pytest.approx(0.15 * share, rel=0.15)
        off = float(fit.calibration.camera.u0 - scene.calibration.camera.u0)
        assert abs(off) < 4.0 * fit.std["camera.u0"]
        found.append(fit.std["camera.u0"] / share)
    assert found[0] == pytest.approx(found[1], rel=0.1)


def test_a_robot_that_errs_along_its_tool_alone_is_taken_for_what_it_is():
    scene = scene_of(3, MANY_VIEWS)
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(MANY_VIEWS, 6)) * np.array([2e-5, 2e-5, 1e-3, 5e-5, 5e-5, 5e-5])
    poses = host_matrices(scene.data.base_from_tool)
    reported = poses.copy()
    reported[:, :3, 3] += np.einsum("vij,vj->vi", poses[:, :3, :3], drawn[:, :3])
    reported[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(drawn[:, 3:]).as_matrix()
    data = dataclasses.replace(scene.data, base_from_tool=as_se3(reported))
    fit = fit_joint(data, scene.calibration)
    assert fit.noise_estimate is not None
    assert fit.noise_estimate.directions is not None
    assert fit.noise_estimate.directions.probabilities["tool axes"] > 0.5
    # At any pose the mean of the covariances, which hardly differ between the views.
    anywhere = fit.noise.pose_covariances(poses[:, :3, :3].swapaxes(1, 2))
    expected = fit.noise_estimate.directions.covariance
    np.testing.assert_allclose(anywhere, expected, atol=0.01 * expected.max())
    # Equal errors of the same sizes take more of the rest for the robot's.
    noise = Noise(fit.noise.pixel, fit.noise.translation, fit.noise.rotation)
    equal = fit_joint(data, scene.calibration, noise=noise)
    errors = [np.asarray(each.pose_corrections) - drawn for each in (fit, equal)]
    across, across_of_equal = (np.sqrt(np.mean(each[:, :2] ** 2)) for each in errors)
    assert across < 0.5 * across_of_equal
    # They have standard deviations of twists, not of the parameters along the axes.
    stated = [
        [fit.std[f"pose_corrections.{view}.translation.{axis}"] for axis in "xyz"]
        for view in fit.view_ids
    ]
    misses = errors[0][:, :3] / np.array(stated)
    assert (np.sqrt(np.mean(misses**2, axis=0)) > 0.3).all()
    assert (np.sqrt(np.mean(misses**2, axis=0)) < 2.0).all()


def test_options_that_others_pass_on_are_those_of_the_fit():
    said_by_them = {"data", "start", "lens", "inliers", "progress"}
    parameters = inspect.signature(fit_joint).parameters
    assert set(get_type_hints(JointOptions)) == set(parameters) - said_by_them
