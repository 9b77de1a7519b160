import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax import Calibration, Rig, held_out
from smartview_jax.evaluation import (
    choose_uncorrected,
    fit_folds,
    has_correction,
    reprojection_errors,
    score,
    view_folds,
)
from smartview_jax.fit_result import FitCode, FitResult
from smartview_jax.robot_errors import LinearInPosition, RobotError


def test_deviations_of_the_truth_are_the_pixel_noise(scene):
    found = reprojection_errors(scene.calibration, scene.data)
    seen = np.asarray(scene.data.visible)
    assert found.rms == pytest.approx(0.15 * np.sqrt(2.0), rel=0.1)
    depth = scene.calibration.points_in_camera(scene.data.base_from_tool, scene.data.points)[..., 2]
    np.testing.assert_allclose(
        found.metres[seen], (found.px * np.asarray(depth) / 2133.0)[seen], rtol=1e-12
    )


def test_folds_are_the_fixed_permutation_dealt_out():
    views = np.arange(3, 18)
    order = np.random.default_rng(0).permutation(15)
    expected = [tuple(views[order[i::5]]) for i in range(5)]
    assert list(view_folds(views, 5)) == expected
    assert [len(fold) for fold in view_folds(np.arange(7), 5)] == [1] * 7
    assert [len(fold) for fold in view_folds(np.arange(8), 5)] == [2, 2, 2, 1, 1]


def test_states_of_a_rig_are_hidden_from_all_its_cameras(scene):
    views = scene.data.view_count
    rig = Rig({"left": scene.data, "right": scene.data.select(range(2, views))})
    shown = []

    def fitter(part):
        shown.append(part)
        return SimpleNamespace(calibrations=dict.fromkeys(part.cameras, scene.calibration))

    found = held_out(rig, fitter, folds=4)
    assert len(shown) == 4
    for name, data in rig.cameras.items():
        # Each view of each camera is hidden once, and predicted then.
        assert sorted(sum(found[name].folds, ())) == list(range(data.view_count))
        truth = reprojection_errors(scene.calibration, data)
        np.testing.assert_array_equal(found[name].errors.px, truth.px)
        for part, hidden in zip(shown, found[name].folds, strict=True):
            visible = np.asarray(part.cameras[name].visible).any(axis=1)
            assert np.flatnonzero(~visible).tolist() == sorted(hidden)


def test_a_camera_whose_views_are_all_hidden_fails_alone(scene):
    rig = Rig({"left": scene.data, "right": scene.data.select([2])})

    def fitter(part):
        return SimpleNamespace(calibrations=dict.fromkeys(part.cameras, scene.calibration))

    found = held_out(rig, fitter, folds=4)
    assert found["left"].failures == ()
    assert np.isfinite(found["left"].errors.px).any(axis=1).all()
    ((_, reason),) = found["right"].failures
    assert reason == "camera 'right': no usable view is left to fit it"


def test_every_view_is_predicted_by_a_fit_that_never_saw_it(scene):
    shown = []

    def fitter(data):
        visible = np.asarray(data.visible).any(axis=1)
        shown.append(visible)
        assert np.isnan(np.asarray(data.pixels)[~visible]).all()
        return scene.calibration

    found = held_out(scene.data, fitter)
    assert len(shown) == 5
    for fold, visible in zip(found.folds, shown, strict=True):
        assert set(np.flatnonzero(~visible)) == set(fold)
    np.testing.assert_array_equal(np.isfinite(found.errors.px), np.asarray(scene.data.visible))
    assert found.errors.rms == reprojection_errors(scene.calibration, scene.data).rms


