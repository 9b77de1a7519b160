"""A fit within a transformation is refused at once; its derivatives have their own function."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.simulation import paper_points, random_scene

SCENE = random_scene(3, 5, paper_points((0.0, 0.02))[::8], pixel_noise=0.1)


def with_pixels(pixels):
    return eqx.tree_at(lambda data: data.pixels, SCENE.data, pixels)


@pytest.mark.parametrize(
    ("name", "fit"),
    [
        ("calibrate", sv.calibrate),
        ("fit_joint", lambda data: sv.fit_joint(data, SCENE.calibration)),
        ("fit_staged", sv.fit_staged),
        ("build_problem", lambda data: sv.build_problem(data, SCENE.calibration)),
    ],
)
@pytest.mark.parametrize("transform", [jax.jit, jax.grad, jax.vmap])
def test_a_fit_within_a_transformation_names_what_serves_there(name, fit, transform):
    pixels = SCENE.data.pixels
    with pytest.raises(TypeError, match=f"{name} cannot be traced .* sv.optimum"):
        transform(lambda p: fit(with_pixels(p)))(pixels[None] if transform is jax.vmap else pixels)


def test_a_data_set_of_traced_arrays_is_refused():
    data = SCENE.data
    with pytest.raises(TypeError, match="from_arrays cannot be traced"):
        jax.jit(lambda p: sv.Dataset.from_arrays(data.points, p, data.base_from_tool, (640, 480)))(
            data.pixels
        )


def test_the_optimum_differentiates_the_fit():
    """Against differences of whole fits."""
    data, start = SCENE.data, SCENE.calibration
    problem = sv.build_problem(data, start).problem
    direction = np.random.default_rng(0).normal(size=data.pixels.shape)
    direction = jnp.where(data.visible[..., None], jnp.asarray(direction), 0.0)

    def hand_eye(step):
        changed = eqx.tree_at(
            lambda p: p.observations.pixels, problem, data.pixels + step * direction
        )
        calibration, _ = changed.calibration(sv.optimum(changed))
        return calibration.camera_from_tool.translation()

    derivative = jax.jacfwd(hand_eye)(0.0)
    h = 1e-3
    moved = [
        sv.fit_joint(
            dataclasses.replace(data, pixels=data.pixels + k * h * direction),
            start,
            noise="trusted",
            field=None,
            gross_errors="keep",
        ).calibration.camera_from_tool.translation()
        for k in (1, -1)
    ]
    expected = (moved[0] - moved[1]) / (2 * h)
    np.testing.assert_allclose(derivative, expected, rtol=1e-4, atol=1e-3 * np.abs(expected).max())
