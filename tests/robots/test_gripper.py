import numpy as np
import pytest

from smartview_jax.robots import Gripper, arm_by_name
from smartview_jax.simulation.arm_scenes import HOME_JOINTS


def test_fingers_open_symmetrically_about_the_tips():
    palm, left, right = Gripper(max_opening=0.1).boxes(0.06)
    # Inner faces 60 mm apart, tips at z = 0, palm behind the fingers.
    assert np.isclose(left.vertices[:, 0].max(), -0.03)
    assert np.isclose(right.vertices[:, 0].min(), 0.03)
    assert np.isclose(max(left.vertices[:, 2].max(), right.vertices[:, 2].max()), 0.0)
    assert np.isclose(palm.vertices[:, 2].max(), left.vertices[:, 2].min())


def test_a_grippers_mesh_is_closed_and_has_the_volume_of_its_boxes():
    trimesh = pytest.importorskip("trimesh")
    gripper = Gripper()
    mesh = trimesh.Trimesh(*gripper.mesh(0.02), process=False)
    expected = sum(np.prod(box.size) for box in gripper.boxes(0.02))
    assert mesh.is_watertight
    assert np.isclose(mesh.volume, expected)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"max_opening": 80.0}, "max_opening is 80"),
        ({"finger_width": -0.01}, "finger_width"),
        ({"palm": (0.1, float("nan"), 0.1)}, r"palm\[1\]"),
        ({"tolerance": float("inf")}, "tolerance"),
        # Millimetres and degrees: the one refuses every object, the other promises too much.
        ({"tolerance": 0.5}, "tolerance is 0.5; expected 0 to 0.04 m"),
        ({"min_hold": 4.0}, "min_hold is 4.0; expected 0 to 0.05 m"),
        ({"max_turn": 15.0}, "max_turn is 15.0; expected 0 to 1.57 rad"),
        ({"tool_from_gripper": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rigid"),
        ({"tool_from_gripper": np.eye(4) + 110.0 * np.eye(4, k=3)}, "expected metres, up to 2"),
    ],
)
def test_wrong_dimensions_are_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        Gripper(**wrong)


def test_a_gripper_refuses_to_open_wider_than_it_can():
    with pytest.raises(ValueError, match="opens to 80 mm"):
        Gripper().boxes(0.09)


def test_the_frames_of_an_arm_lead_from_its_base_to_its_tool():
    arm = arm_by_name("six_axes")
    origins = np.asarray(arm.frame_origins(HOME_JOINTS))
    tool = np.asarray(arm.base_from_tool(HOME_JOINTS).translation())
    assert np.allclose(origins[0], 0.0)
    assert np.allclose(origins[-1], tool)
    # Alternately the links' d and a, whatever the joints are.
    lengths = np.linalg.norm(np.diff(origins, axis=0), axis=1)
    assert np.allclose(lengths[0:12:2], np.abs(arm.d))
    assert np.allclose(lengths[1:12:2], np.abs(arm.a))
