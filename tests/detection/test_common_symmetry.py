"""Against simulated truth: the target stands where it was put, whatever view 0's detection says."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.detection import consistent_ordering
from smartview_jax.targets import CircleGrid

SIZE = (1280, 960)
MATRIX = np.array([[1100.0, 0.0, 640.0], [0.0, 1100.0, 480.0], [0.0, 0.0, 1.0]])
INTO_THE_BOARD = Rotation.from_euler("X", 180, degrees=True)
PLAIN = {2: CircleGrid(5, 7, 0.02), 4: CircleGrid(6, 6, 0.02)}


def seen(grid, holder_from_world, seed=0, views=9, z_into_board=True):
    """Pixels of a pinhole camera and rotations of `mount_from_holder`; each view in any order."""
    rng = np.random.default_rng(seed)
    centre = grid.points.mean(axis=0)
    hand_eye = Rotation.from_euler("ZYX", [20, -10, 5], degrees=True)
    pixels, mounts = [], []
    for _ in range(views):
        tilt = Rotation.from_euler("XYZ", rng.uniform(-25, 25, 3), degrees=True)
        start = Rotation.identity() if z_into_board else INTO_THE_BOARD
        camera_from_world = tilt * start
        in_camera = camera_from_world.apply(grid.points - centre) + np.array([0.0, 0.0, 0.45])
        projected = in_camera @ MATRIX.T
        mounts.append(hand_eye.inv() * camera_from_world * holder_from_world.inv())
        pixels.append(projected[:, :2] / projected[:, 2:])
    return np.stack(pixels), Rotation.concatenate(mounts).as_matrix()


def ordered(grid, pixels, mounts, first, seed=0, **rough):
    """Orders scrambled, view 0 by `first`, and put back; the index of the truth is 0."""
    symmetries = grid.symmetries
    turns = np.random.default_rng(seed).integers(0, len(symmetries), len(pixels))
    turns[0] = first
    scrambled = np.stack([p[symmetries[k]] for p, k in zip(pixels, turns, strict=True)])
    visible = np.ones(pixels.shape[:2], dtype=bool)
    ordering = consistent_ordering(scrambled, visible, grid, mounts, SIZE, **rough)
    back = np.stack([p[symmetries[k]] for p, k in zip(scrambled, ordering.symmetry, strict=True)])
    return [
        k for k, s in enumerate(symmetries) if np.array_equal(back, pixels[:, s])
    ], ordering.message


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("z_into_board", [True, False])
@pytest.mark.parametrize("count", [2, 4])
def test_the_target_is_turned_least_whatever_the_first_view_says(count, z_into_board, first):
    """Seen from above, z into the board or out of it, and x some 30 degrees from the base's."""
    grid = PLAIN[count]
    down = INTO_THE_BOARD if z_into_board else Rotation.identity()
    stands = Rotation.from_euler("ZYX", [30, 4, -3], degrees=True) * down
    pixels, mounts = seen(grid, stands, z_into_board=z_into_board)
    answer, words = ordered(grid, pixels, mounts, first)
    assert answer == [0]
    assert f"looks the same in {count} orders" in words
    assert (
        "with the target's x axis nearest to the base's was chosen (30 degrees off; the next"
        in words
    )
    assert "give a rough base_from_world" in words
    assert "origin_mark" in words


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_a_rough_pose_says_which_way_round(turn):
    grid = PLAIN[4]
    stands = Rotation.from_euler("Z", turn, degrees=True) * INTO_THE_BOARD
    pixels, mounts = seen(grid, stands)
    rough = Rotation.from_euler("ZYX", [turn + 25, 10, -8], degrees=True) * INTO_THE_BOARD
    for first in range(4):
        answer, words = ordered(grid, pixels, mounts, first, rough_rotation=rough.as_matrix())
        assert answer == [0]
        assert "nearest to the rough base_from_world that was given" in words


def test_on_the_tool_its_frame_decides():
    grid = PLAIN[2]
    stands = Rotation.from_euler("Z", 170, degrees=True) * INTO_THE_BOARD
    pixels, mounts = seen(grid, stands)
    answer, words = ordered(grid, pixels, mounts, 0, holder="tool")
    assert answer == [1]
    assert (
        "with the target's x axis nearest to the tool's was chosen (10 degrees off; the next 170)"
        in words
    )
    answer, _ = ordered(grid, pixels, mounts, 0, holder="tool", rough_rotation=stands.as_matrix())
    assert answer == [0]


def test_a_rough_pose_on_the_other_side_of_the_board_is_refused():
    """z out of the board, as a person may have it, where the frame has z into it."""
    grid = PLAIN[4]
    pixels, mounts = seen(grid, INTO_THE_BOARD)
    with pytest.raises(ValueError, match=r"base_from_world: the target's z axis is 180 degrees"):
        ordered(grid, pixels, mounts, 0, rough_rotation=np.eye(3))


def test_a_view_in_a_wrong_order_of_its_own_does_not_turn_the_others():
    """One pose of the robot is wrong: the rest still stand where they do."""
    grid = PLAIN[4]
    stands = Rotation.from_euler("Z", 20, degrees=True) * INTO_THE_BOARD
    pixels, mounts = seen(grid, stands)
    mounts[4] = Rotation.from_quat([0.3, -0.5, 0.7, 0.4]).as_matrix()
    turns = np.random.default_rng(0).integers(0, 4, len(pixels))
    scrambled = np.stack([p[grid.symmetries[k]] for p, k in zip(pixels, turns, strict=True)])
    visible = np.ones(pixels.shape[:2], dtype=bool)
    ordering = consistent_ordering(scrambled, visible, grid, mounts, SIZE)
    back = [p[grid.symmetries[k]] for p, k in zip(scrambled, ordering.symmetry, strict=True)]
    others = np.arange(len(pixels)) != 4
    np.testing.assert_array_equal(np.stack(back)[others], pixels[others])
