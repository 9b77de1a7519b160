import pytest
from fit_scenes import scene_of
from starts import nudged

from smartview_jax import calibrate, fit_joint
from smartview_jax.engine import StructuredLM


@pytest.fixture(scope="session")
def scene():
    """Pixels that err, and a robot that does not."""
    return scene_of(0)


@pytest.fixture(scope="session")
def trusted(scene):
    """Its fit, to the last digit."""
    thorough = StructuredLM(rtol=1e-12)
    return fit_joint(scene.data, nudged(scene.calibration), solver=thorough, noise="trusted")


@pytest.fixture(scope="session")
def shaky_scene():
    """Pixels that err, and a robot that does so too."""
    return scene_of(2, translation_noise=1e-4)


@pytest.fixture(scope="session")
def calibrated(shaky_scene):
    """Both fits of it, with the noise as estimated."""
    return calibrate(shaky_scene.data, "radial")
