"""Poses from matches and from edge points: against SciPy, OpenCV, and the truth."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import SAMPLES, calibration, drawn, pinhole, seen_views
from jaxlie import SE3
from placed_box import (
    MIDDLE,
    MODEL,
    POSE,
    SIGMA,
    corner_matches,
    error_of,
    placed,
    projected,
)
from scipy.optimize import least_squares
from scipy.spatial import KDTree

import smartview_jax as sv
from smartview_jax.engine import Noise
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_exponentials, host_logarithms
from smartview_jax.localization import (
    EdgeLookup,
    Matches,
    Wireframe,
    converged_poses,
    match_equations,
    pose_from_matches,
    refine_pose,
)
from smartview_jax.localization.edge_lookup import padded_poses
from smartview_jax.localization.heavy_tails import solve_heavy_tailed
from smartview_jax.localization.refinement import line_equations, measured_lines
from smartview_jax.modeling import CalibrationUncertainty, ObjectModel, SeenViews
from smartview_jax.runtime.array_namespace import to_device

RUNS = 10
"""Number of simulated sets of pictures of each study; of a NEES of 6 their mean errs by 1.1."""


@pytest.fixture(scope="module")
def pinhole_views():
    """The views, taken by a camera without distortion."""
    calibration = sv.Calibration.eye_in_hand(pinhole(), np.eye(4), np.eye(4))
    return SeenViews.of(calibration, np.linalg.inv(seen_views(MIDDLE).camera_from_world))


def segment_matches(pixels, sigma=SIGMA, part=(0.1, 0.8)):
    """A piece of every edge in every view, as a pinhole camera sees it."""
    a, b = pixels[:, MODEL.edges[:, 0]], pixels[:, MODEL.edges[:, 1]]
    ends = np.stack([(1 - s) * a + s * b for s in part], axis=2)
    count = len(MODEL.edges)
    return Matches.none()._replace(
        segment_view=np.repeat(np.arange(len(pixels)), count),
        segment_edge=np.tile(np.arange(count), len(pixels)),
        segments=ends.reshape(-1, 2, 2),
        segment_covariances=np.tile(sigma**2 * np.eye(2), (len(pixels) * count, 1, 1)),
    )


def nearby(rng, size=1.0):
    return POSE @ host_exponentials(
        size * np.concatenate([0.002 * rng.standard_normal(3), 0.02 * rng.standard_normal(3)])
    )


def test_corners_give_the_optimum_that_scipy_finds(views):
    rng = np.random.default_rng(0)
    pixels = projected(views, placed(MODEL.vertices))
    pixels = pixels + SIGMA * rng.standard_normal(pixels.shape)
    pose, step = pose_from_matches(corner_matches(pixels), MODEL, views, nearby(rng))

    def residuals(tangent):
        world = placed(MODEL.vertices, POSE @ host_exponentials(tangent))
        return np.ravel(projected(views, world) - pixels) / SIGMA

    best = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, x_scale="jac")
    np.testing.assert_allclose(error_of(pose), best.x, atol=1e-8)
    np.testing.assert_allclose(step.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=2e-2)


def test_one_view_of_corners_is_opencvs_pose(pinhole_views):
    views = pinhole_views._replace(camera_from_world=pinhole_views.camera_from_world[:1])
    rng = np.random.default_rng(1)
    pixels = projected(views, placed(MODEL.vertices)) + 0.2 * rng.standard_normal((1, 8, 2))
    pose, _ = pose_from_matches(corner_matches(pixels), MODEL, views, nearby(rng))
    K = np.array([[1500.0, 0, 325.0], [0, 1505.0, 236.0], [0, 0, 1]])
    _, turn, shift = cv2.solvePnP(MODEL.vertices, pixels[0], K, None)
    turn, shift = cv2.solvePnPRefineLM(MODEL.vertices, pixels[0], K, None, turn, shift)
    theirs = np.eye(4)
    theirs[:3, :3], theirs[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    np.testing.assert_allclose(views.camera_from_world[0] @ pose, theirs, atol=2e-6)


def test_segments_alone_determine_the_pose(pinhole_views):
    pixels = projected(pinhole_views, placed(MODEL.vertices))
    start = nearby(np.random.default_rng(2))
    pose, _ = pose_from_matches(segment_matches(pixels), MODEL, pinhole_views, start)
    np.testing.assert_allclose(error_of(pose), 0.0, atol=1e-8)


def test_a_wrong_match_does_not_move_a_robust_pose(views):
    rng = np.random.default_rng(3)
    pixels = projected(views, placed(MODEL.vertices))
    pixels = pixels + SIGMA * rng.standard_normal(pixels.shape)
    clean, _ = pose_from_matches(corner_matches(pixels), MODEL, views, POSE, robust_scale=3.0)
    pixels[1, 2] += [25.0, -14.0]
    robust, _ = pose_from_matches(corner_matches(pixels), MODEL, views, POSE, robust_scale=3.0)
    plain, _ = pose_from_matches(corner_matches(pixels), MODEL, views, POSE)
    moved, fooled = (np.linalg.norm(error_of(p) - error_of(clean)) for p in (robust, plain))
    assert moved < 0.1 * fooled


def test_derivatives_of_matches_are_jaxs(views):
    uncertain = ObjectModel(
        MODEL.vertices, MODEL.edges, covariance=np.tile(1e-10 * np.eye(3), (8, 1, 1))
    )
    pixels = projected(views, placed(MODEL.vertices))
    matches = corner_matches(pixels).joined(segment_matches(pixels))
    none = CalibrationUncertainty.none(views)
    equations = match_equations(matches, uncertain, views, POSE, none)
    matrices, corners = jnp.asarray(views.camera_from_world), 2 * len(matches.corners)

    def predicted(tangent, vertices):
        pose = jnp.asarray(POSE) @ SE3.exp(tangent).as_matrix()
        world = vertices @ pose[:3, :3].T + pose[:3, 3][None]
        seen = jax.vmap(lambda m: views.camera.project(world @ m[:3, :3].T + m[:3, 3][None])[0])
        return seen(matrices).ravel()

    derivatives = jax.jit(jax.jacfwd(predicted, (0, 1)))
    by_pose, by_vertices = derivatives(jnp.zeros(6), jnp.asarray(MODEL.vertices))
    np.testing.assert_allclose(equations.by_pose[:corners], by_pose, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        equations.by_vertices[:corners], by_vertices.reshape(corners, -1), rtol=1e-6, atol=1e-6
    )


def test_derivatives_of_edges_are_differences_of_their_numbers(views, wireframe):
    lookup = EdgeLookup.of(drawn(MODEL, views, POSE, 0.0), views.camera.image_size)
    at = measured_lines(wireframe, views, lookup, POSE, 4.0)
    none = CalibrationUncertainty.none(views)
    J = line_equations(at, MODEL, wireframe, views, POSE, none).by_pose
    for k, size in enumerate([2e-4] * 3 + [4e-3] * 3):
        plus, minus = (
            measured_lines(
                wireframe, views, lookup, POSE @ host_exponentials(s * size * np.eye(6)[k]), 4.0
            )
            for s in (0.5, -0.5)
        )
        # Moving the prediction forwards makes measured minus predicted smaller.
        found = -(plus.offsets - minus.offsets)[at.measured].reshape(-1) / size
        scale = np.abs(J[:, k]).max()
        np.testing.assert_allclose(found / scale, J[:, k] / scale, atol=0.05)


def starts(rng, count):
    tangents = np.concatenate(
        [1e-3 * rng.standard_normal((count, 3)), 0.012 * rng.standard_normal((count, 3))], axis=1
    )
    return POSE @ host_exponentials(tangents)


def test_rough_poses_converge(views):
    coarse, rng = Wireframe.of(MODEL), np.random.default_rng(4)
    lookup = EdgeLookup.of(drawn(MODEL, views, POSE, 0.1), views.camera.image_size)
    matrices = to_device(padded_poses(views.camera_from_world))
    poses, lengths = converged_poses(
        coarse, views.camera, lookup, matrices, to_device(starts(rng, 8))
    )
    errors = host_logarithms(np.linalg.inv(POSE) @ np.asarray(poses))
    assert (np.linalg.norm(errors[:, :3], axis=1) < 1e-4).all()
    visible, explained = np.asarray(lengths).T
    assert (explained / visible).min() > 0.97


def test_the_pictures_covariance_is_true(views, wireframe):
    rng, errors, covariances, sigmas = np.random.default_rng(5), [], [], []
    for _ in range(RUNS):
        pictures = drawn(MODEL, views, POSE, 0.1, rng)
        lookup = EdgeLookup.of(pictures, views.camera.image_size)
        found = refine_pose(nearby(rng, 0.2), MODEL, wireframe, views, lookup)
        errors.append(error_of(found.world_from_object))
        covariances.append(found.covariance)
        sigmas.append(found.edge_sigma)
    assert mean_nees(nees(np.array(errors), np.array(covariances)), 6).is_consistent
    # Nothing is wrong with whole edges.
    assert np.median(sigmas) < 0.02


def test_edges_that_are_off_as_a_whole_are_noticed(views, wireframe):
    rng, errors, covariances, sigmas = np.random.default_rng(6), [], [], []
    for _ in range(RUNS):
        pictures = drawn(MODEL, views, POSE, 0.1, rng, shift=0.5)
        lookup = EdgeLookup.of(pictures, views.camera.image_size)
        found = refine_pose(nearby(rng, 0.2), MODEL, wireframe, views, lookup)
        errors.append(error_of(found.world_from_object))
        covariances.append(found.covariance)
        sigmas.append(found.edge_sigma)
    assert 0.35 < np.median(sigmas) < 0.65
    # An estimated standard deviation has the tails of Student's t, and the mean errs by 1.1 twice.
    assert 3.8 < mean_nees(nees(np.array(errors), np.array(covariances)), 6).value < 9.5


def test_the_robots_noise_is_in_the_covariance(views, wireframe):
    noise = Noise(0.1, 2e-4, float(np.deg2rad(0.02)))
    uncertainty = CalibrationUncertainty.of(views, calibration(), None, noise)
    rng, errors, covariances, trusting = np.random.default_rng(7), [], [], []
    sizes = np.repeat([noise.translation, noise.rotation], 3)
    for _ in range(RUNS):
        twists = host_exponentials(sizes * rng.standard_normal((2, 6)))
        true = views._replace(camera_from_world=twists @ views.camera_from_world)
        lookup = EdgeLookup.of(drawn(MODEL, true, POSE, 0.1, rng), views.camera.image_size)
        found = refine_pose(POSE, MODEL, wireframe, views, lookup, uncertainty, radius=8.0)
        errors.append(error_of(found.world_from_object))
        covariances.append(found.covariance)
        trusting.append(found.pictures)
        np.testing.assert_allclose(
            found.covariance, found.pictures + found.calibration + found.model
        )
    assert 3.8 < mean_nees(nees(np.array(errors), np.array(covariances)), 6).value < 8.2
    # Without it the pose would be called far better than it is.
    assert nees(np.array(errors), np.array(trusting)).mean() > 30.0


def test_an_uncertain_model_makes_the_pose_uncertain(views, wireframe):
    rng, errors, covariances = np.random.default_rng(8), [], []
    covariance = np.tile((2e-4) ** 2 * np.eye(3), (8, 1, 1))
    for _ in range(RUNS):
        moved = MODEL.vertices + 2e-4 * rng.standard_normal((8, 3))
        model = ObjectModel(
            moved, MODEL.edges, MODEL.faces, covariance=covariance, planar_tolerance=0.1
        )
        lookup = EdgeLookup.of(drawn(MODEL, views, POSE, 0.1, rng), views.camera.image_size)
        found = refine_pose(POSE, model, Wireframe.of(model, SAMPLES), views, lookup)
        errors.append(error_of(found.world_from_object))
        covariances.append(found.covariance)
    assert mean_nees(nees(np.array(errors), np.array(covariances)), 6).value < 8.5
    assert nees(np.array(errors), np.array(covariances)).mean() > 3.5


def test_a_wrong_edge_hardly_counts(views, wireframe):
    rng = np.random.default_rng(9)
    pictures = drawn(MODEL, views, POSE, 0.1, rng)
    moved = pictures[0].pixels.copy()
    # The points of one edge belong to something next to it.
    view = measured_lines(
        wireframe,
        views,
        EdgeLookup.of(pictures, views.camera.image_size),
        POSE,
        4.0,
    )
    edge = int(np.argmax(view.found_px[0]))
    owners = np.asarray(wireframe.sample_edges) == edge
    own = KDTree(view.samples[0][owners & (view.sample_px[0] > 0)]).query(moved)[0] < 2.0
    moved[own] += 2.5 * pictures[0].normals[own]
    pictures[0] = pictures[0]._replace(pixels=moved, cells=np.round(moved).astype(int))
    lookup = EdgeLookup.of(pictures, views.camera.image_size)
    found = refine_pose(POSE, MODEL, wireframe, views, lookup)
    assert not found.consistent[0, edge]
    assert found.consistent.sum() == found.lines.measured.sum() - 1
    assert nees(error_of(found.world_from_object)[None], found.covariance[None])[0] < 20.0


def test_a_fit_whose_steps_go_round_ends_where_it_has_been(views, wireframe, monkeypatch):
    """Edges that are near one pose and not near the next make steps that never end."""
    steps = []
    # Three steps of a standard deviation along the axes of a triangle sum to nothing.
    corners = np.array([[1.0, 0.0], [-0.5, np.sqrt(0.75)], [-0.5, -np.sqrt(0.75)]])

    def going_round(equations, errors):
        solved = solve_heavy_tailed(equations, errors)
        sigmas = np.sqrt(np.diagonal(solved.step.covariance))
        steps.append(np.r_[corners[len(steps) % 3], np.zeros(4)] * sigmas)
        return solved._replace(step=solved.step._replace(tangent=steps[-1]))

    monkeypatch.setattr("smartview_jax.localization.refinement.solve_heavy_tailed", going_round)
    lookup = EdgeLookup.of(drawn(MODEL, views, POSE), views.camera.image_size)
    refine_pose(POSE, MODEL, wireframe, views, lookup)
    assert len(steps) == 3


def test_too_few_edges_are_an_error(views, wireframe):
    empty = [
        p._replace(**{n: getattr(p, n)[:0] for n in p._fields}) for p in drawn(MODEL, views, POSE)
    ]
    lookup = EdgeLookup.of(empty, views.camera.image_size)
    with pytest.raises(ValueError, match="undetermined"):
        refine_pose(POSE, MODEL, wireframe, views, lookup)
