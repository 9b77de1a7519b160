"""Poses of a target on an arm, by its joint axes, and their derivatives."""

import numpy as np

from smartview_jax.arm_identification.product_of_exponentials import ProductOfExponentials
from smartview_jax.geometry import host_exponentials, host_logarithms

RNG = np.random.default_rng(0)


def test_twists_are_the_derivatives_of_the_targets_pose():
    """By central differences, for joints of both kinds."""
    *frames, home = host_exponentials(RNG.normal(size=(4, 6)))
    axes = ProductOfExponentials(np.array(frames), np.array([1.1, -0.8, 1.0]), home)
    joints, prismatic, size = RNG.uniform(-2.0, 2.0, (5, 3)), (False, True, False), 1e-5
    poses = axes.camera_from_target(joints, prismatic)
    twists = axes.target_twists(joints, prismatic)
    assert twists.shape == (5, 6, 21)
    for k, step in enumerate(size * np.eye(21)):
        forward, backward = (
            host_logarithms(
                np.linalg.inv(poses) @ axes.displaced(d).camera_from_target(joints, prismatic)
            )
            for d in (step, -step)
        )
        np.testing.assert_allclose(twists[..., k], (forward - backward) / (2 * size), atol=1e-8)
