"""Kosaka and Kak's matching: against the batch optimum, and its gate against chance."""

import numpy as np
import pytest
from placed_box import MODEL, POSE, corner_matches, error_of, placed, projected
from scipy.stats import chi2
from solids import box

from smartview_jax.features import Features
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import PoseState, kalman_update, match_features, pose_from_matches
from smartview_jax.localization.matching import GATE_COVERAGE
from smartview_jax.localization.pose_equations import CommonErrors, PoseEquations, solve_pose
from smartview_jax.modeling import CalibrationUncertainty

SIGMA = 0.3
PRIOR = np.diag(np.repeat([1e-3, 0.01], 3) ** 2)


@pytest.fixture(scope="module")
def one_view(views):
    return views._replace(camera_from_world=views.camera_from_world[:1])


@pytest.fixture(scope="module")
def exact(views):
    return CalibrationUncertainty.none(views)


def from_prior(rng):
    return POSE @ host_exponentials(-np.sqrt(np.diag(PRIOR)) * rng.standard_normal(6))


def seen_corners(views, rng, clutter=0, missing=()):
    """Corners at all vertices of each view, in any order, and others anywhere near."""
    pixels = projected(views, placed(MODEL.vertices))
    found, order = [], []
    for own in pixels:
        kept = np.array([k for k in range(8) if k not in missing])
        others = own.mean(axis=0) + rng.uniform(-250.0, 250.0, (clutter, 2))
        corners = np.concatenate([own[kept] + SIGMA * rng.standard_normal((len(kept), 2)), others])
        turn = rng.permutation(len(corners))
        found.append(
            Features(
                corners[turn],
                np.tile(SIGMA**2 * np.eye(2), (len(corners), 1, 1)),
                np.full((len(corners), 2), -1),
                np.zeros((0, 2, 2)),
                np.zeros((0, 2, 2, 2)),
                np.zeros((0, 3)),
                np.zeros((0, 3, 3)),
                views.camera.image_size,
            )
        )
        order.append(np.concatenate([kept, np.full(clutter, -1)])[turn])
    return found, order


def right_and_wrong(matched, features, order):
    """Numbers of matched corners that belong to their vertex, and that do not."""
    right = 0
    for view, vertex, corner in zip(
        matched.matches.corner_view,
        matched.matches.corner_vertex,
        matched.matches.corners,
        strict=True,
    ):
        index = int(np.argmin(np.abs(features[view].corners - corner).sum(axis=1)))
        right += order[view][index] == vertex
    return right, len(matched.matches.corners) - right


def test_updates_one_by_one_are_the_batch_where_all_is_linear():
    rng, count = np.random.default_rng(0), 9
    J, r = rng.standard_normal((2 * count, 6)), rng.standard_normal(2 * count)
    none = CommonErrors(np.zeros((0, 0)), np.zeros((0, 0)))

    def equations(rows, tangent):
        n = len(J[rows])
        return PoseEquations(
            r[rows] - J[rows] @ tangent,
            J[rows],
            0.1 * np.eye(n),
            np.zeros((n, 0)),
            np.zeros((n, 0)),
            np.arange(n),
        )

    batch = solve_pose(equations(slice(None), np.zeros(6)), none, (np.zeros(6), np.eye(6)))
    mean, covariance = np.zeros(6), np.eye(6)
    for k in range(count):
        step = solve_pose(equations(slice(2 * k, 2 * k + 2), mean), none, (np.zeros(6), covariance))
        mean, covariance = mean + step.tangent, step.covariance
    np.testing.assert_allclose(mean, batch.tangent, atol=1e-12)
    np.testing.assert_allclose(covariance, batch.covariance, atol=1e-12)


