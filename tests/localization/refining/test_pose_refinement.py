"""Poses from edge points: against SciPy and the truth."""

import numpy as np
import pytest
from drawn_edges import calibration, drawn
from placed_box import (
    MODEL,
    NOISE,
    POSE,
    SIGMA,
    error_of,
    placed,
    projected,
)
from scipy.optimize import least_squares
from scipy.spatial import KDTree
from seen_scene import SAMPLES

from smartview_jax.engine import Noise
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_exponentials, host_logarithms
from smartview_jax.localization import (
    EdgeLookup,
    Wireframe,
    converged_poses,
    refine_pose,
)
from smartview_jax.localization.edges.edge_lines import INDEPENDENT_LENGTH
from smartview_jax.localization.edges.edge_lookup import padded_poses
from smartview_jax.localization.refining.heavy_tails import solve_heavy_tailed
from smartview_jax.localization.refining.pose_convergence import lengths_of_poses, poses_on_edges
from smartview_jax.localization.refining.pose_equations import (
    CommonErrors,
    PoseEquations,
    line_equations,
    solve_pose,
)
from smartview_jax.localization.refining.refinement import measured_lines
from smartview_jax.modeling import CalibrationUncertainty, ObjectModel, pixel_jacobians
from smartview_jax.runtime.array_namespace import to_device

RUNS = 10
"""Number of simulated sets of pictures of each study; of a NEES of 6 their mean errs by 1.1."""


def nearby(rng, size=1.0):
    return POSE @ host_exponentials(
        size * np.concatenate([0.002 * rng.standard_normal(3), 0.02 * rng.standard_normal(3)])
    )


def corner_equations(pixels, views, pose, uncertainty):
    """Equations of the model's corners, all in all views."""
    seen = pixel_jacobians(views, placed(MODEL.vertices, pose))
    # x = R (p + v + w x p)
    turns = np.cross(np.eye(3), MODEL.vertices[:, None]).swapaxes(1, 2)
    moves = pose[:3, :3] @ np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns], axis=2)
    count = pixels.size
    return PoseEquations(
        (pixels - seen.pixels).ravel(),
        (seen.by_point @ moves).reshape(count, 6),
        SIGMA**2 * np.eye(count),
        (seen.by_view @ uncertainty.view_jacobian[:, None]).reshape(count, -1),
        np.zeros((count, 0)),
    )


def test_the_solution_of_equations_is_the_optimum_that_scipy_finds(views):
    """Corners of all views, and a calibration whose errors are common to all corners of a view."""
    rng, uncertainty = (
        np.random.default_rng(0),
        CalibrationUncertainty.of(views, calibration(), None, NOISE),
    )
    pixels = projected(views, placed(MODEL.vertices))
    pixels = pixels + SIGMA * rng.standard_normal(pixels.shape)
    pose, errors = nearby(rng), CommonErrors.of(uncertainty, MODEL)
    for _ in range(10):
        equations = corner_equations(pixels, views, pose, uncertainty)
        step = solve_pose(equations, errors)
        pose = pose @ host_exponentials(step.tangent)
    whitening = np.linalg.cholesky(
        np.linalg.inv(equations.noise + errors.covariances(equations)[0])
    )

    def residuals(tangent):
        world = placed(MODEL.vertices, POSE @ host_exponentials(tangent))
        return whitening.T @ np.ravel(projected(views, world) - pixels)

    best = least_squares(residuals, np.zeros(6), xtol=1e-14, ftol=1e-14, x_scale="jac")
    np.testing.assert_allclose(error_of(pose), best.x, atol=1e-8)
    np.testing.assert_allclose(step.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=2e-2)


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
        actual = -(plus.offsets - minus.offsets)[at.measured].reshape(-1) / size
        scale = np.abs(J[:, k]).max()
        np.testing.assert_allclose(actual / scale, J[:, k] / scale, atol=0.05)


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


@pytest.mark.parametrize("shown", [[0], [0, 4, 8]])
def test_poses_do_not_leave_the_edges_that_they_explain(views, shown):
    """A few edges leave the pose undetermined, so that a step may go anywhere."""
    coarse, hidden = Wireframe.of(MODEL), set(range(len(MODEL.edges))) - set(shown)
    pictures = drawn(MODEL, views, POSE, 0.5, hidden=hidden)
    lookup = EdgeLookup.of(pictures, views.camera.image_size)
    given = starts(np.random.default_rng(4), 24)
    before = lengths_of_poses(coarse, views, lookup, given)
    poses, lengths = poses_on_edges(coarse, views, lookup, given)
    assert (lengths[:, 1] > before[:, 1] - INDEPENDENT_LENGTH).all()
    np.testing.assert_allclose(lengths, lengths_of_poses(coarse, views, lookup, poses))


def test_the_pictures_covariance_is_true(views, wireframe):
    rng, errors, covariances, sigmas = np.random.default_rng(5), [], [], []
    for _ in range(RUNS):
        pictures = drawn(MODEL, views, POSE, 0.1, rng)
        lookup = EdgeLookup.of(pictures, views.camera.image_size)
        refined = refine_pose(nearby(rng, 0.2), MODEL, wireframe, views, lookup)
        errors.append(error_of(refined.world_from_object))
        covariances.append(refined.covariance)
        sigmas.append(refined.edge_sigma)
    assert mean_nees(nees(np.array(errors), np.array(covariances)), 6).is_consistent
    # Nothing is wrong with whole edges.
    assert np.median(sigmas) < 0.02


def test_edges_that_are_off_as_a_whole_are_noticed(views, wireframe):
    rng, errors, covariances, sigmas = np.random.default_rng(6), [], [], []
    for _ in range(RUNS):
        pictures = drawn(MODEL, views, POSE, 0.1, rng, shift=0.5)
        lookup = EdgeLookup.of(pictures, views.camera.image_size)
        refined = refine_pose(nearby(rng, 0.2), MODEL, wireframe, views, lookup)
        errors.append(error_of(refined.world_from_object))
        covariances.append(refined.covariance)
        sigmas.append(refined.edge_sigma)
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
        refined = refine_pose(POSE, MODEL, wireframe, views, lookup, uncertainty, radius=8.0)
        errors.append(error_of(refined.world_from_object))
        covariances.append(refined.covariance)
        trusting.append(refined.pictures)
        np.testing.assert_allclose(
            refined.covariance, refined.pictures + refined.calibration + refined.model
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
        refined = refine_pose(POSE, model, Wireframe.of(model, SAMPLES), views, lookup)
        errors.append(error_of(refined.world_from_object))
        covariances.append(refined.covariance)
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
    refined = refine_pose(POSE, MODEL, wireframe, views, lookup)
    assert not refined.consistent[0, edge]
    assert refined.consistent.sum() == refined.lines.measured.sum() - 1
    assert nees(error_of(refined.world_from_object)[None], refined.covariance[None])[0] < 20.0


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

    monkeypatch.setattr(
        "smartview_jax.localization.refining.refinement.solve_heavy_tailed", going_round
    )
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
