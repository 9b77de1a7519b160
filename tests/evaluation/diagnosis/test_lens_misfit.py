import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.evaluation import lens_misfit
from smartview_jax.simulation import paper_points, random_scene


@pytest.fixture(scope="module")
def scene():
    """An exact robot, 0.15 px of noise, and points enough to show a pattern."""
    return random_scene(0, 16, paper_points((0.0, 0.02))[::4])


def everything(data):
    return np.ones(data.visible.shape, dtype=bool)


def test_noise_has_no_pattern(scene):
    """0.15 px of u and of v."""
    assert lens_misfit(scene.calibration, scene.data, everything(scene.data)) < 0.01


def test_a_pattern_over_the_picture_is_found_at_its_size(scene):
    """Waves of u by v and of v by u: what poses of the views cannot take up."""
    place = 2.0 * np.array(scene.data.pixels) / np.array([640.0, 480.0]) - 1.0
    pattern = 0.6 * np.polynomial.legendre.legval(place[..., ::-1], [0, 0, 0, 0, 1])
    data = eqx.tree_at(lambda d: d.pixels, scene.data, scene.data.pixels + pattern)
    size = np.sqrt(np.nanmean(np.sum(pattern**2, axis=-1)))
    found = lens_misfit(scene.calibration, data, everything(data))
    assert found == pytest.approx(size, rel=0.25)
    assert found < 1.02 * size
    # Points that a fit rejected say nothing about the lens.
    wild = np.array(data.pixels)
    wild[:, ::7] += 40.0
    bad = eqx.tree_at(lambda d: d.pixels, data, jnp.asarray(wild))
    used = everything(data)
    used[:, ::7] = False
    assert lens_misfit(scene.calibration, bad, used) == pytest.approx(found, rel=0.1)


def test_too_few_points_for_a_pattern_have_none(scene):
    used = everything(scene.data)
    used[:, 2:] = False
    assert lens_misfit(scene.calibration, scene.data, used) == 0.0
