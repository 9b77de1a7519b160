import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from smartview_jax.engine.parameters import Step
from smartview_jax.engine.schur import BlockArrow, SchurCholesky, eliminate, inverse_cholesky_factor


def arrow(views, shared=7, seed=0):
    """What a least-squares problem of this shape gives."""
    rng = np.random.default_rng(seed)
    blocks = [rng.normal(size=(20, shared + 6)) for _ in range(max(views, 1))]
    grams = np.stack([J.T @ J for J in blocks])
    own = grams[:views, shared:, shared:]
    return BlockArrow(
        jnp.asarray(grams[:, :shared, :shared].sum(axis=0)),
        jnp.asarray(grams[:views, shared:, :shared]),
        jnp.asarray(own),
    )


def vector(views, shared=7):
    rng = np.random.default_rng(1)
    return Step(jnp.asarray(rng.normal(size=shared)), jnp.asarray(rng.normal(size=(views, 6))))


@jax.jit
def solved(operator, damping, right):
    damped = operator + damping * lx.IdentityLinearOperator(operator.in_structure())
    tagged = lx.TaggedLinearOperator(damped, lx.positive_semidefinite_tag)
    return [lx.linear_solve(form, right, SchurCholesky()).value for form in (damped, tagged)]


@pytest.mark.parametrize("views", [0, 1, 5])
def test_the_block_solver_solves_what_a_dense_solver_solves(views):
    operator, right = arrow(views), vector(views)
    matrix = np.asarray(operator.as_matrix())
    for damping in (0.0, 1e-6, 1.0, 1e6):
        wanted = np.linalg.solve(matrix + damping * np.eye(7 + 6 * views), ravel_pytree(right)[0])
        for found in solved(operator, jnp.asarray(damping), right):
            np.testing.assert_allclose(ravel_pytree(found)[0], wanted, rtol=1e-10, atol=1e-12)


def test_products_and_the_dense_matrix_agree():
    operator, x = arrow(4), vector(4)
    dense = operator.as_matrix()
    np.testing.assert_allclose(dense, dense.T)
    np.testing.assert_allclose(
        ravel_pytree(operator.mv(x))[0], dense @ ravel_pytree(x)[0], rtol=1e-12
    )
    np.testing.assert_allclose(ravel_pytree(operator.diagonal())[0], np.diag(dense))
    units = ravel_pytree(x)[0]
    np.testing.assert_allclose(
        operator.scaled(x).as_matrix(), dense * np.outer(units, units), rtol=1e-12
    )


def test_the_reduced_matrix_holds_the_marginal_covariance():
    operator = arrow(3)
    covariance = np.linalg.inv(operator.as_matrix())[:7, :7]
    np.testing.assert_allclose(
        np.linalg.inv(eliminate(operator).schur_complement), covariance, rtol=1e-9
    )


def test_batches_of_systems_by_vmap():
    many = jax.tree.map(lambda *x: jnp.stack(x), *(arrow(3, seed=k) for k in range(4)))
    right = vector(3)
    together = jax.vmap(lambda a: lx.linear_solve(a, right, SchurCholesky()).value)(many)
    alone = lx.linear_solve(arrow(3, seed=2), right, SchurCholesky()).value
    np.testing.assert_allclose(together.per_view[2], alone.per_view, rtol=1e-10)


def test_other_operators_are_refused():
    with pytest.raises(ValueError, match="solves a BlockArrow, damped or not; found Diagonal"):
        SchurCholesky().init(lx.DiagonalLinearOperator(jnp.ones(3)), {})


@pytest.mark.parametrize("count", [1, 3, 40])
def test_the_inverse_factors_of_few_and_of_many_blocks_are_those_of_each(count):
    """Few are factorised one by one and many at once; units of metres and radians differ much."""
    rng = np.random.default_rng(count)
    factors = rng.normal(size=(count, 6, 9))
    units = np.repeat([1e8, 1.0], 3)
    blocks = (factors @ factors.swapaxes(1, 2)) * np.outer(units, units)
    expected = np.linalg.inv(np.linalg.cholesky(blocks)) * units
    result = inverse_cholesky_factor(blocks) * units
    np.testing.assert_allclose(result, expected, rtol=1e-9, atol=1e-12)
    blocks[-1] -= 2.0 * np.diag(np.diagonal(blocks[-1]))
    assert np.isnan(inverse_cholesky_factor(blocks)[-1]).all()


@pytest.mark.parametrize("count", [3, 40])
def test_a_matrix_without_a_factor_does_not_spoil_the_others(count):
    roots = np.random.default_rng(1).normal(size=(2, count, 6, 9))
    matrices = roots @ roots.swapaxes(-1, -2)
    factors = np.linalg.inv(np.linalg.cholesky(matrices))
    # A positive diagonal, and negative eigenvalues.
    matrices[1, 0] = 2.0 - np.eye(6)
    found = inverse_cholesky_factor(matrices)
    factors[1, 0] = np.nan
    np.testing.assert_allclose(found, factors, rtol=1e-9, atol=1e-12)
