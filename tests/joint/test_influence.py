import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from jaxlie import SE3
from scipy import stats
from starts import nudged

from smartview_jax import Noise, Prior, fit_joint, view_influence
from smartview_jax.joint.influence import pose_outlier_test

VIEWS = 10
NOISE = Noise(0.05, 7e-5, 1.7e-4)
"""Small, so that what is of second order is."""
ROBOT = {"translation_noise": 2e-4, "rotation_noise": 5e-4}


def known_scene(seed):
    return scene_of(
        seed,
        VIEWS,
        pixel_noise=NOISE.pixel,
        translation_noise=NOISE.translation,
        rotation_noise=NOISE.rotation,
    )


@pytest.fixture(scope="module")
def scene():
    return known_scene(2)


@pytest.fixture(scope="module")
def fit(scene):
    return fit_joint(scene.data, nudged(scene.calibration), noise=NOISE)


@eqx.filter_jit
def normal_matrix(problem, z):
    return problem.normal_equations(z).matrix


def scored(problem, z, sizes_known):
    return pose_outlier_test(problem, z, normal_matrix(problem, z), sizes_known)


def numbers(calibration, other):
    """What moved, in the units of the parameters."""
    gap = calibration.camera_from_tool, other.camera_from_tool
    turn = (gap[0].rotation() @ gap[1].rotation().inverse()).log()
    return np.concatenate([gap[0].translation() - gap[1].translation(), turn])


@pytest.mark.parametrize("noise", [NOISE, "trusted"])
def test_moves_are_those_of_refits(scene, noise):
    if noise == "trusted":
        scene = scene_of(2, VIEWS, pixel_noise=NOISE.pixel)
    start = nudged(scene.calibration)
    whole = fit_joint(scene.data, start, noise=noise)
    found = view_influence(whole)
    hand = [k for k, name in enumerate(found.parameter_names) if name.startswith("camera_from_t")]
    std = found.std[hand]
    for view in (0, 4, 7):
        refit = fit_joint(scene.data.mask_views([view]), start, noise=noise)
        moved = numbers(refit.calibration, whole.calibration) / std
        stated = found.deletion_changes[view, hand] / std
        # First order: a tenth of the move, or of a standard deviation where it is small.
        np.testing.assert_allclose(stated, moved, atol=0.1 * max(1.0, np.abs(moved).max()))
        assert np.abs(moved).max() > 0.1
        assert found.max_standardised_change("camera_from_tool")[view] == pytest.approx(
            np.abs(stated).max()
        )


def test_square_pixels_stay_square_without_a_view(scene, fit):
    square = {"camera.pixel_aspect": Prior(mean=1.0, std=1e-9)}
    start = nudged(scene.calibration)
    changes = view_influence(fit_joint(scene.data, start, noise=NOISE, priors=square))
    assert changes.parameter_names == fit.parameter_names
    alpha_u, alpha_v = changes.deletion_changes[:, :2].T
    np.testing.assert_allclose(alpha_v, alpha_u, rtol=1e-4)
    assert np.abs(alpha_u).max() > 0.1


def test_by_default_it_is_on_the_mount_whatever_it_is_called(fit):
    found = view_influence(fit)
    np.testing.assert_array_equal(
        found.max_standardised_change(), found.max_standardised_change("camera_from_tool")
    )
    names = [name.replace("camera_from_tool", "camera_from_base") for name in fit.parameter_names]
    stands = found._replace(parameter_names=tuple(names), mount_path="camera_from_base")
    np.testing.assert_array_equal(stands.max_standardised_change(), found.max_standardised_change())


def test_a_path_that_names_nothing_is_refused(fit):
    with pytest.raises(ValueError, match="no parameter is called 'camera_from_base'"):
        view_influence(fit).max_standardised_change("camera_from_base")


def test_a_ratio_of_focal_lengths_is_not_taken_for_a_focal_length(scene, fit):
    path = "camera.pixel_aspect"
    with pytest.raises(ValueError, match="of priors only; expected 'camera"):
        view_influence(fit).max_standardised_change(path)
    with pytest.raises(ValueError, match="of priors only"):
        fit.p_value(scene.calibration, [path])


