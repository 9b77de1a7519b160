"""A fit within a transformation is refused at once: `optimum` has the derivatives."""

import equinox as eqx
import jax
import pytest

import smartview_jax as sv


@pytest.mark.parametrize(
    ("name", "fit"),
    [
        ("calibrate", sv.calibrate),
        ("fit_joint", sv.fit_joint),
        ("fit_staged", sv.fit_staged),
        ("build_problem", sv.build_problem),
    ],
)
@pytest.mark.parametrize("transform", [jax.jit, jax.grad, jax.vmap])
def test_a_fit_within_a_transformation_names_what_serves_there(scene, name, fit, transform):
    pixels = scene.data.pixels
    start = (scene.calibration,) if name in ("fit_joint", "build_problem") else ()

    def fitted(pixels):
        return fit(eqx.tree_at(lambda data: data.pixels, scene.data, pixels), *start)

    with pytest.raises(TypeError, match=f"{name} cannot be traced .* sv.optimum"):
        transform(fitted)(pixels[None] if transform is jax.vmap else pixels)


def test_a_data_set_of_traced_arrays_is_refused(scene):
    data = scene.data
    with pytest.raises(TypeError, match="from_arrays cannot be traced"):
        jax.jit(lambda p: sv.Dataset.from_arrays(data.points, p, data.base_from_tool, (640, 480)))(
            data.pixels
        )
