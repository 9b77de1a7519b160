import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import VIEWS, scene_of
from jaxlie import SE3
from programs import programs_added
from starts import nudged

from smartview_jax import Noise, Prior, fit_joint, fit_many
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.engine import build_problem
from smartview_jax.robot_errors import LinearInPosition, RobotError
from smartview_jax.simulation import paper_calibration


@pytest.fixture(autouse=True)
def _room_for_two(monkeypatch):
    """All fits of the same options share one program, however many they are."""
    monkeypatch.setattr("smartview_jax.joint.batched_fits.FITS_AT_A_TIME", 2)


@pytest.fixture(scope="module")
def scenes():
    """Three data sets of one shape; one of them does not show a view."""
    made = [scene_of(k, translation_noise=1e-4).data for k in range(3)]
    hidden = made[0].visible.at[4].set(False)
    made[0] = eqx.tree_at(lambda d: d.visible, made[0], hidden)
    return made


@pytest.fixture(scope="module")
def bent(scenes):
    """A calibration that corrects the robot."""
    error = RobotError(LinearInPosition.from_poses(scenes[0].base_from_tool), jnp.full(18, 1e-4))
    return dataclasses.replace(paper_calibration(), robot_error=error)


def test_poses_are_checked_as_in_one_fit(scenes):
    """Nothing is fitted where nothing can be found; a pose that was not read again is set aside."""
    first = scenes[1]
    still = SE3(jnp.broadcast_to(first.base_from_tool.wxyz_xyz[0], (VIEWS, 7)))
    unmoved = dataclasses.replace(first, base_from_tool=still)
    halved = dataclasses.replace(first, pixels=first.pixels / 2.0, image_size=(320, 240))
    told = fit_many([first, unmoved, first, halved], paper_calibration())
    with pytest.raises(ValueError, match=r"data\[1\]: all \d+ robot poses are equal"):
        told[1]
    assert np.isnan(told.covariance[1]).all()
    assert told.errors[0] is None
    assert told.converged.tolist() == [True, False, True, False]
    with pytest.raises(ValueError, match=r"data\[3\]: the start's camera takes pictures of 640 x"):
        told[3]
    stale_pose = first.base_from_tool.wxyz_xyz.at[3].set(first.base_from_tool.wxyz_xyz[2])
    stale = dataclasses.replace(first, base_from_tool=SE3(stale_pose))
    hidden = eqx.tree_at(lambda d: d.visible, first, first.visible.at[3].set(False))
    fits = fit_many([hidden, stale], paper_calibration())
    (warning,) = fits.warnings
    assert warning.startswith("data[1]: 1 views (3) repeat another view's pose")
    transforms = fits.calibrations.camera_from_tool.wxyz_xyz
    np.testing.assert_allclose(transforms[0], transforms[1], atol=1e-10)


KNOWN = Noise(0.15, 1e-4, np.inf)
"""Rotations may be anything, so that the views say which of them may move."""


@pytest.mark.parametrize("noise", ["trusted", KNOWN], ids=["trusted", "noise"])
def test_each_of_many_fits_is_what_one_fit_finds(scenes, bent, noise, monkeypatch):
    """With the field of the start, or without it where that is asked for; in turn or at once."""
    options = {"noise": noise, "field": None}
    if noise != "trusted":
        for module in ("many", "batched_fits"):
            monkeypatch.setattr(f"smartview_jax.joint.{module}.runs_in_turn", lambda: False)
        monkeypatch.setattr("smartview_jax.joint.batched_fits.FITS_AT_ONCE", 2)
        options = {"noise": noise, "fixed": ("camera_from_tool",)}
    starts = [nudged(bent, size) for size in (1e-3, 5e-4, -1e-3)]
    starts = [dataclasses.replace(one, robot_error=bent.robot_error) for one in starts]
    together = fit_many(scenes, starts, **options)
    assert len(together) == 3
    assert (together[0].robot_error is None) == (noise == "trusted")
    assert bool(jnp.all(together.converged))
    for k, (data, start) in enumerate(zip(scenes, starts, strict=True)):
        alone = fit_joint(data, start, **options)
        assert together.parameter_names == alone.parameter_names
        assert float(together.cost[k]) == pytest.approx(alone.solution.costs[-1], rel=1e-10)
        assert int(together.steps[k]) == alone.solution.steps
        gap = together[k].camera_from_tool.inverse() @ alone.calibration.camera_from_tool
        assert float(jnp.linalg.norm(gap.log())) < 1e-9
        np.testing.assert_allclose(
            np.sqrt(np.diag(together.covariance[k])), np.sqrt(np.diag(alone.covariance)), rtol=1e-4
        )
        if noise != "trusted":
            np.testing.assert_allclose(
                together.pose_corrections[k], alone.pose_corrections, atol=1e-10
            )


