"""Motions that tell little: directions that the robot's motion leaves open do not move."""

import numpy as np
import pytest
from shared_data import shared_case

from smartview_jax import Prior, calibrate
from smartview_jax.dataset import Dataset
from smartview_jax.geometry import host_matrices


def case(name):
    """A case's data, and the true hand-eye transform."""
    arrays = np.load(shared_case(f"{name}.npz"))
    size = tuple(int(n) for n in arrays["image_size"])
    # Sixteen views share the programs of real data sets.
    pixels, poses = arrays["pixels"][:16], arrays["base_from_tool"][:16]
    data = Dataset.from_arrays(arrays["points"], pixels, poses, size)
    return data, arrays["camera_from_tool_true"]


@pytest.fixture(scope="module")
def scara():
    data, _ = case("scara")
    return calibrate(data)


def test_an_arm_that_turns_about_one_axis_leaves_one_direction_open(scara):
    """The right answer was found with SciPy: x 20.018, y 49.993 mm (0.046, 0.042)."""
    x, y, _ = 1e3 * np.asarray(scara.calibration.camera_from_tool.translation())
    assert x == pytest.approx(20.018, abs=0.05)
    assert y == pytest.approx(49.993, abs=0.05)
    assert scara.std["camera_from_tool.translation.x"] == pytest.approx(4.6e-5, rel=0.3)
    assert scara.std["camera_from_tool.translation.y"] == pytest.approx(4.2e-5, rel=0.3)
    assert float(scara.calibration.camera.alpha_u) == pytest.approx(1399.53, abs=0.5)
    open_names = {name for name, std in scara.std.items() if not np.isfinite(std)}
    assert open_names == {"camera_from_tool.translation.z", "base_from_world.translation.z"}
    # Nothing is thrown out because of it.
    assert scara.rejected == ()


def test_an_undetermined_direction_is_named_once_with_the_option_that_ends_it(scara):
    (direction,) = scara.observability.null_directions
    assert "camera offset along the tool's z axis" in direction.description
    (said,) = scara.warnings
    assert direction.description in said
    assert "fixed=('camera_from_tool.translation.z',)" in said
    assert str(scara).count(direction.description) == 1


def test_a_known_place_determines_the_direction():
    data, truth = case("scara")
    prior = Prior(std=1e-3, mean=truth[2, 3] + 1e-3)
    fit = calibrate(data, priors={"camera_from_tool.translation.z": prior})
    assert fit.observability.null_directions == ()
    z = fit.calibration.camera_from_tool.translation()[2]
    assert float(z) == pytest.approx(prior.mean, abs=1e-5)
    assert fit.std["base_from_world.translation.z"] == pytest.approx(1e-3, rel=0.1)


def test_a_robot_that_never_turns_tells_the_rotation():
    data, truth = case("translation_only")
    with pytest.raises(ValueError, match="never rotates"):
        calibrate(data, fixed=("camera_from_tool.translation",))
    fit = calibrate(
        data, start={"camera_from_tool": truth}, fixed=("camera_from_tool.translation",)
    )
    found = host_matrices(fit.calibration.camera_from_tool)
    turn = np.linalg.norm(found[:3, :3] - truth[:3, :3]) / np.sqrt(2.0)
    assert turn < np.deg2rad(0.05)
    np.testing.assert_allclose(found[:3, 3], truth[:3, 3], atol=1e-12)
    assert fit.observability.null_directions == ()
