"""Points that several cameras see, with errors that their pictures share."""

import dataclasses

import cv2
import jax
import numpy as np
import pytest
from calibrated_rig import calibrated_rig
from rig_pair import (
    BASE_FROM_WORLD,
    NOISE,
    RIGHT,
    drawn_errors,
    estimate,
    noise_twist,
    placed,
    seen_by,
    stereo_pair,
)
from scipy.linalg import null_space

import smartview_jax as sv
from smartview_jax.engine import Observability
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import as_se3, host_adjoints, look_at
from smartview_jax.joint import SavedEstimate
from smartview_jax.modeling import (
    CalibrationUncertainty,
    RigViews,
    SeenViews,
    pixel_jacobians,
    project_points,
    triangulate_points,
)
from smartview_jax.robot_errors import LinearInPose, RobotError
from smartview_jax.runtime.array_namespace import to_device

PAIR = ["left", "right"]
SIGMA = 0.1
RUNS = 256
"""Number of draws of all errors."""

COUNT = 16
"""Number of points that are triangulated at once, so that all tests share one program."""

POINTS = np.random.default_rng(2).uniform(-0.03, 0.03, (COUNT, 3))
DIRECTIONS = np.array([[0.3, 0.2, -1.0], [-0.3, 0.3, -1.0], [0.1, -0.4, -1.0]])


def hand_poses(count):
    """Reported poses at which both cameras look at the world's origin."""
    tool_from_world = np.stack(
        [np.asarray(look_at(np.zeros(3), d, 0.4).as_matrix()) for d in DIRECTIONS[:count]]
    )
    return BASE_FROM_WORLD @ np.linalg.inv(tool_from_world)


@pytest.fixture(scope="module")
def rig():
    return estimate(stereo_pair(), shared=5.0, own=0.5)


def mixed():
    """A camera on the hand, and one next to the arm that saw a target on the hand."""
    hand = stereo_pair()["left"]
    world_from_side = np.linalg.inv(
        np.asarray(look_at(np.zeros(3), np.array([0.1, 1.0, -0.8]), 0.5).as_matrix())
    )
    side = np.linalg.inv(BASE_FROM_WORLD @ world_from_side)
    return {"hand": hand, "side": sv.Calibration.eye_to_hand(RIGHT, side, placed(0.0))}


def test_each_view_is_read_with_the_camera_that_took_it(rig):
    """A stereo pair in one state, and each camera alone in another."""
    cameras, poses = ["left", "right", "right", "left"], hand_poses(3)[[0, 0, 1, 2]]
    exact = dict.fromkeys(rig.parameter_names, 0.0)
    pixels = [
        seen_by(rig, name, exact, POINTS, pose, np.zeros(6))
        for name, pose in zip(cameras, poses, strict=True)
    ]
    views = RigViews(rig.calibrations, cameras)
    triangulated = triangulate_points(views, poses, np.stack(pixels))
    np.testing.assert_allclose(triangulated.points, POINTS, atol=1e-9)
    assert triangulated.calibration_names == ()
    seen = SeenViews.of(views, poses)
    np.testing.assert_array_equal(seen.image_sizes[1], [800, 600])
    np.testing.assert_array_equal(seen.camera.image_size, seen.image_sizes)


def test_cameras_on_the_hand_and_next_to_the_arm_meet_in_the_base_frame():
    rig = estimate(mixed())
    in_base = POINTS @ BASE_FROM_WORLD[:3, :3].T + BASE_FROM_WORLD[:3, 3]
    exact, (pose,) = dict.fromkeys(rig.parameter_names, 0.0), hand_poses(1)
    pixels = [
        seen_by(rig, "hand", exact, in_base, pose, np.zeros(6), frame="base"),
        seen_by(rig, "side", exact, in_base, frame="base"),
    ]
    views = RigViews(rig, ["hand", "side"], frame="base")
    # Wherever the robot is, the camera next to the arm is where it is.
    triangulated = triangulate_points(views, np.stack([pose, np.eye(4)]), np.stack(pixels))
    np.testing.assert_allclose(triangulated.points, in_base, atol=1e-9)
    alone = RigViews(rig, ["side"], frame="base")
    np.testing.assert_allclose(
        SeenViews.of(alone, None).camera_from_world,
        SeenViews.of(views, np.stack([pose, pose])).camera_from_world[1:],
    )
    # So it is for a robot whose reports are wrong.
    field = LinearInPose.from_poses(as_se3(hand_poses(3)))
    error = RobotError(field, to_device(np.full(54, 1e-3)))
    side = dataclasses.replace(rig.calibrations["side"], robot_error=error)
    wrong = RigViews({"side": side}, ["side"], frame="base")
    np.testing.assert_array_equal(
        SeenViews.of(wrong, pose[None]).camera_from_world,
        SeenViews.of(alone, None).camera_from_world,
    )
    with pytest.raises(ValueError, match=r"^poses: .* found None; only cameras next to the arm"):
        SeenViews.of(views, None)


