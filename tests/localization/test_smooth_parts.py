"""Parts without any edge: only their outline shows. An ellipsoid's is known in closed form."""

import numpy as np
import pytest
import trimesh
from drawn_edges import IMAGE_SIZE, pinhole
from scipy.spatial.transform import Rotation
from scipy.special import gamma

import smartview_jax as sv
from smartview_jax.features import EdgePoints, IdealPlane
from smartview_jax.geometry import host_exponentials, host_logarithms
from smartview_jax.io.meshes import model_from_triangles
from smartview_jax.localization import EdgeLookup, Wireframe, refine_pose
from smartview_jax.localization.edges.edge_line_fit import EDGE_BLUR
from smartview_jax.localization.edges.outlines import OutlineSamples
from smartview_jax.localization.search.ellipse_poses import (
    SeenEllipses,
    poses_from_outlines,
    seen_hulls,
)
from smartview_jax.modeling import ObjectModel, SeenViews

AXES = np.array([0.03, 0.02, 0.012])
FOCAL = 1500.0
CAMERA = pinhole(FOCAL, FOCAL)


@pytest.fixture(scope="module")
def egg():
    ball = trimesh.creation.uv_sphere(1.0, (24, 24))
    return model_from_triangles(ball.vertices * AXES, ball.faces, name="egg")


def pose_of(turn, place):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return pose


def outline_conic(camera_from_object):
    """The conic of an ellipsoid's outline in the ideal plane: the inverse of P Q* P^T."""
    P = np.diag([FOCAL, FOCAL, 1.0]) @ camera_from_object[:3]
    return np.linalg.inv(P @ np.diag([*AXES**2, -1.0]) @ P.T)


def points_on(conic, count=900):
    """Points on an ellipse, and their outward normals."""
    middle = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    size = conic[:2, 2] @ np.linalg.solve(conic[:2, :2], conic[:2, 2]) - conic[2, 2]
    angles = 2.0 * np.pi * np.arange(count) / count
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    points = middle + np.linalg.solve(np.linalg.cholesky(conic[:2, :2] / size).T, circle.T).T
    normals = (points - middle) @ (conic[:2, :2] / size)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_an_egg_is_proposed_where_its_outline_is_an_ellipse(egg):
    assert not len(egg.edges)
    pose = pose_of([0.4, -0.7, 0.9], [0.05, -0.03, 0.4])
    conic = outline_conic(pose)
    picture = SeenEllipses(IdealPlane(CAMERA), *points_on(conic), conic[None], np.eye(4))
    poses, (visible, supported) = (part.T for part in poses_from_outlines([picture], egg))
    poses = poses.T
    order = np.argsort(visible - supported)
    assert (supported / visible)[order[0]] > 0.8
    # One picture tells the distance only with the direction, in steps of nine degrees.
    near = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1) < 0.01
    turns = (np.linalg.inv(pose[:3, :3]) @ poses[:, :3, :3])[near]
    equal = egg.symmetry.rotations
    angles = [np.degrees(Rotation.from_matrix(equal @ turn).magnitude().min()) for turn in turns]
    assert min(angles) < 10.0


def test_the_hull_of_an_ellipsoid_has_its_shadows_axes(egg):
    for hull in seen_hulls(egg, 12):
        # Seen from afar along w the shadow's half axes are the roots of eigenvalues of P A^2 P^T.
        shadow = hull.turn[:2] @ np.diag(AXES**2) @ hull.turn[:2].T
        np.testing.assert_allclose(hull.axes**2, np.diagonal(shadow), rtol=0.05)
        assert abs(shadow[0, 1]) < 0.03 * shadow[0, 0]
        assert np.linalg.norm(hull.middle) < 1e-4


TRUTH = pose_of([0.4, -0.7, 0.9], [0.0, 0.0, 0.0])
START = TRUTH @ host_exponentials(np.array([2e-4, -2e-4, 2e-4, 0.01, -0.01, 0.01]))


