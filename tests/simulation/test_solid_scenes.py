import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.simulation import look_at_from_above, paper_calibration
from smartview_jax.simulation.polyhedra import box, random_polyhedron
from smartview_jax.simulation.solid_scenes import (
    WHITE_LEVEL,
    Light,
    SolidScene,
    Surface,
    render_solids,
    scene_brightness,
)
from smartview_jax.simulation.textures import labelled, matt, speckled

pytest.importorskip("embreex")
pytest.importorskip("trimesh")

CALIBRATION = eqx.tree_at(lambda c: c.camera.lens.k1, paper_calibration(), jnp.asarray(0.7))
"""The paper's camera with the strong distortion of its Table 1: 14 px in the corners."""

POSE = CALIBRATION.command_for(look_at_from_above(np.array([0.0, 0.0, 0.01]), 0.2, 0.3, 0.7, 0.4))
SOLID = random_polyhedron(np.random.default_rng(2), 14, 0.014)
SHIFT_BITS, FINE = 8, 8


def project(points, calibration=CALIBRATION):
    pixels, valid = calibration.project(POSE, points)
    assert np.asarray(valid).all()
    return np.asarray(pixels)


def coverage_by_opencv(solid, calibration):
    """The fraction of each pixel that a convex solid covers: its projected faces, filled."""
    width, rows = calibration.camera.image_size
    fine = np.zeros((rows * FINE, width * FINE), np.uint8)
    for face in solid.faces:
        corners = solid.vertices[list(face)]
        steps = np.linspace(0.0, 1.0, 40, endpoint=False)[:, None]
        outline = [
            a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
        ]
        pixels = project(np.concatenate(outline), calibration)
        # The centre of a fine pixel is at (i + 0.5) / FINE - 0.5 of the coarse ones.
        fine_pixels = (pixels + 0.5) * FINE - 0.5
        cv2.fillPoly(
            fine, [np.rint(fine_pixels * 2**SHIFT_BITS).astype(np.int32)], 1, shift=SHIFT_BITS
        )
    return fine.reshape(rows, FINE, width, FINE).mean(axis=(1, 3))


@pytest.fixture(scope="module")
def silhouette():
    scene = SolidScene(
        (Surface(SOLID.vertices, SOLID.triangles, matt(1.0)),), (), ambient=1.0, background=0.0
    )
    return scene_brightness(CALIBRATION, POSE, scene) / WHITE_LEVEL


def test_a_silhouette_is_where_opencv_fills_the_projected_faces(silhouette):
    """Distortion is exact: an outline bent by the lens coincides to a fraction of a pixel."""
    expected = coverage_by_opencv(SOLID, CALIBRATION)
    border = int(((expected > 0.0) & (expected < 1.0)).sum())
    # OpenCV draws the outline itself too: half a fine pixel outwards along the whole border.
    excess = (silhouette - expected).sum() / border
    assert abs(excess) < 1.0 / FINE
    assert np.abs(silhouette - expected).sum() / border < 1.0 / FINE
    straight = eqx.tree_at(lambda c: c.camera.lens.k1, CALIBRATION, jnp.asarray(0.0))
    wrong = coverage_by_opencv(SOLID, straight)
    assert np.abs(silhouette - wrong).sum() / border > 0.5


