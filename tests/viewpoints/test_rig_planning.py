import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from calibrated_rig import calibrated_rig, rig_scene
from jaxlie import SE3

from smartview_jax import Noise, Prior, Rig, choose_views, cramer_rao
from smartview_jax.geometry import host_exponentials, host_matrices, host_transforms
from smartview_jax.robot_errors import JointOffsets, RobotError
from smartview_jax.robots import six_axes
from smartview_jax.simulation import paper_calibration, paper_points, random_viewpoints, simulate
from smartview_jax.viewpoints import (
    InformationModel,
    RigInformationModel,
    StopRule,
    ViewLimits,
    ViewRange,
    a_optimal,
    d_optimal,
    i_optimal,
    plan_states,
)

TRUTH = paper_calibration()
POINTS = paper_points((0.0, 0.02))[::6]
CENTRE = POINTS.mean(axis=0)
NOISE = Noise(0.15, 1e-4, float(np.deg2rad(0.01)))
CANDIDATES, CHOSEN = 12, 4
"""As in `test_view_planning`, so that the tests share programs."""
LEVER_ARM = 0.2


def states(seed, tilt=0.7):
    """Commands of the robot at which the first camera sees the target."""
    rng = np.random.default_rng(seed)
    return TRUTH.command_for(random_viewpoints(rng, CANDIDATES, CENTRE, (0.17, 0.25), tilt))


def second_camera():
    """The calibration of a second camera on the hand, which looks inwards."""
    offset = host_exponentials(np.array([0.02, 0.0, 0.0, 0.0, -0.13, 0.02]))
    there = host_transforms(offset @ host_matrices(TRUTH.camera_from_mount))
    return dataclasses.replace(TRUTH, camera_from_mount=there)


def of_cameras(calibrations, commands):
    """The rig that simulated pictures make, and its model."""
    data = {
        name: simulate(calibration, commands, POINTS, pixel_noise=0.0).data
        for name, calibration in calibrations.items()
    }
    rig = Rig(data)
    return rig, RigInformationModel.from_calibrations(calibrations, rig, NOISE)


@pytest.fixture(scope="module")
def commands():
    return states(0)


@pytest.fixture(scope="module")
def pair(commands):
    """A rig of two cameras, its model, and the information of its states."""
    calibrations = {"left": TRUTH, "right": second_camera()}
    rig, model = of_cameras(calibrations, commands)
    return rig, model, np.asarray(model.information(rig))


def test_one_camera_is_planned_as_alone(commands):
    alone = InformationModel.from_calibration(TRUTH, POINTS, NOISE)
    rig, model = of_cameras({"only": TRUTH}, commands)
    planned = model.planned(commands)
    np.testing.assert_array_equal(
        planned.cameras["only"].visible, np.isfinite(rig.cameras["only"].pixels).all(axis=-1)
    )
    poses = TRUTH.camera_from_world(commands)
    order = [model.parameter_names.index(name) for name in _named("only", alone.parameter_names)]

    def same(of_rig, of_camera):
        """To 1e-9 of each parameter's own scale."""
        of_rig, of_camera = np.asarray(of_rig)[:, order][:, :, order], np.asarray(of_camera)
        scale = np.sqrt(np.diagonal(of_camera.max(axis=0)))
        units = np.outer(scale, scale)
        np.testing.assert_allclose(of_rig / units, of_camera / units, atol=1e-9)

    same(model.information(planned), alone.information(poses))
    tests = states(99, 0.3)
    of_rig = i_optimal(model, tests).weight_matrix
    of_camera = i_optimal(alone, TRUTH.camera_from_world(tests)).weight_matrix
    same(np.asarray(of_rig)[None], np.asarray(of_camera)[None])
    chosen = choose_views(
        model, a_optimal(model, LEVER_ARM), CHOSEN, commands, min_visible_fraction=0.3
    )
    views = choose_views(
        alone, a_optimal(alone, LEVER_ARM), CHOSEN, poses, min_visible_fraction=0.3
    )
    np.testing.assert_allclose(
        host_matrices(TRUTH.camera_from_world(chosen.base_from_tool)),
        host_matrices(views.camera_from_world),
        atol=1e-12,
    )
    np.testing.assert_allclose(chosen.cumulative_criterion, views.cumulative_criterion, rtol=1e-9)
    assert chosen.unit == "m"
    assert chosen.view_ids == tuple(str(k) for k in chosen.states)


