"""Lines of edge points along predicted edges, under the transformations of JAX."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import drawn
from jaxlie import SE3
from placed_box import MODEL, POSE, projected

from smartview_jax.features.edge_points import find_edge_points
from smartview_jax.features.gradient import Gradient
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization.edges.edge_lines import edge_lines
from smartview_jax.localization.edges.edge_lookup import EdgeLookup
from smartview_jax.localization.refining.refinement import measured_lines

RADIUS = 4.0


def tangents(count):
    size = [3e-4, 3e-4, 3e-4, 3e-3, 3e-3, 3e-3]
    return np.random.default_rng(0).standard_normal((count, 6)) * size


def test_a_batch_and_its_gradients_are_those_of_single_poses(views, wireframe):
    """The numbers are measured minus predicted: they fall by what the prediction rises."""
    lookup = EdgeLookup.of(drawn(MODEL, views, POSE, 0.05), views.camera.image_size)
    # By NumPy: JAX would compile two programs for each kind of array.
    first = jax.tree.map(lambda x: jax.device_put(np.asarray(x)[0]), lookup)
    true = jnp.asarray(views.camera_from_world[0] @ POSE)
    weights = np.random.default_rng(1).standard_normal(wireframe.edges.shape)

    def weighted(tangent):
        pose = true @ SE3.exp(tangent).as_matrix()
        lines = edge_lines(wireframe, views.camera, first, pose, jnp.asarray(RADIUS))
        return (lines.offsets * weights).sum(), lines

    batch = np.concatenate([np.zeros((1, 6)), tangents(2)])
    program = jax.jit(jax.vmap(jax.value_and_grad(weighted, has_aux=True)))
    (_, together), gradients = program(batch)
    gradients = np.asarray(gradients)
    for k, tangent in enumerate(batch):
        alone = measured_lines(wireframe, views, lookup, POSE @ host_exponentials(tangent), RADIUS)
        # A box has no outline that depends on the viewpoint, nor on the light.
        for name in set(alone._fields) - {"outline", "by_light"}:
            own, single = np.asarray(getattr(together, name))[k], getattr(alone, name)[0]
            np.testing.assert_allclose(own, single, atol=1e-9, err_msg=name)
        assert alone.measured[0].sum() >= 6
        expected = -np.einsum("ek,eki->i", weights, alone.by_pose[0])
        # The noise of the points changes which of them count, and with what weight.
        scale = np.linalg.norm(weights[..., None] * alone.by_pose[0], axis=(0, 1))
        np.testing.assert_allclose(gradients[k] / scale, expected / scale, atol=0.05)


def test_lines_are_as_exact_as_their_points_are_independent(views, wireframe):
    """Twice the length over which points err alike halves their number."""
    pictures, size = drawn(MODEL, views, POSE, 0.2), views.camera.image_size
    lengths = [[length] * len(pictures) for length in (5.0, 10.0)]
    fine, rough = (
        measured_lines(
            wireframe,
            views,
            EdgeLookup.of(pictures, size, correlated_lengths=each),
            POSE,
            RADIUS,
        )
        for each in lengths
    )
    long = fine.measured & (fine.found_px > 80.0)
    assert long.sum() > 6
    # n points and a line's two numbers: s^2 n / (n - 2) is the variance of a point.
    n = fine.found_px[long] / 5.0
    expected = (n - 2.0) / (0.5 * n - 2.0)
    actual = rough.variances[long, 0] / fine.variances[long, 0]
    # A line along a row or column has a further error (`grid_variance`).
    np.testing.assert_allclose(actual, expected, rtol=0.01)


@pytest.mark.parametrize("displaced", [0.5, 1.0])
def test_points_that_another_edge_displaces_count_where_others_are_too_few(
    views, wireframe, displaced
):
    """In a part of each edge, or along the whole of it, another edge puts the points 0.3 px off."""
    drawing = drawn(MODEL, views, POSE, 0.02)
    is_displaced = [(one.cells.sum(axis=1) % 80) < 80 * displaced for one in drawing]
    disturbed = [
        one._replace(pixels=one.pixels + 0.3 * np.where(off, 1.0, 0.0)[:, None] * one.normals)
        for one, off in zip(drawing, is_displaced, strict=True)
    ]
    size = views.camera.image_size
    lines, unaware = (
        measured_lines(wireframe, views, EdgeLookup.of(disturbed, size, lone=lone), POSE, RADIUS)
        for lone in ([~off for off in is_displaced], [np.ones_like(off) for off in is_displaced])
    )
    used = lines.measured
    np.testing.assert_array_equal(used, unaware.measured)
    off, unaware_off = (np.abs(one.offsets[used][:, 0]) for one in (lines, unaware))
    assert np.median(unaware_off) > 0.05
    if displaced < 1.0:
        assert np.median(off) < 0.01
    else:
        np.testing.assert_array_equal(off, unaware_off)


def pictures_of_faces(views, supersampling=8):
    """The box in every view, its faces drawn by OpenCV in grey levels of their own."""
    pictures = []
    corners = projected(views, MODEL.vertices @ POSE[:3, :3].T + POSE[:3, 3])
    for camera, in_view in zip(views.cameras, corners, strict=True):
        width, rows = camera.image_size
        large = np.full((supersampling * rows, supersampling * width), 40, np.uint8)
        for k, face in enumerate(MODEL.faces):
            polygon = in_view[list(face.loop)]
            around = np.roll(polygon, -1, axis=0)
            # Outward faces run anticlockwise from outside, where v points down.
            if (polygon[:, 0] * around[:, 1] - polygon[:, 1] * around[:, 0]).sum() < 0.0:
                # Pixel 0 reaches from -0.5 to 0.5.
                fixed = np.rint(16 * (supersampling * (polygon + 0.5) - 0.5)).astype(np.int32)
                cv2.fillPoly(large, [fixed], 80 + 25 * k, shift=4)
        picture = cv2.resize(large, (width, rows), interpolation=cv2.INTER_AREA)
        pictures.append(picture.astype(float))
    return pictures


def test_a_small_picture_shows_as_much_of_an_object_as_a_large_one(views, wireframe):
    """The blur rounds the corners; in small pictures they are a tenth of the edges and more."""
    shares = []
    for scale in (1.0, 0.25):
        width, rows = (round(scale * x) for x in views.camera.image_size)
        seen = views._replace(camera=views.camera.resized((width, rows)))
        points = [find_edge_points(Gradient.of(picture)) for picture in pictures_of_faces(seen)]
        lines = measured_lines(wireframe, seen, EdgeLookup.of(points, (width, rows)), POSE, 2.0)
        shares.append(lines.explained_px.sum() / lines.visible_px.sum())
    assert shares[0] > 0.98
    assert shares[1] > shares[0] - 0.02
