"""The scenes that the files of this folder share, so that one program fits all of them."""

import pytest
from shared_data import shared_pairs

from smartview_jax.simulation import random_scene
from smartview_jax.staged import fit_staged

VIEWS = 8
"""Views of every random scene of the paper's points."""


@pytest.fixture(scope="session")
def scene():
    return random_scene(1, views=VIEWS)


@pytest.fixture(scope="session")
def clean_fit(scene):
    return fit_staged(scene.data)


@pytest.fixture(scope="session")
def circles():
    """A real set of circle grids, its reference figures, and the fit of it that gates nothing."""
    data, reference = shared_pairs("rct_circle10x10")
    return data, reference, fit_staged(data, "opencv4", pixel_sigma=1.0)
