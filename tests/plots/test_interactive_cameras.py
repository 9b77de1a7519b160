"""The scene is run by a browser in tests/report; here is what it is told to draw."""

import dataclasses
import json

import numpy as np
import pytest
from standard_scene import POINTS, VIEWS

from smartview_jax import plots
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.simulation import random_scene


@pytest.fixture(scope="module")
def scene():
    return random_scene(1, VIEWS, POINTS)


def trace(drawn, name):
    (found,) = (t for t in drawn.traces if t["name"] == name and t["mode"] == "markers")
    return found


def test_cameras_stand_where_the_chain_puts_them_and_say_their_error(scene):
    errors = reprojection_errors(scene.calibration, scene.data).rms_per_view
    drawn = plots.interactive_cameras(scene.data, scene.calibration, errors)
    cameras = trace(drawn, "cameras")
    centres = scene.calibration.camera_from_world(scene.data.base_from_tool).inverse()
    places = np.stack([cameras[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(places, 1e3 * np.asarray(centres.translation()), atol=0.006)
    assert cameras["text"][2] == f"view 2<br>{errors[2]:.2f} px RMS"


def test_the_page_needs_no_network_and_no_name_ends_its_script(scene):
    named = dataclasses.replace(scene.data, view_ids=("</script>", *map(str, range(1, VIEWS))))
    html = plots.interactive_cameras(named, scene.calibration).html("here")
    assert html.count("</script>") == 2
    # An HTML comment with a script inside would swallow the end of this one.
    swallowing = dataclasses.replace(
        scene.data, view_ids=("<!--<script>", *map(str, range(1, VIEWS)))
    )
    page = plots.interactive_cameras(swallowing, scene.calibration).html("here")
    assert "<!--<script>" not in page.rpartition("...")[2]
    description = html.rpartition("...")[2].partition(", {responsive")[0]
    traces, layout = json.loads(description)
    assert "</script>" in {text for t in traces for text in t.get("text", [])}
    assert layout["scene"]["aspectmode"] == "data"
