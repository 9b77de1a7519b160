"""Directions that the data do not tell are described in words and in units that people read."""

import numpy as np

from smartview_jax.engine import describe_direction
from smartview_jax.simulation import random_scene

CALIBRATION = random_scene(0, views=3).calibration


def test_a_combination_is_scaled_to_its_first_parameter():
    """A singular vector has entries of 1e-6, which say nothing: 1 mm goes with 2 degrees here."""
    components = (
        ("camera_from_tool.translation.x", -2e-6),
        ("camera_from_tool.rotation.y", 4e-3 * np.deg2rad(1.0)),
        ("camera.u0", 1e-3),
    )
    text = describe_direction(components, CALIBRATION, is_null=False)
    assert text == (
        "a combination of parameters: camera_from_tool.translation.x (-1 mm), "
        "camera_from_tool.rotation.y (+2 degrees), camera.u0 (+0.5)"
    )


def test_only_a_direction_that_nothing_tells_has_turns_about_one_axis_as_its_cause():
    components = (("camera_from_tool.translation.x", 1.0),)
    described = [describe_direction(components, CALIBRATION, is_null) for is_null in (True, False)]
    assert described[0] == described[1] + ": all rotations share that axis"
