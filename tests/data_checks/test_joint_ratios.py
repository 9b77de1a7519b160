"""Joints that turn by another angle than reported are named; arms that err as arms do never.

The true poses are made by SciPy's rotations and plain products of matrices.
"""

import numpy as np
import pytest
from described_arm import A, D, camera_poses, described, readings

from smartview_jax.data_checks import JointShareOptions, find_joint_share
from smartview_jax.geometry import as_se3

VIEWS = 12
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
READINGS = readings(VIEWS)
TRANSMISSION = np.eye(6)


def share_of(mount, transmission=TRANSMISSION, arm=None, size=1.0, zeros=0.0):
    """The share that is found where joints turn by these multiples of the readings."""
    poses = camera_poses(READINGS @ transmission.T + zeros, mount)
    poses[:, :3, 3] /= size
    arm = described() if arm is None else arm
    return find_joint_share(READINGS, arm, as_se3(poses), mount, EVERY_VIEW)


@pytest.mark.parametrize(
    ("mount", "joint", "reading", "share", "words"),
    [
        ("eye_in_hand", 2, 2, 0.02, "joint 3 seems to turn 1.0"),
        ("eye_to_hand", 4, 4, -0.02, "joint 5 seems to turn 0.9"),
        ("eye_to_hand", 4, 3, 0.05, "joint 5 seems to turn by its own reading and +0.0"),
    ],
)
def test_a_gear_ratio_and_a_coupling_are_named_with_their_size(mount, joint, reading, share, words):
    transmission = TRANSMISSION.copy()
    transmission[joint, reading] += share
    found = share_of(mount, transmission)
    assert (found.joint, found.reading) == (joint, reading)
    assert found.share == pytest.approx(share, abs=5.0 * found.std)
    assert found.std < 1e-3
    assert found.sentence.startswith(words)
    assert not found.contradicts
    # The noise of the poses has a mean length of 0.16 mm and 0.016 degrees.
    assert found.misfit[0] < 2e-4
    assert found.score < 0.3 * found.given_score


def test_a_joint_that_turns_half_as_far_again_contradicts_every_calibration():
    found = share_of("eye_in_hand", np.diag([1.0, 1.0, 1.0, 1.5, 1.0, 1.0]))
    assert found.share == pytest.approx(0.5, abs=5.0 * found.std)
    assert found.contradicts


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_nothing_is_named_of_arms_and_targets_that_err(mount):
    assert share_of(mount) is None
    rng = np.random.default_rng(4)
    longer = described(D + rng.normal(0.0, 1e-3, 6), A + rng.normal(0.0, 1e-3, 6))
    zeros = np.deg2rad(rng.normal(0.0, 0.5, 6))
    assert share_of(mount, arm=longer, zeros=zeros, size=1.01) is None


def test_too_few_views_tell_no_ratio():
    transmission = np.diag([1.0, 1.0, 1.02, 1.0, 1.0, 1.0])
    camera = as_se3(camera_poses(READINGS @ transmission, "eye_in_hand"))
    few = np.arange(VIEWS) < 7
    assert find_joint_share(READINGS, described(), camera, "eye_in_hand", few) is None


@pytest.mark.parametrize(
    "options",
    [JointShareOptions(min_share=0.03), JointShareOptions(share_std=1e-5)],
)
def test_the_user_says_how_poor_an_arm_may_be_and_which_share_matters(options):
    camera = as_se3(camera_poses(READINGS @ np.diag([1, 1, 1.02, 1, 1, 1]), "eye_in_hand"))
    arguments = READINGS, described(), camera, "eye_in_hand", EVERY_VIEW
    assert find_joint_share(*arguments) is not None
    assert find_joint_share(*arguments, options=options) is None
