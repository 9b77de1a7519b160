"""An estimated calibration displaces each picture: that is taken away before edges are judged."""

import jax
import numpy as np
import pytest
from drawn_edges import drawn
from placed_box import MODEL, NOISE, POSE, placed, projected

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import EdgeLookup, refine_pose
from smartview_jax.localization.edges.edge_lines import EXPLAINED_DISTANCE
from smartview_jax.localization.judging.evidence import evidence_of
from smartview_jax.localization.refining.pose_equations import (
    CommonErrors,
    PoseEquations,
    solve_pose,
)
from smartview_jax.localization.refining.refinement import measured_lines
from smartview_jax.modeling import CalibrationUncertainty


def test_common_errors_are_those_of_a_least_squares_fit_that_has_them_as_unknowns():
    rng = np.random.default_rng(0)
    rows, numbers = 20, 4
    J, B = rng.standard_normal((rows, 6)), rng.standard_normal((rows, numbers))
    root = rng.standard_normal((numbers, numbers))
    r, variances = rng.standard_normal(rows), rng.uniform(0.5, 2.0, rows)
    equations = PoseEquations(r, J, np.diag(variances), B, np.zeros((rows, 0)))
    step = solve_pose(equations, CommonErrors(root @ root.T, np.zeros((0, 0))))
    # The unknowns are the tangent, and x with errors = root x, each x of unit variance.
    weights = 1.0 / np.sqrt(variances)[:, None]
    A = np.block([[weights * J, weights * (B @ root)], [np.zeros((numbers, 6)), np.eye(numbers)]])
    best = np.linalg.lstsq(A, np.append(weights[:, 0] * r, np.zeros(numbers)), rcond=None)[0]
    np.testing.assert_allclose(step.tangent, best[:6], atol=1e-10)
    np.testing.assert_allclose(step.calibration_error, root @ best[6:], atol=1e-10)
    # The trace of the hat matrix beyond the trace for the pose alone.
    hat = A[:rows] @ np.linalg.inv(A.T @ A) @ A[:rows].T
    assert step.absorbed == pytest.approx(np.trace(hat) - 6.0)


def test_edges_lie_on_the_model_once_what_the_calibration_may_err_is_taken_away(
    views, uncertainty, wireframe
):
    rng = np.random.default_rng(1)
    sizes = np.repeat([NOISE.translation, NOISE.rotation], 3)
    gains, misses = [], []
    for _ in range(3):
        twists = host_exponentials(sizes * rng.standard_normal((2, 6)))
        true = views._replace(camera_from_world=twists @ views.camera_from_world)
        pictures = drawn(MODEL, true, POSE, 0.05, rng)
        lookup = EdgeLookup.of(pictures, views.camera.image_size)
        refined = refine_pose(POSE, MODEL, wireframe, views, lookup, uncertainty, radius=8.0)
        corrected = uncertainty.corrected(views, refined.calibration_error)
        lines = [
            measured_lines(wireframe, own, lookup, refined.world_from_object, EXPLAINED_DISTANCE)
            for own in (views, corrected)
        ]
        before, after = (evidence_of(line, wireframe, False) for line in lines)
        assert before.edge_rms < EXPLAINED_DISTANCE
        assert after.explained >= before.explained
        assert 0.0 < refined.absorbed < 12.0
        gains.append(after.edge_rms / before.edge_rms)
        # The corners are seen by the true views, which only the judge knows.
        seen = projected(true, placed(MODEL.vertices))
        misses.append(
            [
                np.abs(
                    projected(own, placed(MODEL.vertices, refined.world_from_object)) - seen
                ).max()
                for own in (views, corrected)
            ]
        )
    assert np.median(gains) < 0.3
    nominal, mended = np.median(misses, axis=0)
    assert mended < 0.3 * nominal


def test_an_exact_calibration_is_left_as_it_is(views):
    assert CalibrationUncertainty.none(views).corrected(views, np.zeros(0)) is views


def test_numbers_of_the_camera_are_corrected_too(views, uncertainty):
    count = sum(np.size(leaf) for leaf in jax.tree.leaves(views.camera))
    jacobian = np.zeros((2, count + 6, 1))
    jacobian[:, 0] = 2.0
    own = uncertainty._replace(view_jacobian=jacobian)
    moved = own.corrected(views, np.array([1.5])).camera
    before, after = jax.tree.leaves(views.camera), jax.tree.leaves(moved)
    assert float(after[0]) == float(before[0]) + 3.0
    np.testing.assert_array_equal(np.hstack(after[1:]), np.hstack(before[1:]))
