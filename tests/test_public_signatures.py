"""The tests' own check of types and shapes: on where rooms call one another, off inside of them."""

import jax.numpy as jnp
import jaxtyping
import pytest
from public_signatures import shown_names

from smartview_jax import cameras, geometry
from smartview_jax.geometry import rigid_transforms


def test_a_wrong_shape_is_refused_where_a_function_is_shown():
    with pytest.raises(jaxtyping.TypeCheckError):
        geometry.se3_left_jacobian(jnp.zeros(5))


def test_a_wrong_shape_is_refused_by_a_method_of_a_class_that_is_shown():
    camera = cameras.Camera(500.0, 500.0, 320.0, 240.0, cameras.Pinhole(), (640, 480))
    with pytest.raises(jaxtyping.TypeCheckError):
        camera.project(jnp.zeros((4, 2)))


def test_what_is_not_shown_is_not_checked():
    shown = shown_names()["smartview_jax.geometry.rigid_transforms"]
    functions = {
        name: value
        for name, value in vars(rigid_transforms).items()
        if callable(value) and getattr(value, "__module__", None) == rigid_transforms.__name__
    }
    checked = {name for name, value in functions.items() if hasattr(value, "__wrapped__")}
    assert checked <= shown
    assert checked
