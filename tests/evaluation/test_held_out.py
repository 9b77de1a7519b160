import jax.numpy as jnp
import numpy as np
import pytest

from smartview_jax import held_out
from smartview_jax.evaluation import Deviations, deviations, view_folds
from smartview_jax.simulation import paper_points, random_scene


@pytest.fixture(scope="module")
def scene():
    return random_scene(0, views=10, points=paper_points((0.0,))[::3])


def test_measures_are_what_they_say():
    px = np.array([[3.0, 4.0, np.nan], [0.0, 5.0, np.nan]])
    found = Deviations(px, 1e-3 * px)
    assert found.mean == 3.0
    assert found.std == pytest.approx(np.std([3.0, 4.0, 0.0, 5.0]))
    assert found.rms == pytest.approx(np.sqrt(12.5))
    assert found.rms_mm == pytest.approx(np.sqrt(12.5))
    np.testing.assert_allclose(found.per_view, [np.sqrt(12.5)] * 2)


def test_deviations_are_distances_and_millimetres_follow_from_depth(scene):
    found = deviations(scene.calibration, scene.data)
    seen = np.asarray(scene.data.visible)
    assert found.rms == pytest.approx(0.15 * np.sqrt(2.0), rel=0.1)
    depth = scene.calibration.points_in_camera(scene.data.base_from_tool, scene.data.points)[..., 2]
    np.testing.assert_allclose(
        found.m[seen], (found.px * np.asarray(depth) / 2133.0)[seen], rtol=1e-12
    )


def test_folds_are_the_fixed_permutation_dealt_out():
    views = np.arange(3, 18)
    order = np.random.default_rng(0).permutation(15)
    expected = [tuple(views[order[i::5]]) for i in range(5)]
    assert list(view_folds(views, 5)) == expected
    assert [len(fold) for fold in view_folds(np.arange(7), 5)] == [1] * 7


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
    np.testing.assert_array_equal(np.isfinite(found.deviations.px), np.asarray(scene.data.visible))
    assert found.deviations.rms == deviations(scene.calibration, scene.data).rms


def test_a_fold_that_fails_is_reported(scene):
    calls = iter(range(5))

    def fitter(_):
        if next(calls) == 1:
            raise ValueError("no")
        return scene.calibration

    found = held_out(scene.data, fitter)
    assert found.failures == ((1, "no"),)
    assert np.isnan(found.deviations.px[list(found.folds[1])]).all()


def test_too_little_to_hold_out(scene):
    with pytest.raises(ValueError, match="folds: expected at least 2, found 1"):
        held_out(scene.data, lambda _: scene.calibration, folds=1)
    few = scene.data.select(range(3))
    with pytest.raises(ValueError, match="at least 4 usable views, found 3"):
        held_out(few, lambda _: scene.calibration)
    assert jnp.isfinite(few.points).all()
