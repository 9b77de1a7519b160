import pytest

from smartview_jax.simulation import paper_calibration


@pytest.fixture(scope="session")
def calibration():
    return paper_calibration()
