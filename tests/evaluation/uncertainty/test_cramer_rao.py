import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from standard_scene import POINTS

from smartview_jax import (
    Dataset,
    Noise,
    Prior,
    cramer_rao,
    fit_joint,
    fit_many,
    std_of,
)
from smartview_jax.engine import build_problem, build_rig
from smartview_jax.evaluation import covariance_of
from smartview_jax.geometry import host_exponentials
from smartview_jax.joint import OpenDirections
from smartview_jax.robot_errors import RobotError
from smartview_jax.simulation import random_scene, simulate
from smartview_jax.simulation.scenes import reported_poses

NOISE = Noise(0.15, 1e-4, float(np.deg2rad(0.01)))
RUNS = 256
MOUNT = "camera_from_tool.translation"


@pytest.fixture(scope="module")
def setting():
    """Poses of eight views, and the bound there."""
    scene = random_scene(0, 8, POINTS, pixel_noise=0.0)
    return scene, cramer_rao(scene.calibration, scene.data, NOISE)


@pytest.fixture(scope="module")
def fits(setting):
    """Many fits to data drawn from the model of the bound."""
    scene, _ = setting
    poses, pixels = scene.data.base_from_tool, np.asarray(scene.data.pixels)
    drawn = []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        noisy = pixels + NOISE.pixel * rng.standard_normal(pixels.shape)
        reported = reported_poses(poses, rng, NOISE.translation, NOISE.rotation)
        drawn.append(Dataset.from_arrays(POINTS, noisy, reported, scene.data.image_size))
    return fit_many(drawn, scene.calibration, noise=NOISE)


def test_fits_scatter_as_the_bound_says(setting, fits):
    _, bound = setting
    camera = fits.calibrations.camera
    found = {
        "camera.alpha_u": camera.alpha_u,
        "camera.u0": camera.u0,
        "camera.lens.k1": camera.lens.k1,
        "camera_from_tool.translation.x": fits.calibrations.camera_from_mount.translation()[:, 0],
        "camera_from_tool.translation.z": fits.calibrations.camera_from_mount.translation()[:, 2],
        "base_from_world.translation.y": fits.calibrations.holder_from_world.translation()[:, 1],
    }
    for name, values in found.items():
        # A deviation from so many draws is itself known to 4.4 %.
        assert np.std(np.asarray(values)) == pytest.approx(bound.std[name], rel=0.12), name


def test_what_is_computed_from_fits_scatters_as_the_bound_says(setting, fits):
    scene, bound = setting
    pose = SE3(scene.data.base_from_tool.wxyz_xyz[:1])

    def corner(calibration):
        return calibration.project(pose, POINTS[:1])[0].ravel()

    stated = std_of(bound, corner)
    pixels = jax.lax.map(corner, fits.calibrations)
    np.testing.assert_allclose(np.std(pixels, axis=0), stated, rtol=0.12)
    spread = covariance_of(bound, corner)
    np.testing.assert_allclose(np.sqrt(np.diagonal(spread)), stated, rtol=1e-9)
    correlation = spread[0, 1] / np.sqrt(spread[0, 0] * spread[1, 1])
    assert np.corrcoef(np.transpose(pixels))[0, 1] == pytest.approx(float(correlation), abs=0.15)


def test_a_parameter_itself_has_its_own_deviation(setting):
    _, bound = setting

    def some(calibration):
        translation = calibration.camera_from_tool.translation()
        return jnp.concatenate([calibration.camera.alpha_u[None], translation])

    names = ["camera.alpha_u", *(f"camera_from_tool.translation.{axis}" for axis in "xyz")]
    stated = [bound.std[name] for name in names]
    np.testing.assert_allclose(std_of(bound, some), stated, rtol=1e-9)


def test_pixels_do_not_matter_and_noise_counts_in_proportion(setting):
    scene, _ = setting
    data = scene.data
    other = Dataset.from_arrays(data.points, data.pixels + 3.0, data.base_from_tool, (640, 480))
    exact = cramer_rao(scene.calibration, data, 0.15)
    np.testing.assert_allclose(
        list(cramer_rao(scene.calibration, other, 0.3).std.values()),
        2.0 * np.array(list(exact.std.values())),
        rtol=1e-9,
    )


def test_a_robot_that_errs_a_fit_and_priors_agree_with_the_bound(setting):
    """The stated deviations of a fit are the bound's at its own optimum; priors count in both."""
    scene, _ = setting
    priors = {"camera.lens.k1": Prior(std=0.01)}
    fit = fit_joint(scene.data, scene.calibration, noise=NOISE, priors=priors)
    bound = cramer_rao(fit.calibration, scene.data, NOISE, priors=priors)
    for name, value in bound.std.items():
        assert fit.std[name] == pytest.approx(value, rel=1e-6)
    assert bound.std["camera.lens.k1"] < 0.01


def test_what_no_data_tell_is_refused_in_words(setting):
    """All rotations about one axis: the offset along it is open."""
    scene, _ = setting
    turns = np.zeros((8, 6))
    turns[:, 5] = np.linspace(-0.5, 0.5, 8)
    first = np.asarray(scene.data.base_from_tool.as_matrix())[:1]
    there = np.eye(4)
    there[:3, 3] = scene.calibration.base_from_world.apply(jnp.asarray(POINTS.mean(axis=0)))
    aside = np.tile(np.eye(4), (8, 1, 1))
    aside[:, :3, 3] = 0.01 * np.random.default_rng(0).normal(size=(8, 3))
    poses = aside @ there @ host_exponentials(turns) @ np.linalg.inv(there) @ first
    data = simulate(scene.calibration, poses, POINTS, pixel_noise=0.0).data
    bound = cramer_rao(scene.calibration, data, NOISE)
    assert any(np.isinf(value) for value in bound.std.values())
    with pytest.raises(ValueError, match="all rotations share that axis"):
        std_of(bound, lambda calibration: calibration.camera.alpha_u)