def test_priors_and_losses_weigh_as_in_one_fit_and_a_lens_may_be_asked_for(scenes):
    """One start serves all."""
    pinhole = Camera(2133.0, 2133.0, 320.0, 240.0, Pinhole(), (640, 480))
    start = dataclasses.replace(nudged(paper_calibration()), camera=pinhole)
    told = {
        "priors": {"camera.u0": Prior(std=2.0), "camera.v0": Prior(std=2.0)},
        "loss": "cauchy",
        "lens": "radial",
        "fixed": ("camera.alpha_v",),
    }
    together = fit_many(scenes[1:], start, **told)
    assert together.parameter_names[:4] == (
        "camera.alpha_u",
        "camera.u0",
        "camera.v0",
        "camera.lens.k1",
    )
    for k in range(2):
        alone = fit_joint(scenes[1 + k], start, noise="trusted", **told)
        np.testing.assert_allclose(
            np.sqrt(np.diag(together.covariance[k])), np.sqrt(np.diag(alone.covariance)), rtol=5e-3
        )
    assert float(together[1].camera.lens.k1) == pytest.approx(
        float(alone.calibration.camera.lens.k1), rel=1e-3
    )


def test_square_pixels_are_known_as_in_one_fit(scenes):
    start, noise = nudged(paper_calibration()), Noise(0.15, 1e-4, 2e-4)
    told = {"camera.pixel_aspect": Prior(mean=1.0, std=1e-5)}
    together = fit_many(scenes[1:], start, noise=noise, priors=told)
    for k in range(2):
        alone = fit_joint(scenes[1 + k], start, noise=noise, priors=told)
        std = np.sqrt(np.diag(alone.covariance))
        difference = (together.covariance[k] - alone.covariance) / np.outer(std, std)
        assert np.abs(difference).max() < 1e-4
        camera = together[k].camera
        assert float(camera.alpha_v / camera.alpha_u) == pytest.approx(1.0, abs=4e-5)
        assert std[1] == pytest.approx(std[0], rel=1e-3)


def test_what_priors_cost_is_no_scatter_of_pixels(scenes, monkeypatch):
    """Priors that contradict the pixels add to the cost; the pixels' variance leaves them out.

    By the program of the test before. One fit alone would also name the priors, and widen its
    intervals by what they may have moved.
    """
    monkeypatch.setattr("smartview_jax.joint.fit.held_value_test", lambda _: None)
    start = nudged(paper_calibration())
    camera = start.camera
    told = {
        "camera.alpha_u": Prior(std=0.5, mean=float(camera.alpha_u) + 20.0),
        "camera.alpha_v": Prior(std=0.5, mean=float(camera.alpha_v) - 20.0),
    }
    options = {"priors": told, "loss": "cauchy", "fixed": ("camera.u0",)}
    together = fit_many(scenes[:2], start, **options)
    alone = fit_joint(scenes[0], start, noise="trusted", **options)
    np.testing.assert_allclose(
        np.diag(together.covariance[0]), np.diag(alone.covariance), rtol=1e-3
    )


def test_errors_have_the_size_that_is_stated(scene):
    """The normalised error of all parameters, over many noisy copies, is chi-square."""
    truth, count = scene.calibration, 60
    clean, _ = truth.project(scene.base_from_tool, scene.data.points)
    # Little noise, so that the chain is linear over the errors that it causes.
    noise = 0.03 * np.random.default_rng(0).normal(size=(count, *clean.shape))
    copies = [
        dataclasses.replace(scene.data, pixels=jnp.asarray(np.asarray(clean) + one))
        for one in noise
    ]
    fits = fit_many(copies, truth)
    parameters = build_problem(scene.data, truth).problem.parameters
    error = np.asarray(jax.jit(jax.vmap(parameters.step_to))(fits.calibrations))[:, :-1]
    n = len(fits.parameter_names)
    nees = np.einsum("ki,kij,kj->k", error, np.linalg.inv(fits.covariance), error)
    assert nees.mean() == pytest.approx(n, abs=4.0 * np.sqrt(2.0 * n / count))


