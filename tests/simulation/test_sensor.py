import numpy as np
import pytest

from smartview_jax.simulation.sensor import sensor_picture


def test_exposure_scales_and_saturates():
    ramp = np.tile(np.linspace(0.0, 250.0, 26), (5, 1))
    picture = sensor_picture(ramp, blur=0.0, noise=0.0, exposure=2.0)
    np.testing.assert_array_equal(picture[0], np.minimum(2.0 * ramp[0], 255.0))


def test_noise_has_the_size_asked_for_and_its_seed():
    flat = np.full((200, 200), 100.0)
    picture = sensor_picture(flat, noise=3.0, seed=4)
    # Rounding adds 1/12 of a squared grey level.
    assert picture.std() == pytest.approx(np.sqrt(9.0 + 1.0 / 12.0), rel=0.02)
    np.testing.assert_array_equal(picture, sensor_picture(flat, noise=3.0, seed=4))
    assert (picture != sensor_picture(flat, noise=3.0, seed=5)).any()


def test_blur_keeps_the_light_of_a_point():
    point = np.zeros((21, 21))
    point[10, 10] = 5e3
    picture = sensor_picture(point, blur=2.0, noise=0.0).astype(float)
    assert picture.sum() == pytest.approx(5e3, rel=0.01)
    assert picture.max() == pytest.approx(5e3 / (2.0 * np.pi * 4.0), rel=0.02)
