import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of

from smartview_jax import fit_staged
from smartview_jax.staged.stretched_target import likeliest_stretch

STRETCH = 1.06


def stated(scene, axis):
    """The data of a target that is longer along an axis than stated."""
    factors = np.ones(3)
    factors[axis] = 1.0 / STRETCH
    return dataclasses.replace(
        scene.data, points=jnp.asarray(np.asarray(scene.data.points) * factors)
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_the_pictures_tell_the_stretch(axis):
    data = stated(scene_of(4, MANY_VIEWS), axis)
    shape = likeliest_stretch(data.observations, np.ones(MANY_VIEWS, dtype=bool))
    assert shape is not None
    aspect, shear = np.asarray(shape.coefficients)[3:] / float(shape.half_size)
    expected = 0.5 * np.log(STRETCH) * (1.0 if axis == 0 else -1.0)
    assert aspect == pytest.approx(expected, abs=3e-3)
    assert shear == pytest.approx(0.0, abs=3e-3)


def test_a_target_as_stated_is_not_stretched():
    data = scene_of(4, MANY_VIEWS).data
    shape = likeliest_stretch(data.observations, np.ones(MANY_VIEWS, dtype=bool))
    assert shape is not None
    np.testing.assert_allclose(np.asarray(shape.coefficients) / shape.half_size, 0.0, atol=3e-3)


def test_too_few_views_tell_nothing():
    data = scene_of(4, MANY_VIEWS).data
    used = np.arange(MANY_VIEWS) < 3
    assert likeliest_stretch(data.observations, used) is None


def test_a_stretched_target_is_named_and_its_camera_found():
    scene = scene_of(4, MANY_VIEWS)
    fit = fit_staged(stated(scene, 0), "radial")
    assert fit.calibration.target_shape is not None
    (doubt,) = fit.warnings
    assert "stretched by 5.8 % along its x" in doubt or "stretched by 5.9 % along its x" in doubt
    actual, truth = fit.calibration.camera, scene.calibration.camera
    assert float(actual.alpha_u) == pytest.approx(float(truth.alpha_u), rel=0.02)
    assert float(actual.alpha_u / actual.alpha_v) == pytest.approx(1.0, abs=2e-3)
