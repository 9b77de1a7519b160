import pickle

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from host_poses import motion_between
from jaxlie import SE3

from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.hand_eye import CLOSED_FORMS, solve_hand_eye
from smartview_jax.hand_eye.frobenius import frobenius_factor
from smartview_jax.hand_eye.solution import PAPER_START
from smartview_jax.simulation import random_scene

VIEWS = 9


@pytest.fixture(scope="module")
def exact():
    scene = random_scene(3, views=VIEWS)
    camera_from_world = scene.calibration.camera_from_world(scene.base_from_tool)
    return scene, scene.base_from_tool.inverse(), camera_from_world


@pytest.fixture(scope="module")
def noisy(exact):
    scene, tool_from_base, camera_from_world = exact
    noise = 1e-3 * np.random.default_rng(0).normal(size=(VIEWS, 6))
    noisy = host_transforms(host_exponentials(noise) @ host_matrices(camera_from_world))
    return scene, tool_from_base, SE3(jnp.asarray(noisy.wxyz_xyz))


def distance(a, b):
    return float(np.abs(motion_between(a, b)).max())


# One program for all tests; without `jit` every operation is one.
@jax.jit
def cost_of(X, T, C, weights, length_scale=1.0):
    """Eq. 17 as it is printed, pair by pair, with weights and a unit of length."""
    x, t, c = X.as_matrix()[None, None], T.as_matrix(), C.as_matrix()
    robot = jnp.linalg.inv(t)[:, None] @ t[None]
    camera = jnp.linalg.inv(c)[:, None] @ c[None]
    squares = jnp.sum((robot @ x - x @ camera) ** 2, axis=2)
    of_pairs = squares[..., :3].sum(axis=-1) + squares[..., 3] / length_scale**2
    return weights @ of_pairs @ weights


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms_find_the_truth(exact, name):
    scene, T, C = exact
    hand_eye, world = CLOSED_FORMS[name](T, C, jnp.ones(VIEWS))
    assert distance(hand_eye, scene.calibration.camera_from_tool) < 1e-10
    assert distance(world, scene.calibration.base_from_world) < 1e-10


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms_take_matrices_as_they_take_transforms(noisy, name):
    _, T, C = noisy
    weights = np.linspace(0.0, 2.0, VIEWS)
    expected = map(host_matrices, CLOSED_FORMS[name](T, C, weights))
    found = CLOSED_FORMS[name].of_matrices(host_matrices(T), host_matrices(C), weights)
    np.testing.assert_allclose(found, list(expected), atol=1e-14)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_closed_forms_are_sent_to_other_processes(name):
    assert pickle.loads(pickle.dumps(CLOSED_FORMS[name])) is CLOSED_FORMS[name]


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_a_view_of_weight_zero_has_no_say(exact, name):
    scene, T, C = exact
    wrong = SE3(C.wxyz_xyz.at[2].set(np.eye(7)[0]))
    hand_eye, _ = CLOSED_FORMS[name](T, wrong, jnp.ones(VIEWS).at[2].set(0.0))
    assert distance(hand_eye, scene.calibration.camera_from_tool) < 1e-10


@pytest.mark.parametrize(
    ("name", "method", "metres"),
    [
        ("Park-Martin", "PARK", 3e-4),
        ("Tsai-Lenz", "TSAI", 1e-3),
        ("Daniilidis", "DANIILIDIS", 1e-9),
    ],
)
def test_closed_forms_agree_with_opencv(noisy, name, method, metres):
    """OpenCV weighs pairs otherwise, so translations differ by a little of the noise's effect."""
    if not hasattr(cv2, "calibrateHandEye"):
        pytest.skip("this OpenCV has no calibrateHandEye (5.0 left it out of its Python package)")
    _, T, C = noisy
    tool, world = np.asarray(T.inverse().as_matrix()), np.asarray(C.as_matrix())
    R, t = cv2.calibrateHandEye(
        tool[:, :3, :3],
        tool[:, :3, 3],
        world[:, :3, :3],
        world[:, :3, 3],
        method=getattr(cv2, f"CALIB_HAND_EYE_{method}"),
    )
    actual = np.asarray(CLOSED_FORMS[name](T, C, jnp.ones(VIEWS))[0].inverse().as_matrix())
    np.testing.assert_allclose(actual[:3, :3], R, atol=1e-3 if name == "Tsai-Lenz" else 1e-9)
    np.testing.assert_allclose(actual[:3, 3], t[:, 0], atol=metres)


def test_shah_agrees_with_opencv(noisy):
    if not hasattr(cv2, "calibrateRobotWorldHandEye"):
        pytest.skip("this OpenCV has no calibrateRobotWorldHandEye")
    _, T, C = noisy
    tool, world = np.asarray(T.as_matrix()), np.asarray(C.as_matrix())
    _, _, R, t = cv2.calibrateRobotWorldHandEye(
        world[:, :3, :3],
        world[:, :3, 3],
        tool[:, :3, :3],
        tool[:, :3, 3],
        method=cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH,
    )
    hand_eye, _ = CLOSED_FORMS["Shah"](T, C, jnp.ones(VIEWS))
    np.testing.assert_allclose(hand_eye.rotation().as_matrix(), R, atol=1e-9)
    np.testing.assert_allclose(hand_eye.translation(), t[:, 0], atol=1e-3)


