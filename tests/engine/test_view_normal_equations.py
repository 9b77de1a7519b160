"""The structured linearisation against automatic differentiation of the residuals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from jaxlie import SE3
from scipy_optimum import residuals_and_jacobian
from starts import nudged

from smartview_jax import Calibration, Noise, Prior
from smartview_jax.cameras import AbstractPerspectiveLens
from smartview_jax.engine import view_normal_equations
from smartview_jax.engine.losses import loss_by_name
from smartview_jax.engine.problem_builder import build_problem
from smartview_jax.robot_errors import DHErrors, LinearInPose
from smartview_jax.robots import six_axes
from smartview_jax.simulation import paper_points, random_scene

NOISE = Noise(0.15, 1e-3, 1e-2)


class Division(AbstractPerspectiveLens):
    """A user's own lens: Fitzgibbon's division model, ideal = distorted / (1 + k |distorted|^2)."""

    k: jax.Array

    def distort_normalised(self, ideal):
        square = jnp.sum(ideal**2, axis=-1)
        root = jnp.sqrt(jnp.maximum(1.0 - 4.0 * self.k * square, 0.0))
        return ideal * (2.0 / (1.0 + root))[..., None], 4.0 * self.k * square < 1.0

    def undistort_normalised(self, distorted):
        scale = 1.0 + self.k * jnp.sum(distorted**2, axis=-1)
        return distorted / scale[..., None], scale > 0.0


@pytest.fixture(scope="module")
def scene():
    """Six views, points that some of them do not show."""
    scene = random_scene(0, 6, paper_points((0.0, 0.02))[::6])
    hidden = np.random.default_rng(5).random(scene.data.visible.shape) < 0.2
    visible = scene.data.visible & ~jnp.asarray(hidden)
    pixels = jnp.where(visible[..., None], scene.data.pixels, jnp.nan)
    return eqx.tree_at(lambda s: (s.data.visible, s.data.pixels), scene, (visible, pixels))


# The problem is an argument, as of `residuals_and_jacobian`.
@eqx.filter_jit
def structured(problem, z):
    return problem.normal_equations(z)


def dense_and_structured(problem, size=1e-3):
    """Cost, gradient and Gauss-Newton matrix by `jacfwd`, then ours, at a random step."""
    _, unravel = ravel_pytree(problem.zero_step())
    count = len(problem.free) + problem.per_view_free.size
    z = size * np.random.default_rng(1).normal(size=count)

    r, J = map(np.asarray, residuals_and_jacobian(problem, z))
    dense = J.T @ J
    at = len(problem.free) + np.flatnonzero(~np.asarray(problem.per_view_free))
    dense[at, at] = 1.0
    found = structured(problem, unravel(jnp.asarray(z)))
    gradient = np.concatenate([np.ravel(part) for part in found.gradient])
    return (0.5 * r @ r, J.T @ r, dense), (found.cost, gradient, whole_matrix(found.matrix))


def whole_matrix(blocks):
    """The matrix of a `BlockArrow`, put together here."""
    shared, border, per_view = map(np.asarray, (blocks.shared, blocks.border, blocks.per_view))
    count, views = len(shared), len(per_view)
    whole = np.zeros((count + 6 * views, count + 6 * views))
    whole[:count, :count] = shared
    for k in range(views):
        at = slice(count + 6 * k, count + 6 * k + 6)
        whole[at, at], whole[at, :count], whole[:count, at] = per_view[k], border[k], border[k].T
    return whole


def assert_same(dense, structured, tolerance=1e-10):
    np.testing.assert_allclose(structured[0], dense[0], rtol=1e-12)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(dense[2]), 1e-300))
    gradient = np.abs((structured[1] - dense[1]) * unit).max()
    assert gradient < tolerance * np.abs(dense[1] * unit).max()
    assert np.abs((structured[2] - dense[2]) * np.outer(unit, unit)).max() < tolerance


def mounted(scene, mount):
    """Data and start with the camera on the hand, or the same pictures with it on the base."""
    data, start = scene.data, nudged(scene.calibration)
    if mount == "eye_in_hand":
        return data, start
    start = Calibration(start.camera, start.camera_from_mount, start.holder_from_world, mount)
    data = type(data).from_arrays(
        data.points, data.pixels, data.base_from_tool.inverse(), data.image_size, mount=mount
    )
    return data, start


# Every lens occurs in one of the cases below, with either mount and what else may be fitted.


@pytest.mark.parametrize(
    ("mount", "corrected", "lens"),
    [("eye_in_hand", True, "opencv8"), ("eye_to_hand", False, "fisheye")],
)
def test_a_field_of_the_robots_error(scene, mount, corrected, lens):
    data, start = mounted(scene, mount)
    field = LinearInPose.from_poses(data.base_from_tool)
    noise = Noise(0.15, 1e-3, 1e-2, field=(1e-3, 2e-3, 3e-3, 4e-3)) if corrected else "trusted"
    priors = {} if corrected else {"robot_error": Prior(std=1e-3, mean=0.0)}
    problem = build_problem(data, start, lens=lens, noise=noise, priors=priors, field=field).problem
    assert_same(*dense_and_structured(problem, 3e-2))


@pytest.mark.parametrize(("mount", "lens"), [("eye_in_hand", "weng"), ("eye_to_hand", "pinhole")])
def test_the_errors_of_an_arm(scene, mount, lens):
    """An arm that moves a little; the target goes where its first view sees it as before."""
    data, start = mounted(scene, mount)
    arm, rng = six_axes(), np.random.default_rng(0)
    joints = np.array([0.1, 0.4, 0.2, 0.1, -0.9, 0.0]) + 0.02 * rng.normal(size=(6, 6))
    first, own = SE3(data.base_from_tool.wxyz_xyz[0]), arm.base_from_tool(joints[0])
    moved = own @ first.inverse() if mount == "eye_in_hand" else own.inverse() @ first
    start = Calibration(
        start.camera, start.camera_from_mount, moved @ start.holder_from_world, mount
    )
    data = type(data).from_arrays(
        data.points, data.pixels, None, data.image_size, mount=mount, joints=joints, arm=arm
    )
    noise = Noise(0.15, 1e-3, 1e-2, field=(1e-2, 2e-3, 3e-3))
    problem = build_problem(data, start, lens=lens, noise=noise, field=DHErrors(arm)).problem
    assert_same(*dense_and_structured(problem, 1e-2))


def with_scale_and_priors(scene, mount, lens, coefficient):
    """A problem with corrections, some of them held, a free scale, and priors."""
    data, start = mounted(scene, mount)
    return build_problem(
        data,
        start,
        lens=lens,
        noise=NOISE,
        free=("target_scale",),
        fixed=("camera.v0", "pose_corrections.3", "pose_corrections.1.rotation.z"),
        priors={
            f"camera.lens.{coefficient}": Prior(std=0.1, mean=0.2),
            "pose_corrections.2": Prior(std=0.5),
        },
    ).problem


@pytest.mark.parametrize(
    ("mount", "lens", "coefficient"),
    [("eye_in_hand", "opencv4", "k1"), ("eye_to_hand", Division(jnp.array(-0.2)), "k")],
    ids=["eye_in_hand", "eye_to_hand-own_lens"],
)
def test_corrections_scale_and_priors(scene, mount, lens, coefficient):
    # jaxlie's exp loses digits at small angles, so the step is a large one here.
    problem = with_scale_and_priors(scene, mount, lens, coefficient)
    assert_same(*dense_and_structured(problem, 3e-2))


def test_lost_points_cost_what_they_should(scene):
    """Half of the target is behind the camera: its points cost, but pull at nothing."""
    problem = with_scale_and_priors(scene, "eye_in_hand", "opencv4", "k1")
    behind = problem.observations.points.at[:, ::2, 2].add(1.0)
    problem = eqx.tree_at(lambda p: p.observations.points, problem, behind)
    dense, structured = dense_and_structured(problem, 3e-2)
    assert dense[0] > 1e6
    assert_same(dense, structured)


def test_chunks_change_nothing(scene, monkeypatch):
    data, truth = scene.data, scene.calibration
    camera, poses = truth.camera, truth.camera_from_world(data.base_from_tool).as_matrix()

    def linearised():
        """By a program of its own for each call."""
        program = eqx.filter_jit(lambda *x: view_normal_equations.linearise_views(*x, None))
        return program(camera, poses, data.observations, jnp.ones(()), jnp.array(0.15))

    whole = linearised()
    monkeypatch.setattr(view_normal_equations, "MAX_CHUNK_POINTS", 5)
    parts = linearised()
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        size = float(jnp.abs(one).max(initial=0.0))
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-9 * size)


def test_a_robust_loss_has_the_right_cost_and_gradient(scene):
    """The weights are derivatives of `rho`, whichever loss has it."""
    problem = build_problem(
        scene.data, nudged(scene.calibration), loss="geman_mcclure", noise=Noise(20.0, 1.0, 1.0)
    )
    dense, structured = dense_and_structured(problem.problem)
    np.testing.assert_allclose(structured[0], dense[0], rtol=1e-10)
    unit = 1.0 / np.sqrt(np.diag(dense[2]))
    difference = np.abs((structured[1] - dense[1]) * unit).max()
    assert difference < 1e-8 * np.abs(dense[1] * unit).max()


@pytest.mark.parametrize("square", [0.5, 3.0, 200.0])
def test_losses_are_those_of_the_literature(square):
    """By hand, with the usual scales: 2, 2.5 and 3 sigmas, and 5 degrees of freedom."""
    expected = {
        "huber": square if square <= 4.0 else 4.0 * np.sqrt(square) - 4.0,
        "cauchy": 6.25 * np.log(1.0 + square / 6.25),
        "geman_mcclure": 9.0 * square / (9.0 + square),
        "student_t": 7.0 * np.log(1.0 + square / 5.0),
    }
    found = {name: float(loss_by_name(name).rho(jnp.array(square))) for name in expected}
    assert found == pytest.approx(expected)
