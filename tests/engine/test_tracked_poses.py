"""The normal equations of tracked poses, against JAX's derivatives of the same residuals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from smartview_jax import Calibration, Noise
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.dataset import PoseDataset
from smartview_jax.engine import build_problem
from smartview_jax.geometry import as_se3, host_exponentials

CAMERA = Camera(1.0, 1.0, 0.0, 0.0, Pinhole(), (1, 1))


def test_normal_equations_are_made_of_the_residuals_derivatives():
    rng = np.random.default_rng(0)
    robot, measured = host_exponentials(rng.normal(0.0, 0.7, (2, 6, 6)))
    roots = 1e-2 * rng.normal(size=(6, 6, 6))
    measured_poses = (
        PoseDataset.from_poses(robot, measured)
        .with_covariance(roots @ roots.swapaxes(1, 2) + 1e-5 * np.eye(6))
        .mask_views([4])
    )
    transforms = as_se3(host_exponentials(rng.normal(0.0, 0.5, (2, 6))))
    start = Calibration(
        CAMERA,
        as_se3(transforms.as_matrix()[0]),
        as_se3(transforms.as_matrix()[1]),
        "eye_in_hand",
        target_scale=jnp.asarray(1.3),
    )
    problem = build_problem(
        measured_poses,
        start,
        noise=Noise(0.7, 1e-2, 2e-2),
        fixed=("camera",),
        free=("target_scale",),
    ).problem
    flat, unravel = ravel_pytree(problem.zero_step())
    z = flat + 0.05 * rng.normal(size=flat.shape)

    @eqx.filter_jit
    def compared(problem, z):
        def residuals(z):
            r = ravel_pytree(problem.residuals(unravel(z)))[0]
            return r, r

        return problem.normal_equations(unravel(z)), jax.jacfwd(residuals, has_aux=True)(z)

    found, (J, r) = jax.tree.map(np.asarray, compared(problem, z))
    assert float(found.cost) == pytest.approx(0.5 * float(r @ r), rel=1e-12)
    np.testing.assert_allclose(ravel_pytree(found.gradient)[0], J.T @ r, rtol=1e-9, atol=1e-6)
    shared = found.gradient.shared.shape[0]
    whole = J.T @ J
    np.testing.assert_allclose(found.matrix.shared, whole[:shared, :shared], rtol=1e-9, atol=1e-6)
    per_view = whole[shared:, shared:]
    for view in range(6):
        # The gradient of a view that was not seen is its prior's alone.
        block = slice(6 * view, 6 * view + 6)
        np.testing.assert_allclose(
            found.matrix.per_view[view], per_view[block, block], rtol=1e-9, atol=1e-6
        )
        np.testing.assert_allclose(
            found.matrix.border[view], whole[shared:, :shared][block], rtol=1e-9, atol=1e-6
        )
