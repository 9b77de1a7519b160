"""A real arm commanded by its joints: lwr4_joint, against what SciPy found on the same corners."""

import numpy as np
import pytest
from shared_data import shared_data, shared_pairs
from starts import reference_start

from smartview_jax import fit_joint
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.robot_errors import JointOffsets
from smartview_jax.robots import kuka_lwr4


@pytest.fixture(scope="module")
def data():
    seen, _ = shared_pairs("lwr4_joint")
    joints = np.loadtxt(shared_data("lwr4_joint") / "joint_angles.csv", delimiter=",")
    return seen.with_joints(joints, kuka_lwr4())


@pytest.fixture(scope="module")
def start():
    return reference_start(shared_pairs("lwr4_joint")[1])


def test_offsets_and_scale_are_those_of_the_reference(data, start):
    """1.214 px; offsets of joints 2 to 6; squares of 25 x 0.8624 mm, where 25 is a guess."""
    found = fit_joint(
        data,
        start,
        noise="trusted",
        field=JointOffsets(data.arm),
        free=("target_scale",),
        fixed=("robot_error.joint_offset.1", "robot_error.joint_offset.7"),
    )
    assert found.result.converged
    assert reprojection_errors(found.calibration, data).rms == pytest.approx(1.214, abs=1e-3)
    offsets = found.calibration.robot_error.coefficients
    expected = [0.0, 0.0108, -0.0054, -0.0094, -0.0018, 0.0222, 0.0]
    np.testing.assert_allclose(offsets, expected, atol=1e-4)
    assert float(found.calibration.target_scale) == pytest.approx(0.8624, abs=1e-4)


def test_the_arms_own_errors_are_what_the_likelihood_chooses(data, start):
    found = fit_joint(data, start, noise="estimated", free=("target_scale",))
    # Its joints have torque sensors, which bend.
    assert found.noise_estimate.name == "elastic_dh"
    gains = {other.name: other.log_likelihood_ratio for other in found.noise_estimate.candidates}
    assert gains["joint_offsets"] > gains["white"] + 100.0
    assert gains["elastic_dh"] > gains["dh"] + 20.0
    assert reprojection_errors(found.calibration, data).rms <= 1.45
    # The first and the last joint's zeros are the target's and the mount's: no data tell them.
    offsets = np.asarray(found.calibration.robot_error.coefficients[:7])
    np.testing.assert_allclose(offsets[[0, 6]], 0.0, atol=1e-5)
    # Elsewhere they are as without bending, but of the two joints that bend most.
    np.testing.assert_allclose(offsets[[2, 3, 5]], [-0.0054, -0.0094, 0.0222], atol=2e-3)
    # More views would not help: what the last zero does to the mount is not asked of them.
    (said,) = [text for text in found.warnings if "camera_from_tool.rotation.y" in text]
    assert "the zero of the last joint is equivalent to a rotation of the mount" in said
    assert "take more views" not in said
