"""Time and memory of the staged pipeline grow with the number of views, not with its square."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.calibration import mount_from_holder
from smartview_jax.data_checks import conventions, rotation_angles
from smartview_jax.data_checks.conventions import check_conventions
from smartview_jax.geometry import host_matrices, host_transforms
from smartview_jax.hand_eye import CLOSED_FORMS, closed_form
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.simulation.scenes import random_viewpoints
from smartview_jax.staged.kalman import kalman_filter

MANY = 400


def moving(views, noise=0.0, seed=0):
    """The robot's part of the chain, and what the camera sees, with noise in m and rad at it."""
    truth = paper_calibration()
    rng = np.random.default_rng(seed)
    seen = random_viewpoints(rng, views, np.zeros(3), (0.17, 0.25), 0.6)
    robot = mount_from_holder("eye_in_hand", truth.command_for(seen))
    shaken = SE3.exp(jnp.asarray(noise * rng.standard_normal((views, 6))))
    return host_transforms(host_matrices(robot)), host_transforms(host_matrices(shaken @ seen))


def pairs_of(views, seed=0):
    robot, camera = (host_matrices(p)[:, :3, :3] for p in moving(views, seed=seed))
    return np.array(closed_form._paired_views(robot, camera))


@pytest.mark.parametrize("views", [3, 20, 45])
def test_of_few_views_every_pair_is_compared_once(views):
    pairs = {tuple(pair) for pair in pairs_of(views).T}
    assert pairs == {(i, j) for i in range(views) for j in range(i + 1, views)}


@pytest.mark.parametrize("views", [46, 47, 100, MANY])
def test_of_many_views_each_is_in_several_pairs_and_the_number_of_pairs_is_linear(views):
    pairs = pairs_of(views)
    assert pairs.shape[1] >= closed_form.MAX_PAIRS * 0.6
    assert pairs.shape[1] <= closed_form.MAX_PAIRS + closed_form.MIN_PAIRS_PER_VIEW * views
    assert len({frozenset(pair) for pair in pairs.T}) == pairs.shape[1]
    assert np.bincount(pairs.ravel(), minlength=views).min() >= closed_form.MIN_PAIRS_PER_VIEW
    np.testing.assert_array_equal(pairs, pairs_of(views))


def test_the_chosen_pairs_turn_far():
    """Random pairs of these views turn by half of this angle from each other, or almost around."""
    robot, camera = (host_matrices(p)[:, :3, :3] for p in moving(MANY))
    first, second = closed_form._paired_views(robot, camera)
    traces = np.einsum("nab,nab->n", camera[first], camera[second])
    sine = np.sqrt(1.0 - np.square(0.5 * (traces - 1.0)))
    assert np.median(sine) > 0.9


@pytest.mark.parametrize("name", ["Park-Martin", "Tsai-Lenz", "Daniilidis"])
def test_chosen_pairs_give_what_all_pairs_give(name, monkeypatch):
    """They differ by little against the errors by noise of 0.2 mm and 0.01 degrees."""
    errors, changes = [], []
    truth = host_matrices(paper_calibration().camera_from_mount)
    for seed in range(4):
        poses = moving(MANY, noise=2e-4, seed=seed)
        chosen = host_matrices(CLOSED_FORMS[name](*poses, np.ones(MANY))[0])
        with monkeypatch.context() as patch:
            patch.setattr(closed_form, "MAX_PAIRS", MANY**2)
            everything = host_matrices(CLOSED_FORMS[name](*poses, np.ones(MANY))[0])
        changes.append(np.linalg.norm((chosen - everything)[:3, 3]))
        errors.append(np.linalg.norm((everything - truth)[:3, 3]))
    assert np.mean(changes) < 2.0 * np.mean(errors), (changes, errors)


def test_every_view_is_compared_with_a_limited_number_of_others(monkeypatch):
    """What is said of views that are wrong, and of none that is right, is said of many alike."""
    robot, camera = moving(MANY)
    base_from_tool = np.linalg.inv(host_matrices(robot))
    wrong = np.arange(1, MANY, 3)
    base_from_tool[wrong] = base_from_tool[wrong - 1]
    sizes = []
    differences = conventions.angle_differences

    def recorded(*arguments):
        angles = differences(*arguments)
        sizes.append(angles.shape)
        return angles

    monkeypatch.setattr(conventions, "angle_differences", recorded)
    report = check_conventions(host_transforms(base_from_tool), camera, "eye_in_hand")
    assert sizes == [(MANY, rotation_angles.MAX_COMPARED_VIEWS)]
    assert [view for view, _ in report.suspicious_views] == wrong.tolist()


def test_step_2_keeps_no_matrix_of_the_whole_state():
    """It is put together where it is asked for; the views' own 6 x 6 blocks are what is kept."""
    scene = random_scene(0, views=12)
    poses = scene.calibration.camera_from_world(scene.base_from_tool)
    fit = kalman_filter(scene.data.observations, scene.calibration.camera, poses)
    state = fit.covariance.shape[0]
    assert state == 5 + 6 * 12
    per_point = scene.data.observations.visible.size * 2
    assert max(np.size(leaf) for leaf in jax.tree.leaves(fit)) <= max(16 * 6 * 12, per_point)