def test_opencv_finds_the_corners_of_the_silhouette_at_the_projected_vertices(silhouette):
    hull = cv2.convexHull(project(SOLID.vertices).astype(np.float32))[:, 0]
    picture = cv2.GaussianBlur((200.0 * silhouette).astype(np.float32), (0, 0), 0.7)
    # Only where the outline turns clearly, a corner is well defined.
    before, after = np.roll(hull, 1, 0) - hull, np.roll(hull, -1, 0) - hull
    cosine = (
        (before * after).sum(1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    )
    corners = hull[cosine > -0.85]
    assert len(corners) >= 4
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    actual = cv2.cornerSubPix(picture, corners[:, None].copy(), (6, 6), (-1, -1), stop)[:, 0]
    # Blur rounds a corner off: OpenCV finds it up to 0.2 px inside.
    assert np.linalg.norm(actual - corners, axis=1).max() < 0.25


def test_a_shadow_falls_where_the_light_throws_the_corners():
    plate, light = box(0.012, 0.009, 0.002), np.array([0.4, -0.3, 1.0])
    plate = plate._replace(vertices=plate.vertices + np.array([0.002, 0.001, 0.012]))
    scene = SolidScene(
        (Surface.of_plane(0.2, matt(0.5)), Surface.of_polyhedron(plate, matt(0.9))),
        (Light(tuple(light), 0.5),),
        ambient=0.3,
    )
    picture = scene_brightness(CALIBRATION, POSE, scene)
    # A point p throws its shadow to p - l p_z / l_z of the plane z = 0.
    shadow = plate.vertices - light * (plate.vertices[:, 2:] / light[2])
    outline = cv2.convexHull(shadow[:, :2].astype(np.float32))[:, 0].astype(float)
    middle = outline.mean(axis=0)
    cosine = light[2] / np.linalg.norm(light)
    lit, dark = WHITE_LEVEL * 0.5 * (0.3 + 0.5 * cosine), WHITE_LEVEL * 0.5 * 0.3
    for scale, level in ((0.97, dark), (1.03, lit)):
        points = np.column_stack([middle + scale * (outline - middle), np.zeros(len(outline))])
        u, v = np.rint(project(points)).astype(int).T
        seen = picture[v, u]
        # Some of the points are behind the plate itself.
        top = WHITE_LEVEL * 0.9 * (0.3 + 0.5 * cosine)
        free = ~np.isclose(seen, top) & (seen < lit + 1.0)
        assert free.sum() >= 3
        np.testing.assert_allclose(seen[free], level, atol=1e-6)


def test_the_nearer_solid_hides_the_farther_one():
    low, high = box(0.02, 0.02, 0.005), box(0.008, 0.008, 0.02)
    surfaces = [Surface.of_polyhedron(one, matt(level)) for one, level in ((low, 0.2), (high, 0.8))]
    pictures = [
        scene_brightness(CALIBRATION, POSE, SolidScene(tuple(order), (), ambient=1.0))
        for order in (surfaces, surfaces[::-1])
    ]
    np.testing.assert_array_equal(*pictures)
    u, v = np.rint(project(np.array([[0.0, 0.0, 0.02]]))).astype(int)[0]
    assert pictures[0][v, u] == pytest.approx(0.8 * WHITE_LEVEL)


def test_textures_are_albedos_and_seeds_repeat_them():
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (2000, 3))
    texture = labelled(speckled(0.5, 0.2, 0.002, seed=1), 10, 0.02, 0.05, seed=2)
    albedo = texture(points)
    assert ((albedo >= 0.0) & (albedo <= 1.0)).all()
    assert np.ptp(albedo) > 0.3
    again = labelled(speckled(0.5, 0.2, 0.002, seed=1), 10, 0.02, 0.05, seed=2)
    np.testing.assert_array_equal(albedo, again(points))
    # It is smooth: a step of a hundredth of the grain changes little.
    near = speckled(0.5, 0.2, 0.002)(points) - speckled(0.5, 0.2, 0.002)(points + 2e-5)
    assert np.abs(near).max() < 0.02


def test_a_picture_is_bytes_of_the_cameras_size_and_noise_has_a_seed(small_truth):
    scene = SolidScene((Surface.of_polyhedron(SOLID, matt(0.6)),))
    first, same, other = (
        render_solids(small_truth, POSE, scene, seed=seed, samples=4) for seed in (0, 0, 1)
    )
    assert first.dtype == np.uint8
    assert first.shape == (240, 320)
    np.testing.assert_array_equal(first, same)
    assert (first != other).any()


def test_wrong_scenes_are_refused():
    with pytest.raises(ValueError, match="at least one surface"):
        scene_brightness(CALIBRATION, POSE, SolidScene(()))
    poses = CALIBRATION.command_for(sv.five_viewpoints(np.zeros(3), 0.2))
    with pytest.raises(ValueError, match="expected one pose"):
        render_solids(CALIBRATION, poses, SolidScene((Surface.of_plane(0.1, matt(0.5)),)))


def test_coarse_to_fine_gives_the_same_edges_for_fewer_rays(small_truth):
    scene = SolidScene(
        (
            Surface.of_plane(0.3, speckled(0.5, 0.05, 0.01)),
            Surface.of_polyhedron(SOLID, matt(0.8)),
        )
    )
    full, coarse = (
        scene_brightness(small_truth, POSE, scene, samples=8, stride=stride) for stride in (1, 3)
    )
    # Contours are hit by the same rays; between them nothing differs by what counts as smooth.
    strong = cv2.dilate(full, np.ones((3, 3))) - cv2.erode(full, np.ones((3, 3))) > 8.0
    assert strong.sum() > 400
    assert np.abs(full - coarse)[strong].max() < 1e-9
    assert np.abs(full - coarse).max() < 4.0
    assert np.abs(full - coarse).mean() < 0.05
