"""Round parts: arcs of their rims, outlines of their sides, and poses from ellipses."""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import pinhole, predicted
from round_scene import POSES, SIDES, SIZES, models, part, pictures
from scipy.spatial.transform import Rotation
from seen_scene import CALIBRATION, base_from_tool
from solids import box, drilled

from smartview_jax.features import picture_evidence
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Wireframe, find_hypotheses, localize, pose_jacobians
from smartview_jax.localization.edges.curves import Curves, is_round
from smartview_jax.localization.edges.outlines import smooth_edges, with_outline
from smartview_jax.localization.search.ellipse_poses import circle_poses, circles_of
from smartview_jax.modeling import SeenViews
from smartview_jax.runtime.compilation import compiled

RADIUS = SIZES["pipe"][0]


def test_a_washer_and_a_pipe_are_found():
    """Rendered with four times as many sides as the models have."""
    views = SeenViews.of(CALIBRATION, base_from_tool())
    evidence = [picture_evidence(*view) for view in zip(pictures(), views.cameras, strict=True)]
    searched = find_hypotheses(evidence, views, models())
    # As the search does, but with few of each: the true poses are among the first.
    few = [h for k in (0, 1) for h in [h for h in searched if h.model == k][:4]]
    localizations = localize(evidence, base_from_tool(), CALIBRATION, models(), hypotheses=few)
    assert sorted(obj.model_index for obj in localizations.accepted) == [0, 1]
    for obj in localizations.accepted:
        truth, middle = POSES[obj.model_index], obj.model.vertices.mean(axis=0)
        estimate = obj.world_from_object
        shift = (estimate - truth)[:3] @ np.append(middle, 1.0)
        assert np.linalg.norm(shift) < 5e-4
        assert abs(estimate[:3, 2] @ truth[:3, 2]) > np.cos(np.deg2rad(0.5))
        # No picture shows the turn about the axis: any within a step is equally probable.
        step = 2.0 * np.pi / SIDES
        np.testing.assert_allclose(obj.covariance[5, 5], step**2 / 12.0, rtol=0.02)


def tangent_lines(centre):
    """Both lines in which planes through a point touch the pipe: unit normals, and their points."""
    distance, towards = np.hypot(*centre[:2]), np.arctan2(centre[1], centre[0])
    for side in (-1.0, 1.0):
        angle = towards + side * np.arccos(RADIUS / distance)
        normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        yield normal, RADIUS * normal + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, RADIUS]])


def distance_from_line(pixels, ends):
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return (pixels - ends[0]) @ np.array([-along[1], along[0]])


_project = compiled(lambda camera, points: camera.project(points)[0])
_outlined = compiled(with_outline)
_jacobians = compiled(pose_jacobians)


def projected(camera, pose, points):
    moved = points @ pose[:3, :3].T + pose[:3, 3]
    return np.asarray(_project(camera, jnp.asarray(moved)))


def test_the_outline_of_a_cylinder_is_where_planes_through_the_camera_touch_it():
    wireframe, camera, rng = Wireframe.of(models()[1], 256), pinhole(), np.random.default_rng(5)
    for _ in range(4):
        pose = np.eye(4)
        tilt = Rotation.from_euler("zx", [rng.uniform(0, 6), 2.0 + rng.uniform(-0.4, 0.4)])
        pose[:3, :3], pose[:3, 3] = tilt.as_matrix(), [*rng.uniform(-0.01, 0.01, 2), 0.35]
        centre = -pose[:3, :3].T @ pose[:3, 3]
        view = predicted(wireframe, camera, jnp.asarray(pose))
        seen = _outlined(wireframe, jnp.asarray(centre))
        is_outline = np.asarray(seen.sample_chains < 0) & np.asarray(view.sample_visible)
        pixels, points = np.asarray(view.samples)[is_outline], np.asarray(seen.samples)[is_outline]
        J = np.asarray(_jacobians(seen.samples, camera, jnp.asarray(pose))[1])[is_outline]
        total = 0
        for normal, line in tangent_lines(centre):
            own = points @ normal > 0.99 * RADIUS
            total += own.sum()
            ends = projected(camera, pose, line)
            off = distance_from_line(pixels[own], ends)
            assert np.abs(off).max() < 0.01
            # The points of the outline slide over the surface with the pose, but along the line.
            tangent = 1e-5 * rng.standard_normal(6) * [0.1, 0.1, 0.1, 1.0, 1.0, 1.0]
            moved = pose @ host_exponentials(tangent)
            ((_, line_then),) = [
                pair
                for pair in tangent_lines(-moved[:3, :3].T @ moved[:3, 3])
                if pair[0] @ normal > 0.99
            ]
            then = distance_from_line(pixels[own], projected(camera, moved, line_then))
            along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
            change = J[own] @ tangent @ np.array([-along[1], along[0]])
            np.testing.assert_allclose(off - then, change, atol=2e-5)
        # Both, and nothing of the hole.
        assert total == is_outline.sum() > 20