def test_updates_one_by_one_are_nearly_the_batch_of_pictures(views, exact):
    rng = np.random.default_rng(1)
    pixels = projected(views, placed(MODEL.vertices))
    pixels = pixels + SIGMA * rng.standard_normal(pixels.shape)
    matches = corner_matches(pixels, SIGMA)
    batch, step = pose_from_matches(matches, MODEL, views, POSE)
    state = PoseState(from_prior(rng), 1e4 * PRIOR)
    for k in range(len(matches.corners)):
        one = matches._replace(
            **{name: getattr(matches, name)[k : k + 1] for name in matches._fields[:4]}
        )
        state, _ = kalman_update(state, one, MODEL, views, exact)
    apart = error_of(state.world_from_object) - error_of(batch)
    # Within a fifth of its standard deviation: the first updates were linear far from the optimum.
    assert np.sqrt(apart @ np.linalg.solve(step.covariance, apart)) < 0.2
    np.testing.assert_allclose(
        np.sqrt(np.diag(state.covariance)), np.sqrt(np.diag(step.covariance)), rtol=0.05
    )


def test_the_gate_holds_what_it_states(views, exact):
    rng, inside = np.random.default_rng(2), []
    exact_pixels = projected(views, placed(MODEL.vertices))[:1]
    for _ in range(30):
        pixels = exact_pixels + SIGMA * rng.standard_normal(exact_pixels.shape)
        state = PoseState(from_prior(rng), PRIOR)
        for vertex in range(0, 8, 3):
            match = corner_matches(pixels, SIGMA)
            one = match._replace(
                **{name: getattr(match, name)[vertex : vertex + 1] for name in match._fields[:4]}
            )
            _, squared = kalman_update(state, one, MODEL, views, exact)
            inside.append(squared <= chi2.ppf(GATE_COVERAGE, 2))
    # 90 draws, three of each pose: 95 %, known to 2.3 %.
    assert abs(np.mean(inside) - GATE_COVERAGE) < 0.05


def test_matches_are_found_among_clutter(views, exact):
    rng = np.random.default_rng(3)
    features, order = seen_corners(views, rng, clutter=12)
    matched = match_features(MODEL, views, features, PoseState(from_prior(rng), PRIOR), exact)
    right, wrong = right_and_wrong(matched, features, order)
    assert right >= 10
    assert wrong == 0
    error = error_of(matched.state.world_from_object)
    assert error @ np.linalg.solve(matched.state.covariance, error) < chi2.ppf(0.999, 6)


def test_a_vertex_that_is_not_seen_has_no_match(one_view):
    rng = np.random.default_rng(4)
    features, order = seen_corners(one_view, rng, missing=(4, 5))
    matched = match_features(MODEL, one_view, features, PoseState(from_prior(rng), PRIOR))
    _, wrong = right_and_wrong(matched, features, order)
    assert wrong == 0
    assert not set(matched.matches.corner_vertex.tolist()) & {4, 5}
    assert matched.cost > 9.0


def test_a_contradiction_sends_the_search_back(one_view):
    """A corner beside the true one is nearer to the prediction: the greedy choice is wrong."""
    rng = np.random.default_rng(5)
    start = from_prior(rng)
    features, order = seen_corners(one_view, rng)
    predicted = projected(one_view, placed(MODEL.vertices, start))
    own = features[0]
    decoy = predicted[0, 4][None]
    features[0] = own._replace(
        corners=np.concatenate([decoy, own.corners]),
        corner_covariances=np.concatenate([own.corner_covariances[:1], own.corner_covariances]),
        corner_segments=np.concatenate([own.corner_segments[:1], own.corner_segments]),
    )
    order[0] = np.concatenate([[-1], order[0]])
    matched = match_features(MODEL, one_view, features, PoseState(start, PRIOR))
    _, wrong = right_and_wrong(matched, features, order)
    assert wrong == 0
    assert matched.updates > len(matched.matches.corners)


def test_features_of_another_number_of_views_are_refused(views, exact):
    features, _ = seen_corners(views, np.random.default_rng(6))
    with pytest.raises(ValueError, match="expected 2 views, found 1"):
        match_features(box(), views, features[:1], PoseState(POSE, PRIOR), exact)