@pytest.mark.parametrize(
    ("calibrations", "cameras", "frame"),
    [(stereo_pair(), PAIR, "world"), (mixed(), ["hand", "side"], "base")],
)
def test_each_number_moves_the_pixels_as_opencv_says(calibrations, cameras, frame):
    """By central differences; the robot's error in the one state comes last."""
    rig = estimate(calibrations)
    (pose,) = hand_poses(1)
    views = RigViews(rig, cameras, frame=frame)
    seen = SeenViews.of(views, np.stack([pose, pose]))
    uncertainty = CalibrationUncertainty.of(seen, views, None)
    points = POINTS
    if frame == "base":
        points = POINTS @ BASE_FROM_WORLD[:3, :3].T + BASE_FROM_WORLD[:3, 3]
        assert not [name for name in uncertainty.names if "_from_world" in name]
    by_view = pixel_jacobians(seen, points).by_view
    actual = np.einsum("vpil,vln->nvpi", by_view, uncertainty.view_jacobian)

    def pixels(errors, twist):
        robots = [
            () if rig.calibrations[name].mount == "eye_to_hand" else (pose, twist)
            for name in cameras
        ]
        return np.stack(
            [
                seen_by(rig, name, errors, points, *robot, frame=frame)
                for name, robot in zip(cameras, robots, strict=True)
            ]
        )

    exact, step = dict.fromkeys(rig.parameter_names, 0.0), 1e-6
    for k, name in enumerate(uncertainty.names):
        after, before = (
            pixels({**exact, name: change}, np.zeros(6))
            if k < uncertainty.shared_count
            else pixels(exact, change * np.eye(6)[k - uncertainty.shared_count])
            for change in (step, -step)
        )
        difference = (after - before) / (2.0 * step)
        np.testing.assert_allclose(actual[k], difference, rtol=1e-5, atol=1e-4, err_msg=name)


