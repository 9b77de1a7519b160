"""Two views of the placed box, and how uncertain a robot makes them."""

import pytest
from drawn_edges import calibration, seen_views
from placed_box import MIDDLE, MODEL, NOISE
from seen_scene import SAMPLES

from smartview_jax.localization import Wireframe
from smartview_jax.modeling import CalibrationUncertainty


@pytest.fixture(autouse=True, scope="module")
def few_samples():
    """Enough for wireframes among drawn edges."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("smartview_jax.localization.judging.candidates.FIT_SAMPLES", SAMPLES)
        yield


@pytest.fixture(scope="session")
def views():
    return seen_views(MIDDLE)


@pytest.fixture(scope="session")
def uncertainty(views):
    """Of views that a robot with `NOISE` takes, all else being known."""
    return CalibrationUncertainty.of(views, calibration(), None, NOISE)


@pytest.fixture(scope="session")
def wireframe():
    return Wireframe.of(MODEL, SAMPLES)
