"""A camera that was knocked on its mount is named, by the others' pictures or by the robot."""

import re

import numpy as np
import pytest
from two_cameras import NOISE, POINTS, rig_of, seen_by_both

from smartview_jax import Dataset, Rig
from smartview_jax.data_checks import SeenTarget, target_findings
from smartview_jax.geometry import host_exponentials

STATES, FIRST_CHANGED = 12, 7
TWIST = np.array([3e-3, -3e-3, 2.7e-3, 5e-3, -7e-3, 2e-3])
KNOCK = host_exponentials(TWIST)
"""By 5 mm and half a degree."""

TOP_FROM_LEFT = host_exponentials(np.array([0.02, 0.11, 0.01, 0.2, 0.03, 0.0]))


def knocked(camera, seed=0, knock=KNOCK, third=False, states=STATES):
    """What cameras see, one of which is knocked between two states."""
    rng = np.random.default_rng(seed)
    seen = seen_by_both(np.eye(4), rng, states)
    if third:
        errors = host_exponentials(rng.normal(0.0, NOISE, (STATES, 6)))
        poses = errors @ TOP_FROM_LEFT @ seen["left"].camera_from_world
        seen["top"] = SeenTarget(np.arange(STATES), poses, np.eye(4))
    if camera is not None:
        after = seen[camera].camera_from_world[FIRST_CHANGED:]
        after[:] = knock @ after
    return seen


def three_cameras():
    """The rig of two cameras with a third one, whose pixels are random as well."""
    left, right = rig_of((1, 2)).cameras.values()
    top = rig_of((1, 3)).cameras["right"]
    return Rig({"left": left, "right": right, "top": top})


def findings_of_robot(seen, noise, states=STATES):
    """The findings with a robot that reports where the left camera was before it was knocked."""
    rng = np.random.default_rng(5)
    true = knocked(None, states=states)["left"].camera_from_world
    poses = np.linalg.inv(host_exponentials(rng.normal(0.0, noise, (states, 6))) @ true)
    cameras = {
        name: Dataset.from_arrays(POINTS, data.pixels, poses, (640, 480))
        for name, data in rig_of((1, 2), states).cameras.items()
    }
    return target_findings(Rig(cameras), seen)


@pytest.mark.parametrize("camera", ["left", "right", "top"])
def test_a_third_camera_tells_which_one_was_knocked(camera):
    (text,) = target_findings(three_cameras(), knocked(camera, third=True)).doubts
    assert text.startswith(f"from view {FIRST_CHANGED} on, the pictures of cameras")
    assert f"as if camera '{camera}' had been moved on its mount by" in text
    degrees, millimetres = (float(word) for word in re.findall(r"(\S+) (?:degrees|mm)", text)[:2])
    assert degrees == pytest.approx(np.rad2deg(np.linalg.norm(TWIST[3:])), abs=0.05)
    assert millimetres == pytest.approx(1e3 * np.linalg.norm(TWIST[:3]), abs=0.5)


@pytest.mark.parametrize("camera", ["left", "right"])
def test_a_robot_tells_which_camera_was_knocked_if_it_is_good_enough(camera):
    seen = knocked(camera)
    (text,) = findings_of_robot(seen, NOISE).doubts
    assert f"as if camera '{camera}' had been moved" in text
    (text,) = findings_of_robot(seen, 30.0 * NOISE).doubts
    assert "as if camera 'left' or 'right' had been moved" in text


def seen_at_times(seen, **views):
    """What cameras see, some of them in fewer views."""
    return seen | {
        name: SeenTarget(np.array(some), seen[name].camera_from_world[some], np.eye(4))
        for name, some in views.items()
    }


@pytest.mark.parametrize(
    ("states", "noise"), [([*range(7)], 0.0), ([0, 1, 2, 3, 7, 8, 9, 10], 2.0)]
)
def test_a_third_camera_that_cannot_tell_clears_no_other(states, noise):
    """It saw one of the cameras before the change alone, or less exactly than that is large."""
    seen = seen_at_times(knocked("right", third=True), left=[*range(3, STATES)])
    errors = noise * np.random.default_rng(1).normal(0.0, 100.0 * NOISE, (STATES, 6))
    seen["top"].camera_from_world[:] = host_exponentials(errors) @ seen["top"].camera_from_world
    (text,) = target_findings(three_cameras(), seen_at_times(seen, top=states)).doubts
    assert "as if camera 'left' or 'right' had been moved" in text


def test_a_weak_robot_blames_no_camera_because_it_has_few_views():
    seen = seen_at_times(knocked("left", states=48), left=[0, 2, 4, 6, 7, 15, 23, 31, 39, 47])
    (text,) = findings_of_robot(seen, 20.0 * NOISE, states=48).doubts
    assert "as if camera 'left' or 'right' had been moved" in text


def test_a_zoom_of_one_of_two_cameras_that_none_tells_apart_is_of_its_lens():
    for camera in ("left", "right"):
        seen = knocked(None)
        seen[camera].camera_from_world[FIRST_CHANGED:, 2, 3] /= 1.05
        (text,) = findings_of_robot(seen, 300.0 * NOISE).doubts
        assert f"the lens of camera '{camera}' had zoomed by +" in text


def test_a_zoom_is_of_the_lens_that_zoomed():
    for camera in ("left", "right"):
        seen = knocked(None)
        seen[camera].camera_from_world[FIRST_CHANGED:, 2, 3] /= 1.05
        (text,) = findings_of_robot(seen, NOISE).doubts
        assert f"the lens of camera '{camera}' had zoomed by +" in text


def test_a_camera_that_fell_down_makes_the_rig_useless():
    fallen = host_exponentials(np.array([0.02, 0.0, 0.0, 0.0, 0.1, 0.0]))
    found = target_findings(three_cameras(), knocked("top", knock=fallen, third=True))
    (text,) = found.problems
    assert found.doubts == ()
    assert "camera 'top' had been moved" in text


def test_cameras_that_keep_their_places_are_not_doubted():
    rig = three_cameras()
    for seed in range(20):
        assert target_findings(rig, knocked(None, seed, third=True)) == ((), ())
