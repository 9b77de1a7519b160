"""The scene that the files of this folder share."""

import pytest

from smartview_jax.simulation import random_scene
from smartview_jax.staged import fit_staged


@pytest.fixture(scope="session")
def scene():
    """As many views as tests/staged has: the same programs fit them."""
    return random_scene(1, views=8)


@pytest.fixture(scope="session")
def clean_fit(scene):
    return fit_staged(scene.data)
