"""The scene that the tests of this room share: with one number of views and of points."""

import pytest
from standard_scene import POINTS, VIEWS

from smartview_jax.simulation import random_scene


@pytest.fixture(scope="session")
def scene():
    """An exact robot, 0.15 px of noise."""
    return random_scene(0, VIEWS, POINTS)
