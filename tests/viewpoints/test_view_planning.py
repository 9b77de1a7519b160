import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from programs import programs_added

from smartview_jax import Dataset, Noise, Prior, cramer_rao, look_at, std_of
from smartview_jax.robot_errors import JointOffsets, RobotError
from smartview_jax.robots import six_axes
from smartview_jax.simulation import paper_calibration, paper_points, random_viewpoints, simulate
from smartview_jax.simulation.arm_scenes import HOME_JOINTS
from smartview_jax.viewpoints import (
    InformationModel,
    OptimalityCriterion,
    ViewRange,
    a_optimal,
    choose_views,
    cumulative_criterion,
    d_optimal,
    i_optimal,
    view_planning,
    views_needed,
)
from smartview_jax.viewpoints.candidate_selection import exchange_selection, greedy_selection
from smartview_jax.viewpoints.view_planning import visible_fraction

TRUTH = paper_calibration()
POINTS = paper_points((0.0, 0.02))[::6]
CENTRE = POINTS.mean(axis=0)
NOISE = Noise(0.15, 1e-4, float(np.deg2rad(0.01)))
RANGE = ViewRange(CENTRE, (0.17, 0.25), 0.7)
CANDIDATES, CHOSEN = 12, 4
"""Everything is chosen from so many and so few, so that the tests share programs."""


@pytest.fixture(autouse=True)
def few_random_candidates(monkeypatch):
    monkeypatch.setattr(view_planning, "DEFAULT_CANDIDATE_COUNT", CANDIDATES)


def views(seed, count, tilt=0.7):
    return random_viewpoints(np.random.default_rng(seed), count, CENTRE, (0.17, 0.25), tilt)


def taken(poses):
    """The data set that views would give."""
    return simulate(TRUTH, TRUTH.command_for(poses), POINTS, pixel_noise=0.0).data


@pytest.fixture(scope="module")
def survey():
    return InformationModel.from_calibration(TRUTH, POINTS, NOISE)


@pytest.fixture(scope="module")
def tests():
    """Views that the error is judged on; their points are all in the picture."""
    return views(99, CANDIDATES, 0.3)


@pytest.fixture(scope="module")
def goal(survey, tests):
    return i_optimal(survey, tests)


@pytest.fixture(scope="module")
def candidates(survey):
    poses = views(0, CANDIDATES)
    return poses, survey.information(poses)


def pixels_of(calibration, tests):
    return calibration.project(TRUTH.command_for(tests), POINTS)[0]


def test_the_goals_are_those_of_the_bound_of_the_chosen_views(survey, goal, tests, candidates):
    poses, information = candidates
    some = SE3(poses.wxyz_xyz[:6])
    bound = cramer_rao(TRUTH, taken(some), NOISE)
    told = jnp.sum(information[:6], axis=0)
    criteria = goal, a_optimal(survey, 0.2), d_optimal()
    values = jax.jit(lambda told: [criterion(told) for criterion in criteria])(told)
    value, a_value, d_value = map(float, values)
    assert survey.parameter_names == bound.parameter_names
    spread = std_of(bound, lambda calibration: pixels_of(calibration, tests))
    expected = np.sqrt(np.mean(np.sum(np.asarray(spread) ** 2, axis=-1)))
    assert value == pytest.approx(float(expected), rel=1e-6)
    assert goal.unit == "px"
    shifts = [bound.std[f"camera_from_tool.translation.{axis}"] for axis in "xyz"]
    turns = [bound.std[f"camera_from_tool.rotation.{axis}"] for axis in "xyz"]
    expected = np.sqrt(np.sum(np.square(shifts)) + 2.0 / 3.0 * 0.2**2 * np.sum(np.square(turns)))
    assert a_value == pytest.approx(float(expected), rel=1e-6)
    _, logarithm = np.linalg.slogdet(bound.covariance)
    size = 0.5 * logarithm / len(bound.covariance)
    assert float(np.log(d_value)) == pytest.approx(size, abs=1e-6)