def mean_squares(rig, cameras, poses, believed):
    """The mean squared error of a point across the line of sight, by each belief's covariance.

    Each of the points that are triangulated is the same one, seen with other errors.
    """
    rng, pixels = np.random.default_rng(0), np.zeros((len(cameras), RUNS, 2))
    point = POINTS[0]
    for run, errors in enumerate(drawn_errors(rig, rng, RUNS)):
        twists = [noise_twist(rng) for _ in poses]
        for view, (name, state) in enumerate(cameras):
            robot = poses[state], twists[state]
            pixels[view, run] = seen_by(rig, name, errors, point[None], *robot)[0]
    pixels += SIGMA * rng.standard_normal(pixels.shape)
    of_views, across = poses[[state for _, state in cameras]], null_space(DIRECTIONS[:1])
    means = []
    for views in believed:
        values = []
        for some in np.split(pixels, RUNS // COUNT, axis=1):
            triangulated = triangulate_points(views, of_views, some, pixel_sigma=SIGMA)
            covariance = across.T @ triangulated.covariance() @ across
            values.append(nees((triangulated.points - point) @ across, covariance))
        means.append(mean_nees(np.concatenate(values), 2))
    return means


def test_errors_that_cameras_share_count_once():
    """A stereo pair whose hand-eye transforms are wrong by the same."""
    rig, cameras = estimate(stereo_pair(), shared=5.0, own=0.5), [("left", 0), ("right", 0)]
    separate = np.zeros_like(rig.covariance)
    for own in PAIR:
        kept = np.array([name.startswith(own) for name in rig.parameter_names])
        separate[np.ix_(kept, kept)] = rig.covariance[np.ix_(kept, kept)]
    apart = RigViews(rig._replace(covariance=separate), PAIR)
    joint, as_if_apart = mean_squares(rig, cameras, hand_poses(1), [RigViews(rig, PAIR), apart])
    assert joint.is_consistent
    assert as_if_apart.value > 1.4 * joint.value


def test_an_error_of_the_robot_counts_once_in_a_state(rig):
    """Two pictures of a pair at one pose are one state, unless they are said to be two."""
    poses = hand_poses(2)[[0, 0, 1, 1]]
    for cameras, states, count in (
        (PAIR * 2, None, 2),
        # A camera takes one picture in a state: the robot came back to each pose.
        (["left"] * 4, None, 4),
        (PAIR * 2, ["a", "b", "c", "d"], 4),
        (PAIR * 2, [7, 7, 8, 8], 2),
    ):
        views = RigViews(rig, cameras, states)
        uncertainty = CalibrationUncertainty.of(SeenViews.of(views, poses), views, None)
        first = uncertainty.shared_count
        assert len(uncertainty.names) - first == 6 * count
        own = uncertainty.covariance[first:, first:]
        sizes = np.repeat([NOISE.translation, NOISE.rotation], 3)
        np.testing.assert_allclose(own, np.diag(np.tile(sizes, count) ** 2))


def test_one_camera_of_a_rig_is_the_same_as_alone(rig):
    poses, views, alone = hand_poses(3), RigViews(rig, ["left"] * 3), rig.calibrations["left"]
    seen, expected = SeenViews.of(views, poses), SeenViews.of(alone, poses)
    # So that the same programs are given the same numbers.
    assert seen.camera is expected.camera
    np.testing.assert_array_equal(seen.padded, expected.padded)
    kept = [k for k, name in enumerate(rig.parameter_names) if not name.startswith("right")]
    own = SavedEstimate(
        alone,
        rig.covariance[np.ix_(kept, kept)],
        tuple(rig.parameter_names[k].removeprefix("left.") for k in kept),
        NOISE,
        SIGMA,
        Observability(len(kept), len(kept), (), (), 1.0),
    )
    actual = CalibrationUncertainty.of(seen, views, None)
    known = CalibrationUncertainty.of(expected, alone, own)
    assert [name.removeprefix("left.") for name in actual.names] == list(known.names)
    np.testing.assert_array_equal(actual.view_jacobian, known.view_jacobian)
    np.testing.assert_allclose(actual.covariance, known.covariance, rtol=1e-12, atol=1e-20)


def test_the_relative_pose_of_two_cameras_is_as_uncertain_as_their_fit_says(tmp_path_factory):
    """In one state the robot's errors move both alike, and leave the pair as it is."""
    fit = calibrated_rig(tmp_path_factory)
    command = jax.tree.map(lambda x: np.asarray(x)[[0, 0]], fit.built.problem.command)
    views = RigViews(fit, list(fit.calibrations))
    seen = SeenViews.of(views, command)
    uncertainty = CalibrationUncertainty.of(seen, views, None)
    first, second = seen.camera_from_world
    relative = fit.relative(*fit.calibrations)
    np.testing.assert_allclose(
        first @ np.linalg.inv(second), relative.transform.as_matrix(), atol=1e-12
    )
    by_first, by_second = uncertainty.view_jacobian[:, -6:]
    jacobian = by_first - host_adjoints(first @ np.linalg.inv(second)) @ by_second
    # The twist (v, w) moves the translation t by v + w x t.
    x, y, z = (first @ np.linalg.inv(second))[:3, 3]
    at_camera = np.eye(6)
    at_camera[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    jacobian = at_camera @ jacobian
    np.testing.assert_allclose(
        jacobian @ uncertainty.covariance @ jacobian.T, relative.covariance, rtol=1e-6, atol=1e-14
    )


def test_lenses_of_different_kinds_go_together():
    """A fisheye next to an ordinary lens; OpenCV knows both."""
    wide = sv.Camera(
        420.0, 425.0, 330.0, 250.0, sv.cameras.Fisheye(0.02, -0.01, 0.0, 0.0), (640, 480)
    )
    pair = stereo_pair()
    pair["left"] = dataclasses.replace(pair["left"], camera=wide)
    views = SeenViews.of(RigViews(pair, ["right", "left"]), hand_poses(1)[[0, 0]])
    turns = [(cv2.Rodrigues(m[:3, :3])[0], m[:3, 3]) for m in views.camera_from_world]
    lens = np.array([float(x) for x in vars(RIGHT.lens).values()])
    theirs = [
        cv2.projectPoints(POINTS, *turns[0], RIGHT.K, lens)[0],
        cv2.fisheye.projectPoints(
            POINTS[:, None], *turns[1], wide.K, np.array([0.02, -0.01, 0, 0])
        )[0],
    ]
    projected = project_points(views, POINTS)
    np.testing.assert_allclose(projected, np.reshape(theirs, projected.shape), atol=1e-9)


def test_bad_input_is_named(rig):
    pair = stereo_pair()
    moved = dataclasses.replace(pair["right"], holder_from_world=as_se3(np.eye(4)))
    for arguments, said in (
        ((rig, ["left", "middle"]), "cameras: view 1: expected .* left, right, found 'middle'"),
        ((rig, []), "cameras: expected the name of the camera of each view, found none"),
        ((rig, "left"), "cameras: expected a list of names"),
        ((rig, PAIR, [0]), "states: expected one for each of 2 views, found 1"),
        ((rig, PAIR, None, "tool"), "frame is one of world, base; found 'tool'"),
        (({**pair, "right": moved}, PAIR), "cameras: 'left' and 'right' saw different targets"),
        ((mixed(), ["hand", "side"]), "cameras: 'hand' and 'side' saw different targets"),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            RigViews(*arguments)
    views = RigViews(rig, PAIR, states=["a", "a"])
    seen = SeenViews.of(views, hand_poses(2))
    with pytest.raises(
        ValueError, match=r"^poses: views 0 and 1 are of one state of the robot, 'a'"
    ):
        CalibrationUncertainty.of(seen, views, None)
    with pytest.raises(ValueError, match=r"^poses: expected one for each of 2 views, found 3"):
        SeenViews.of(views, hand_poses(3))
    outside = np.full((2, 1, 2), 700.0)
    outside[1] = 500.0
    with pytest.raises(ValueError, match=r"view 0, .* picture of 640 x 480 px"):
        triangulate_points(RigViews(rig, PAIR), hand_poses(1)[[0, 0]], outside)
