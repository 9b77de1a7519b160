import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from fit_scenes import MANY_VIEWS, scene_of, scene_with, thinned
from jaxlie import SE3, SO3
from shared_data import shared_pairs
from starts import nudged, reference_start

from smartview_jax import Noise, Prior, fit_joint
from smartview_jax.cameras import Camera, Pinhole
from smartview_jax.evaluation import reprojection_errors
from smartview_jax.robot_errors import (
    LinearInPose,
    LinearInPosition,
    RobotError,
    RobotPrior,
    ScaleError,
    SmoothInPose,
)
from smartview_jax.simulation import paper_calibration

VIEWS = MANY_VIEWS
TRANSLATION, ROTATION, PIXEL = 2e-4, 5e-4, 0.1


def white_scene(seed):
    return scene_of(
        seed,
        VIEWS,
        pixel_noise=PIXEL,
        translation_noise=TRANSLATION,
        rotation_noise=ROTATION,
    )


def fit(scene, **options):
    return fit_joint(scene.data, nudged(scene.calibration), noise="estimated", **options)


@pytest.fixture(scope="module")
def white():
    return [fit(white_scene(seed), field=None, gross_errors="keep") for seed in range(12)]


def test_white_noise_is_found_at_its_size(white):
    """Variances are unbiased; twelve sets of sixteen views tell them to a tenth or so."""
    found = [[f.noise.translation, f.noise.rotation, f.noise.white_pixel] for f in white]
    sizes = np.sqrt(np.mean(np.square(found), axis=0))
    np.testing.assert_allclose(sizes, [TRANSLATION, ROTATION, PIXEL], rtol=0.15)


def test_margins_are_wider_for_sizes_that_were_found(white):
    """Student's t on the degrees of freedom that sixteen views of six numbers leave, or fewer."""
    one = white[0]
    # Of the mount's numbers the one that rests most on what the robot errs by.
    mount = [name for name in one.degrees_of_freedom if name.startswith("camera_from_tool.")]
    name = min(mount, key=one.degrees_of_freedom.get)
    freedom = one.degrees_of_freedom[name]
    assert 5.0 < freedom < 6 * VIEWS
    times = one.confidence_half_width(name, 0.9) / one.std[name]
    assert times == pytest.approx(scipy.stats.t(freedom).ppf(0.95), rel=1e-9)
    given = fit_joint(white_scene(0).data, one.calibration, noise=one.noise)
    assert given.confidence_half_width(name) == pytest.approx(1.959964 * given.std[name], rel=1e-6)


def test_how_far_a_mount_is_from_what_the_pictures_say(white):
    """The true one as often as stated; one moved by its margin just at the level; a far one not."""
    truth = white_scene(0).calibration
    chances = [one.p_value(truth) for one in white]
    assert scipy.stats.kstest(chances, "uniform").pvalue > 0.01
    one, path = white[0], "camera_from_tool.translation.x"
    mount = one.calibration.camera_from_tool
    aside = mount.translation().at[0].add(one.confidence_half_width(path))
    moved = SE3.from_rotation_and_translation(mount.rotation(), aside)
    other = dataclasses.replace(one.calibration, camera_from_mount=moved)
    assert one.p_value(other, [path]) == pytest.approx(0.05, rel=1e-3)
    turned = SE3.from_rotation_and_translation(
        SO3.exp(jnp.array([0.01, 0.0, 0.0])) @ mount.rotation(), mount.translation()
    )
    assert one.p_value(dataclasses.replace(one.calibration, camera_from_mount=turned)) < 1e-9
    assert one.p_value(one.calibration, ["camera", "base_from_world"]) == 1.0


def test_what_cannot_be_compared_is_named(white):
    one, truth = white[0], white_scene(0).calibration
    with pytest.raises(ValueError, match="no parameter is called 'camera_from_hand'"):
        one.p_value(truth, ["camera_from_hand"])
    pinhole = dataclasses.replace(
        truth, camera=Camera(2e3, 2e3, 320.0, 240.0, Pinhole(), (640, 480))
    )
    with pytest.raises(ValueError, match=r"truth: expected the parameters .* of the fit, found .*"):
        one.p_value(pinhole)