def test_the_bound_of_a_rig_is_the_covariance_of_its_fit(fitted_rig):
    rig, truths, noise, options, fit = fitted_rig
    bound = cramer_rao(truths, rig, noise, **options)
    assert bound.parameter_names == fit.parameter_names
    for name in bound.parameter_names:
        assert bound.std[name] == pytest.approx(fit.std[name], rel=1e-6)
    expected = fit.relative("left", "right").covariance
    np.testing.assert_allclose(bound.relative("left", "right").covariance, expected, rtol=1e-6)
    # As if nothing told where the left camera is along its axis.
    names = ("left.camera_from_tool.translation.z",)
    undetermined = OpenDirections(names, np.eye(1), np.ones(1), 1e-6)
    std = dataclasses.replace(bound, undetermined=undetermined).relative("left", "right").std
    assert np.isinf(std[2])
    assert np.isfinite(std[3:]).all()
    with pytest.raises(TypeError, match="a rig needs a Noise, and calibrations by camera"):
        cramer_rao(truths, rig, 0.15)


def test_a_rigs_robot_has_the_known_error_of_its_calibrations(fitted_rig):
    """Unless a field is given, as for one camera; a rig has one robot, so that they must agree."""
    rig, truths, noise, options, _ = fitted_rig
    field = options["field"]
    known = RobotError(field, jnp.full(field.size, 1e-3))
    erring = {name: dataclasses.replace(t, robot_error=known) for name, t in truths.items()}
    built = build_rig(rig, erring, noise=NOISE, field="auto")
    assert built.shared_names == build_rig(rig, truths, noise=NOISE).shared_names
    assert built.problem.start_error is known
    (group,) = built.problem.groups
    alone = build_problem(rig.cameras["left"], erring["left"], noise=NOISE).problem
    for own, expected in zip(
        jax.tree.leaves(group.problems.prepared_poses),
        jax.tree.leaves(alone.prepared_poses),
        strict=True,
    ):
        np.testing.assert_allclose(np.asarray(own)[0], expected, rtol=1e-12)
    with pytest.raises(ValueError, match="error in 'right' is another than in 'left'"):
        cramer_rao(erring | {"right": truths["right"]}, rig, noise)


def test_square_pixels_are_as_certain_as_fits_say_and_are(setting):
    """Cameras whose ratio of focal lengths scatters as a prior says; all of a fit has its size."""
    scene, free = setting
    std, centre = 3e-4, float(scene.calibration.camera.v0)
    told = {"camera.pixel_aspect": Prior(mean=1.0, std=std)}
    bound = cramer_rao(scene.calibration, scene.data, NOISE, priors=told)
    # By the formula of a linear measurement: the bound without the prior, given the ratio.
    camera, covariance = scene.calibration.camera, free.covariance
    alpha_u, alpha_v = float(camera.alpha_u), float(camera.alpha_v)
    row = np.zeros(len(covariance))
    row[:2] = -alpha_v / alpha_u**2, 1.0 / alpha_u
    gain = covariance @ row / (row @ covariance @ row + std**2)
    given = covariance - np.outer(gain, row @ covariance)
    scale = np.sqrt(np.diagonal(given))
    np.testing.assert_allclose(
        bound.covariance / np.outer(scale, scale), given / np.outer(scale, scale), atol=1e-6
    )
    poses, pixels, drawn, ratios = scene.data.base_from_tool, scene.data.pixels, [], []
    for seed in range(RUNS // 2):
        rng = np.random.default_rng(seed)
        ratios.append(1.0 + std * rng.standard_normal())
        stretched = np.array(pixels)
        stretched[..., 1] = centre + ratios[-1] * (stretched[..., 1] - centre)
        noisy = stretched + NOISE.pixel * rng.standard_normal(pixels.shape)
        reported = reported_poses(poses, rng, NOISE.translation, NOISE.rotation)
        drawn.append(Dataset.from_arrays(POINTS, noisy, reported, scene.data.image_size))
    fits = fit_many(drawn, scene.calibration, noise=NOISE, priors=told)
    errors = np.stack(
        [
            np.asarray(fits.calibrations.camera.alpha_u) - alpha_u,
            np.asarray(fits.calibrations.camera.alpha_v) - np.array(ratios) * alpha_u,
            *np.transpose(
                np.asarray(fits.calibrations.camera_from_mount.translation())
                - np.asarray(scene.calibration.camera_from_mount.translation())
            ),
        ],
        axis=1,
    )
    rows = np.array([0, 1, *(fits.parameter_names.index(f"{MOUNT}.{k}") for k in "xyz")])
    stated = np.asarray(fits.covariance)[:, rows[:, None], rows]
    nees = np.einsum("fi,fij,fj->f", errors, np.linalg.inv(stated), errors)
    # The mean of so many chi-squares of five degrees of freedom is known to 0.28.
    assert nees.mean() == pytest.approx(5.0, abs=1.0)