def test_a_criterion_of_a_matrix_keeps_small_numbers():
    scales = np.array([1e3, 1.0, 1e-4, 1e-4])
    mixing = np.random.default_rng(0).normal(size=(4, 2))
    matrix = scales[:, None] * (mixing @ mixing.T) * scales
    criterion = OptimalityCriterion.of_matrix(matrix, "px")
    assert criterion.weight_matrix is not None
    units = np.outer(scales, scales)
    np.testing.assert_allclose(criterion.weight_matrix / units, matrix / units, atol=1e-13)
    information = np.diag([1e-6, 1.0, 1e6, 1e8]) + 1e-7
    expected = np.sqrt(np.trace(matrix @ np.linalg.inv(information)))
    assert float(criterion(jnp.asarray(information))) == pytest.approx(expected, rel=1e-9)


def test_the_hand_eye_transform_has_six_columns(survey):
    """A thousand candidates are compared at a time: all columns would take ten times as long."""
    assert a_optimal(survey, 0.2).weight_root.shape == (len(survey.parameter_names), 6)


def test_priors_past_views_and_an_exact_robot_count_as_in_the_bound(candidates):
    poses, _ = candidates
    first, rest = SE3(poses.wxyz_xyz[:3]), SE3(poses.wxyz_xyz[3:6])
    priors = {"camera.lens.k1": Prior(std=0.01)}
    bound = cramer_rao(TRUTH, taken(SE3(poses.wxyz_xyz[:6])), 0.15, priors=priors)
    survey = InformationModel.from_calibration(
        TRUTH, POINTS, 0.15, priors=priors, previous_data=taken(first)
    )
    told = survey.prior_information + jnp.sum(survey.information(rest), axis=0)
    std = np.sqrt(np.diagonal(np.linalg.inv(told)))
    np.testing.assert_allclose(std, [bound.std[name] for name in survey.parameter_names], rtol=1e-5)


def test_other_numbers_of_views_and_points_need_no_other_programs(survey, candidates):
    poses, information = candidates
    few, data = SE3(poses.wxyz_xyz[:5]), taken(poses)
    cramer_rao(TRUTH, data, NOISE)
    fewer_points = dataclasses.replace(survey, points=survey.points[:-1])
    with programs_added() as added:
        told = survey.information(few)
        fewer_points.information(few)
        cramer_rao(TRUTH, data.select(range(9)), NOISE)
    assert not added
    np.testing.assert_allclose(told, information[:5], rtol=1e-12)


def test_greed_takes_the_best_next_one_and_exchange_comes_near_the_best_of_all(
    survey, goal, candidates
):
    _, information = candidates
    free = jnp.ones(CANDIDATES, dtype=bool)
    actual = greedy_selection(information, survey.prior_information, goal, CHOSEN, free)
    assert len(set(np.asarray(actual).tolist())) == CHOSEN
    total = jax.jit(jax.vmap(lambda index: goal(jnp.sum(information[index], axis=0))))
    sets = np.array(list(itertools.combinations(range(CANDIDATES), CHOSEN)))
    every = np.asarray(total(jnp.asarray(sets)))
    values = dict(zip(map(frozenset, sets.tolist()), every.tolist(), strict=True))
    first, last = np.asarray(actual).tolist()[:-1], int(actual[-1])
    others = [i for i in range(CANDIDATES) if i not in first]
    assert min(others, key=lambda i: values[frozenset((*first, i))]) == last
    better = exchange_selection(information, survey.prior_information, goal, actual, free)
    value, improved = (values[frozenset(np.asarray(x).tolist())] for x in (actual, better))
    assert improved <= value
    assert improved <= np.nanquantile(every, 0.01)
    # A view that tells more than all others together is taken once.
    strong = information.at[0].set(1e4 * information.sum(axis=0))
    prior = survey.prior_information
    index = greedy_selection(strong, prior, goal, CHOSEN, free)
    for chosen in (index, exchange_selection(strong, prior, goal, index, free)):
        assert len(set(np.asarray(chosen).tolist())) == CHOSEN
    # What may not be taken is not.
    barred = greedy_selection(
        information, survey.prior_information, goal, CHOSEN, free.at[actual].set(False)
    )
    assert not set(np.asarray(barred).tolist()) & set(np.asarray(actual).tolist())


