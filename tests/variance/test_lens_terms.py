"""A lens of higher order than its model: the pictures tell, and intervals cover what it changes."""

import dataclasses

import numpy as np
import pytest
from fit_scenes import MANY_VIEWS
from jaxlie import SE3
from starts import nudged

from smartview_jax import fit_joint
from smartview_jax.cameras import Camera, OpenCV4, Radial
from smartview_jax.evaluation import std_of
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.variance import lens_terms

NOT_ASKED = RobotPrior(wrong_lens_probability=0.0)


def scene_with(lens):
    """A wide lens, and a board that fills its picture."""
    y, x = np.indices((4, 4)).reshape(2, -1)
    board = np.stack([0.08 * x, 0.055 * y, np.zeros(16)], axis=1)
    camera = Camera(1000.0, 1000.0, 640.0, 512.0, lens, (1280, 1024))
    truth = dataclasses.replace(paper_calibration(), camera=camera)
    return random_scene(
        0,
        MANY_VIEWS,
        board,
        truth,
        distance=(0.35, 0.5),
        pixel_noise=0.1,
        translation_noise=1e-4,
        rotation_noise=np.deg2rad(0.01),
    )


def fit_of(scene, robot_prior=None):
    start = nudged(dataclasses.replace(scene.calibration, camera=CAMERA))
    return fit_joint(scene.data, start, gross_errors="keep", robot_prior=robot_prior)


CAMERA = Camera(1000.0, 1000.0, 640.0, 512.0, Radial(0.02), (1280, 1024))


@pytest.fixture(scope="module")
def bent():
    """A lens with a term of the fifth order, which the paper's lacks."""
    scene = scene_with(OpenCV4(-0.02, 0.4, 0.0, 0.0))
    return scene, fit_of(scene)


def test_a_lens_of_its_model_is_not_doubted():
    scene = scene_with(Radial(0.02))
    fit, without = fit_of(scene), fit_of(scene, robot_prior=NOT_ASKED)
    assert fit.noise_estimate.lens.probability < 0.9
    assert fit.noise_estimate.lens.rms < 0.01
    assert without.noise_estimate.lens is None
    for name, std in without.std.items():
        if name.startswith(("camera.alpha", "camera_from_tool")):
            assert fit.std[name] == pytest.approx(std, rel=0.05)
    assert not [text for text in fit.warnings if "is not described by" in text]


def test_a_term_that_the_model_lacks_is_named_and_covered(bent):
    scene, fit = bent
    lens = fit.noise_estimate.lens
    assert lens.probability > 0.99
    without = fit_of(scene, robot_prior=NOT_ASKED)
    widths = {name: fit.std[name] / std for name, std in without.std.items() if std > 0.0}
    mount = [ratio for name, ratio in widths.items() if name.startswith("camera_from_tool.")]
    assert min(mount) > 0.99
    assert max(mount) > 1.1
    # What the transforms may be off is made up for by the camera: the same pixels are predicted.
    pose, points = SE3(scene.data.base_from_tool.wxyz_xyz[0]), scene.data.points[0]

    def predicted(calibration):
        return calibration.project(pose, points)[0]

    np.testing.assert_allclose(std_of(fit, predicted), std_of(without, predicted), rtol=0.2)
    (said,) = [text for text in fit.warnings if "is not described by" in text]
    assert "is not described by the radial lens" in said
    assert "try lens='opencv4'" in said


def test_the_linearised_terms_are_those_of_a_lens_with_them(bent, monkeypatch):
    """To second order a term changes the cost as moving the pixels back by the term does."""
    scene, _ = bent
    found = []
    extended = lens_terms._with_terms

    def recorded(views, z, linearised, terms):
        result = extended(views, z, linearised, terms)
        found.append((views, z, linearised, terms, result))
        return result

    monkeypatch.setattr(lens_terms, "_with_terms", recorded)
    fit_of(scene)
    views, z, linearised, terms, result = found[-1]
    amount = np.array([0.3, -0.2, 0.1])
    moved = lens_terms._with_moved_pixels(views, -np.tensordot(amount, terms, 1)).linearise(z)
    count = len(amount)
    gradient = np.asarray(result.gradient.shared)[-count:]
    matrix = np.asarray(result.matrix.shared)
    np.testing.assert_allclose(
        moved.residual_sum_of_squares - linearised.residual_sum_of_squares,
        2.0 * gradient @ amount + amount @ matrix[-count:, -count:] @ amount,
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        moved.gradient.shared,
        linearised.gradient.shared + matrix[:-count, -count:] @ amount,
        atol=1e-6 * np.abs(matrix[:-count, -count:]).max(),
    )
