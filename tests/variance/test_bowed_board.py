"""A board that bows: its shape is found, and neither the camera nor the mount pays for it."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from starts import nudged

from smartview_jax import Noise, fit_joint
from smartview_jax.calibration import flat_shape
from smartview_jax.engine import Step, build_problem
from smartview_jax.joint import parameter_estimates
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.simulation import random_scene

VIEWS = 16
BOW = 3e-4
EXACTLY_FLAT = RobotPrior(target_bow_median=0.0, target_print_median=0.0)


def board(bow=0.0):
    """A board of 60 x 40 mm, whose corners are higher than its middle."""
    y, x = np.indices((4, 4)).reshape(2, -1)
    points = np.stack([0.02 * x, 0.04 / 3 * y, np.zeros(x.size)], axis=1)
    square = np.sum((points[:, :2] - points[:, :2].mean(axis=0)) ** 2, axis=1)
    points[:, 2] = bow * (square - square.mean()) / np.ptp(square)
    return points


def scene_with_bow(seed, bow, stretch=1.0):
    scene = random_scene(
        seed,
        VIEWS,
        board(bow) * [stretch, 1.0, 1.0],
        translation_noise=3e-5,
        rotation_noise=np.deg2rad(0.005),
    )
    stated = jnp.broadcast_to(board(), scene.data.points.shape)
    return dataclasses.replace(scene, data=dataclasses.replace(scene.data, points=stated))


def mount_error(fit, scene):
    true = scene.calibration.camera_from_tool.translation()
    return np.asarray(fit.calibration.camera_from_tool.translation() - true)


@pytest.fixture(scope="module")
def bowed():
    scenes = [scene_with_bow(seed, BOW) for seed in range(3)]
    return scenes, [fit_joint(scene.data, nudged(scene.calibration)) for scene in scenes]


def test_the_mount_does_not_pay_for_a_bow(bowed):
    scenes, fits = bowed
    flat = [
        fit_joint(scene.data, nudged(scene.calibration), robot_prior=EXACTLY_FLAT)
        for scene in scenes
    ]
    errors, of_flat = (
        np.array([mount_error(fit, scene) for fit, scene in zip(found, scenes, strict=True)])
        for found in (fits, flat)
    )
    assert np.linalg.norm(errors) < 0.5 * np.linalg.norm(of_flat)
    widths = [
        [fit.confidence_half_width(f"camera_from_tool.translation.{axis}") for axis in "xyz"]
        for fit in fits
    ]
    # 9 intervals of 95 %: less than 7 that hold happen once in a hundred times.
    assert np.sum(np.abs(errors) < widths) >= 7


def test_the_bow_is_named_with_its_size(bowed):
    _, fits = bowed
    for fit in fits:
        estimate = fit.noise_estimate.target_shape
        height, std = estimate.bow(board())
        assert abs(height - BOW) < 4.0 * std < 0.5 * BOW
        assert any(f"the target bows by {1e3 * height:.2f} +- " in one for one in fit.warnings)
        shown = {one.name: one for one in parameter_estimates(fit)}["target_shape.bow_x"]
        assert shown.unit == "mm"
        assert shown.value == pytest.approx(1e3 * float(estimate.shape.coefficients[0]))


def test_a_board_that_is_printed_too_wide_is_named_with_its_stretch():
    scene = scene_with_bow(0, 0.0, stretch=1.004)
    fit = fit_joint(scene.data, nudged(scene.calibration))
    (said,) = [text for text in fit.warnings if "is stretched by" in text]
    percent, std = re.search(r"by (\S+) \+- (\S+) % along its x compared", said).groups()
    assert abs(float(percent) - 0.4) < max(4.0 * float(std), 0.02)
    assert float(std) < 0.1


def test_a_flat_board_is_left_alone():
    scene = scene_with_bow(0, 0.0)
    found, flat = (
        fit_joint(scene.data, nudged(scene.calibration), robot_prior=prior)
        for prior in (None, EXACTLY_FLAT)
    )
    assert not any("bows" in text or "stretched" in text for text in found.warnings)
    assert flat.calibration.target_shape is None
    height, std = found.noise_estimate.target_shape.bow(board())
    assert height < 4.0 * std
    gap = found.calibration.camera_from_tool.inverse() @ flat.calibration.camera_from_tool
    names = [f"camera_from_tool.translation.{axis}" for axis in "xyz"]
    assert (np.abs(gap.translation()) < 2.0 * np.array([found.std[name] for name in names])).all()


def test_equations_with_the_shape_are_those_of_automatic_differentiation():
    scene = scene_with_bow(1, BOW)
    data = dataclasses.replace(
        scene.data,
        **{k: getattr(scene.data, k)[:4] for k in ("pixels", "visible", "points")},
        base_from_tool=jax.tree.map(lambda x: x[:4], scene.data.base_from_tool),
        view_ids=scene.data.view_ids[:4],
    )
    problem = build_problem(data, nudged(scene.calibration), noise=Noise(0.15, 1e-4, 1e-4)).problem
    shape = flat_shape(np.asarray(data.points), np.asarray(data.visible))
    count, own = len(problem.free), problem.per_view_free.size

    def residuals(numbers):
        moved = dataclasses.replace(shape, coefficients=numbers[count + own :])
        displaced = dataclasses.replace(problem, observations=problem.observations.of_shape(moved))
        step = Step(numbers[:count], numbers[count : count + own].reshape(-1, 6))
        r = displaced.whitened_residuals(step).ravel()
        return r, r

    jacobian, r = jax.jit(jax.jacfwd(residuals, has_aux=True))(jnp.zeros(count + own + 5))
    dense, gradient = np.asarray(jacobian.T @ jacobian), np.asarray(jacobian.T @ r)
    order = np.r_[:count, count + own : count + own + 5]
    found = jax.jit(lambda p, s: p.normal_equations_without_priors(p.zero_step(), s))(
        problem, shape
    )
    scale = np.sqrt(np.diagonal(dense))
    np.testing.assert_allclose(
        found.matrix.shared / np.outer(scale[order], scale[order]),
        (dense / np.outer(scale, scale))[np.ix_(order, order)],
        atol=1e-9,
    )
    np.testing.assert_allclose(
        found.matrix.border.reshape(own, -1) / np.outer(scale[count : count + own], scale[order]),
        (dense / np.outer(scale, scale))[count : count + own][:, order],
        atol=1e-9,
    )
    np.testing.assert_allclose(
        found.gradient.shared / scale[order], gradient[order] / scale[order], atol=1e-6
    )


@pytest.mark.parametrize("medians", [(-1e-3, 1e-3), (1e-3, 0.0), (np.nan, 1e-3)])
def test_a_prior_of_the_shape_is_positive_or_holds_all_of_it(medians):
    with pytest.raises(ValueError, match="target_print_median: expected two positive numbers"):
        RobotPrior(target_bow_median=medians[0], target_print_median=medians[1])
