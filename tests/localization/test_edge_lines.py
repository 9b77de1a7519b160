"""Lines of edge points along predicted edges, under the transformations of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import drawn, seen_views
from jaxlie import SE3
from solids import box

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Wireframe
from smartview_jax.localization.edge_lines import edge_lines
from smartview_jax.localization.edge_lookup import EdgeLookup

MODEL = box()
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
VIEWS = seen_views(POSE[:3, :3] @ MODEL.vertices.mean(axis=0) + POSE[:3, 3])
RADIUS = jnp.asarray(4.0)


@pytest.fixture(scope="module")
def measured():
    """The function of a tangent at the true pose that returns the lines in the first view."""
    wireframe = Wireframe.of(MODEL, 256)
    lookups = EdgeLookup.of(drawn(MODEL, VIEWS, POSE, 0.05), VIEWS.camera.image_size)
    first = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[0]), lookups)
    true = jnp.asarray(VIEWS.camera_from_world[0] @ POSE)

    def lines(tangent):
        pose = true @ SE3.exp(tangent).as_matrix()
        return edge_lines(wireframe, VIEWS.camera, first, pose, RADIUS)

    return lines


def tangents(count):
    size = [3e-4, 3e-4, 3e-4, 3e-3, 3e-3, 3e-3]
    return jnp.asarray(np.random.default_rng(0).standard_normal((count, 6)) * size)


def test_a_batch_gives_what_single_poses_give(measured):
    batch = tangents(3)
    together = jax.jit(jax.vmap(measured))(batch)
    single = jax.jit(measured)
    for k in range(len(batch)):
        own, alone = jax.tree.map(lambda x, k=k: x[k], together), single(batch[k])
        for name in own._fields:
            np.testing.assert_allclose(
                getattr(own, name), getattr(alone, name), atol=1e-9, err_msg=name
            )


def test_the_derivatives_by_the_pose_are_those_of_jax(measured):
    """The numbers are measured minus predicted: they fall by what the prediction rises."""

    @jax.jit
    def numbers_and_derivatives(tangent):
        found = measured(tangent)
        return found, jax.jacfwd(lambda t: measured(t).offsets[:, 0])(tangent)

    found, derivatives = numbers_and_derivatives(jnp.zeros(6))
    used = np.asarray(found.measured)
    assert used.sum() >= 6
    scale = np.abs(np.asarray(found.by_pose[used, 0])).max()
    np.testing.assert_allclose(
        np.asarray(derivatives)[used], -np.asarray(found.by_pose[used, 0]), atol=0.02 * scale
    )


def test_gradients_are_finite(measured):
    gradient = jax.jit(jax.grad(lambda t: (measured(t).offsets ** 2).sum()))(tangents(1)[0])
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0.0


def lines_of(pictures, lone):
    """The lines in the first view of edge points at the true pose, with those that are alone."""
    lookups = EdgeLookup.of(pictures, VIEWS.camera.image_size, lone=lone)
    first = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[0]), lookups)
    wireframe, true = Wireframe.of(MODEL, 256), jnp.asarray(VIEWS.camera_from_world[0] @ POSE)
    return edge_lines(wireframe, VIEWS.camera, first, true, RADIUS)


@pytest.mark.parametrize("displaced", [0.5, 1.0])
def test_points_that_another_edge_displaces_count_where_others_are_too_few(displaced):
    """In a part of each edge, or along the whole of it, another edge puts the points 0.3 px off."""
    drawing = drawn(MODEL, VIEWS, POSE, 0.02)
    is_displaced = [(one.cells.sum(axis=1) % 80) < 80 * displaced for one in drawing]
    disturbed = [
        one._replace(pixels=one.pixels + 0.3 * np.where(off, 1.0, 0.0)[:, None] * one.normals)
        for one, off in zip(drawing, is_displaced, strict=True)
    ]
    lines = lines_of(disturbed, [~off for off in is_displaced])
    unaware = lines_of(disturbed, [np.ones_like(off) for off in is_displaced])
    used = np.asarray(lines.measured)
    np.testing.assert_array_equal(used, unaware.measured)
    off, unaware_off = (np.abs(np.asarray(one.offsets)[used, 0]) for one in (lines, unaware))
    assert np.median(unaware_off) > 0.05
    if displaced < 1.0:
        assert np.median(off) < 0.01
    else:
        np.testing.assert_array_equal(off, unaware_off)
