"""The gain of a step at every view is the one of least squares with its columns, one by one."""

import numpy as np

from smartview_jax.data_checks.step_gains import step_gains

VIEWS = 9


def test_the_gain_of_each_step_is_the_one_of_least_squares():
    """A column of the step is one that others determine, and units differ by orders."""
    rng = np.random.default_rng(0)
    model, step = rng.normal(size=(VIEWS, 6, 5)), rng.normal(size=(VIEWS, 6, 3))
    model[..., 0] *= 1e4
    step[..., 2] = 1e-3 * step[..., 0]
    values = rng.normal(size=(VIEWS, 6)) + 5.0 * (np.arange(VIEWS) >= 4)[:, None] * step[..., 1]
    values[:, :3] *= 1e-3

    def left_over(columns, sigmas):
        matrix, scaled = (columns / sigmas[:, None]).reshape(6 * VIEWS, -1), values / sigmas
        numbers = np.linalg.lstsq(matrix, scaled.ravel(), rcond=1e-12)[0]
        return values - columns @ numbers

    sigmas = np.ones(6)
    for _ in range(200):
        errors = left_over(model, sigmas)
        sigmas = np.repeat(np.sqrt(np.mean(errors.reshape(VIEWS, 2, 3) ** 2, axis=(0, 2))), 3)
    gains = step_gains(errors, model, step)
    assert np.argmax(gains) == 4
    for view in range(VIEWS):
        later = (np.arange(VIEWS) >= view)[:, None, None] * step
        rest = left_over(np.concatenate([model, later], axis=2), sigmas)
        ratio = np.sum((rest / sigmas) ** 2) / np.sum((errors / sigmas) ** 2)
        np.testing.assert_allclose(gains[view], -6 * VIEWS * np.log(ratio), rtol=1e-6)
