"""Where the bases of two arms are, from a camera on one hand and a target on the other."""

import numpy as np
import pytest
from host_poses import transform_errors
from two_hands_scene import two_hands

from smartview_jax import fit_staged
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.staged.two_hands import solve_bases

RNG = np.random.default_rng(0)


def poses(seed, views):
    """The camera's poses without noise, and what both arms reported without noise."""
    scene = two_hands(seed, views)
    seen = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    other = host_matrices(scene.data.hands.other_base_from_other_tool)
    bases = host_matrices(scene.calibration.base_from_other_base)
    return seen, bases @ other @ host_matrices(scene.base_from_tool), other, scene


@pytest.mark.parametrize("views", [4, 10])
def test_exact_poses_give_the_true_bases(views):
    seen, own, other, scene = poses(1, views)
    error = transform_errors(solve_bases(seen, own, other), scene.calibration.base_from_other_base)
    assert np.abs(error).max() < 1e-6


def test_wrong_pairs_do_not_move_the_bases():
    """Two of ten pictures belong to other poses, and all are noisy."""
    seen, own, other, scene = poses(2, 10)
    own[:2] = own[[5, 7]]
    noise = np.array([1e-4] * 3 + [5e-4] * 3) * RNG.standard_normal((10, 6))
    actual = solve_bases(host_exponentials(noise) @ seen, own, other)
    error = transform_errors(actual, scene.calibration.base_from_other_base)
    assert np.abs(error[:3]).max() < 4e-3
    assert np.abs(error[3:]).max() < 3e-3


@pytest.mark.parametrize(("still", "name"), [(1, "camera"), (2, "target")])
def test_a_hand_that_does_not_turn_is_named(still, name):
    given = list(poses(1, 4)[:3])
    given[still] = np.repeat(given[still][:1], 4, axis=0)
    with pytest.raises(ValueError, match=f"the hand with the {name} did not turn about two axes"):
        solve_bases(*given)


def test_the_staged_fit_finds_all_three_transforms():
    scene = two_hands(0)
    fit = fit_staged(scene.data, camera=scene.calibration.camera)
    actual, truth = fit.calibration.transforms, scene.calibration.transforms
    assert actual.keys() == truth.keys()
    for name, transform in actual.items():
        assert np.abs(transform_errors(transform, truth[name])).max() < 5e-3
    assert fit.warnings == ()


def test_bases_that_are_given_are_kept():
    scene = two_hands(0)
    given = host_transforms(
        host_exponentials(1e-3 * RNG.standard_normal(6))
        @ host_matrices(scene.calibration.base_from_other_base)
    )
    camera, start = scene.calibration.camera, {"base_from_other_base": given}
    fit = fit_staged(scene.data, camera=camera, start=start)
    assert np.abs(transform_errors(fit.calibration.base_from_other_base, given)).max() < 1e-12
