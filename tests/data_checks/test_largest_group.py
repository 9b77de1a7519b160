"""Views that agree with each other are found among others that are wrong, each in its own way."""

import numpy as np
import pytest

from smartview_jax.data_checks.largest_group import largest_group
from smartview_jax.data_checks.transform_fit import closures_of_groups, fit_transforms
from smartview_jax.geometry import host_exponentials

HAND = host_exponentials(np.array([0.05, -0.02, 0.1, 0.2, -0.1, 1.0]))
WORLD = host_exponentials(np.array([0.3, 0.1, -0.2, 0.4, 0.3, -0.6]))


@pytest.fixture
def motions():
    """Poses of robot and camera in ten views that a transform of the hand explains."""
    rng = np.random.default_rng(0)
    robot = host_exponentials(rng.normal(0.0, [0.1] * 3 + [0.5] * 3, (10, 6)))
    return robot, HAND @ robot @ WORLD


def test_the_good_views_are_found_however_wrong_the_others_are(motions):
    robot, camera = motions
    wrong = [1, 4, 5, 8]
    camera[wrong] = camera[wrong] @ host_exponentials(
        np.random.default_rng(1).normal(0.0, 0.3, (4, 6))
    )
    np.testing.assert_array_equal(
        np.flatnonzero(~largest_group(robot, camera, distance=0.5)), wrong
    )


def test_groups_are_fitted_together_as_one_by_one(motions):
    robot, camera = motions
    camera = camera @ host_exponentials(np.random.default_rng(2).normal(0.0, 0.02, (10, 6)))
    groups = np.array([[0, 1, 2], [3, 5, 7], [0, 4, 9]])
    for group, closures in zip(groups, closures_of_groups(robot, camera, groups), strict=True):
        used = np.isin(np.arange(10), group)
        np.testing.assert_allclose(closures, fit_transforms(robot, camera, used).closure, atol=1e-9)


def test_the_views_that_agree_are_fitted_again_together_and_one_by_one_alike(motions, monkeypatch):
    """With errors of half the tolerance, triples lead to groups of many sizes."""
    robot, camera = motions
    camera = camera @ host_exponentials(np.random.default_rng(3).normal(0.0, 0.004, (10, 6)))
    camera[[2, 6]] = camera[[6, 2]]
    together = largest_group(robot, camera, distance=0.5)
    monkeypatch.setattr("smartview_jax.data_checks.largest_group.MAX_PAIRS", 0)
    np.testing.assert_array_equal(largest_group(robot, camera, distance=0.5), together)
    assert 3 < together.sum() <= 8
    assert not together[[2, 6]].any()


def test_many_views_are_compared_with_few_triples_at_a_time(motions, monkeypatch):
    robot, camera = motions
    camera[:2] = camera[[1, 0]]
    expected = largest_group(robot, camera, distance=0.5)
    counts = []

    def counted(robot, camera, groups):
        counts.append(len(groups))
        return closures_of_groups(robot, camera, groups)

    module = "smartview_jax.data_checks.largest_group"
    monkeypatch.setattr(f"{module}.closures_of_groups", counted)
    monkeypatch.setattr(f"{module}.MAX_TOGETHER", 35)
    np.testing.assert_array_equal(largest_group(robot, camera, distance=0.5), expected)
    # All triples of ten views, three at a time; of larger groups each is fitted alone.
    assert counts[:40] == [3] * 40
    assert len(counts) > 40
    assert set(counts[40:]) == {1}


def test_views_that_tell_no_transforms_are_no_group(motions):
    """Two views; and any number that turn about one axis, which agree with anything."""
    robot, camera = motions
    assert not largest_group(robot[:2], camera[:2], distance=0.5).any()
    turns = np.zeros((6, 6))
    turns[:, 5] = np.arange(6.0)
    about_z = host_exponentials(turns)
    assert not largest_group(about_z, HAND @ about_z @ WORLD, distance=0.5).any()
