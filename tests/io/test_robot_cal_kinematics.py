import numpy as np
import pytest
from shared_data import shared_data

from smartview_jax.io import read_robot_cal_kinematics

ENTRY = """'1':
  camera_joints: []
  pose: {qw: 0.5, qx: -0.5, qy: 0.5, qz: 0.5, x: 1.0, y: 2.0, z: 3.0}
  target_joints: [0.25, -0.5]
"""


def test_numbers_are_where_their_names_say(tmp_path):
    path = tmp_path / "measured.yaml"
    path.write_text(ENTRY)
    joints, poses = read_robot_cal_kinematics(path)
    np.testing.assert_array_equal(joints, [[0.25, -0.5]])
    np.testing.assert_array_equal(poses.wxyz_xyz, [[0.5, -0.5, 0.5, 0.5, 1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("qw: 0.5, ", "", "entry '1.pose.qw' is missing"), ("[]", "[0.1]", "the camera has joints")],
)
def test_wrong_entries_are_named(tmp_path, old, new, message):
    path = tmp_path / "measured.yaml"
    path.write_text(ENTRY.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_robot_cal_kinematics(path)


def test_a_real_file_is_read():
    """How well it is fitted is a claim of `python -m benchmarks kinematics`."""
    folder = shared_data("rct_positioner_kinematic")
    joints, poses = read_robot_cal_kinematics(folder / "positioner_kinematic_measurements.yaml")
    assert joints.shape == (205, 2)
    np.testing.assert_allclose(np.linalg.norm(poses.wxyz_xyz[:, :4], axis=1), 1.0, atol=1e-12)