def test_the_gradient_of_the_goal_is_that_of_differences(survey, goal):
    numbers = RANGE.sample(np.random.default_rng(1), CHOSEN)

    def value(step):
        moved = RANGE.to_unbounded(numbers) + step * direction
        poses = RANGE.poses(RANGE.from_unbounded(moved))
        return goal(jnp.sum(survey.information(poses), axis=0))

    direction = jnp.asarray(np.random.default_rng(2).normal(size=numbers.shape))
    # Forwards: how JAX turns that into a gradient is not ours.
    both = jax.jit(lambda step: jax.jvp(value, (step,), (1.0,)))
    (before, _), (_, slope), (after, _) = map(both, (-1e-5, 0.0, 1e-5))
    assert float(slope) == pytest.approx(float(after - before) / 2e-5, rel=1e-5)


class Directions(InformationModel):
    """As if a view told of its direction only: quick to compile where choosing is tested."""

    @eqx.filter_jit
    def information(self, camera_from_world):
        axis = camera_from_world.inverse().rotation().as_matrix()[:, :, 2]
        return axis[:, :, None] * axis[:, None, :]


@pytest.fixture(scope="module")
def directions(survey):
    names = ("x", "y", "z")
    return Directions(survey.problem, survey.points, 1e-3 * jnp.eye(3), None, None, names)


def test_chosen_views_keep_their_limits_and_are_better_than_those_they_came_from(directions):
    rough = choose_views(directions, d_optimal(), CHOSEN, RANGE, border_margin=5.0, refine=False)
    fine = choose_views(directions, d_optimal(), CHOSEN, RANGE, border_margin=5.0)
    assert float(fine.value) < float(rough.value)
    told = directions.information(fine.camera_from_world).sum(axis=0)
    told += directions.prior_information
    assert float(fine.value) == pytest.approx(float(d_optimal()(told)), rel=1e-9)
    np.testing.assert_allclose(visible_fraction(directions, fine.camera_from_world, 5.0), 1.0)
    ways = np.asarray(fine.camera_from_world.inverse().translation()) - CENTRE
    away = np.linalg.norm(ways, axis=1)
    assert (away > 0.17 - 1e-9).all()
    assert (away < 0.25 + 1e-9).all()
    assert (np.arccos(ways[:, 2] / away) < 0.7 + 1e-9).all()


def test_the_gradient_does_not_take_a_view_to_where_it_may_not_be(directions):
    """It would go to the limit of the range, beyond what is allowed."""

    def upright(some):
        ways = some.inverse().translation() - jnp.broadcast_to(CENTRE, some.translation().shape)
        return ways[:, 2] / jnp.linalg.norm(ways, axis=1) > np.cos(0.4)

    rough = choose_views(
        directions, d_optimal(), CHOSEN, RANGE, border_margin=5.0, allowed=upright, refine=False
    )
    fine = choose_views(directions, d_optimal(), CHOSEN, RANGE, border_margin=5.0, allowed=upright)
    assert bool(upright(fine.camera_from_world).all())
    assert float(fine.value) <= float(rough.value)


def test_views_that_may_not_be_taken_are_not_and_too_few_are_an_error(directions, candidates):
    poses, _ = candidates

    def left(some):
        return some.inverse().translation()[:, 0] < CENTRE[0]

    chosen = choose_views(
        directions, d_optimal(), CHOSEN, poses, allowed=left, min_visible_fraction=0.3
    ).camera_from_world
    assert bool(left(chosen).all())
    with pytest.raises(
        ValueError, match=r"13 views requested, but only \d+ of 12 candidates may be taken"
    ):
        choose_views(directions, d_optimal(), 13, poses, min_visible_fraction=0.3)


