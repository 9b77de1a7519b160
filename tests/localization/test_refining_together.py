"""Objects refined together: neighbours that mislead, and errors of the calibration in common."""

import dataclasses

import numpy as np
import pytest
from drawn_edges import calibration, drawn, evidence, together
from placed_box import MODEL, NOISE, OTHER_POSE, POSE, views_of_both
from scipy.linalg import block_diag

from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_exponentials, host_logarithms
from smartview_jax.localization import Localization, judge, refine_pose
from smartview_jax.localization.judging.candidates import Prepared
from smartview_jax.localization.judging.evidence import evidence_of
from smartview_jax.localization.judging.scene import Scene
from smartview_jax.localization.refining_together import refined_together
from smartview_jax.modeling import CalibrationUncertainty

NO_TRIANGLES = np.zeros((0, 3, 3))


@pytest.fixture(scope="module")
def prepared(few_samples):
    return Prepared.of(MODEL)


@pytest.fixture(scope="module")
def views():
    return views_of_both()


@pytest.fixture(scope="module")
def uncertainty(views):
    return CalibrationUncertainty.of(views, calibration(), None, NOISE)


def scene_of(views, pictures):
    return Scene(views, evidence(pictures), NO_TRIANGLES)


def alone(scene, start, uncertainty, prepared):
    """An object that was accepted by itself."""
    model = prepared.model
    refined = refine_pose(start, model, prepared.fine, scene.views, scene.lookup, uncertainty)
    lines = scene.lines(refined.world_from_object, prepared.fine)
    found = evidence_of(lines, prepared.fine, is_alone=False)
    verdict = judge(found, 1, np.inf)._replace(decision="accepted")
    return Localization(model, 0, refined, verdict, ())


def error_of(localization, pose):
    return host_logarithms(np.linalg.inv(localization.world_from_object) @ pose)


def test_what_a_neighbour_hides_and_explains_misleads_no_more(views, prepared):
    """Of the second box some edges are hidden, and the first has edges 2 px away from them."""
    rng, exact = np.random.default_rng(0), CalibrationUncertainty.none(views)
    # The first box stands before the second one, as its right side is seen from the cameras.
    close = POSE.copy()
    close[:3, 3] += POSE[:3, :3] @ [0.0605, 0.0, 0.0]
    shared = [k for k, edge in enumerate(MODEL.edges) if (MODEL.vertices[edge, 0] == 0.0).all()]
    pictures = together(
        drawn(MODEL, views, POSE, 0.05, rng), drawn(MODEL, views, close, 0.05, rng, hidden=shared)
    )
    scene = scene_of(views, pictures)
    before = [alone(scene, pose, exact, prepared) for pose in (POSE, close)]
    after = refined_together(before, scene, [prepared], exact)
    errors = [[error_of(localization, p) for localization, p in zip(x, (POSE, close), strict=True)]
              for x in (before, after)]  # fmt: skip
    size_before, size_after = (np.linalg.norm(x[1][:3]) for x in errors)
    assert size_after < 3e-5
    assert size_after < 0.5 * size_before


def test_all_objects_tell_of_the_calibrations_error(views, uncertainty, prepared):
    """Of one object little is seen, of the other everything: their poses are true, as stated."""
    sizes = np.repeat([NOISE.translation, NOISE.rotation], 3)
    rng, squares, gains = np.random.default_rng(1), [], []
    few = [k for k, edge in enumerate(MODEL.edges) if MODEL.vertices[edge, 2].max() > 0.0][:6]
    for _ in range(5):
        twists = host_exponentials(sizes * rng.standard_normal((2, 6)))
        true = views._replace(camera_from_world=twists @ views.camera_from_world)
        pictures = together(
            drawn(MODEL, true, POSE, 0.05, rng),
            drawn(MODEL, true, OTHER_POSE, 0.3, rng, hidden=few),
        )
        scene = scene_of(views, pictures)
        before = [alone(scene, pose, uncertainty, prepared) for pose in (POSE, OTHER_POSE)]
        after = refined_together(before, scene, [prepared], uncertainty)
        errors = np.array(
            [
                error_of(localization, p)
                for localization, p in zip(after, (POSE, OTHER_POSE), strict=True)
            ]
        )
        squares += list(nees(errors, np.array([localization.covariance for localization in after])))
        gains.append(
            np.linalg.slogdet(after[1].covariance)[1] - np.linalg.slogdet(before[1].covariance)[1]
        )
        parts = after[1].refined
        np.testing.assert_allclose(
            parts.calibration_jacobian @ uncertainty.covariance @ parts.calibration_jacobian.T,
            parts.calibration,
            rtol=1e-6, atol=1e-12,
        )  # fmt: skip
    mean = mean_nees(np.array(squares), 6)
    assert mean.low - 1.0 < mean.value < mean.high
    assert max(gains) < -1.0


UNCERTAIN = dataclasses.replace(
    MODEL, covariance=np.tile(1e-4**2 * np.eye(3), (len(MODEL.vertices), 1, 1))
)


@pytest.mark.parametrize("model", [MODEL, UNCERTAIN], ids=["exact model", "measured model"])
def test_the_solution_is_that_of_all_unknowns_together(views, uncertainty, model):
    """Least squares with the errors of the calibration and the model's as unknowns, for both."""
    rng, prepared = np.random.default_rng(2), Prepared.of(model)
    pictures = together(
        drawn(MODEL, views, POSE, 0.2, rng), drawn(MODEL, views, OTHER_POSE, 0.2, rng)
    )
    scene = scene_of(views, pictures)
    before = [alone(scene, pose, uncertainty, prepared) for pose in (POSE, OTHER_POSE)]
    after = refined_together(before, scene, [prepared], uncertainty)
    equations = [obj.refined.equations for obj in after]
    J = np.asarray(block_diag(*(part.by_pose for part in equations)))
    # Equations are about the refined poses: there the best tangent of all unknowns is zero.
    r = np.concatenate([part.residuals for part in equations])
    noise = np.asarray(block_diag(*(part.noise for part in equations)))
    whitening = np.linalg.inv(np.linalg.cholesky(noise))
    root = np.linalg.cholesky(uncertainty.covariance)
    B = np.concatenate(
        [np.hstack([e.by_calibration @ root, 1e-4 * e.by_vertices]) for e in equations]
    )
    numbers = B.shape[1]
    A = np.block(
        [[whitening @ J, whitening @ B],
         [np.zeros((numbers, J.shape[1])), np.eye(numbers)]]
    )  # fmt: skip
    best = np.linalg.lstsq(A, np.append(whitening @ r, np.zeros(numbers)), rcond=None)[0]
    covariance = np.linalg.inv(A.T @ A)
    for k, localization in enumerate(after):
        part = slice(6 * k, 6 * k + 6)
        sigmas = np.sqrt(np.diagonal(localization.covariance))
        np.testing.assert_allclose(best[part] / sigmas, 0.0, atol=1e-6)
        np.testing.assert_allclose(
            localization.covariance / np.outer(sigmas, sigmas),
            covariance[part, part] / np.outer(sigmas, sigmas),
            atol=1e-6,
        )


def test_what_is_not_accepted_stays_as_it_is(views, uncertainty, prepared):
    pictures = drawn(MODEL, views, POSE, 0.1)
    scene = scene_of(views, pictures)
    localization = alone(scene, POSE, uncertainty, prepared)
    undecided = localization._replace(verdict=localization.verdict._replace(decision="open"))
    both = [localization, undecided]
    assert refined_together(both, scene, [prepared], uncertainty) == both