def test_square_pixels_are_known_before_the_first_view(commands):
    """As one row for alpha_u and alpha_v; the information of views stays the same."""
    camera, square = TRUTH.camera, Prior(mean=1.0, std=3e-4)
    told = {"camera.pixel_aspect": square}
    plain = InformationModel.from_calibration(TRUTH, POINTS, NOISE)
    alone = InformationModel.from_calibration(TRUTH, POINTS, NOISE, priors=told)
    row = np.zeros(len(alone.parameter_names))
    row[:2] = -float(camera.alpha_v) / float(camera.alpha_u) ** 2, 1.0 / float(camera.alpha_u)
    known = np.outer(row, row) / square.std**2
    np.testing.assert_allclose(alone.prior_information, known, atol=1e-9)
    poses = TRUTH.camera_from_world(commands)
    np.testing.assert_array_equal(alone.information(poses), plain.information(poses))
    rig, plain = of_cameras({"only": TRUTH}, commands)
    told = {"only.camera.pixel_aspect": square}
    model = RigInformationModel.from_calibrations({"only": TRUTH}, rig, NOISE, priors=told)
    np.testing.assert_allclose(model.prior_information[:2, :2], known[:2, :2], atol=1e-9)
    np.testing.assert_array_equal(model.information(rig), plain.information(rig))


def test_what_is_known_of_the_poses_of_states_counts_in_their_information(commands):
    rig, plain = of_cameras({"only": TRUTH}, commands)
    exact = {"pose_corrections": Prior(std=1e-9)}
    model = RigInformationModel.from_calibrations({"only": TRUTH}, rig, NOISE, priors=exact)
    more = np.asarray(model.information(rig)) - np.asarray(plain.information(rig))
    # What the poses' noise takes away is positive semidefinite, and not nothing.
    scale = np.sqrt(np.diagonal(np.asarray(model.information(rig)), axis1=1, axis2=2))
    values = np.linalg.eigvalsh(more / (scale[:, :, None] * scale[:, None, :]))
    assert values.min() > -1e-9
    assert values.max() > 0.1


def _named(camera, names):
    """A single camera's parameters as its rig calls them."""
    return [f"{camera}.{name}" if name.startswith("camera") else name for name in names]


def test_two_cameras_tell_what_the_bound_of_their_rig_says(pair):
    rig, model, information = pair
    bound = cramer_rao(model.calibrations, rig, NOISE)
    assert model.parameter_names == bound.parameter_names
    told = np.asarray(model.prior_information) + information.sum(axis=0)
    std = np.sqrt(np.diagonal(np.linalg.inv(told)))
    np.testing.assert_allclose(std, list(bound.std.values()), rtol=1e-7)
    squares = {}
    for camera in rig.cameras:
        path = f"{camera}.camera_from_tool"
        shift = sum(bound.std[f"{path}.translation.{axis}"] ** 2 for axis in "xyz")
        turn = sum(bound.std[f"{path}.rotation.{axis}"] ** 2 for axis in "xyz")
        squares[camera] = shift + 2.0 / 3.0 * LEVER_ARM**2 * turn
        value = a_optimal(model, LEVER_ARM, camera)(jnp.asarray(told))
        assert float(value) == pytest.approx(np.sqrt(squares[camera]), rel=1e-7)
    both = float(a_optimal(model, LEVER_ARM)(jnp.asarray(told)))
    assert both == pytest.approx(np.sqrt(np.mean(list(squares.values()))), rel=1e-7)


