"""An arm whose links are longer than its description says is named; good arms never.

The true poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
import pytest
from described_arm import A, camera_poses, described, readings

from smartview_jax.data_checks import find_other_arm
from smartview_jax.geometry import as_se3

VIEWS = 15
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
JOINTS = readings(VIEWS)


def seen(mount, joints=JOINTS, size=1.0):
    """What the camera sees of an arm with these joints, by a target of another size than stated."""
    poses = camera_poses(joints, mount)
    poses[:, :3, 3] /= size
    return as_se3(poses)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_links_of_another_arm_are_named_with_their_lengths(mount):
    other = described(a=A + np.array([0.0, -0.19, -0.18, 0.0, 0.0, 0.0]))
    lengths = find_other_arm(JOINTS, other, seen(mount), mount, EVERY_VIEW)
    wanted = dict(zip(lengths.names, lengths.wanted, strict=True))
    assert wanted["a of link 2"] == pytest.approx(-0.42, abs=1e-3)
    assert wanted["a of link 3"] == pytest.approx(-0.39, abs=1e-3)
    assert "a of link 2 is -420 mm, not -610" in lengths.sentence
    # The noise of the poses has a mean length of 0.16 mm.
    assert lengths.misfit < 2e-4 < 0.1 * lengths.size_misfit


def test_nothing_is_named_of_the_described_arm_or_of_a_target_of_another_size():
    for size in (1.0, 1.06):
        camera = seen("eye_in_hand", size=size)
        assert find_other_arm(JOINTS, described(), camera, "eye_in_hand", EVERY_VIEW) is None


def test_joints_that_are_off_are_no_other_arm():
    off = JOINTS + np.deg2rad([0.0, 3.0, -2.0, 1.0, 2.0, 0.0])
    camera = seen("eye_in_hand", joints=off)
    assert find_other_arm(JOINTS, described(), camera, "eye_in_hand", EVERY_VIEW) is None


def test_an_arm_that_errs_by_millimetres_is_not_another():
    a_little = described(a=A + np.array([0.0, 0.003, -0.004, 0.0, 0.0, 0.0]))
    camera = seen("eye_in_hand")
    assert find_other_arm(JOINTS, a_little, camera, "eye_in_hand", EVERY_VIEW) is None


def test_few_views_tell_nothing():
    camera = seen("eye_in_hand", JOINTS[:6])
    other = described(a=1.4 * A)
    assert find_other_arm(JOINTS[:6], other, camera, "eye_in_hand", EVERY_VIEW[:6]) is None
