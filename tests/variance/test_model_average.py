import numpy as np
import pytest
from fit_scenes import thinned
from linear_world import CAMERA, SHARED, drawn, linearised
from shared_data import shared_pairs
from starts import reference_start

from smartview_jax import fit_joint
from smartview_jax.engine import TARGET_SCALE
from smartview_jax.joint.gross_errors import without_views
from smartview_jax.joint.joint_fit import half_width
from smartview_jax.variance.fisher_scoring import LikelihoodMaximum
from smartview_jax.variance.likelihood import marginalise
from smartview_jax.variance.model_average import averaged_models, between_models_covariance
from smartview_jax.variance.model_selection import FittedCandidate, ModelName
from smartview_jax.variance.standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations

STATED, OTHER = ModelName("white"), ModelName("white", (TARGET_SCALE,))
SIZE = CAMERA
"""Index of the parameter that plays the size of the target, which is stated to be zero."""


@pytest.fixture(scope="module")
def undecided(world):
    """Two models that differ in one parameter: as stated, or any value within 2."""
    group_index = np.full(SHARED, -1)
    group_index[SIZE] = 0
    views = linearised(world, drawn(world, 0))._replace(group_index=group_index)
    return views, {
        model: FittedCandidate(
            np.ones(3, dtype=bool),
            LikelihoodMaximum(
                StandardDeviations.from_vector(np.array([0.7, 0.4, 0.2, size])),
                0.0,
                0.0,
                np.zeros((0, 0)),
                0,
            ),
            0.0,
        )
        for model, size in ((STATED, ROBOT_SIGMA_FLOOR), (OTHER, 2.0))
    }


@pytest.mark.parametrize("probability", [0.02, 0.5, 0.9])
def test_the_answer_and_its_covariance_are_those_of_the_mixture(undecided, probability):
    """Mean and covariance of two normal distributions, by the textbook."""
    views, fitted = undecided
    probabilities = {STATED: 1.0 - probability, OTHER: probability}
    averaged = averaged_models(views, (TARGET_SCALE,), fitted, probabilities)
    answer = marginalise(views, averaged)
    each = [marginalise(views, fitted[model].maximum.sigmas) for model in probabilities]
    weights = np.array([1.0 - probability, probability])

    means = np.array([one.step.shared for one in each])
    mean = weights @ means
    # The prior within 2 moves the size by a hundredth of its standard deviation.
    std = np.sqrt(np.diagonal(each[1].shared_covariance))
    np.testing.assert_allclose((answer.step.shared - mean) / std, 0.0, atol=0.03)

    covariance = answer.shared_covariance + between_models_covariance(
        views, fitted, probabilities, averaged
    )
    within = np.tensordot(weights, [one.shared_covariance for one in each], 1)
    between = np.einsum("m,mi,mj->ij", weights, means - mean, means - mean)
    np.testing.assert_allclose(covariance, within + between, rtol=0.02, atol=0.02 * std.min() ** 2)


def test_a_size_that_is_certain_is_held_or_free(undecided):
    views, fitted = undecided
    for model, prior_std in ((STATED, ROBOT_SIGMA_FLOOR), (OTHER, 2.0)):
        only = {model: fitted[model]}
        averaged = averaged_models(views, (TARGET_SCALE,), only, {model: 1.0})
        assert averaged.field[0] == prior_std
        covariance = between_models_covariance(views, only, {model: 1.0}, averaged)
        np.testing.assert_allclose(covariance, 0.0, atol=1e-12)


def test_two_pictures_do_not_decide_where_the_camera_is():
    """A real set whose target is 2 % smaller than stated with a probability of a half."""
    data, reference = shared_pairs("tampere_kuka_2")
    data, start = thinned(data, 4), reference_start(reference)
    answers, widths = [], []
    for part in (data, without_views(data, {20: "", 21: ""})):
        fit = fit_joint(part, start)
        names = [f"camera_from_tool.translation.{axis}" for axis in "xyz"]
        answers.append(np.asarray(fit.calibration.camera_from_tool.translation()))
        widths.append([half_width(fit.std[name], fit.degrees_of_freedom[name]) for name in names])
        assert 0.1 < fit.noise_estimate.target_scale.probability < 0.9
        assert "for the stated size" in " ".join(fit.warnings)
    assert (np.abs(answers[0] - answers[1]) < np.min(widths, axis=0)).all()
    # Not by stating nothing at all.
    assert np.max(widths) < 8e-3