def test_the_states_kept_are_among_the_best_of_all_sets_for_all_cameras(pair):
    rig, model, information = pair
    weights = np.asarray(a_optimal(model, LEVER_ARM).weight_matrix)
    sets = list(itertools.combinations(range(CANDIDATES), CHOSEN))
    totals = np.array([information[list(some)].sum(axis=0) for some in sets])
    scale = np.sqrt(np.diagonal(totals.mean(axis=0)))
    inverses = np.linalg.inv(totals / np.outer(scale, scale)) / np.outer(scale, scale)
    values = np.sqrt(np.einsum("ij,sji->s", weights, inverses))
    chosen = choose_views(model, a_optimal(model, LEVER_ARM), CHOSEN, rig)
    value = values[sets.index(tuple(sorted(chosen.states.tolist())))]
    assert float(chosen.value) == pytest.approx(value, rel=1e-6)
    # Exchange need not find the very best of 495 sets.
    assert value <= min(np.quantile(values, 0.01), 1.01 * values.min())


def test_a_named_camera_has_states_of_its_own(pair):
    rig, model, _ = pair
    for camera in rig.cameras:
        criterion = a_optimal(model, LEVER_ARM, camera)
        for_it = choose_views(model, criterion, CHOSEN, rig)
        for_all = choose_views(model, a_optimal(model, LEVER_ARM), CHOSEN, rig)
        total = sum(np.asarray(model.information(rig))[k] for k in for_all.states)
        assert float(for_it.value) <= float(criterion(jnp.asarray(total))) * (1.0 + 1e-9)


def test_states_that_may_not_be_taken_are_not(pair, commands):
    rig, model, _ = pair

    def left(poses):
        return np.asarray(poses.translation())[:, 0] < np.median(
            np.asarray(commands.translation())[:, 0]
        )

    chosen = choose_views(
        model, d_optimal(), CHOSEN, commands, min_visible_fraction=0.3, allowed=left
    )
    assert left(chosen.base_from_tool).all()
    with pytest.raises(ValueError, match="13 states requested, but only 12 of 12 candidates"):
        choose_views(model, d_optimal(), 13, rig)
    # One camera has to see enough of its target, whatever the other sees.
    seen = [
        (np.asarray(data.visible).mean(axis=1) >= 0.8).sum()
        for data in model.planned(commands, 60.0).cameras.values()
    ]
    assert seen[0] > seen[1] > 0
    with pytest.raises(ValueError, match=f"12 states requested, but only {seen[0]} of 12"):
        choose_views(model, d_optimal(), 12, commands, border_margin=60.0, min_visible_fraction=0.8)
    # A state in which no camera sees the target tells nothing.
    away = SE3(jnp.asarray(commands.wxyz_xyz).at[3, 4:].add(1.0))
    with pytest.raises(ValueError, match="12 states requested, but only 11 of 12 candidates"):
        choose_views(model, d_optimal(), 12, away, min_visible_fraction=0.3)
    in_millimetres = SE3(jnp.asarray(commands.wxyz_xyz).at[:, 4:].multiply(1e3))
    with pytest.raises(ValueError, match=r"from the robot's base, .*: millimetres given as metr"):
        choose_views(model, d_optimal(), CHOSEN, in_millimetres)
    with pytest.raises(TypeError, match="of a rig, expected states of the robot or a Rig"):
        choose_views(model, d_optimal(), 3, ViewRange(CENTRE, (0.17, 0.25), 0.7))
    with pytest.raises(ValueError, match="expected a camera of left, right, found 'middle'"):
        a_optimal(model, LEVER_ARM, "middle")


