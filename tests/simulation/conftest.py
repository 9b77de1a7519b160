"""What the tests of this room share: a camera of small pictures, and the example."""

import dataclasses
import importlib

import numpy as np
import pytest

from smartview_jax.cameras import Camera, Radial
from smartview_jax.simulation import object_example, paper_calibration, render_solids


@pytest.fixture(scope="session")
def small_truth():
    """The paper's set-up with pixels twice as large: a quarter of the rays."""
    camera = Camera(1066.5, 1066.5, 160.75, 118.75, Radial(0.3), image_size=(320, 240))
    return dataclasses.replace(paper_calibration(), camera=camera)


RENDERED = (0, 3)
"""Which of the example's pictures are rendered; the others stay empty."""


@pytest.fixture(scope="session")
def example():
    def render_some(calibration, pose, scene, *, seed, **options):
        if seed not in RENDERED:
            return np.zeros(calibration.camera.image_size[::-1], np.uint8)
        return render_solids(calibration, pose, scene, seed=seed, **options)

    module = importlib.import_module("smartview_jax.simulation.object_example")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "render_solids", render_some)
        return object_example()
