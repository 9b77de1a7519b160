"""An arm whose links are longer than its description says is named; good arms never.

The true poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
import pytest
from robot_motions import CAMERA_FROM_MOUNT, HOLDER_FROM_WORLD, transform

from smartview_jax.data_checks import find_other_arm
from smartview_jax.geometry import as_se3
from smartview_jax.robots import SerialArm

VIEWS = 15
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
D = np.array([0.16, 0.0, 0.0, 0.13, 0.10, 0.10])
A = np.array([0.0, -0.42, -0.39, 0.0, 0.0, 0.0])
ALPHA = np.array([90.0, 0.0, 0.0, 90.0, -90.0, 0.0])
JOINTS = np.deg2rad([10.0, -80.0, 100.0, -110.0, -85.0, 20.0]) + np.random.default_rng(0).normal(
    0.0, 0.3, (VIEWS, 6)
)


def described(d=D, a=A):
    return SerialArm(np.zeros(6), d, a, np.deg2rad(ALPHA))


def seen(mount, joints=JOINTS, size=1.0):
    """What the camera sees of an arm with these joints, by a target of another size than stated."""
    rng = np.random.default_rng(1)
    poses = []
    for row in joints:
        tool = np.eye(4)
        for angle, d, a, alpha in zip(row, D, A, ALPHA, strict=True):
            tool = tool @ transform([0, 0, np.rad2deg(angle)], [0, 0, d])
            tool = tool @ transform([0, 0, 0], [a, 0, 0]) @ transform([alpha, 0, 0], [0, 0, 0])
        tool = tool @ transform(rng.normal(0, 0.01, 3), rng.normal(0, 1e-4, 3))
        mount_from_holder = np.linalg.inv(tool) if mount == "eye_in_hand" else tool
        pose = CAMERA_FROM_MOUNT @ mount_from_holder @ HOLDER_FROM_WORLD
        pose[:3, 3] /= size
        poses.append(pose)
    return as_se3(np.stack(poses))


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
