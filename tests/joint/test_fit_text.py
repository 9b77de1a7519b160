"""What `print(fit)` and a notebook show, against the numbers of the fit itself."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax import Prior, calibrate, fit_joint, plots
from smartview_jax.calibration_pipeline import refit_uncorrected
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


def test_square_pixels_are_said_and_both_focal_lengths_are_as_certain(fit, shaky_scene):
    """The noise is estimated: both have the same freedom, too."""
    square = {"camera.pixel_aspect": Prior(mean=1.0, std=1e-9)}
    both = calibrate(shaky_scene.data, "radial", priors=square)
    told = both.joint
    assert re.search(r"pixel_aspect +1.0000000000 \+- 0.000000002\d", str(told))
    assert "pixel_aspect" not in str(fit)
    camera = told.calibration.camera
    assert float(camera.alpha_v / camera.alpha_u) == pytest.approx(1.0, abs=1e-12)
    bare = refit_uncorrected(shaky_scene.data, both).camera
    assert float(bare.alpha_v / bare.alpha_u) == pytest.approx(1.0, abs=1e-9)
    for of_parameters in (told.std, told.degrees_of_freedom):
        assert of_parameters["camera.alpha_v"] == pytest.approx(
            of_parameters["camera.alpha_u"], rel=1e-6
        )
    off = abs(float(camera.alpha_v - shaky_scene.calibration.camera.alpha_v))
    assert off < 1.5 * told.confidence_half_width("camera.alpha_v")
    (axes,) = plots.parameter_intervals(told, ["camera"], shaky_scene.calibration).axes
    (true,) = (line for line in axes.lines if line.get_label() == "true")
    assert 1.0 in true.get_ydata()
    correction = told.noise_estimate.correction_of(["camera.alpha_v"])
    assert correction.degrees_of_freedom[0] == told.degrees_of_freedom["camera.alpha_v"]


def numbers_after(text, label):
    """The numbers in the lines after a label, up to the next label."""
    lines = text[text.index(label) :].splitlines()[1:5]
    block = [line for line in lines if re.match(r"[\s\[(]*-?\d", line)]
    return np.array([float(x) for x in re.findall(r"-?\d+\.\d+", " ".join(block))])


def test_the_hand_eye_transform_comes_first_and_in_the_forms_of_others(fit):
    """Both directions, against SciPy."""
    robot = dataclasses.replace(fit, pose_format="kuka_abc")
    text = str(robot)
    forward, backward = text.split("\ntool_from_camera\n")
    matrix = np.asarray(fit.calibration.camera_from_tool.as_matrix())
    assert forward.splitlines()[1] == "camera_from_tool"
    for part, expected in ((forward, matrix), (backward, np.linalg.inv(matrix))):
        rotation = Rotation.from_matrix(expected[:3, :3])
        np.testing.assert_allclose(
            numbers_after(part, "matrix, m:")[:16].reshape(4, 4), expected, atol=6e-10
        )
        found = numbers_after(part, "translation x, y, z, m:")[:3]
        np.testing.assert_allclose(found, expected[:3, 3], atol=6e-10)
        quaternion = numbers_after(part, "quaternion x, y, z, w:")[:4]
        assert abs(quaternion @ rotation.as_quat()) == pytest.approx(1.0, abs=1e-8)
        angles = numbers_after(part, "roll, pitch, yaw of ROS")[:3]
        np.testing.assert_allclose(angles, rotation.as_euler("xyz"), atol=1e-9)
        kuka = numbers_after(part, "kuka_abc: x mm, y mm, z mm, A deg, B deg, C deg:")[:6]
        np.testing.assert_allclose(kuka[:3], 1e3 * expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(kuka[3:], rotation.as_euler("ZYX", degrees=True), atol=1e-7)
    assert "kuka_abc" in robot._repr_html_()
    assert "kuka_abc" not in str(fit)


def test_only_the_tables_say_rms(fit):
    """They count points that the fit left out; two figures of one name would contradict."""
    assert "RMS" not in str(fit)
    assert "residuals of " in str(fit).splitlines()[0]


def test_every_warning_is_said_in_text_and_in_a_notebook(fit):
    joint = dataclasses.replace(fit.joint, warnings=("the lens is < too simple",))
    doubtful = type(fit).of(fit.staged, joint, fit.data)
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
