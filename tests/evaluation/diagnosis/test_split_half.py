import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from standard_scene import POINTS, VIEWS
from starts import nudged

from smartview_jax import Calibration, Noise, fit_joint
from smartview_jax.evaluation import split_half_difference
from smartview_jax.simulation import random_scene

MOVED = np.array([3e-3, -4e-3, 0.0, 0.0, 0.0, 0.01])
"""Of one half's hand-eye transform, in the frame of the camera: 5 mm and 0.01 rad."""


@dataclasses.dataclass
class Fit:
    calibration: Calibration
    std: dict[str, float]


def two_halves(scene, std):
    """Two fits: the half that sees view 0 finds the truth, and the other is off."""
    truth = scene.calibration
    step = SE3.exp(jnp.asarray(MOVED))
    there = truth.camera_from_tool
    turned = SE3.from_rotation_and_translation(
        step.rotation() @ there.rotation(), there.translation() + MOVED[:3]
    )
    off = Calibration.eye_in_hand(truth.camera, turned, truth.base_from_world)
    seen = []

    def fitter(data):
        visible = np.asarray(data.visible).any(axis=1)
        seen.append(list(np.flatnonzero(visible)))
        return Fit(truth if visible[0] else off, std)

    return fitter, seen


def test_the_difference_is_that_of_the_halves_and_in_what_they_state(scene):
    std = {f"camera_from_tool.translation.{axis}": 1e-3 for axis in "xyz"}
    std |= {f"camera_from_tool.rotation.{axis}": 2e-3 for axis in "xy"}  # z was held
    fitter, seen = two_halves(scene, std)
    found = split_half_difference(scene.data, fitter)
    assert seen == [list(range(0, 16, 2)), list(range(1, 16, 2))]
    assert (found.translation, found.rotation) == pytest.approx((5e-3, 0.01))
    root = np.sqrt(2.0)
    np.testing.assert_allclose(
        found.standardised_difference, [3 / root, 4 / root, 0, 0, 0, 0], atol=1e-9
    )
    assert found.description == "0.573 deg and 5.00 mm apart, 2.8 stated std at most"
    # Half a degree is more than a hand-eye transform may be off by.
    assert found.warnings[0].startswith(
        "camera poses from even and odd views are 0.573 deg and 5.00 mm"
    )
    assert found._replace(rotation=0.001, translation=1e-3).warnings == ()
    close = found._replace(
        rotation=0.001, translation=1e-3, standardised_difference=np.full(6, 3.5)
    )
    assert "stated uncertainty is too small" in close.warnings[0]


def test_fits_without_stated_std_are_compared_all_the_same(scene):
    truth = scene.calibration
    found = split_half_difference(scene.data, lambda _: truth)
    assert (found.rotation, found.translation, found.standardised_difference) == (0.0, 0.0, None)
    assert found.description == "0.000 deg and 0.00 mm apart"
    assert found.warnings == ()


def test_halves_of_data_whose_model_is_true_agree_within_what_they_state():
    """Twenty-four differences of unit variance."""
    noise = Noise(0.15, 1e-4, 2e-4)
    apart = []
    for seed in range(4):
        scene = random_scene(seed, VIEWS, POINTS, translation_noise=1e-4, rotation_noise=2e-4)
        start = nudged(scene.calibration)
        found = split_half_difference(scene.data, lambda d, s=start: fit_joint(d, s, noise=noise))
        apart.append(found.standardised_difference)
    assert 0.6 < np.sqrt(np.mean(np.square(apart))) < 1.5


def test_too_few_views_for_halves(scene):
    with pytest.raises(ValueError, match="two halves need at least 6 usable views, found 5"):
        split_half_difference(scene.data.select(range(5)), lambda _: scene.calibration)


def test_something_that_has_no_hand_eye_transform_is_refused(scene):
    class Interpolation:
        camera = scene.calibration.camera
        project = points_in_camera = staticmethod(len)

    with pytest.raises(ValueError, match="expected fits with a Calibration, found Interpolation"):
        split_half_difference(scene.data, lambda _: Interpolation())
