"""The joint fit of a camera on one hand and a target on another, against SciPy and the truth."""

import dataclasses

import numpy as np
import pytest
from host_poses import transform_errors
from numpy_camera import project_radial
from scipy.optimize import least_squares
from scipy.stats import chi2
from two_hands_scene import BOARD, NOISE, TRANSFORMS, stepped, two_hands

import smartview_jax as sv
from benchmarks.transform_errors import stated_covariance
from smartview_jax.engine import STEP_NAMES, Parameters, host_retract
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.modeling.view_poses import SeenViews

DRAWS = 24


def known_camera_fit(seed, views=8):
    scene = two_hands(seed, views)
    options = {"noise": NOISE, "field": None, "fixed": ("camera",)}
    return scene, sv.fit_joint(scene.data, scene.calibration, **options)


def test_scipy_finds_the_same_optimum_and_covariance():
    """By a chain and a camera in NumPy; a view's noise is about the middle of the hands."""
    scene, fit = known_camera_fit(0, 6)
    truth, hands = scene.calibration, scene.data.hands
    X, Z, B = (host_matrices(truth.transforms[name]) for name in TRANSFORMS)
    own, other = (
        host_matrices(hands.base_from_tool),
        host_matrices(hands.other_base_from_other_tool),
    )
    tool_from_other = np.linalg.inv(own) @ B @ other
    middle = np.tile(np.eye(4), (6, 1, 1))
    middle[:, :3, 3] = 0.5 * tool_from_other[:, :3, 3]
    camera = truth.camera
    numbers = np.array([camera.alpha_u, camera.alpha_v, camera.u0, camera.v0, camera.lens.k1])
    pixels, visible = np.asarray(scene.data.pixels), np.asarray(scene.data.visible)

    def residuals(x):
        x_step, z_step, b_step = x[:18].reshape(3, 6)
        noise = x[18:].reshape(6, 6)
        moved = middle @ host_exponentials(noise) @ np.linalg.inv(middle)
        between = np.linalg.inv(own) @ stepped(B, b_step) @ other
        chain = stepped(X, x_step) @ moved @ between @ stepped(Z, z_step)
        seen = np.einsum("vij,pj->vpi", chain[:, :3, :3], BOARD.points) + chain[:, None, :3, 3]
        missed = (pixels - project_radial(numbers, seen))[visible] / NOISE.pixel
        sigmas = np.repeat([NOISE.translation, NOISE.rotation], 3)
        return np.concatenate([missed.ravel(), (noise / sigmas).ravel()])

    unit = np.concatenate([np.full(54, 1e-3)])
    found = least_squares(lambda x: residuals(unit * x), np.zeros(54), xtol=1e-14, ftol=1e-14)
    assert found.cost == pytest.approx(fit.solution.costs[-1], rel=1e-8)
    covariance = unit[:18, None] * np.linalg.inv(found.jac.T @ found.jac)[:18, :18] * unit[:18]
    steps = (unit * found.x)[:18].reshape(3, 6)
    for k, (name, pose, step) in enumerate(zip(TRANSFORMS, (X, Z, B), steps, strict=True)):
        std = np.sqrt(np.diagonal(covariance))[6 * k : 6 * k + 6]
        off = transform_errors(
            fit.calibration.transforms[name], host_transforms(stepped(pose, step))
        )
        assert np.abs(off / std).max() < 1e-3
        expected = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        np.testing.assert_allclose(
            stated_covariance(fit, name) / np.outer(std, std),
            expected / np.outer(std, std),
            atol=1e-3,
        )


def test_errors_are_as_large_as_said():
    """The mean of `DRAWS` values of NEES for each transform: chi-square with 6 numbers each."""
    nees = np.empty((DRAWS, len(TRANSFORMS)))
    for seed in range(DRAWS):
        scene, fit = known_camera_fit(seed)
        for k, name in enumerate(TRANSFORMS):
            error = transform_errors(
                fit.calibration.transforms[name], scene.calibration.transforms[name]
            )
            nees[seed, k] = error @ np.linalg.solve(stated_covariance(fit, name), error)
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 6 * DRAWS) / DRAWS
    assert ((low < nees.mean(axis=0)) & (nees.mean(axis=0) < high)).all(), nees.mean(axis=0)


