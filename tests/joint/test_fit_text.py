"""What `print(fit)` and a notebook show, against the numbers of the fit itself."""

import dataclasses
import re

import jax
import numpy as np
import pytest

from smartview_jax import fit_joint
from smartview_jax.joint import parameter_estimates


@pytest.fixture
def fit(calibrated):
    return calibrated


def test_every_transform_is_said_in_mm_and_degrees_with_its_interval(fit):
    text = str(fit)
    x = 1e3 * float(fit.calibration.camera_from_tool.translation()[0])
    half_width = 1e3 * fit.confidence_half_width("camera_from_tool.translation.x")
    block = text[text.index("camera_from_tool (+- 95 %)") :]
    shown = re.search(r"  x +(\S+) \+- (\S+) mm", block)
    assert shown is not None
    assert float(shown[1]) == pytest.approx(x, abs=0.06 * half_width)
    assert float(shown[2]) == pytest.approx(half_width, rel=0.06)
    assert re.search(r"  turn z +\S+ \+- \S+ deg", block)
    assert "base_from_world (+- 95 %)" in text
    assert "8 views" in text.splitlines()[0]
    assert "converged" in text.splitlines()[0]


def test_every_warning_is_said_in_text_and_in_a_notebook(fit):
    doubtful = type(fit).of(
        fit.staged, dataclasses.replace(fit.joint, warnings=("the lens is < too simple",))
    )
    assert "warning: the lens is < too simple" in str(doubtful)
    assert "warning: the lens is &lt; too simple" in doubtful._repr_html_()
    assert doubtful._repr_html_().count("<tr>") > 15


def test_the_short_form_is_one_line(fit):
    assert repr(fit).startswith("<joint fit of ")
    assert "\n" not in repr(fit)
    assert repr(fit.joint) == repr(fit)


def test_what_is_held_or_trusted_is_said(scene, trusted):
    held = fit_joint(scene.data, trusted.calibration, noise="trusted", fixed=("camera",))
    assert re.search(r"alpha_u +\S+ px \(held\)", str(held))
    assert "the robot's poses are trusted" in str(held)


def test_what_is_not_determined_is_said(fit):
    joint = fit.joint
    std = dict(joint.std) | {"camera.u0": np.inf}
    unknown = dataclasses.replace(joint, std=std)
    assert re.search(r"u0 +\S+ px \(not determined\)", str(unknown))


def test_estimates_are_in_the_units_that_are_said(fit):
    found = {one.name: one for one in parameter_estimates(fit.joint)}
    z = found["camera_from_tool.rotation.z"]
    assert z.unit == "deg"
    assert z.std == pytest.approx(np.rad2deg(fit.std["camera_from_tool.rotation.z"]))
    assert found["target_scale"].std is None


def test_a_traced_fit_can_be_shown(fit):
    """Errors inside `jit` print what they were given."""

    def shown(calibration):
        assert "Camera" in repr(calibration)
        return calibration.camera.K

    K = jax.jit(shown)(fit.calibration)
    np.testing.assert_allclose(K, fit.calibration.camera.K)
