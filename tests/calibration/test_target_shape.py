import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import Calibration
from smartview_jax.calibration import SHAPE_NAMES, TargetShape, flat_shape
from smartview_jax.dataset import chain_residuals
from smartview_jax.simulation import paper_calibration, random_scene

COEFFICIENTS = np.array([2e-4, -1e-4, 3e-4, 5e-5, -4e-5])


def board(columns=6, rows=4, spacing=0.01, z=0.0):
    y, x = np.indices((rows, columns)).reshape(2, -1)
    return np.stack([spacing * x, spacing * y, np.full(x.size, z)], axis=1)


def everything(points):
    return points[None], np.ones((1, len(points)), dtype=bool)


@pytest.fixture(scope="module")
def bowed():
    return flat_shape(*everything(board())).with_coefficients(COEFFICIENTS)


def test_points_are_displaced_by_the_formula(bowed):
    """By hand: a board of 50 x 30 mm about (25, 15) mm."""
    points = board()
    x, y = ((points[:, :2] - [0.025, 0.015]) / 0.025).T
    a, b, c, d, e = COEFFICIENTS
    height = a * x * x + b * x * y + c * y * y
    expected = points + np.stack([d * x + e * y, -d * y + e * x, height - height.mean()], axis=1)
    np.testing.assert_allclose(bowed.displaced(jnp.asarray(points)), expected, atol=1e-12)


def test_a_point_far_from_the_target_is_not_moved_by_a_parabola(bowed):
    far = jnp.array([[1.0, -1.0, 0.0]])
    assert np.abs(bowed.displaced(far) - far).max() < 1e-3


def test_derivatives_and_batches(bowed):
    points = jnp.asarray(board())
    by_coefficient = jax.jacfwd(
        lambda c: TargetShape(bowed.centre, bowed.half_size, bowed.mean_products, c).displaced(
            points
        )
    )(bowed.coefficients)
    np.testing.assert_allclose(
        jnp.moveaxis(by_coefficient, -1, -2), bowed.directions(points), atol=1e-12
    )
    one_by_one = jax.jit(jax.vmap(bowed.displaced))(points)
    np.testing.assert_allclose(one_by_one, bowed.displaced(points), atol=1e-15)


@pytest.mark.parametrize(
    ("points", "is_flat"),
    [
        (board(), True),
        (np.concatenate([board(), board(z=0.02)]), True),
        (np.random.default_rng(0).normal(size=(20, 3)), False),
        (board()[:3], False),
        (np.zeros((6, 3)), False),
    ],
)
def test_only_flat_targets_have_a_shape(points, is_flat):
    """A board at two heights is flat; a cloud, a triangle and a single point are not."""
    shape = flat_shape(*everything(points))
    assert (shape is not None) == is_flat
    if shape is not None:
        np.testing.assert_array_equal(shape.displaced(jnp.asarray(points)), points)


def test_a_calibration_predicts_the_target_as_it_is(bowed, tmp_path):
    calibration = dataclasses.replace(paper_calibration(), target_shape=bowed)
    data = random_scene(0, 3, board(), pixel_noise=0.0).data
    stated, _ = paper_calibration().project(data.base_from_tool, bowed.displaced(data.points))
    pixels, _ = calibration.project(data.base_from_tool, data.points)
    np.testing.assert_allclose(pixels, stated, atol=1e-9)
    np.testing.assert_allclose(
        chain_residuals(calibration, data.observations),
        np.where(data.visible[..., None], data.pixels - pixels, 0.0),
        atol=1e-9,
    )

    calibration.save(tmp_path / "calibration.yaml")
    loaded = Calibration.load(tmp_path / "calibration.yaml")
    again, _ = loaded.project(SE3(data.base_from_tool.wxyz_xyz), data.points)
    np.testing.assert_allclose(again, pixels, atol=1e-9)
    text = (tmp_path / "calibration.yaml").read_text()
    assert all(name in text for name in SHAPE_NAMES)
    (tmp_path / "wrong.yaml").write_text(text.replace("half_size: 0.02", "half_size: -0.02"))
    with pytest.raises(ValueError, match=r"target_shape\.half_size: .*half of a target's longer"):
        Calibration.load(tmp_path / "wrong.yaml")
