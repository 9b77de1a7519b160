"""What is drawn of a rig, from numbers that are known, and from the fit that other tests share."""

import dataclasses

import numpy as np
import pytest
from calibrated_rig import calibrated_rig
from standard_scene import POINTS, VIEWS

from smartview_jax import Rig, plots
from smartview_jax.evaluation import PoseUncertainty, reprojection_errors
from smartview_jax.evaluation.diagnosis.rig_budget import PoseCause
from smartview_jax.simulation import random_scene


def test_bars_of_a_state_stand_side_by_side():
    scene = random_scene(1, VIEWS, POINTS)
    right = scene.data.select([1, 5, 9])
    rig = Rig({"left": scene.data, "right": right})
    errors = {
        name: reprojection_errors(scene.calibration, data) for name, data in rig.cameras.items()
    }
    (axes,) = plots.view_errors(rig, errors).axes
    left, right = axes.containers
    np.testing.assert_allclose(
        [bar.get_x() + bar.get_width() for bar in left], np.arange(VIEWS), atol=0.05
    )
    np.testing.assert_allclose([bar.get_x() for bar in right], [1, 5, 9], atol=0.05)
    np.testing.assert_allclose([bar.get_height() for bar in right], errors["right"].rms_per_view)
    assert [text.get_text() for text in axes.get_xticklabels()] == list(rig.view_ids)


def test_shares_of_the_variance_fill_each_bar():
    causes = (PoseCause("pixel noise", 3e-3, 0.0), PoseCause("robot noise", 4e-3, 2e-2))
    one = PoseUncertainty("left.camera_from_tool", 5e-3, 2e-2, causes)
    other = PoseUncertainty("right in left", 3e-3, 1e-2, (PoseCause("pixel noise", 3e-3, 1e-2),))
    held = PoseUncertainty("right.camera_from_tool", 0.0, 0.0, ())
    translation, rotation = plots.pose_uncertainties([one, held, other]).axes
    shares = [[bar.get_width() for bar in bars] for bars in translation.containers]
    np.testing.assert_allclose(shares, [[36.0, 100.0], [64.0, 0.0]])
    shares = [[bar.get_width() for bar in bars] for bars in rotation.containers]
    np.testing.assert_allclose(shares, [[0.0, 100.0], [100.0, 0.0]])
    texts = [text.get_text() for text in (*translation.texts, *rotation.texts)]
    assert texts == ["5 mm", "3 mm", "1.1 degrees", "0.57 degrees"]
    names = [text.get_text() for text in translation.get_yticklabels()]
    assert names == ["left.camera_from_tool", "right in left"]
    with pytest.raises(ValueError, match="none has any uncertainty"):
        plots.pose_uncertainties([held])


def test_pyramids_stand_where_the_cameras_are(tmp_path_factory):
    fit = calibrated_rig(tmp_path_factory)
    next_to_arm = dataclasses.replace(fit.calibrations["camera2"], mount="eye_to_hand")
    other = dataclasses.replace(
        fit, calibrations={"camera1": fit.calibrations["camera1"], "camera2": next_to_arm}
    )
    tool, base = plots.camera_mounts(other).axes
    for axes, name, factor in ((tool, "camera1", 1e3), (base, "camera2", 1.0)):
        calibration = other.calibrations[name]
        centre = np.asarray(calibration.camera_from_mount.inverse().translation())
        starts = [np.array(line.get_data_3d())[:, 0] for line in axes.lines]
        at_camera = [start for start in starts if np.allclose(start, factor * centre)]
        # Three axes of its frame, and four edges of its pyramid.
        assert len(at_camera) == 7
        (outline,) = (line for line in axes.lines if line.get_label().startswith(name))
        corners = np.array(outline.get_data_3d()).T[:4] / factor
        in_camera = np.asarray(calibration.camera_from_mount.apply(corners))
        rays = in_camera[:, :2] / in_camera[:, 2:]
        camera = calibration.camera
        pixels = rays * [camera.alpha_u, camera.alpha_v] + [camera.u0, camera.v0]
        width, height = camera.image_size
        expected = [[0, 0], [width, 0], [width, height], [0, height]]
        np.testing.assert_allclose(pixels, expected, atol=1e-6)
    path = "camera1.camera_from_tool.translation"
    std = 1e3 * np.hypot.reduce([fit.std[f"{path}.{axis}"] for axis in "xyz"])
    legend = [text.get_text() for text in tool.get_legend().get_texts()]
    assert legend == [f"camera1, std {std:.2g} mm"]
    assert [text.get_text() for text in base.get_legend().get_texts()] == ["camera2, held"]
