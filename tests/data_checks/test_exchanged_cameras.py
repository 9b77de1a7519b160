"""States in which the pictures of two cameras were exchanged are found without the robot."""

import numpy as np
import pytest
from two_cameras import rig_of, seen_by_both

from smartview_jax.data_checks import exchanged_cameras, target_findings


def exchanged(states, seed=0):
    """What two cameras see, with their pictures exchanged in some states."""
    seen = seen_by_both(np.eye(4), np.random.default_rng(seed))
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


def test_pictures_in_order_are_not_doubted():
    rig = rig_of((1, 2))
    for seed in range(20):
        assert exchanged_cameras(rig, exchanged([], seed)) == ()
        # A picture that was taken one state too late is no exchange.
        late = exchanged([], seed)
        late["right"].camera_from_world[5] = late["right"].camera_from_world[6]
        assert exchanged_cameras(rig, late) == ()