def test_the_distance_is_that_to_a_pose_predicted_without_the_report(scene, fit):
    """Give view 3 a prior without size: its correction, by the prior and its own covariance."""
    scores = scored(fit.problem, fit.solution.z, True)
    names = [
        f"pose_corrections.3.{part}.{axis}"
        for part in ("translation", "rotation")
        for axis in "xyz"
    ]
    wide = {name: Prior(std=1e3) for name in names}
    alone = fit_joint(scene.data, nudged(scene.calibration), noise=NOISE, priors=wide)
    correction = np.asarray(alone.pose_corrections)[3]
    # Its covariance by brute force, on the dense normal equations.
    dense = np.asarray(normal_matrix(alone.problem, alone.solution.z).as_matrix())
    scale = 1.0 / np.sqrt(np.diag(dense))
    inverse = np.linalg.inv(dense * scale[:, None] * scale) * scale[:, None] * scale
    first = len(alone.parameter_names) + 6 * 3
    spread = inverse[first : first + 6, first : first + 6]
    spread = spread + np.diag(np.repeat([NOISE.translation, NOISE.rotation], 3) ** 2)
    square = correction @ np.linalg.solve(spread, correction)
    assert float(scores.distance[3]) ** 2 == pytest.approx(square, rel=0.02)
    chance = stats.chi2.sf(float(scores.distance[3]) ** 2, 6)
    assert float(scores.p_value[3]) == pytest.approx(chance, rel=1e-9)


def test_where_the_model_is_true_the_chances_are_uniform():
    chances = []
    for seed in range(12):
        scene = known_scene(seed)
        fit = fit_joint(scene.data, scene.calibration, noise=NOISE)
        chances.append(np.asarray(scored(fit.problem, fit.solution.z, True).p_value))
    assert stats.kstest(np.concatenate(chances), "uniform").pvalue > 0.01


def bumped(data, view, correction):
    poses = data.base_from_tool.wxyz_xyz
    moved = SE3(poses[view]) @ SE3.exp(jnp.asarray(correction))
    return eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz, data, poses.at[view].set(moved.wxyz_xyz)
    )


def test_a_view_that_was_moved_is_named_and_left_out():
    """By 4 mm and 0.6 degrees: too little to stand out by itself, twenty of the robot's errors."""
    scene = scene_of(3, MANY_VIEWS, **ROBOT)
    data = bumped(scene.data, 6, [4e-3, 0.0, 0.0, 0.0, 0.0, 0.01])
    found = fit_joint(data, nudged(scene.calibration), noise="estimated", field=None)
    (entry,) = [entry for entry in found.rejected if entry[1] is None]
    assert entry[0] == "6"
    assert "standard deviations from where the other views put it" in entry[2]
    best = fit_joint(
        scene.data.mask_views([6]), nudged(scene.calibration), noise="estimated", field=None
    )
    apart = np.abs(numbers(found.calibration, best.calibration))
    std = [
        best.std[f"camera_from_tool.{p}.{a}"] for p in ("translation", "rotation") for a in "xyz"
    ]
    assert (apart < 0.05 * np.array(std)).all()
    kept = fit_joint(
        data, nudged(scene.calibration), noise="estimated", field=None, gross_errors="keep"
    )
    assert kept.noise.translation > 2.0 * found.noise.translation
    assert not [entry for entry in kept.rejected if entry[1] is None]


def test_a_robot_without_noise_gives_no_score_not_nan(fit):
    """What an estimate that trusts the robot leaves: priors that no view can tell anything of."""
    problem = eqx.tree_at(
        lambda p: p.prior_weight.per_view,
        fit.problem,
        jnp.full_like(fit.problem.prior_weight.per_view, 1e9),
    )
    scores = scored(problem, problem.zero_step(), False)
    np.testing.assert_array_equal(scores.distance, 0.0)
    np.testing.assert_array_equal(scores.p_value, 1.0)