def test_a_circle_bends_in_the_picture_by_one_over_its_radius():
    """A washer that faces the camera: its top rim is a circle of f r / z px."""
    wireframe, pose = Wireframe.of(models()[0], 256), np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.4
    view = predicted(wireframe, pinhole(1500.0, 1500.0), jnp.asarray(pose))
    radius, height = SIZES["washer"]
    on_top = np.asarray(wireframe.samples)[:, 2] > 0.5 * radius * height
    size = np.linalg.norm(np.asarray(wireframe.samples)[:, :2], axis=1)
    is_rim = on_top & (np.abs(size - radius) < 1e-5) & np.asarray(view.sample_visible)
    assert is_rim.sum() > 20
    expected = 1500.0 * radius / (0.4 - radius * height)
    gap = np.asarray(view.samples)[is_rim] - [325.0, 236.0]
    # Towards the centre, and nothing along the rim.
    np.testing.assert_allclose(
        np.asarray(view.bends)[is_rim], -gap / expected**2, atol=0.02 / expected
    )
    assert predicted(Wireframe.of(box(), 256), pinhole(), jnp.asarray(pose)).bends is None


def test_rims_are_measured_in_arcs_and_straight_edges_as_they_are():
    model = part("washer")
    curves = Curves.of(model)
    assert len(curves.lengths) == 4 * 8
    assert len(np.unique(curves.chain)) == 4
    np.testing.assert_array_equal(Curves.of(box()).curve, np.arange(12))
    wireframe = Wireframe.of(model)
    is_rim = np.asarray(wireframe.sample_chains) >= 0
    points, tangents = (
        np.asarray(each)[is_rim] for each in (wireframe.samples, wireframe.sample_tangents)
    )
    radii = np.linalg.norm(points[:, :2], axis=1)
    radius = SIZES["washer"][0]
    gap = np.minimum(abs(radii - radius), abs(radii - 0.5 * radius))
    # On the circle, not on its chords, which are 190 um off.
    assert gap.max() < 2e-6
    assert np.abs((points[:, :2] * tangents[:, :2]).sum(axis=1) / radii).max() < 2e-3
    # The hollow side of the wall never is an outline.
    assert len(smooth_edges(model)[0]) == SIDES
    assert is_round(model)
    assert not any(map(is_round, (box(), drilled(6, 32))))
    # A hexagonal nut: its hole is round.
    assert len(circles_of(drilled(6, 32))) == 2


@pytest.mark.parametrize("turn", [[0.0, 0.7, 0.0], [1.1, 0.2, 0.4]])
def test_a_circle_is_at_one_of_two_poses(turn):
    """The conic is OpenCV's fit to projected points."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), [0.03, -0.02, 0.4]
    angles, f = np.linspace(0.0, 2.0 * np.pi, 400), 1000.0
    rim = 0.02 * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    x, y, z = (rim @ pose[:3, :3].T + pose[:3, 3]).T
    seen = f * np.column_stack([x / z, y / z])
    middle, axes, degrees = cv2.fitEllipseDirect(seen.astype(np.float32))
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    to_unit = np.eye(3)
    to_unit[:2, :2] = np.diag(2.0 / np.array(axes)) @ [[c, s], [-s, c]]
    to_unit[:2, 2] = -to_unit[:2, :2] @ middle
    poses = circle_poses(to_unit.T @ np.diag([1.0, 1.0, -1.0]) @ to_unit, f, 0.02)
    assert len(poses) == 2
    gaps = [np.linalg.norm(circle.centre - pose[:3, 3]) for circle in poses]
    best = poses[int(np.argmin(gaps))]
    assert min(gaps) < 1e-4
    assert abs(best.normal @ pose[:3, 2]) > np.cos(np.deg2rad(0.3))


def test_a_model_without_its_symmetry_is_as_round():
    """What is known of the axis does not decide how it is searched for."""
    assert is_round(dataclasses.replace(models()[0], symmetry=None))