def test_a_pose_that_is_not_finite_is_not_chosen_and_changes_no_other(directions, candidates):
    """Inverse kinematics give NaN where no joints reach a pose."""
    poses, _ = candidates
    others = choose_views(directions, d_optimal(), CHOSEN, poses, min_visible_fraction=0.3)
    with_nan = SE3(jnp.concatenate([poses.wxyz_xyz, jnp.full((1, 7), jnp.nan)]))
    for fraction in (0.3, 0.0):
        chosen = choose_views(
            directions, d_optimal(), CHOSEN, with_nan, min_visible_fraction=fraction
        ).camera_from_world.wxyz_xyz
        assert np.isfinite(chosen).all()
        assert len(np.unique(chosen, axis=0)) == CHOSEN
        if fraction:
            np.testing.assert_allclose(chosen, others.camera_from_world.wxyz_xyz)


def test_candidates_in_millimetres_are_refused(directions, candidates):
    """The whole target is in the picture, but as a dot."""
    in_millimetres = SE3(candidates[0].wxyz_xyz.at[:, 4:].multiply(1e3))
    distance = np.linalg.norm(in_millimetres.translation()[0])
    words = f"candidate 0 is {distance:.4g} m from the target, .*: millimetres given as metres"
    with pytest.raises(ValueError, match=words):
        choose_views(directions, d_optimal(), CHOSEN, in_millimetres)
    with pytest.raises(ValueError, match="millimetres given as metres"):
        choose_views(directions, d_optimal(), CHOSEN, ViewRange(1e3 * CENTRE, (170.0, 250.0), 0.7))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"border_margin": -1.0}, "border_margin: expected px, at least 0, found -1.0"),
        ({"min_visible_fraction": 80.0}, "min_visible_fraction: expected 0 to 1, found 80.0"),
        ({"allowed": lambda _: np.ones(5, dtype=bool)}, "a flag for each of 12 views, found an ar"),
        ({"count": 0}, "count: expected at least 1, found 0"),
    ],
)
def test_requirements_out_of_range_are_named(directions, candidates, wrong, message):
    arguments: dict = {"count": CHOSEN} | wrong
    with pytest.raises(ValueError, match=message):
        choose_views(directions, d_optimal(), views=candidates[0], **arguments)


def test_the_curve_falls_and_says_when_to_stop(survey, goal, candidates):
    _, information = candidates
    values = cumulative_criterion(information, survey.prior_information, goal)
    assert np.isinf(values[0])
    falling = np.asarray(values)[np.isfinite(values)]
    assert (np.diff(falling) < 0.0).all()
    assert float(values[-1]) == pytest.approx(float(goal(jnp.sum(information, axis=0))))
    given = jnp.array([jnp.inf, 2.0, 1.0, 0.8, 0.79, 0.5])
    assert views_needed(given) == 4
    assert views_needed(given, required_value=1.5) == 3
    assert views_needed(given, min_relative_decrease=0.0) == 6


def test_numbers_without_limits_come_back_within_them():
    narrow = ViewRange(CENTRE, (0.1, 0.2), 0.5, roll=0.3, max_aim_offset=0.01, above=False)
    numbers = narrow.sample(np.random.default_rng(0), 200)
    again = narrow.from_unbounded(narrow.to_unbounded(numbers))
    # Next to a limit, numbers are moved inside a little.
    np.testing.assert_allclose(again, numbers, atol=3e-3)
    anything = 1e3 * np.random.default_rng(1).normal(size=(200, 6))
    within = np.asarray(narrow.from_unbounded(jnp.asarray(anything)))
    assert (np.linalg.norm(within[:, :2], axis=1) <= np.sin(0.5)).all()
    assert (np.linalg.norm(within[:, 2:4], axis=1) <= 0.01 + 1e-12).all()
    assert (np.abs(within[:, 4]) <= 0.3 + 1e-12).all()
    assert ((within[:, 5] >= 0.1) & (within[:, 5] <= 0.2)).all()
    assert (np.asarray(narrow.poses(numbers).inverse().translation())[:, 2] < CENTRE[2]).all()