def test_eq_17_is_the_sum_it_says(noisy):
    _, T, C = noisy
    X = host_transforms(host_exponentials(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])))
    t, c, x = (np.asarray(pose.as_matrix()) for pose in (T, C, X))
    expected = sum(
        np.sum((np.linalg.inv(t[i]) @ t[j] @ x - x @ np.linalg.inv(c[i]) @ c[j]) ** 2)
        for i in range(VIEWS)
        for j in range(VIEWS)
        if i != j
    )
    assert float(cost_of(X, T, C, jnp.ones(VIEWS), 1.0)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("length_scale", [1.0, 0.05])
def test_the_factor_of_eq_17_gives_its_cost(noisy, length_scale):
    _, T, C = noisy
    weights = np.random.default_rng(1).uniform(0.2, 2.0, VIEWS)
    factor = frobenius_factor(host_matrices(T), host_matrices(C), weights, length_scale)
    for tangent in np.random.default_rng(2).normal(size=(5, 6)):
        X = host_transforms(host_exponentials(tangent))
        R, t = host_matrices(X)[:3, :3], host_matrices(X)[:3, 3]
        expected = float(cost_of(X, T, C, jnp.asarray(weights), length_scale))
        actual = np.sum((factor @ np.concatenate([R.ravel(), t, [1.0]])) ** 2)
        assert actual == pytest.approx(expected, rel=1e-12)


def test_the_factor_of_eq_17_resolves_the_cost_of_exact_poses(exact):
    """A difference of large sums would leave about 1e-13 of the cost of a pair."""
    scene, T, C = exact
    result = solve_hand_eye(T, C)
    assert max(search.final_cost for search in result.searches) / VIEWS**2 < 1e-28
    assert distance(result.holder_from_world, scene.calibration.base_from_world) < 1e-13


def test_poses_that_are_not_finite_give_no_transforms(noisy):
    _, T, C = noisy
    broken = SE3(C.wxyz_xyz.at[2].set(jnp.nan))
    result = solve_hand_eye(T, broken)
    assert not result.converged
    assert np.isnan(np.asarray(result.camera_from_mount.wxyz_xyz)).all()
    without = solve_hand_eye(T, broken, jnp.ones(VIEWS).at[2].set(0.0))
    assert without.converged
    assert without.hand_eye_difference[0] < 5e-3


def test_bfgs_reaches_the_same_optimum_from_every_start(noisy):
    scene, T, C = noisy
    result = solve_hand_eye(T, C)
    assert result.converged
    assert result.searches[0].name == PAPER_START
    assert len(result.searches) == 1 + len(CLOSED_FORMS)
    costs = [tried.final_cost for tried in result.searches]
    np.testing.assert_allclose(costs, min(costs), rtol=1e-6)
    assert all(tried.final_cost <= tried.initial_cost for tried in result.searches)
    gradient = jax.jit(jax.grad(lambda step, X: cost_of(SE3.exp(step) @ X, T, C, jnp.ones(VIEWS))))(
        jnp.zeros(6), result.holder_from_world
    )
    assert np.abs(gradient).max() < 1e-5
    assert distance(result.holder_from_world, scene.calibration.base_from_world) < 5e-3
    assert result.hand_eye_difference[0] < 5e-3


def test_only_the_papers_start_needs_bfgs(noisy, monkeypatch):
    """The closed forms are near the minimum, where Gauss-Newton converges by itself."""
    _, T, C = noisy
    begun = []

    def minimize(cost, start, **options):
        begun.append(cost(start)[0])
        return scipy.optimize.minimize(cost, start, **options)

    monkeypatch.setattr("smartview_jax.hand_eye.solution.minimize", minimize)
    searches = solve_hand_eye(T, C).searches
    # One for each of both unknowns.
    assert len(begun) == 2
    assert VIEWS**2 * begun[0] == pytest.approx(searches[0].initial_cost)


def test_the_unit_of_length_matters_and_can_be_chosen(noisy):
    _, T, C = noisy
    metres, millimetres = solve_hand_eye(T, C), solve_hand_eye(T, C, length_scale=1e-3)
    assert 1e-7 < distance(metres.holder_from_world, millimetres.holder_from_world) < 0.05


def test_a_failed_start_is_listed_and_not_used(exact):
    """One rotation axis only: Park-Martin's rotation is not determined."""
    scene, _, _ = exact
    turns = np.zeros((VIEWS, 6))
    turns[:, 5] = np.linspace(0.0, 1.0, VIEWS)
    T = host_transforms(host_exponentials(turns))
    hand_eye, world = map(
        host_matrices, (scene.calibration.camera_from_tool, scene.calibration.base_from_world)
    )
    C = host_transforms(hand_eye @ host_matrices(T) @ world)
    result = solve_hand_eye(T, C)
    assert all(np.isfinite(np.asarray(pose.wxyz_xyz)).all() for pose in (result.holder_from_world,))
    assert min(tried.final_cost for tried in result.searches) < 1e-12


def test_two_views_are_too_few(exact):
    _, T, C = exact
    with pytest.raises(ValueError, match="at least 3 views, found 2"):
        solve_hand_eye(T, C, weights=jnp.zeros(VIEWS).at[:2].set(1.0))
