"""Every check on the side where it passes and on the side where it does not, by hand.

The camera hangs 1 m above the origin and looks down; camera, tool and base agree.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.geometry import ViewedRegion, look_at
from smartview_jax.robots import Command
from smartview_jax.viewpoints import SAFETY_CHECKS, ClearancePlane, Limits
from smartview_jax.viewpoints.checks import check_views

CAMERA = Camera(1000.0, 1000.0, 320.0, 240.0, Pinhole(), (640, 480))
CALIBRATION = Calibration.eye_in_hand(CAMERA, SE3.identity(), SE3.identity())
VIEW = look_at(np.zeros(3), np.array([[0.0, 0.0, -1.0]]), 1.0)
LOW_AND_HIGH = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.2]])
"""Depths of 1.0 and 0.8 m."""


def checked(points=None, **limits):
    command = Command(VIEW.inverse())
    points = None if points is None else jnp.asarray(points)
    return check_views(CALIBRATION, command, VIEW, points, None, Limits(**limits))


@pytest.mark.parametrize(("axis", "last"), [(0, 639.0 - 620.0), (1, 479.0 - 470.0)])
def test_the_margin_to_the_border_is_kept(axis, last):
    """300 px from the centre of 640 columns, 230 px of 480 rows."""
    place = np.zeros((1, 3))
    place[0, axis] = (0.30, 0.23)[axis]
    aside = [np.asarray(CALIBRATION.project(VIEW.inverse(), sign * place)[0]) for sign in (1, -1)]
    nearest = min(min(p.min(), (np.array([639.0, 479.0]) - p).min()) for p in aside)
    assert nearest == pytest.approx(last)
    both = np.concatenate([place, -place])
    assert checked(both, border_margin=last - 0.1).reasons() == ("",)
    checks = checked(both, border_margin=last + 0.1)
    assert checks.reasons() == ("only 50% of the target is well inside the picture",)
    assert checked(both, border_margin=last + 0.1, min_visible_fraction=0.5).ok.all()


@pytest.mark.parametrize(
    ("focus", "reason"),
    [
        ((0.79, 1.01), ""),
        ((0.81, 1.01), "the nearest target point is at 0.800 m: too near to be sharp"),
        ((0.79, 0.99), "the farthest target point is at 1.000 m: too far to be sharp"),
    ],
)
def test_all_of_the_target_is_in_focus(focus, reason):
    assert checked(LOW_AND_HIGH, focus_range=focus).reasons() == (reason,)


@pytest.mark.parametrize("part", ["camera", "tool"])
def test_camera_and_tool_keep_clear_of_the_table(part):
    """A slope of 3 in 4 through a point 0.5 m up: 1 m above the origin is 0.4 m from it."""
    other = {"camera": "tool", "tool": "camera"}[part] + "_clearance"
    plane = {"point": [0.0, 0.0, 0.5], "normal": [6.0, 0.0, 8.0], other: 0.0}
    assert checked(
        clearance_plane=ClearancePlane(**plane, **{f"{part}_clearance": 0.39})
    ).reasons() == ("",)
    checks = checked(clearance_plane=ClearancePlane(**plane, **{f"{part}_clearance": 0.41}))
    assert checks.reasons() == (f"the {part} is 0.400 m above the table: too low",)


def in_region(places, **limits):
    """Checks of cameras that look straight up or down from these places, seen from z = 1 +- 0.1."""
    seen = np.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0], [0.0, 0.1, 1.1], [0.0, -0.1, 0.9]])
    region = ViewedRegion.from_positions(seen, np.zeros((1, 3)), seen)
    known = dataclasses.replace(CALIBRATION, region=region)
    places = np.asarray(places, dtype=float)
    directions = np.zeros_like(places)
    directions[:, 2] = -np.sign(places[:, 2])
    floor = np.where([True, True, False], places, 0.0)
    wanted = look_at(floor, directions, np.abs(places[:, 2]))
    return check_views(known, Command(wanted.inverse()), wanted, None, None, Limits(**limits))


def test_the_side_that_was_seen_and_how_far_out_are_checked():
    # The farthest view of the target's middle, whose distance is the unit.
    reach = np.hypot(0.1, 1.1)
    checks = in_region(
        [[0.0, 0.0, 1.0], [1.9 * reach, 0.0, 1.0], [2.1 * reach, 0.0, 1.0], [0.0, 0.0, -0.5]]
    )
    fine, near, far, behind = checks.reasons(SAFETY_CHECKS)
    assert fine == near == ""
    assert far == (
        "the camera is 2.1 times as far from the middle of the calibrated views as these were from "
        "the target"
    )
    assert "the camera is 0.500 m behind the target's plane" in behind
    assert "the tool is 0.500 m behind the target's plane" in behind
    np.testing.assert_array_equal(checks.safe, [True, True, False, False])
    assert in_region([[2.1 * reach, 0.0, 1.0]], max_viewed_region_extent=3.0).safe.all()


def test_a_tool_further_than_any_arm_reaches_is_unsafe():
    assert (
        "the tool is 400 m from the base: no arm is that long"
        in in_region([[0, 0, 400]]).reasons(SAFETY_CHECKS)[0]
    )


def test_other_faults_are_no_danger():
    """A target that is not in the picture is said, and breaks nothing."""
    aside = checked(np.array([[3.0, 0.0, 0.0]]))
    assert aside.reasons() != ("",)
    assert aside.reasons(SAFETY_CHECKS) == ("",)
    assert bool(aside.safe[0])
