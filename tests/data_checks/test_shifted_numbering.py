"""Views whose points are numbered a column or a row off are named with the shift; no others are.

Numbers are shifted as a detector does: a view's pose is the one of the points that it names.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from robot_motions import VIEWS, moving_alike, transform

from smartview_jax.data_checks import find_shifted_numbering
from smartview_jax.data_checks.shifted_numbering import possible_shifts, shift_text
from smartview_jax.geometry import as_se3
from smartview_jax.staged import fit_staged

COLUMNS, ROWS, STEP = 7, 5, 0.025
COLUMN, ROW = np.indices((COLUMNS, ROWS)).reshape(2, -1)
BOARD = STEP * np.stack([COLUMN, ROW, 0 * ROW], axis=1)
EVERY_VIEW = np.ones(VIEWS, dtype=bool)


def shifts_found(wrong, seed=0, see_all=False, **options):
    """The shifts found, m, where views are numbered by columns and rows off, `{view: (c, r)}`."""
    robot, camera = moving_alike(seed, **options)
    seen = np.ones((VIEWS, len(BOARD)), dtype=bool)
    for view, (columns, rows) in wrong.items():
        true_column, true_row = COLUMN + columns, ROW + rows
        inside = np.isin(true_column, range(COLUMNS)) & np.isin(true_row, range(ROWS))
        seen[view] = see_all | inside
        camera[view] = camera[view] @ transform([0, 0, 0], STEP * np.array([columns, rows, 0.0]))
    points = np.broadcast_to(BOARD, (VIEWS, *BOARD.shape))
    return find_shifted_numbering(as_se3(robot), as_se3(camera), EVERY_VIEW, points, seen)


@pytest.mark.parametrize(
    "wrong",
    [{2: (1, 0), 5: (1, 0), 8: (1, 0)}, {4: (0, -1)}, {1: (-2, 0), 9: (0, 1)}, {3: (1, 1)}],
    ids=str,
)
def test_each_view_is_named_with_its_shift(wrong):
    found = shifts_found(wrong)
    assert found.keys() == wrong.keys()
    for view, steps in wrong.items():
        np.testing.assert_allclose(found[view][:2], STEP * np.array(steps), atol=1e-9)


@pytest.mark.parametrize("noise", [(2e-4, 0.02), (5e-3, 1.0), (2e-2, 2.0)])
def test_views_that_see_part_of_the_board_are_no_fault(noise):
    """The first column or row is out of every other picture, whatever the robot's errors are."""
    robot, camera = moving_alike(noise=noise)
    seen = np.ones((VIEWS, len(BOARD)), dtype=bool)
    seen[::2] = COLUMN > 0
    seen[1::4] = ROW > 0
    points = np.broadcast_to(BOARD, (VIEWS, *BOARD.shape))
    assert find_shifted_numbering(as_se3(robot), as_se3(camera), EVERY_VIEW, points, seen) == {}


def test_a_view_of_the_whole_board_is_not_shifted():
    assert shifts_found({2: (1, 0), 5: (1, 0)}, see_all=True) == {}


def test_shifts_of_a_grid_are_the_ones_that_take_it_into_itself():
    """In an asymmetric grid of circles, whose rows are staggered, half a step meets none."""
    steps = possible_shifts(BOARD)[:, :2] / STEP
    # Two columns and two rows at once leave less than half of the points.
    assert len(steps) == 24 - 4
    assert np.abs(np.rint(steps) - steps).max() < 1e-9
    row, column = np.indices((8, 5)).reshape(2, -1)
    staggered = np.stack([2 * column + row % 2, row, 0 * row], axis=1) * 0.01
    found = np.rint(possible_shifts(staggered)[:, :2] / 0.01).astype(int)
    assert (found.sum(axis=1) % 2 == 0).all()
    assert (found == [2, 0]).all(axis=1).any()


def test_the_words_say_how_far():
    assert "25 mm along the target's -x from" in shift_text(np.array([-0.025, 0.0, 0.0]))
    assert "50 mm along the target's x and 25 mm along the target's y" in shift_text(
        np.array([0.05, 0.025, 0.0])
    )


def test_the_staged_fit_leaves_them_out_and_says_why(scene):
    """Both layers of the scene's target have the same columns."""
    points = np.asarray(scene.data.points)
    first = points[0]
    step = np.diff(np.unique(first[:, 0]))[0]
    pixels, visible = (np.array(a) for a in (scene.data.pixels, scene.data.visible))
    distances = np.linalg.norm(first[:, None] + [step, 0.0, 0.0] - first, axis=2)
    there, shown = distances.min(axis=1) < 1e-9, distances.argmin(axis=1)
    for view in (2, 5):
        pixels[view], visible[view] = pixels[view][shown], visible[view][shown] & there
    data = dataclasses.replace(scene.data, pixels=jnp.asarray(pixels), visible=jnp.asarray(visible))
    fit = fit_staged(data)
    assert {view for view, point, text in fit.rejected if "numbered wrongly" in text} == {"2", "5"}