def test_pixels_that_err_alone_are_weighed_as_they_scatter(white):
    times = [one.noise.pixel / one.noise.white_pixel for one in white]
    assert min(times) >= 1.0
    assert np.median(times) < 1.2
    assert all(one.noise_estimate.converged for one in white)


def test_a_robot_with_white_noise_is_not_given_a_field():
    """Also where one gains by chance, as in the first and last."""
    names = [fit(white_scene(seed)).noise_estimate.name for seed in range(5)]
    assert names == ["white"] * 5


@pytest.fixture(scope="module")
def crooked():
    """A robot whose error is smooth, and views of it on which to judge."""
    rng = np.random.default_rng(1)
    poses = scene_of(0, VIEWS).data.base_from_tool
    field = LinearInPose.from_poses(poses)
    sizes = np.repeat([4e-4, 8e-4, 3e-4, 6e-4], [count for _, count in field.groups])
    error = RobotError(field, jnp.asarray(sizes * rng.normal(size=field.size)))
    truth = dataclasses.replace(paper_calibration(), robot_error=error)
    small = {"pixel_noise": PIXEL, "translation_noise": 2e-5, "rotation_noise": 5e-5}
    seen, unseen = (scene_with(truth, k, VIEWS, **small) for k in (0, 7))
    return seen, unseen, fit(dataclasses.replace(seen, calibration=paper_calibration()))


def test_a_smooth_error_is_found_and_corrected(crooked):
    seen, unseen, found = crooked
    assert found.noise_estimate.name == "pose"
    gains = {one.name: one.log_likelihood_ratio for one in found.noise_estimate.candidates}
    assert gains["pose"] > gains["white"] + 50.0
    exact = Noise(PIXEL, 1e-9, 1e-9)
    trusting = fit_joint(seen.data, nudged(paper_calibration()), noise=exact)
    errors = [reprojection_errors(f.calibration, unseen.data).rms for f in (found, trusting)]
    assert errors[0] < 0.5 * errors[1]


def test_a_smooth_errors_twist_is_the_true_one_up_to_what_no_data_tell(crooked):
    """A constant part of the error is the mount's or the world's: compare differences of views."""
    seen, _, found = crooked
    poses = seen.data.base_from_tool
    true, fitted = (c.camera_from_world(poses) for c in (seen.calibration, found.calibration))
    bare = found.calibration.camera_from_world(poses, corrected=False)
    scatter = []
    for predicted in (fitted, bare):
        apart = np.asarray((true @ predicted.inverse()).translation())
        scatter.append(np.median(np.linalg.norm(apart - apart.mean(axis=0), axis=1)))
    assert scatter[0] < 0.5 * scatter[1]


def test_a_field_is_kept_with_the_calibration_and_priors_say_its_size(crooked):
    _, _, found = crooked
    # It contains the linear field that the robot has.
    field = found.calibration.robot_error.field
    assert isinstance(field, SmoothInPose)
    assert len(found.noise.field) == len(field.groups)
    assert set(field.names) >= set(LinearInPose(field.centre, field.reach, field.axes).names)
    assert "robot_error.translation_by_position.0" in found.std
    assert found.pose_corrections.shape == (VIEWS, 6)


def test_no_field_is_taken_where_none_is_asked_for(crooked):
    none = fit_joint(crooked[0].data, nudged(paper_calibration()), noise="estimated", field=None)
    assert none.calibration.robot_error is None


def test_with_few_views_white_noise_is_believed_where_pixels_agree():
    scene = scene_of(3, 6, translation_noise=TRANSLATION, rotation_noise=ROTATION)
    found = fit(scene)
    assert found.noise_estimate.name == "white"
    assert found.noise.pixel < 3.0 * found.noise.white_pixel


def test_data_without_any_noise_are_fitted_exactly():
    scene = scene_of(0, VIEWS, pixel_noise=0.0)
    found = fit(scene)
    assert found.result.converged
    assert all(np.isfinite(size) for size in found.std.values())
    assert found.noise.translation < 1e-7
    apart = found.calibration.camera_from_tool.inverse() @ scene.calibration.camera_from_tool
    np.testing.assert_allclose(apart.log(), 0.0, atol=1e-7)


