"""Two arms that see one table: where their bases are to each other, and whose fault an error is."""

import dataclasses

import numpy as np
import pytest
from arms_scene import (
    FOUR_CAMERAS,
    LEFT_FROM_RIGHT,
    LENSES,
    NOISE,
    arms_fit,
    arms_scene,
    base_error,
    truth_of,
)
from jaxlie import SE3
from scipy.stats import chi2

from smartview_jax import (
    Prior,
    RelativePose,
    error_budget,
    fit_rig,
    load_estimate,
    load_rig_estimate,
)
from smartview_jax.engine import STEP_NAMES, build_rig
from smartview_jax.geometry import (
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transforms,
)
from smartview_jax.joint import RigEstimate, is_rig
from smartview_jax.joint.relative_pose import RigUncertainty, relative_base
from smartview_jax.viewpoints import RigInformationModel, StopRule, ViewLimits, plan_states

STATE = 5

MOUNT = tuple(f"camera_from_tool.{name}" for name in STEP_NAMES)
"""Names of the parameters of a camera's place on its hand."""

RIGHT_NOISE = 5.0
"""Noise of the right arm as a multiple of the left one's."""


@pytest.fixture(scope="module")
def rig():
    """One target connects the arms; the right one was not where it said in one of 16 states.

    Its reports err five times as much as the left one's.
    """
    rig, _ = arms_scene(2, views=16, right_noise=RIGHT_NOISE)
    data = rig.cameras["right_table"]
    poses = data.base_from_tool.wxyz_xyz.at[STATE, 4].add(20e-3)
    moved = dataclasses.replace(data, base_from_tool=SE3(poses))
    return rig.with_cameras({**rig.cameras, "right_table": moved})


@pytest.fixture(scope="module")
def fit(rig):
    return fit_rig(rig, arms_scene(2, views=16, right_noise=RIGHT_NOISE)[1], field=None)


def test_a_state_that_is_wrong_is_the_fault_of_its_own_arm(fit):
    ((camera, entry),) = fit.rejected
    assert (camera, entry.view) == ("right_table", f"table{STATE}")
    assert fit.warnings == ()
    for arm, times in (("left", 1.0), ("right", RIGHT_NOISE)):
        assert 0.5 < fit.noises[arm].translation / (times * NOISE.translation) < 2.0
        assert 0.5 < fit.noises[arm].rotation / (times * NOISE.rotation) < 2.0
    with pytest.raises(ValueError, match=r"this rig has the arms left, right: take noises\[...\]"):
        _ = fit.noise


def test_the_bases_are_known_as_well_as_said(fit):
    base, back = fit.base("left", "right"), fit.base("right", "left")
    error = base_error(base)
    assert error @ np.linalg.solve(base.covariance, error) < chi2.ppf(0.95, 6)
    assert (base.std[:3] < 5e-3).all()
    np.testing.assert_allclose(
        host_matrices(base.transform) @ host_matrices(back.transform), np.eye(4), atol=1e-12
    )
    for axis, offset in zip("xyz", error[:3], strict=True):
        name = f"base_left_from_base_right.translation.{axis}"
        assert abs(offset) < fit.confidence_half_width(name)


def test_the_base_has_the_covariance_of_both_arms_targets(rig, fit):
    """By simulation of the target's pose in both bases, which one target leaves independent."""
    rng, poses = np.random.default_rng(0), []
    for camera in rig.cameras:
        estimate = fit.estimate(camera)
        rows = [n.startswith("base_from_world") for n in estimate.parameter_names]
        own = estimate.covariance[np.ix_(rows, rows)]
        steps = rng.multivariate_normal(np.zeros(6), own, 20000)
        poses.append(_moved(host_matrices(estimate.calibration.base_from_world), steps))
    _has_covariance_of(poses[0] @ np.linalg.inv(poses[1]), fit.base("left", "right"))
    _has_covariance_of(poses[1] @ np.linalg.inv(poses[0]), fit.base("right", "left"))


def _moved(pose, steps):
    """The pose after translation and rotation steps, one for each row."""
    moved = host_exponentials(np.pad(steps[:, 3:], ((0, 0), (3, 0)))) @ pose
    moved[:, :3, 3] = pose[:3, 3] + steps[:, :3]
    return moved


def _has_covariance_of(drawn, relative):
    """Drawn poses scatter as a relative pose says."""
    turned = drawn @ np.linalg.inv(host_matrices(relative.transform))
    turned[:, :3, 3] = 0.0
    sampled = np.hstack([drawn[:, :3, 3], host_logarithms(turned)[:, 3:]])
    size = np.outer(relative.std, relative.std)
    np.testing.assert_allclose(np.cov(sampled.T) / size, relative.covariance / size, atol=0.03)