def test_an_arms_own_errors_need_commands_with_joints(commands):
    error = RobotError(JointOffsets(six_axes()), jnp.zeros(6))
    rig = Rig({"only": simulate(TRUTH, commands, POINTS, pixel_noise=0.0).data})
    model = RigInformationModel.from_calibrations({"only": TRUTH}, rig, NOISE)
    erring = dataclasses.replace(TRUTH, robot_error=error)
    with pytest.raises(ValueError, match="give commands with joint readings"):
        dataclasses.replace(model, calibrations={"only": erring}).planned(commands)


def test_after_a_fit_its_covariance_is_what_is_known(tmp_path_factory):
    fit, rig = calibrated_rig(tmp_path_factory), rig_scene().rig
    model = RigInformationModel.from_fit(fit, rig)
    assert set(model.parameter_names) == set(fit.parameter_names)
    order = [fit.parameter_names.index(name) for name in model.parameter_names]
    std = np.array([fit.std[name] for name in model.parameter_names])
    product = np.asarray(model.prior_information) @ np.asarray(fit.covariance)[np.ix_(order, order)]
    np.testing.assert_allclose(product * std[:, None] / std, np.eye(len(std)), atol=1e-6)
    built = model.build(rig)
    for cameras, group in zip(built.cameras, built.problem.groups, strict=True):
        for camera, sigma in zip(cameras, group.problems.pixel_sigma, strict=True):
            expected = fit.pixel_sigmas[camera]
            assert float(sigma * built.problem.pixel_sigma) == pytest.approx(expected, rel=1e-12)
    open_one = dataclasses.replace(fit, std={**fit.std, "camera1.camera.u0": np.inf})
    with pytest.raises(ValueError, match=r"fit: the data do not determine camera1\.camera\.u0"):
        RigInformationModel.from_fit(open_one, rig)


def hand_eye_error(fit, covariance, names, distance):
    """The displacement of a point before each camera, root mean square over both, by NumPy."""
    squares = []
    for camera, calibration in fit.calibrations.items():
        path = f"{camera}.{calibration.transform_names[0]}"
        shift, turn = (
            sum(covariance[k, k] for k, n in enumerate(names) if n.startswith(f"{path}.{part}."))
            for part in ("translation", "rotation")
        )
        squares.append(shift + 2.0 / 3.0 * distance**2 * turn)
    return np.sqrt(np.mean(squares))


def test_the_next_states_of_a_rig_bring_what_is_promised(tmp_path_factory):
    fit, rig = calibrated_rig(tmp_path_factory), rig_scene().rig
    model = RigInformationModel.from_fit(fit, rig)
    actual = plan_states(model, ViewLimits(), StopRule(3, least_gain=0.0))
    plan, commands = actual.plan, actual.commands
    assert len(actual.view_of) == len(plan.values) == 3
    assert np.asarray(commands.checks.safe).all()
    before = hand_eye_error(fit, np.asarray(fit.covariance), fit.parameter_names, plan.distance)
    assert plan.before == pytest.approx(before, rel=1e-6)
    told = model.information(model.planned(commands.command)).sum(axis=0)
    after = np.linalg.inv(np.asarray(model.prior_information) + np.asarray(told))
    expected = hand_eye_error(fit, after, model.parameter_names, plan.distance)
    assert plan.after == pytest.approx(expected, rel=1e-5)
    assert plan.after < 0.95 * plan.before
    for state, camera in enumerate(actual.view_of):
        assert actual.seen[camera][state] == 1.0
    for camera, calibration in fit.calibrations.items():
        pixels, valid = calibration.project(commands.base_from_tool, rig.cameras[camera].points[0])
        last = np.array(calibration.camera.image_size) - 1
        inside = (np.asarray(pixels) >= 0) & (np.asarray(pixels) <= last)
        shown = (inside.all(axis=-1) & np.asarray(valid)).mean(axis=1)
        np.testing.assert_allclose(actual.seen[camera], shown, atol=1e-12)
    # A goal that is reached already needs no state.
    enough = plan_states(model, ViewLimits(), StopRule(3, goal=1.0))
    assert (enough.view_of, len(enough.plan.camera_from_world)) == ((), 0)