def refined(egg, lights=(0.0, 0.0)):
    """The egg, refined by two pictures whose light displaces its outline."""
    calibration = sv.Calibration.eye_in_hand(CAMERA, np.eye(4), np.eye(4))
    cameras = [
        pose_of([0.0, np.pi, 0.0], [0.0, 0.0, 0.4]),
        pose_of([0.0, 2.4, 0.0], [-0.27, 0.0, 0.295]),
    ]
    views = SeenViews.of(calibration, np.stack(cameras))
    pictures = []
    for camera_from_world, light in zip(views.camera_from_world, lights, strict=True):
        points, normals = points_on(outline_conic(camera_from_world @ TRUTH))
        # Bright on the side of the light, where the ground is as bright as the egg.
        strengths = 20.0 + 10.0 * normals[:, 0]
        radii = radii_across(camera_from_world @ TRUTH, points, normals)
        points = points - (light * SHIFT / np.sqrt(radii) / strengths)[:, None] * normals
        pixels = points + np.array([325.0, 236.0])
        cells = np.round(pixels).astype(int)
        pictures.append(EdgePoints(pixels, -normals, strengths, cells))
    lookup = EdgeLookup.of(pictures, IMAGE_SIZE)
    return refine_pose(START, egg, Wireframe.of(egg, 512), views, lookup)


SHIFT = np.sqrt(EDGE_BLUR) * 2.0**0.25 * gamma(0.75) / np.sqrt(8.0 * np.pi)
"""Displacement by a light of one grey level, over its gradient and the root of the radius."""


def radii_across(camera_from_object, points, normals):
    """The ellipsoid's radii of curvature along the rays that touch it, px."""
    R, t = camera_from_object[:3, :3], camera_from_object[:3, 3]
    rays = np.column_stack([points / FOCAL, np.ones(len(points))]) @ R
    centre, Q = -R.T @ t, np.diag(1.0 / AXES**2)
    # On a ray that touches it, (c + s d)^T Q (c + s d) is least.
    depth = -(rays @ Q @ centre) / np.einsum("ni,ij,nj->n", rays, Q, rays)
    touched = centre + depth[:, None] * rays
    along = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    # The curvature of x^T Q x = 1 along a direction d is d^T Q d / |Q x|.
    curvature = np.einsum("ni,ij,nj->n", along, Q, along) / np.linalg.norm(touched @ Q, axis=1)
    return FOCAL / depth / curvature


def squared_error(refined):
    error = host_logarithms(np.linalg.inv(refined.world_from_object) @ TRUTH)
    return error, error @ np.linalg.solve(refined.covariance, error)


def test_a_smooth_part_is_refined_by_its_outline(egg):
    error, squared = squared_error(refined(egg))
    assert np.linalg.norm(error[:3]) < 3e-5
    assert np.linalg.norm(error[3:]) < 0.01
    assert squared < 6.0


def test_the_light_of_each_picture_is_an_unknown(egg):
    """By up to 0.5 px it displaces the outline inwards; the pose hardly."""
    error, squared = squared_error(refined(egg, (60.0, 100.0)))
    assert np.linalg.norm(error[:3]) < 2e-5
    assert squared < 2.0


def test_the_outline_of_a_coarse_mesh_is_on_its_smooth_surface(egg):
    """The middles of its edges are up to 0.9 % of the axes within it."""
    samples = OutlineSamples.of(egg, 2e3)
    off = np.linalg.norm(samples.points / AXES, axis=1) - 1.0
    assert np.abs(off).max() < 1e-3
    assert np.sqrt((off**2).mean()) < 3e-4


def test_faces_without_a_convex_smooth_edge_show_nothing():
    sheet = ObjectModel(np.eye(3), name="sheet")
    with pytest.raises(ValueError, match="'sheet' has no edges"):
        Wireframe.of(sheet)
