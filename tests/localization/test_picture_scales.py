"""The same objects in pictures that were enlarged: neither decisions nor covariances change."""

import functools

import cv2
import numpy as np
import pytest
from drawn_edges import seen_views
from placed_box import MIDDLE
from seen_scene import CALIBRATION, CAMERA, base_from_tool, errors, seen_scene

import smartview_jax as sv
from smartview_jax.features import picture_evidence
from smartview_jax.geometry import host_logarithms
from smartview_jax.localization import Hypothesis, find_hypotheses, localize
from smartview_jax.localization.search.hypotheses import at_one_scale
from smartview_jax.modeling import CalibrationUncertainty, SeenViews, pixel_jacobians

LARGE = CAMERA.resized((2 * CAMERA.image_size[0], 2 * CAMERA.image_size[1]))
LARGE_CALIBRATION = sv.Calibration.eye_in_hand(LARGE, np.eye(4), np.eye(4))


def enlarged(picture):
    return cv2.resize(picture, LARGE.image_size, interpolation=cv2.INTER_LINEAR)


@functools.cache
def large_evidence():
    return [picture_evidence(enlarged(picture), LARGE) for picture in seen_scene().pictures]


def searched(evidence, calibration):
    """What is found of the scene's models near their poses."""
    scene = seen_scene()
    starts = [Hypothesis(k, pose, 0.0, 0.0) for k, pose in enumerate(scene.world_from_object)]
    return localize(evidence, base_from_tool(), calibration, scene.models, hypotheses=starts)


def test_pictures_enlarged_by_interpolation_change_neither_decision_nor_covariance():
    original = searched(seen_scene().evidence, CALIBRATION)
    at_twice = searched(large_evidence(), LARGE_CALIBRATION)
    assert [obj.scale for obj in (*original, *at_twice)] == [1.0, 1.0, 0.5, 0.5]
    for obj in at_twice:
        (same,) = (other for other in original if other.model_index == obj.model_index)
        assert obj.verdict.decision == same.verdict.decision == "accepted"
        grown = np.linalg.slogdet(obj.covariance)[1] - np.linalg.slogdet(same.covariance)[1]
        # Of six numbers; twice as many independent edge points would halve the variances.
        assert abs(grown / 6.0) < 0.35
        truth = seen_scene().world_from_object[obj.model_index] @ obj.model.object_from_object
        tangents = host_logarithms(np.linalg.inv(obj.world_from_object) @ truth)
        error = tangents[np.argmin(np.linalg.norm(tangents[:, 3:], axis=1))]
        assert error @ np.linalg.solve(obj.covariance, error) < 25.0


def test_pictures_of_different_sharpness_are_searched_at_the_scale_of_the_sharpest():
    scene, views = seen_scene(), SeenViews.of(LARGE_CALIBRATION, base_from_tool())
    sharper = picture_evidence(enlarged(scene.pictures[1]), LARGE, scale=0.7)
    alike, small = at_one_scale([large_evidence()[0], sharper], views)
    assert [picture.scale for picture in alike] == [0.7, 0.7]
    assert small.camera.image_size == alike[0].features.image_size == (896, 672)
    # Views of the reduced pictures stay as they are.
    assert at_one_scale(alike, small)[1] is small


def test_hypotheses_are_found_in_reduced_pictures():
    scene, views = seen_scene(), SeenViews.of(LARGE_CALIBRATION, base_from_tool())
    best = find_hypotheses(large_evidence(), views, scene.models[:1])[0]
    angle, shift = errors(scene.models[0], best.world_from_object[None], scene.world_from_object[0])
    assert angle[0] < 3.0
    assert shift[0] < 3.0


def test_an_uncertain_camera_moves_reduced_pictures_in_proportion():
    views, size = seen_views(MIDDLE), seen_views(MIDDLE).camera.image_size
    small = views._replace(camera=views.camera.resized((size[0] // 2, size[1] // 2)))
    points = MIDDLE + np.random.default_rng(0).normal(0.0, 0.02, (5, 3))
    local = pixel_jacobians(views, points).by_view.shape[-1]
    numbers = np.random.default_rng(1).normal(size=(len(views.camera_from_world), local, 3))
    full = CalibrationUncertainty(("a", "b", "c"), np.eye(3), numbers, 3)
    moved, halved = (
        np.einsum("vpil,vln->vpin", pixel_jacobians(seen, points).by_view, own.view_jacobian)
        for seen, own in ((views, full), (small, full.resized(views, small)))
    )
    assert halved == pytest.approx(0.5 * moved, rel=1e-9)
