import pytest

from smartview_jax.engine import Noise
from smartview_jax.evaluation import cramer_rao
from smartview_jax.simulation import paper_calibration, random_scene


@pytest.fixture(scope="session")
def calibration():
    return paper_calibration()


@pytest.fixture(scope="session")
def uncertain(calibration):
    """What eight views tell of the calibration, and the robot's noise in them."""
    noise = Noise(0.15, 2e-4, 1e-3)
    return cramer_rao(calibration, random_scene(0, 8).data, noise, field=None), noise
