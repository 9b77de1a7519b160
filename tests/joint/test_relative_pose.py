"""The pose of one camera in the frame of another: its intervals, and its file."""

import numpy as np
import pytest
from rig_pair import stereo_pair
from scipy.stats import norm
from scipy.stats import t as student

from smartview_jax import RelativePose
from smartview_jax.engine import STEP_NAMES, ScaledJacobian
from smartview_jax.geometry import host_matrices
from smartview_jax.joint import RigUncertainty, relative_pose
from smartview_jax.joint.open_directions import OpenDirections
from smartview_jax.joint.undetermined_motion import UndeterminedMotion
from smartview_jax.variance import SmallSampleCorrection


def test_the_interval_of_a_relative_pose_is_students(tmp_path):
    """By the share of its variance that is due to each standard deviation that was estimated.

    Satterthwaite's degrees of freedom, by finite differences of the pose's variance.
    """
    names = tuple(f"{c}.camera_from_tool.{step}" for c in ("a", "b") for step in STEP_NAMES)
    rng = np.random.default_rng(2)
    pixel, robot = (x @ x.T for x in rng.standard_normal((2, 12, 12)))
    logs = np.diag([0.01, 0.2])

    def covariance(log_sigmas):
        return np.exp(2.0 * log_sigmas[0]) * pixel + np.exp(2.0 * log_sigmas[1]) * robot

    correction = SmallSampleCorrection(
        np.sqrt(np.diagonal(logs)),
        np.zeros((12, 12)),
        np.full(12, np.nan),
        logs,
        2.0 * np.stack([pixel, robot]),
    )
    calibrations = dict(zip("ab", stereo_pair().values(), strict=True))

    def relative(log_sigmas):
        known = RigUncertainty(names, covariance(np.array(log_sigmas)), correction)
        return relative_pose(calibrations, known, "a", "b")

    step = 1e-6
    slopes = [
        (np.log(relative(up).std ** 2) - np.log(relative(down).std ** 2)) / (2.0 * step)
        for up, down in (([step, 0.0], [-step, 0.0]), ([0.0, step], [0.0, -step]))
    ]
    freedom = 2.0 / np.einsum("ik,ij,jk->k", slopes, logs, slopes)
    pose = relative([0.0, 0.0])
    np.testing.assert_allclose(pose.degrees_of_freedom, freedom, rtol=1e-6)
    np.testing.assert_allclose(pose.half_widths(), pose.std * student(freedom).ppf(0.975))
    pose.save(tmp_path / "pose.yaml")
    read = RelativePose.load(tmp_path / "pose.yaml")
    np.testing.assert_allclose(read.half_widths(0.9), pose.half_widths(0.9))
    given_noise = RigUncertainty(names, covariance(np.zeros(2)))
    known = relative_pose(calibrations, given_noise, "a", "b")
    np.testing.assert_allclose(known.half_widths(), pose.std * norm.ppf(0.975))
    known.save(tmp_path / "known.json")
    assert RelativePose.load(tmp_path / "known.json").degrees_of_freedom == (np.inf,) * 6


@pytest.mark.parametrize("free", [3, 0])
def test_what_was_held_has_no_interval(free):
    """The rotations of both cameras, or all of them, were known."""
    names = tuple(f"{c}.camera_from_tool.{step}" for c in ("a", "b") for step in STEP_NAMES[:free])
    count = len(names)
    correction = SmallSampleCorrection(
        np.array([0.1]),
        np.zeros((count, count)),
        np.full(count, 200.0),
        np.array([[0.01]]),
        2.0 * np.eye(count)[None],
    )
    calibrations = dict(zip("ab", stereo_pair().values(), strict=True))
    known = RigUncertainty(names, np.eye(count), correction)
    pose = relative_pose(calibrations, known, "a", "b")
    np.testing.assert_allclose(pose.degrees_of_freedom, [50.0] * free + [np.inf] * (6 - free))
    np.testing.assert_allclose(pose.half_widths()[free:], 0.0, atol=1e-12)


def test_what_nothing_determines_has_an_infinite_interval(tmp_path):
    """Unless both cameras move together along it, as two on the hand of a SCARA arm do."""
    names = tuple(f"{c}.camera_from_tool.{step}" for c in ("a", "b") for step in STEP_NAMES)
    left, right = stereo_pair().values()
    calibrations = {"a": left, "b": right}
    # A shift of the mount along its z axis moves a camera along this axis of its own frame.
    shifts = [host_matrices(each.camera_from_tool)[:3, 2] for each in (left, right)]
    together = np.concatenate([shifts[0], np.zeros(3), shifts[1], np.zeros(3)])
    for direction, is_open in ((together, False), (np.eye(12)[2], True)):
        motion = UndeterminedMotion(names, direction[None], ())
        undetermined = (OpenDirections.of_motion(motion),)
        known = RigUncertainty(names, np.eye(12), undetermined=undetermined)
        pose = relative_pose(calibrations, known, "a", "b")
        expected = [k == 2 and is_open for k in range(6)]
        np.testing.assert_array_equal(np.isinf(pose.std), expected)
        np.testing.assert_array_equal(np.isinf(pose.half_widths()), expected)
        for file in ("pose.yaml", "pose.json"):
            pose.save(tmp_path / file)
            np.testing.assert_array_equal(
                RelativePose.load(tmp_path / file).covariance, pose.covariance
            )
    text = (tmp_path / "pose.json").read_text().replace("null", "0.0", 1)
    (tmp_path / "pose.json").write_text(text)
    with pytest.raises(ValueError, match=r"the variance of translation\.z is not positive"):
        RelativePose.load(tmp_path / "pose.json")


def test_a_direction_is_open_in_the_units_of_its_parameters():
    """A focal length that nothing determines turns the camera only by microradians per pixel."""
    names = ("left.camera.alpha_u", "left.camera_from_tool.rotation.y")
    # By hand: unit columns in px and rad, with a null direction that changes both.
    jacobian = ScaledJacobian(np.array([[1e-4, -1.0], [-1.0, 1e4]]), np.sqrt(np.array([1e-4, 1e4])))
    undetermined = OpenDirections.of_jacobian(names, jacobian)
    turn = np.array([[0.0, 1.0]])
    assert undetermined.changed(names, turn).tolist() == [True]
    # What does not change along it: the combination that the pixels see.
    assert undetermined.changed(names, np.array([[1.0, -1e4]])).tolist() == [False]
    assert undetermined.changed(("right.camera.alpha_u",), np.ones((1, 1))).tolist() == [False]