@pytest.mark.parametrize(
    ("words", "given"),
    [
        ("distance", ((0.2, 0.1), 0.5, 1.0)),
        ("tilt", ((0.1, 0.2), 1.6, 1.0)),
        ("roll", ((0.1, 0.2), 0.5, 0.0)),
    ],
)
def test_a_range_that_is_none_is_refused(words, given):
    with pytest.raises(ValueError, match=words):
        ViewRange(CENTRE, *given)


def test_what_is_held_cannot_be_the_goal():
    survey = InformationModel.from_calibration(TRUTH, POINTS, NOISE, fixed=("camera_from_tool",))
    with pytest.raises(ValueError, match="camera_from_tool is held"):
        a_optimal(survey, 0.2)


@pytest.fixture(scope="module")
def arm_survey():
    """Of an arm whose joints' zeros are off, and that sets out from over the table."""
    field = JointOffsets(six_axes())
    error = RobotError(field, jnp.asarray([0.0, 1e-3, -1e-3, 5e-4, 1e-3, 0.0]))
    truth = dataclasses.replace(TRUTH, robot_error=error)
    noise = dataclasses.replace(NOISE, field=(1e-3,))
    return InformationModel.from_calibration(
        truth, POINTS, noise, field=field, near=HOME_JOINTS
    ), noise


OVER_THE_TARGET = np.array(
    [
        [-0.37, -0.55, 1.51, 0.31, 0.34, 0.41],
        [-0.11, -0.09, 1.17, -0.06, 0.46, -2.86],
        [-0.39, -0.07, 1.22, 0.1, 0.5, -0.18],
        [-0.42, 0.56, 0.74, 0.27, 0.94, -2.17],
        [0.07, 0.0, 1.55, 0.49, -0.5, 1.91],
        [-0.15, -0.15, 1.31, 0.08, 0.2, -3.01],
    ]
)
"""Joint angles, rad, at which the arm's camera sees most of the target."""


def test_an_arms_views_tell_what_the_bound_says_of_their_joints(arm_survey):
    """The model has to find the joints by itself."""
    survey, noise = arm_survey
    truth, field = survey.calibration, survey.calibration.robot_error.field
    command = field.arm.command(OVER_THE_TARGET)
    pixels, _ = map(np.array, truth.project(command, POINTS))
    pixels[~((pixels >= 0.0) & (pixels <= [639.0, 479.0])).all(axis=-1)] = np.nan
    data = Dataset.from_arrays(
        POINTS, pixels, None, truth.camera.image_size, joints=OVER_THE_TARGET, arm=field.arm
    )
    bound = cramer_rao(truth, data, noise, field=field)
    assert survey.parameter_names == bound.parameter_names
    information = survey.information(truth.camera_from_world(command))
    told = survey.prior_information + jnp.sum(information, axis=0)
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(np.linalg.inv(told))), list(bound.std.values()), rtol=1e-5
    )


def test_a_view_that_the_arm_does_not_reach_shows_nothing_and_is_not_chosen(arm_survey):
    survey, _ = arm_survey
    near = views(6, 5)
    away = look_at(CENTRE, (0.0, 0.0, -1.0), 5.0)
    all_of_them = SE3(jnp.concatenate([away.wxyz_xyz[None], near.wxyz_xyz]))
    information = survey.information(all_of_them)
    assert not np.asarray(information[0]).any()
    assert np.asarray(information[1:]).any(axis=(1, 2)).all()
    chosen = choose_views(survey, d_optimal(), 5, all_of_them, min_visible_fraction=0.5)
    heights = chosen.camera_from_world.inverse().translation()[:, 2]
    assert float(jnp.max(heights)) < 1.0
    with pytest.raises(
        ValueError, match=r"6 views requested, but only 5 of 6 candidates may be taken"
    ):
        choose_views(survey, d_optimal(), 6, all_of_them, min_visible_fraction=0.5)


def test_an_arms_own_errors_need_joints_to_begin_from():
    field = JointOffsets(six_axes())
    with pytest.raises(ValueError, match="near=joints"):
        InformationModel.from_calibration(
            TRUTH, POINTS, dataclasses.replace(NOISE, field=(1e-3,)), field=field
        )
