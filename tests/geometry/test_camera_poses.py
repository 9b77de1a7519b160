import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import FIVE_VIEWPOINT_STEP, five_viewpoints, look_at, viewing_direction

POINT = np.array([0.1, -0.2, 0.3])


def scipy_look_at(direction, roll):
    """World axes of the camera: the shortest turn from straight down or up, then the roll."""
    unit = direction / np.linalg.norm(direction)
    start = np.eye(3) if unit[2] > 0.0 else np.diag([1.0, -1.0, -1.0])
    axis = np.cross(start[:, 2], unit)
    size = np.linalg.norm(axis)
    angle = np.arctan2(size, start[:, 2] @ unit)
    turn = Rotation.from_rotvec(axis / max(size, 1e-300) * angle).as_matrix()
    return turn @ start @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()


@pytest.mark.parametrize(
    "direction",
    [
        [0.0, 0.0, -1.0],
        [0.0, 0.0, 2.0],
        [0.3, -0.2, -0.9],
        [0.3, -0.2, 0.9],
        [1.0, 0.0, 0.0],
        [1e-9, 0.0, -1.0],
    ],
)
def test_the_camera_looks_along_the_direction_with_the_roll_of_the_convention(direction):
    pose = look_at(POINT, np.array(direction), 0.5, 0.7)
    np.testing.assert_allclose(pose.apply(jnp.asarray(POINT)), [0.0, 0.0, 0.5], atol=1e-15)
    expected = scipy_look_at(np.array(direction), 0.7)
    np.testing.assert_allclose(pose.inverse().rotation().as_matrix(), expected, atol=1e-12)


def test_roll_turns_x_of_the_picture_towards_its_y():
    before, after = (look_at(POINT, np.array([0.0, 0.0, -1.0]), 0.5, r) for r in (0.0, 0.1))
    x = np.asarray(after.inverse().rotation().as_matrix())[:, 0]
    in_old_picture = np.asarray(before.rotation().as_matrix()) @ x
    np.testing.assert_allclose(in_old_picture, [np.cos(0.1), np.sin(0.1), 0.0], atol=1e-12)


def test_poses_are_found_in_batches_under_jit_grad_and_vmap():
    rng = np.random.default_rng(0)
    directions, rolls = rng.normal(size=(4, 3)), rng.normal(size=4)
    batch = jax.jit(look_at)(POINT, directions, 0.3, rolls)
    single = jax.jit(jax.vmap(lambda d, r: look_at(POINT, d, 0.3, r)))(directions, rolls)
    np.testing.assert_allclose(batch.wxyz_xyz, single.wxyz_xyz, atol=1e-15)

    # Straight down is an inner point of the convention: the derivative there is finite and right.
    def place(direction):
        return look_at(POINT, direction, 0.3, 0.2).as_matrix()[:3].ravel()

    value_and_slope = jax.jit(lambda direction: (place(direction), jax.jacrev(place)(direction)))
    down, step = np.array([0.0, 0.0, -1.0]), np.array([1e-6, -2e-6, 0.0])
    ahead, behind = (np.asarray(value_and_slope(down + s * step)[0]) for s in (1.0, -1.0))
    slope = np.asarray(value_and_slope(down)[1])
    np.testing.assert_allclose(slope @ step, (ahead - behind) / 2.0, atol=1e-13)


def test_no_direction_is_no_pose():
    assert np.isnan(look_at(POINT, np.zeros(3), 0.3).wxyz_xyz).any()


@pytest.mark.parametrize("above", [True, False])
def test_the_papers_five_viewpoints_are_a_cross(above):
    views = five_viewpoints(POINT, 0.2, above=above)
    ways = (np.asarray(views.inverse().translation()) - POINT) / 0.2
    reach = np.sin(np.deg2rad(9.5))
    expected = reach * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    np.testing.assert_allclose(ways[:, :2], expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0)
    assert (ways[:, 2] > 0.0).all() == above


def test_a_pattern_that_is_not_known_is_named():
    with pytest.raises(ValueError, match="pattern is one of cross, L; found 'T'"):
        five_viewpoints(POINT, 0.2, pattern="T")


@pytest.mark.parametrize("above", [True, False])
def test_five_viewpoints_in_an_l_reach_twice_as_far(above):
    views = five_viewpoints(POINT, 0.2, above=above, pattern="L")
    ways = np.asarray(views.inverse().translation()) - POINT
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 0.2)
    ways /= 0.2
    np.testing.assert_allclose(ways[0], [0.0, 0.0, 1.0 if above else -1.0], atol=1e-14)
    angles = np.arccos(np.clip(ways @ ways.T, -1.0, 1.0))
    for first, second in ((0, 1), (1, 2), (0, 3), (3, 4)):
        assert angles[first, second] == pytest.approx(FIVE_VIEWPOINT_STEP, abs=1e-7)
    np.testing.assert_allclose(ways[1:3, 1], 0.0, atol=1e-14)
    np.testing.assert_allclose(ways[3:, 0], 0.0, atol=1e-14)
    assert (ways[1:3, 0] > 0.0).all()
    assert (ways[3:, 1] > 0.0).all()


def test_directions_are_where_their_angles_say():
    assert viewing_direction(0.3, 0.0)[0] < 0.0  # the camera stands at +x and looks back
    np.testing.assert_allclose(viewing_direction(0.0, 1.0), [0.0, 0.0, -1.0], atol=1e-15)
    np.testing.assert_allclose(
        viewing_direction(0.0, 1.0, above=False), [0.0, 0.0, 1.0], atol=1e-15
    )