def test_a_few_words_for_calibrate():
    """The start is searched, the noise of both arms together is estimated, and all is printed."""
    scene = two_hands(3)
    fit = sv.calibrate(scene.data, "radial", camera=scene.calibration.camera, field=None)
    assert fit.warnings == ()
    assert 0.5 < fit.noise.translation / NOISE.translation < 2.0
    assert 0.5 < fit.noise.rotation / NOISE.rotation < 2.0
    text = str(fit)
    assert "\nbase_from_other_base (+- 95 %)" in text
    assert "\nother_tool_from_world (+- 95 %)" in text
    for name in TRANSFORMS:
        error = transform_errors(
            fit.calibration.transforms[name], scene.calibration.transforms[name]
        )
        widths = [fit.confidence_half_width(f"{name}.{step}") for step in STEP_NAMES]
        assert (np.abs(error) < 2.0 * np.array(widths)).all()


def test_bases_that_are_known_are_held():
    """As from the maker of both arms; by priors, so that the program of the other tests serves."""
    scene = two_hands(3)
    truth = scene.calibration
    fit = sv.calibrate(
        scene.data,
        camera=truth.camera,
        start={"base_from_other_base": truth.base_from_other_base},
        priors={"base_from_other_base": sv.Prior(std=1e-9)},
        noise=NOISE,
        field=None,
    )
    assert fit.warnings == ()
    found = fit.calibration.base_from_other_base
    assert np.abs(transform_errors(found, truth.base_from_other_base)).max() < 1e-8
    error = transform_errors(fit.calibration.camera_from_tool, truth.camera_from_tool)
    assert error @ np.linalg.solve(stated_covariance(fit, "camera_from_tool"), error) < chi2.ppf(
        0.999, 6
    )


def test_what_the_data_assume_of_the_bases_does_not_matter():
    """Neither for predictions, which are by what both arms report, nor for a bound."""
    scene = two_hands(0)
    truth = scene.calibration
    placed = scene.data.with_bases(truth.base_from_other_base)
    assert not np.allclose(placed.base_from_tool.wxyz_xyz, scene.data.base_from_tool.wxyz_xyz)
    (a, valid), (b, _) = (
        truth.project(data.command, BOARD.points) for data in (placed, scene.data)
    )
    np.testing.assert_allclose(a, b, atol=1e-9)
    off = np.linalg.norm(np.asarray(a - scene.data.pixels), axis=-1)[np.asarray(valid)]
    assert np.nanmedian(off) < 5.0
    first, second = (sv.cramer_rao(truth, data, NOISE).std for data in (placed, scene.data))
    assert first == pytest.approx(second, rel=1e-6)


def test_the_parameters_of_three_transforms():
    """A step on the host is the step of the engine, and `step_to` takes it back."""
    truth = two_hands(0).calibration
    parameters = Parameters(truth)
    step = 1e-2 * np.random.default_rng(0).standard_normal(parameters.layout.size)
    np.testing.assert_array_equal(parameters.values(np), parameters.values())
    moved = host_retract(truth, step)
    np.testing.assert_allclose(parameters.step_to(moved), step, atol=1e-12)
    changes = transform_errors(moved.base_from_other_base, truth.base_from_other_base)
    assert np.abs(changes).max() > 1e-3


def test_what_two_arms_do_not_have_is_said():
    scene = two_hands(0)
    data, truth = scene.data, scene.calibration
    with pytest.raises(ValueError, match="command_for: expected a calibration of one arm, found h"):
        truth.command_for(np.eye(4))
    with pytest.raises(ValueError, match="Rig: camera 'a' is on one arm's hand and sees"):
        sv.Rig({"a": data})
    with pytest.raises(ValueError, match="two arms are fitted by fit_joint"):
        sv.fit_many([data], truth, noise=NOISE)
    with pytest.raises(ValueError, match="base_from_other_base: a start has it for the data of"):
        sv.build_problem(data, dataclasses.replace(truth, base_from_other_base=None))
    with pytest.raises(ValueError, match="objects in pictures: expected a calibration of one arm"):
        SeenViews.of(truth, np.eye(4)[None])