def test_views_outside_of_what_a_predictor_knows_are_listed(scene):
    far = np.asarray(scene.data.base_from_tool.translation())[:, 0] > 0.47

    class Cautious(eqx.Module):
        chain: Calibration

        @property
        def camera(self):
            return self.chain.camera

        def points_in_camera(self, base_from_tool, points):
            return self.chain.points_in_camera(base_from_tool, points)

        def project(self, base_from_tool, points):
            return self.chain.project(base_from_tool, points)

        def is_inside(self, base_from_tool):
            return np.asarray(base_from_tool.translation())[:, 0] <= 0.47

    found = held_out(scene.data, lambda _: Cautious(scene.calibration))
    assert 0 < far.sum() < 16
    assert sorted(found.extrapolated_views) == np.flatnonzero(far).tolist()
    assert held_out(scene.data, lambda _: scene.calibration).extrapolated_views == ()


def test_only_the_usable_views_are_dealt_out(scene):
    pixels = np.array(scene.data.pixels)
    pixels[2] = np.nan
    data = type(scene.data).from_arrays(
        scene.data.points, pixels, scene.data.base_from_tool, scene.data.image_size
    )
    found = held_out(data, lambda _: scene.calibration)
    assert found.folds == view_folds(np.array([0, 1, *range(3, 16)]), 5)


def test_a_fold_that_fails_is_reported(scene):
    calls = iter(range(5))

    def fitter(_):
        if next(calls) == 1:
            raise ValueError("no")
        return scene.calibration

    found = held_out(scene.data, fitter)
    assert found.failures == ((1, "no"),)
    assert np.isnan(found.errors.px[list(found.folds[1])]).all()
    others = list(found.folds[0])
    np.testing.assert_array_equal(
        np.isfinite(found.errors.px[others]), np.asarray(scene.data.visible)[others]
    )


class Fit:
    """A fit that predicts by the truth and stops early when view 0 is hidden."""

    def __init__(self, data, calibration):
        stopped = not np.asarray(data.visible)[0].any()
        self.result = FitResult(
            FitCode.STOPPED_EARLY if stopped else FitCode.CONVERGED,
            "stopped" if stopped else "fine",
        )
        self.calibration = calibration


def test_a_fold_that_did_not_converge_is_named_and_counts(scene):
    found = held_out(scene.data, lambda data: Fit(data, scene.calibration))
    fold = next(k for k, views in enumerate(found.folds) if 0 in views)
    assert found.unconverged_folds == ((fold, "stopped"),)
    np.testing.assert_array_equal(np.isfinite(found.errors.px), np.asarray(scene.data.visible))


def test_parts_of_one_fit_are_scored_from_the_same_refits(scene):
    far = scene.calibration.target_scale * 1.01
    worse = type(scene.calibration).eye_in_hand(
        scene.calibration.camera,
        scene.calibration.camera_from_tool,
        scene.calibration.base_from_world,
        far,
    )
    fits = fit_folds(scene.data, lambda _: {"good": scene.calibration, "bad": worse})
    good = score(fits, scene.data, lambda fit, _: fit["good"]).errors
    bad = score(fits, scene.data, lambda fit, _: fit["bad"]).errors
    assert good.rms == reprojection_errors(scene.calibration, scene.data).rms
    assert bad.rms == reprojection_errors(worse, scene.data).rms > good.rms


def test_what_a_fit_predicts_without_its_correction_is_scored_too(scene):
    field = LinearInPosition.from_poses(scene.data.base_from_tool)
    bent = dataclasses.replace(
        scene.calibration, robot_error=RobotError(field, jnp.full(field.size, 1e-3))
    )
    assert has_correction(bent)
    assert not has_correction(scene.calibration)
    fits = fit_folds(scene.data, lambda _: bent)
    bare = score(fits, scene.data, choose_uncorrected()).errors
    # The scene was made by a robot without error.
    assert bare.rms == reprojection_errors(scene.calibration, scene.data).rms
    assert score(fits, scene.data).errors.rms > 10.0 * bare.rms


def test_too_little_to_hold_out(scene):
    with pytest.raises(ValueError, match="folds: expected at least 2, found 1"):
        held_out(scene.data, lambda _: scene.calibration, folds=1)
    few = scene.data.select(range(3))
    with pytest.raises(ValueError, match="by view needs at least 4 usable views, found 3"):
        held_out(few, lambda _: scene.calibration)