def test_bases_that_are_both_relative_to_a_third_have_the_covariance_of_both():
    """By simulation of both poses, whose errors are correlated."""
    rng = np.random.default_rng(1)
    bases = {"a": np.eye(4), "b": LEFT_FROM_RIGHT, "c": np.linalg.inv(LEFT_FROM_RIGHT)}
    mixing = 1e-3 * rng.standard_normal((12, 12))
    names = [f"base_a_from_base_{arm}.{name}" for arm in "bc" for name in STEP_NAMES]
    given = {name: host_transforms(pose) for name, pose in bases.items()}
    relative = relative_base(given, RigUncertainty(names, mixing @ mixing.T), "b", "c")
    steps = rng.standard_normal((20000, 12)) @ mixing.T
    drawn = [
        _moved(pose, own) for pose, own in ((bases["b"], steps[:, :6]), (bases["c"], steps[:, 6:]))
    ]
    _has_covariance_of(np.linalg.inv(drawn[0]) @ drawn[1], relative)


def test_with_one_common_target_each_arm_is_known_as_alone(rig, fit):
    """The arms then have only the place of the target to tell each other."""
    part = rig.of_arm("right")
    alone = fit_rig(part, {"right_table": truth_of("right_table")}, field=None)
    own, of_both = alone.estimate("right_table"), fit.estimate("right_table")
    assert own.parameter_names == of_both.parameter_names
    std = np.sqrt(np.outer(np.diagonal(own.covariance), np.diagonal(own.covariance)))
    np.testing.assert_allclose(of_both.covariance / std, own.covariance / std, atol=1e-5)
    name = "right_table.camera_from_tool.translation.x"
    assert fit.degrees_of_freedom[name] == pytest.approx(alone.degrees_of_freedom[name], rel=1e-3)
    assert alone.bases == {}
    with pytest.raises(ValueError, match="base: the rig has one arm, 'right'"):
        alone.base("left", "right")


def test_the_states_are_named_by_their_arms(rig, fit):
    assert fit.view_ids == rig.view_ids
    assert fit.pose_corrections.shape == (32, 6)
    # The wrong state has no correction; all others have one.
    names = [name for name in fit.std if name.startswith("pose_corrections.")]
    assert len(names) == 6 * 31
    assert f"pose_corrections.right/table{STATE}.translation.x" not in names
    assert not fit.pose_corrections[fit.view_ids.index(f"right/table{STATE}")].any()


def test_the_text_names_arms_and_bases(fit):
    text = str(fit)
    assert "\nleft: 0." in text
    assert "\nbase_left_from_base_right: " in text
    with pytest.raises(ValueError, match="'left_table' is on arm 'left' and 'right_table' on 'ri"):
        fit.relative("left_table", "right_table")
    with pytest.raises(ValueError, match="expected an arm of left, right, found 'middle'"):
        fit.base("left", "middle")


def test_a_target_that_was_moved_between_the_arms_views_is_said(tmp_path_factory):
    """Five standard deviations of the wall's place, which the fit with all views does not hide."""
    for moved, count in ((0.0, 0), (20e-3, 1)):
        said = [
            text
            for text in arms_fit(tmp_path_factory, moved).warnings
            if "contradict each other" in text
        ]
        assert len(said) == count
    assert "left, right contradict each other about the targets" in said[0]


def test_the_bases_are_saved_with_the_cameras(fit, tmp_path):
    fit.save(tmp_path / "out", run="tried")
    names = ("base_left_from_base_right", "left.joint", "left_table", "right.joint", "right_table")
    assert sorted(path.stem for path in (tmp_path / "out").iterdir()) == list(names)
    path = tmp_path / "out" / f"{names[0]}.yaml"
    read, base = RelativePose.load(path), fit.base("left", "right")
    np.testing.assert_allclose(read.transform.wxyz_xyz, base.transform.wxyz_xyz, atol=1e-15)
    np.testing.assert_allclose(read.covariance, base.covariance, rtol=1e-12)
    own, kept = fit.estimate("right_table"), load_estimate(tmp_path / "out" / "right_table.yaml")
    np.testing.assert_allclose(kept.covariance, own.covariance, rtol=1e-12)
    path.write_text(path.read_text().replace("end: smartview_relative_pose", ""))
    with pytest.raises(ValueError, match=r"base_left_from_base_right\.yaml: .*end"):
        RelativePose.load(path)


