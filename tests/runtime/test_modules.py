"""Modules whose fields are changed at once equal the results of `dataclasses.replace`."""

import dataclasses
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax.engine import BlockArrow
from smartview_jax.runtime.modules import HostModule, with_fields


class Pair(eqx.Module):
    first: jax.Array
    second: jax.Array
    name: str = eqx.field(static=True, default="pair")

    def total(self):
        return self.first.sum() + self.second.sum()


def test_fields_change_as_by_replace_and_the_module_itself_stays():
    pair = Pair(jnp.arange(3.0), jnp.ones(2))
    changed, expected = (
        change(pair, second=jnp.zeros(4), name="other")
        for change in (with_fields, dataclasses.replace)
    )
    assert eqx.tree_equal(changed, expected)
    assert jax.tree.structure(changed) == jax.tree.structure(expected)
    assert changed.total() == expected.total() == 3.0
    assert pair.name == "pair"
    assert pair.second.shape == (2,)
    # Inside a program as well.
    derivative = jax.grad(lambda x: with_fields(pair, first=x).total())(jnp.ones(3))
    np.testing.assert_array_equal(derivative, np.ones(3))


def test_a_linear_operator_keeps_its_structure():
    arrow = BlockArrow(jnp.eye(2), jnp.zeros((3, 6, 2)), jnp.zeros((3, 6, 6)))
    blocks = {"shared": jnp.eye(1), "border": jnp.zeros((3, 6, 1))}
    assert eqx.tree_equal(with_fields(arrow, **blocks), dataclasses.replace(arrow, **blocks))


def test_a_field_that_does_not_exist_is_named():
    with pytest.raises(TypeError, match="Pair has no field third"):
        with_fields(Pair(jnp.ones(1), jnp.ones(1)), third=jnp.ones(1))


class Scaled(HostModule):
    factor: jax.Array

    def times(self, x):
        return self.factor * x


def test_methods_of_a_host_module_are_plain_and_the_module_is_an_argument():
    scaled = Scaled(jnp.array(3.0))
    assert isinstance(scaled.times, types.MethodType)
    assert eqx.filter_jit(lambda module, x: module.times(x))(scaled, 2.0) == 6.0
    assert jax.tree.leaves(scaled) == [scaled.factor]
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(scaled, "factor", jnp.array(4.0))  # noqa: B010 - a type checker refuses the other