def test_a_prior_on_what_is_estimated_is_refused():
    scene = scene_of(0, VIEWS)
    with pytest.raises(ValueError, match=r"prior on 'pose_corrections.3': .* give a Noise"):
        fit(scene, priors={"pose_corrections.3": Prior(std=1e-3)})


def test_a_field_of_given_size_needs_a_deviation_for_each_group(crooked):
    seen, _, _ = crooked
    field = LinearInPosition.from_poses(seen.data.base_from_tool)
    with pytest.raises(ValueError, match=r"Noise.field: .*the field's 2 groups, found 1"):
        fit_joint(
            seen.data, seen.calibration, noise=Noise(0.2, 1e-4, 1e-4, field=(1e-3,)), field=field
        )


def test_a_real_target_is_smaller_than_it_is_said_to_be():
    """rct: ways of an arm are not 2 % off. What its field has left is half of the chain's error."""
    data, reference = shared_pairs("rct_circle10x10")
    data = thinned(data, 7)
    found = fit_joint(data, reference_start(reference), noise="estimated")
    scale = found.noise_estimate.target_scale
    assert scale.probability > 0.9
    assert float(found.calibration.target_scale) == pytest.approx(0.977, abs=0.003)
    assert found.noise.white_pixel < 0.2 < found.noise.pixel
    # The reference trusts the robot.
    assert reprojection_errors(found.calibration, data).rms < 0.6 * reference["joint_px"]


def test_a_start_that_corrects_the_robot_is_not_corrected_where_no_field_is_asked_for(crooked):
    """Sizes are of the errors in the chain that is fitted, wherever it began."""
    scene, _, corrected = crooked
    assert corrected.calibration.robot_error is not None
    again = fit_joint(scene.data, corrected.calibration, noise="estimated", field=None)
    fresh = fit_joint(scene.data, corrected.calibration.uncorrected, noise="estimated", field=None)
    assert again.calibration.robot_error is None
    assert again.noise.translation == pytest.approx(fresh.noise.translation, rel=1e-6)
    assert again.std == pytest.approx(fresh.std, rel=1e-6)


def test_with_everything_held_the_sizes_are_found_all_the_same():
    scene = white_scene(0)
    held = ("camera", "camera_from_tool", "base_from_world")
    found = fit_joint(scene.data, scene.calibration, fixed=held, field=None, gross_errors="keep")
    assert found.parameter_names == ()
    assert found.noise.translation == pytest.approx(TRANSLATION, rel=0.3)


def test_ways_that_are_too_long_are_a_field_for_who_asks():
    """Of eight views, by a share that a field alone takes for one of its many numbers."""
    poses = scene_of(2).data.base_from_tool
    plain = LinearInPose.from_poses(poses)
    field = ScaleError.from_poses(plain, poses)
    other = np.zeros(plain.size)
    other[:18] = np.repeat([2e-4, 4e-4], 9) * np.random.default_rng(3).normal(size=18)
    coefficients = jnp.asarray([*other, 0.13 * float(field.reach)])
    truth = dataclasses.replace(paper_calibration(), robot_error=RobotError(field, coefficients))
    small = {"pixel_noise": 0.1, "translation_noise": 2e-5, "rotation_noise": 4e-5}
    data = scene_with(truth, 2, **small).data
    unseen = scene_with(truth, 50, 30, pixel_noise=0.0).data
    prior = RobotPrior(wrong_target_probability=0.0)
    inner, stretched = (
        fit_joint(data, truth.uncorrected, noise="estimated", field=one, robot_prior=prior)
        for one in (plain, field)
    )
    assert inner.noise_estimate.name == "pose"
    assert eqx.tree_equal(inner.calibration.robot_error.field, plain)
    assert eqx.tree_equal(stretched.calibration.robot_error.field, field)
    errors = [reprojection_errors(one.calibration, unseen).rms for one in (stretched, inner)]
    assert errors[0] < 0.95 * errors[1]
    # Arms are not like that: without a word about it the target is taken to be larger.
    found = fit_joint(data, truth.uncorrected, noise="estimated")
    assert found.noise_estimate.target_scale.probability > 0.99
    assert float(found.calibration.target_scale) == pytest.approx(1.0 / (1.0 - 0.13), abs=0.02)
