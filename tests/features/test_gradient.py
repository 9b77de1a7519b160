"""The gradient of pictures whose gradient, or whose noise, is known."""

import numpy as np
import pytest

from smartview_jax.features.gradient import MIN_NOISE, SMOOTHING, Gradient


def test_the_gradient_is_exact_on_a_plane_of_grey_levels():
    v, u = np.mgrid[:40, :60].astype(float)
    gradient = Gradient.of(20.0 + 1.5 * u - 0.8 * v)
    inner = slice(6, -6), slice(6, -6)
    np.testing.assert_allclose(gradient.by_u[inner], 1.5, rtol=1e-12)
    np.testing.assert_allclose(gradient.by_v[inner], -0.8, rtol=1e-12)
    np.testing.assert_allclose(gradient.magnitude[inner], 1.7, rtol=1e-12)
    np.testing.assert_allclose(gradient.at(np.array([20]), np.array([30])), [[1.5, -0.8]])


@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_the_stated_noise_is_the_scatter_of_derivatives_of_a_noisy_picture(noise):
    v, u = np.mgrid[:300, :400].astype(float)
    ramp = 100.0 + 0.1 * u + 0.05 * v
    gradient = Gradient.of(ramp + np.random.default_rng(0).normal(0.0, noise, ramp.shape))
    assert gradient.by_u.std() == pytest.approx(gradient.sigma, rel=0.03)
    assert gradient.by_v.std() == pytest.approx(gradient.sigma, rel=0.03)


def test_a_picture_without_noise_is_not_believed_to_have_none():
    gradient = Gradient.of(np.full((20, 20), 90.0))
    assert gradient.sigma == pytest.approx(MIN_NOISE / (np.sqrt(8.0 * np.pi) * SMOOTHING**2))
    assert gradient.magnitude.max() < 1e-12
