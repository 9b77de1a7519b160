import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import quaternion_exponentials, se3_left_jacobian

RNG = np.random.default_rng(0)

# One program for all cases; without `jit` every operation is one.
left_jacobian = jax.jit(se3_left_jacobian)


@jax.jit
def exp_derivative(tangent):
    """The derivative of exp, by the twist after it."""
    back = SE3.exp(tangent).inverse()
    return jax.jacfwd(lambda d: (SE3.exp(tangent + d) @ back).log())(jnp.zeros(6))


@pytest.mark.parametrize("size", [1e-3, 0.1, 1.0, 2.5])
def test_exp_jacobian_is_the_derivative_of_exp(size):
    tangent = size * RNG.normal(size=6) / np.sqrt(6)
    actual = left_jacobian(np.tile(tangent, (2, 1)))[0]
    np.testing.assert_allclose(actual, exp_derivative(tangent), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.4999, 0.5001, 3.0, 7.0])
def test_exp_jacobian_is_the_series_of_the_commutator(angle):
    """The integral of exp(s ad) over s from 0 to 1 is a block of a matrix exponential."""
    axis = np.array([0.6, -0.48, 0.64])
    tangents = np.stack([np.r_[RNG.normal(size=3), sign * angle * axis] for sign in (1.0, -1.0)])
    for tangent, actual in zip(tangents, left_jacobian(tangents), strict=True):
        v, w = (np.cross(part, np.eye(3), axisb=0).T for part in np.split(tangent, 2))
        ad = np.block([[w, v], [np.zeros((3, 3)), w]])
        block = np.block([[ad, np.eye(6)], [np.zeros((6, 12))]])
        np.testing.assert_allclose(actual, expm(block)[:6, 6:], atol=1e-13)


def test_quaternions_of_rotation_vectors_are_scipys():
    angles = np.array([0.0, 1e-9, 1e-3, 0.9999, 1.0001, 3.0, 7.0])
    vectors = angles[:, None] * np.array([0.6, -0.48, 0.64])
    actual = np.asarray(jax.jit(quaternion_exponentials)(vectors))
    x, y, z, w = Rotation.from_rotvec(vectors).as_quat().T
    expected = np.stack([w, x, y, z], axis=1)
    # A quaternion and its negative are one rotation.
    expected *= np.sign(np.sum(actual * expected, axis=1, keepdims=True))
    np.testing.assert_allclose(actual, expected, atol=1e-15)


def test_functions_of_the_angle_are_differentiable_at_zero():
    """A fit begins at corrections of zero, where the quotients are not finite."""
    slopes = jax.jit(jax.jacfwd(se3_left_jacobian))(jnp.zeros(6))
    # J = I + ad / 2 + ..., and ad is linear in the tangent.
    step = 1e-6 * np.eye(6)
    ahead, behind = left_jacobian(step), left_jacobian(-step)
    np.testing.assert_allclose(
        np.moveaxis(np.asarray(slopes), 2, 0), (ahead - behind) / 2e-6, atol=1e-9
    )