def test_what_is_known_of_a_base_is_used():
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)
    name = "base_left_from_base_right.translation.x"
    known = Prior(std=1e-6, mean=float(LEFT_FROM_RIGHT[0, 3]))
    fit = fit_rig(rig, truths, noise=NOISE, fixed=LENSES, priors={name: known})
    assert fit.std[name] < 1.01e-6
    assert abs(base_error(fit.base("left", "right"))[0]) < 4e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": ["base_from_world"]}, "no parameter is called 'base_from_world'; did you mean"),
        ({"fixed": ["base_left_from_base_right"]}, "a base has no start; give a prior"),
        ({"priors": {"base_left_from_base_right.rotation": Prior(std=1.0)}}, "give the mean"),
        ({"noise": {"left": NOISE}}, "noise: expected a value for arm 'right', found left"),
        ({"noise": "trusted"}, 'noise is "estimated" or a Noise for a rig'),
    ],
)
def test_wrong_options_are_named(options, message):
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)
    with pytest.raises(ValueError, match=message):
        fit_rig(rig, truths, **{"noise": NOISE, **options})


def test_starts_and_problems_of_other_rigs_are_refused(tmp_path_factory):
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)
    fit = arms_fit(tmp_path_factory)
    with pytest.raises(ValueError, match="starts: expected the cameras left_table, left_wall"):
        fit_rig(rig, {"left_table": truths["left_table"]}, noise=NOISE)
    with pytest.raises(
        ValueError, match="build_rig: expected a rig with one arm, found left, right"
    ):
        build_rig(rig, truths, noise=NOISE)
    with pytest.raises(ValueError, match="error_budget: expected a rig with one arm"):
        error_budget(rig, fit)
    with pytest.raises(ValueError, match="RigInformationModel: expected a rig with one arm"):
        RigInformationModel.from_fit(fit, rig)
    with pytest.raises(ValueError, match="fit: expected an arm of left, right, found 'middle'"):
        RigInformationModel.from_fit(fit, rig, "middle")
    with pytest.raises(ValueError, match="expected the fit of a rig with one arm, found left, ri"):
        RigEstimate.of(fit)


def test_each_arm_has_a_file_of_its_cameras_together(tmp_path_factory, tmp_path):
    """With the covariance that the fit of all arms gives them, in their own base."""
    fit = arms_fit(tmp_path_factory)
    fit.save(tmp_path)
    for arm in ("left", "right"):
        read = load_rig_estimate(tmp_path / f"{arm}.joint.yaml")
        expected = RigEstimate.of(fit, arm)
        assert set(read.calibrations) == {f"{arm}_table", f"{arm}_wall"}
        assert read.parameter_names == expected.parameter_names
        np.testing.assert_allclose(read.covariance, expected.covariance, rtol=1e-12)
        wall = fit.estimate(f"{arm}_wall")
        rows = [read.parameter_names.index(f"{arm}_wall.{name}") for name in MOUNT]
        own = [wall.parameter_names.index(name) for name in MOUNT]
        np.testing.assert_allclose(
            read.covariance[np.ix_(rows, rows)], wall.covariance[np.ix_(own, own)], rtol=1e-9
        )
    assert is_rig(tmp_path / "left.joint.yaml")
    assert not is_rig(tmp_path)


def test_the_next_states_of_one_arm_are_planned(tmp_path_factory):
    """From what the fit of all arms tells of its cameras, in its own base."""
    rig, fit = arms_scene(0, FOUR_CAMERAS, 4)[0], arms_fit(tmp_path_factory)
    model = RigInformationModel.from_fit(fit, rig, "right")
    names, covariance, _ = fit.of_arm("right")
    rows = [names.index(name) for name in model.parameter_names]
    known = np.asarray(model.prior_information) @ covariance[np.ix_(rows, rows)]
    np.testing.assert_allclose(known, np.eye(len(rows)), atol=1e-5)
    found = plan_states(model, ViewLimits(), StopRule(1, least_gain=0.0))
    assert set(found.seen) == {"right_table", "right_wall"}
    assert found.view_of[0] in found.seen
    assert found.plan.values[0] < found.plan.before
    # The command is of the right arm: its camera sees the whole target from there.
    truth, data = fit.calibrations[found.view_of[0]], rig.cameras[found.view_of[0]]
    pixels, valid = truth.project(found.commands.base_from_tool, np.asarray(data.points)[0])
    assert np.asarray(valid).all()
    assert ((np.asarray(pixels) > 0.0) & (np.asarray(pixels) < data.image_size)).all()
