"""States in which the pictures of two cameras were exchanged are found without the robot."""

import numpy as np
import pytest
from two_cameras import rig_of, seen_by_both

from smartview_jax.data_checks import exchanged_cameras, target_findings
from smartview_jax.geometry import host_exponentials


def exchanged(states, seed=0, count=12):
    """What two cameras see, with their pictures exchanged in some states."""
    seen = seen_by_both(np.eye(4), np.random.default_rng(seed), count)
    left, right = (target.camera_from_world for target in seen.values())
    left[states], right[states] = right[states].copy(), left[states].copy()
    return seen


@pytest.mark.parametrize("states", [[3], [0, 4, 5, 9], [6, 7, 8, 9, 10, 11]])
def test_states_with_exchanged_pictures_are_named(states):
    found = target_findings(rig_of((1, 2)), exchanged(states))
    (text,) = found.problems
    assert text.startswith("the pictures of cameras 'left' and 'right' are exchanged in")
    assert f"{len(states)} of 12 states" in text
    named = {int(name) for name in text.split("(")[1].split(")")[0].split(", ")}
    # Nothing tells which of two halves is right.
    answers = [set(states)] if len(states) < 6 else [set(states), set(range(12)) - set(states)]
    assert named in answers


def test_exchanged_pictures_are_named_among_very_many_states():
    """There are 2^1000 ways to exchange them, more than any number of 64 bits can count."""
    (text,) = exchanged_cameras(rig_of((1, 2), 1000), exchanged([3, 700], count=1000))
    assert "exchanged in 2 of 1000 states (3, 700)" in text


def test_pictures_in_order_are_not_doubted():
    rig = rig_of((1, 2))
    for seed in range(20):
        assert exchanged_cameras(rig, exchanged([], seed)) == ()
        # A picture that was taken one state too late is no exchange.
        late = exchanged([], seed)
        late["right"].camera_from_world[5] = late["right"].camera_from_world[6]
        assert exchanged_cameras(rig, late) == ()


def test_errors_along_one_line_are_no_exchange():
    """Two cameras at one place, with errors as of the tilt of a flat target."""
    rig, line = rig_of((1, 2), 6), np.array([0.0, 0.0, 5e-3, 0.0, 0.02, 0.0])
    for seed in range(30):
        rng = np.random.default_rng(seed)
        errors = rng.normal(size=(6, 1)) * line + 1e-4 * rng.normal(size=(6, 6))
        seen = seen_by_both(np.eye(4), rng, 6)
        seen["right"].camera_from_world[:] = (
            host_exponentials(errors) @ seen["left"].camera_from_world
        )
        assert exchanged_cameras(rig, seen) == ()


@pytest.mark.filterwarnings("error")
def test_cameras_that_see_the_same_to_rounding_are_not_exchanged():
    """As two data sets of one camera whose depths are exact."""
    rig = rig_of((1, 2), 6)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        seen = seen_by_both(np.eye(4), rng, 6)
        left, right = (target.camera_from_world for target in seen.values())
        right[:] = left @ host_exponentials(1e-16 * rng.normal(size=(6, 1)) * np.ones(6))
        assert exchanged_cameras(rig, seen) == ()
