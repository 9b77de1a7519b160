import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.robots import arm_from_axes

Z, X = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
CHAINS = {
    "skew": np.random.default_rng(0).normal(size=(2, 6, 3)),
    "parallel": (np.random.default_rng(1).normal(size=(4, 3)), [Z, Z, [0.0, 0.0, -2.0], Z]),
    "meeting": (np.zeros((3, 3)), [Z, X, [0.0, 1.0, 1.0]]),
    "one line": ([[0, 0, 0], [0, 0, 1], [0, 0, 2]], [Z, Z, Z]),
    "nearly parallel": ([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [Z, [0, 1e-5, 1], [1e-7, 0, 1]]),
    "single": ([[1.0, 2.0, 3.0]], [[1.0, 1.0, 0.0]]),
}


def moved(points, directions, slides, joints, home):
    """Product of exponentials, by matrices."""
    pose = np.eye(4)
    for point, axis, slide, q in zip(points, directions, slides, joints, strict=True):
        axis = axis / np.linalg.norm(axis)
        step = np.eye(4)
        if slide:
            step[:3, 3] = q * axis
        else:
            step[:3, :3] = Rotation.from_rotvec(q * axis).as_matrix()
            step[:3, 3] = point - step[:3, :3] @ point
        pose = pose @ step
    return pose @ home


@pytest.mark.parametrize("name", CHAINS)
def test_the_arm_moves_as_its_axes_do(name):
    points, directions = (np.array(rows, dtype=float) for rows in CHAINS[name])
    rng = np.random.default_rng(2)
    home = np.eye(4)
    home[:3, :3], home[:3, 3] = Rotation.random(random_state=3).as_matrix(), rng.normal(size=3)
    for slides in (np.zeros(len(points), bool), np.arange(len(points)) % 2 == 1):
        arm = arm_from_axes(points, directions, home, slides.tolist())
        for joints in (np.zeros(len(points)), *rng.uniform(-3.0, 3.0, (5, len(points)))):
            actual = np.asarray(arm.base_from_tool(joints).as_matrix())
            expected = moved(points, directions, slides, joints, home)
            np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=1e-9)


def test_an_axis_without_direction_is_named():
    with pytest.raises(ValueError, match="joint 2: the axis has no direction"):
        arm_from_axes(np.zeros((2, 3)), np.array([Z, [0.0, 0.0, 0.0]]), np.eye(4))