def test_what_the_data_do_not_tell_has_no_finite_variance(scenes):
    # Points on one line: a turn of the target about it changes no picture.
    on_a_line = scenes[1].visible & (scenes[1].points[..., 1] == 0.0)
    few = eqx.tree_at(lambda d: d.visible, scenes[1], on_a_line)
    found = fit_many([scenes[1], few], paper_calibration())
    assert np.isfinite(found.covariance[0]).all()
    assert np.isinf(found.covariance[1]).all()


def test_one_program_takes_any_number_in_turns(scenes):
    start = nudged(paper_calibration())
    three = fit_many(scenes, start)
    with programs_added() as added:
        five = fit_many([*scenes, *scenes[:2]], start)
    assert not added
    np.testing.assert_array_equal(five.cost, np.asarray(three.cost)[[0, 1, 2, 0, 1]])
    alone = fit_joint(scenes[2], start, noise="trusted")
    assert float(three.cost[2]) == pytest.approx(alone.solution.costs[-1], rel=1e-10)


def test_what_is_not_alike_is_named(scenes):
    start = paper_calibration()
    with pytest.raises(ValueError, match="at least one data set"):
        fit_many([], start)
    with pytest.raises(ValueError, match="takes the noise as given"):
        fit_many(scenes, start, noise="estimated")
    with pytest.raises(ValueError, match="start: expected one, or 3, found 2"):
        fit_many(scenes, [start, start])
    pinhole = eqx.tree_at(lambda c: c.camera.lens, start, Pinhole())
    with pytest.raises(ValueError, match=r"start\[1\]: lens, picture size or mount differs"):
        fit_many(scenes[:2], [start, pinhole])


def test_many_fits_are_a_sequence(scenes):
    fits = fit_many(scenes[:2], paper_calibration())
    assert len(list(fits)) == 2
    assert float(fits[-1].camera.u0) == float(fits[1].camera.u0)
    with pytest.raises(IndexError):
        fits[2]


def test_every_data_set_is_looked_at(scenes):
    """Not the first one alone, whose views also say which poses may move."""
    few = scenes[1].mask_views(range(1, VIEWS))
    with pytest.raises(ValueError, match=r"data\[1\]: a joint fit needs at least 3 views"):
        fit_many([scenes[0], few, scenes[0]], paper_calibration())[1]
    with pytest.raises(ValueError, match=r"data\[0\]: a joint fit needs at least 3 views"):
        fit_many([few, few], paper_calibration())
    poses = scenes[2].base_from_tool.wxyz_xyz
    turned = SE3(poses[3]) @ SE3.exp(jnp.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))
    blind = eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz, scenes[2], poses.at[3].set(turned.wxyz_xyz)
    )
    fits = fit_many([scenes[0], blind, scenes[1]], paper_calibration())
    with pytest.raises(ValueError, match=r"data\[1\]: start: every point of view 3 is behind"):
        fits[1]
    assert bool(fits.converged[2])


def test_data_sets_of_other_shapes_get_what_one_fit_finds(scenes):
    """They are padded to shapes in common, and keep their order."""
    noise, fewer = Noise(0.15, 1e-4, 1e-3), scene_of(4, views=5).data
    arrays = {name: getattr(fewer, name)[:, :12] for name in ("points", "pixels", "visible")}
    given = [scenes[1], scene_of(5, views=7).data, dataclasses.replace(fewer, **arrays)]
    start = nudged(paper_calibration())
    together = fit_many(given, start, noise=noise)
    for k, data in enumerate(given):
        alone = fit_joint(data, start, noise=noise)
        assert float(together.cost[k]) == pytest.approx(alone.solution.costs[-1], rel=1e-9)
        np.testing.assert_allclose(
            np.sqrt(np.diag(together.covariance[k])), np.sqrt(np.diag(alone.covariance)), rtol=1e-3
        )
        corrections = together.pose_corrections[k]
        views = data.view_count
        np.testing.assert_allclose(corrections[:views], alone.pose_corrections, atol=1e-9)
        assert not corrections[views:].any()
