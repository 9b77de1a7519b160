"""The joint fit to tracked poses: against SciPy, the truth, and what goes wrong with trackers."""

import dataclasses
import itertools

import numpy as np
import pytest
from programs import programs_added
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp
from tracked_scene import (
    MOUNT,
    ROBOT,
    TRACKER,
    VIEWS,
    WORLD,
    data_of,
    mount_covariance,
    mount_error,
    tracked,
    turned,
)

import smartview_jax as sv
from smartview_jax.cameras import Camera, OpenCV4, Pinhole
from smartview_jax.dataset import PoseDataset
from smartview_jax.engine import Prior
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.geometry import host_adjoints, host_exponentials, host_logarithms, host_matrices
from smartview_jax.joint import TrackerPrior
from smartview_jax.joint.pose_start import (
    blank_calibration,
    start_from_poses,
    start_of_poses,
)
from smartview_jax.joint.robust_hand_eye import robust_hand_eye
from smartview_jax.joint.tracker_noise import TrackedChain, likeliest_noise
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.simulation import random_scene


@pytest.fixture(scope="module")
def fit():
    camera = Camera(900.0, 900.0, 320.0, 240.0, Pinhole(), (640, 480))
    return sv.fit_poses(data_of(0), camera=camera, field=None)


def test_the_camera_takes_no_part_in_the_fit(fit):
    """With a picture of another size and another lens no other program is compiled."""
    other = Camera(500.0, 510.0, 400.0, 300.0, OpenCV4(0.1, 0.0, 0.0, 0.0), (800, 600))
    with programs_added() as seconds:
        again = sv.fit_poses(data_of(0), camera=other, field=None)
    assert seconds == []
    assert again.calibration.camera is other
    np.testing.assert_array_equal(again.covariance, fit.covariance)


def test_the_fit_writes_its_page(fit, tmp_path):
    dataclasses.replace(fit, warnings=("the tracker drifts",)).report(str(tmp_path / "page.html"))
    page = (tmp_path / "page.html").read_text()
    assert "warning: the tracker drifts" in page
    assert f"{1e3 * float(fit.calibration.camera_from_mount.translation()[0]):.1f}" in page


def test_the_optimum_is_scipys(fit):
    """With the standard deviations that were found; the robot's noise moves the prediction."""
    robot, measured = tracked(0)
    reported = np.linalg.inv(robot)
    camera, world = (
        host_matrices(fit.calibration.camera_from_mount),
        host_matrices(fit.calibration.holder_from_world),
    )
    sigmas = np.repeat([fit.noise.translation, fit.noise.rotation], 3)
    by_noise = np.asarray(fit.problem.observations.whitening)[:VIEWS] / float(fit.pixel_sigma)
    tracker = np.linalg.inv(by_noise.swapaxes(1, 2) @ by_noise)

    def residuals(x):
        predicted = (
            (host_exponentials(x[:6]) @ camera) @ reported @ (world @ host_exponentials(x[6:]))
        )
        gap = measured @ np.linalg.inv(predicted)
        # Translations apart from rotations, as a tracker measures them.
        errors = np.concatenate(
            [measured[:, :3, 3] - predicted[:, :3, 3], host_logarithms(turns(gap))[:, 3:]], axis=1
        )
        return np.einsum("vij,vj->vi", whitening, errors).ravel()

    # The robot's twist at the tool, seen in the camera's frame, about the target.
    by_robot = host_adjoints(camera)[None].repeat(VIEWS, axis=0)
    place = measured[:, :3, 3]
    levers = np.zeros((VIEWS, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        levers[:, :, k] = np.cross(axis, place)
    moved = by_robot.copy()
    moved[:, :3] += levers @ by_robot[:, 3:]
    total = (moved * sigmas**2) @ moved.swapaxes(1, 2) + tracker
    whitening = np.linalg.inv(np.linalg.cholesky(total))
    best = least_squares(residuals, np.zeros(12), xtol=1e-14, ftol=1e-14)
    std = np.sqrt(np.diagonal(np.linalg.inv(best.jac.T @ best.jac)))
    # Beyond the first order the robot's noise and the mean differ: a hundredth of the interval.
    assert np.abs(best.x / std).max() < 0.02
    # The translation of a twist is at the base of the camera's frame.
    np.testing.assert_allclose(np.sqrt(np.diagonal(mount_covariance(fit)))[3:], std[3:6], rtol=0.15)


def turns(poses):
    found = poses.copy()
    found[:, :3, 3] = 0.0
    return found


def test_both_noises_are_found(fit):
    assert fit.result.converged
    assert fit.warnings == ()
    np.testing.assert_allclose(fit.tracker_noise, TRACKER, rtol=0.35)
    # The robot's is a fifth of it, where the prior for good arms decides.
    assert fit.noise.translation < 3.0 * ROBOT[0]
    text = str(fit)
    assert text.startswith(f"joint fit of {VIEWS} pairs of poses, ")
    assert "tracked poses +- " in text
    assert "camera," not in text


def along_over_across(fit):
    """Noise along the line of sight over noise across it, in the fit's covariances."""
    by_noise = np.asarray(fit.problem.observations.whitening)[:VIEWS]
    covariance = np.linalg.inv(by_noise.swapaxes(1, 2) @ by_noise)[:, :3, :3]
    place = np.asarray(fit.problem.observations.camera_from_world.translation())[:VIEWS]
    sight = place / np.linalg.norm(place, axis=1, keepdims=True)
    along = np.einsum("vi,vij,vj->v", sight, covariance, sight)
    across = 0.5 * (np.trace(covariance, axis1=1, axis2=2) - along)
    return float(np.median(np.sqrt(along / across)))


@pytest.mark.parametrize("unit", [1.0, 0.5], ids=["metres", "unknown unit"])
def test_noise_along_the_line_of_sight_has_its_own_size(fit, unit):
    """A single moving camera, whose unit nobody knows, has such a noise where its scale drifts."""
    robot, measured = tracked(0)
    sight = measured[:, :3, 3] / np.linalg.norm(measured[:, :3, 3], axis=1, keepdims=True)
    measured[:, :3, 3] += np.random.default_rng(0).normal(0.0, 5e-3, (VIEWS, 1)) * sight
    measured[:, :3, 3] /= unit
    deep = sv.fit_poses(PoseDataset.from_poses(robot, measured), field=None, scale=unit != 1.0)
    # Ten times as large, of which 16 pairs and a prior that expects twice make somewhat less.
    assert 4.0 < along_over_across(deep) < 12.0
    assert 0.5 < along_over_across(fit) < 2.0


def test_a_pair_that_the_fit_leaves_out_does_not_widen_the_covariance(fit):
    """Its error is too small for the start to see it."""
    robot, measured = tracked(0)
    measured[3] = measured[3] @ host_exponentials(np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]))
    measured[3, :3, 3] += 2e-3 * np.array([1.0, -1.0, 1.0])
    spoilt = sv.fit_poses(PoseDataset.from_poses(robot, measured), field=None)
    assert "standard deviations from where the other views put it" in spoilt.rejected[0].reason
    stds = [np.sqrt(np.diagonal(mount_covariance(each))) for each in (spoilt, fit)]
    assert (stds[0] < 1.25 * stds[1]).all()


def test_the_covariance_is_true():
    fits = [sv.fit_poses(data_of(seed), field=None) for seed in range(1, 5)]
    scores = nees(
        np.array([mount_error(f) for f in fits]), np.array([mount_covariance(f) for f in fits])
    )
    assert mean_nees(scores, 6).is_consistent


def test_pairs_that_contradict_the_others_are_named_and_the_rest_is_kept():
    robot, measured = tracked(3)
    rng = np.random.default_rng(0)
    wrong = [1, 5, 6, 11]
    measured[wrong] = measured[wrong] @ host_exponentials(
        rng.normal(size=(4, 6)) * np.repeat([0.1, 0.5], 3)
    )
    measured[8] = np.nan
    fit = sv.fit_poses(PoseDataset.from_poses(robot, measured))
    assert sorted(int(rejection.view) for rejection in fit.rejected) == sorted([*wrong, 8])
    assert "degrees from where the other pairs put it" in fit.rejected[-1].reason
    assert np.isnan(fit.pose_errors[8]).all()
    assert (fit.pose_errors[wrong, 0] > 0.02).all()
    clean = sv.fit_poses(data_of(3).select([k for k in range(VIEWS) if k not in (*wrong, 8)]))
    np.testing.assert_allclose(mount_error(fit), mount_error(clean), atol=1e-6)


def test_a_fixed_camera_and_a_tracker_without_a_unit():
    fit = sv.fit_poses(data_of(4, mount="eye_to_hand"), field=None)
    assert np.abs(mount_error(fit))[:3].max() < 2e-3
    fit = sv.fit_poses(data_of(4, scale=2.5), scale=True, field=None)
    assert float(fit.calibration.target_scale) == pytest.approx(2.5, rel=5e-3)
    assert np.abs(mount_error(fit))[:3].max() < 4e-3
    # In the tracker's units the noise is smaller by as much.
    assert fit.tracker_noise[0] < 0.7 * TRACKER[0]


def test_a_motion_about_one_axis_is_named_with_what_ends_it():
    about_z = np.zeros((VIEWS, 3))
    about_z[:, 2] = np.linspace(-1.5, 1.5, VIEWS)
    fit = sv.fit_poses(data_of(5, turns=about_z), field=None)
    assert len(fit.observability.null_directions) == 1
    assert "fixed=(" in " ".join(fit.warnings)
    with pytest.raises(ValueError, match="never rotates"):
        sv.fit_poses(data_of(5, turns=np.zeros((VIEWS, 3))))


def read_too_late(poses, part):
    """Poses that lie a part of each move before their own."""
    logged = poses.copy()
    for k, (before, pose) in enumerate(itertools.pairwise(poses), 1):
        way = Slerp([0.0, 1.0], Rotation.from_matrix([before[:3, :3], pose[:3, :3]]))
        logged[k, :3, :3] = way(1.0 - part).as_matrix()
        logged[k, :3, 3] = part * before[:3, 3] + (1.0 - part) * pose[:3, 3]
    return logged


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_poses_that_were_read_too_late_are_named(mount):
    robot, measured = tracked(6, mount=mount)
    in_time, late, later = (
        PoseDataset.from_poses(read_too_late(robot, part), measured, mount)
        for part in (0.0, 0.015, 0.05)
    )
    assert start_from_poses(in_time).ambiguities == ()
    warning = start_from_poses(late).ambiguities[0]
    assert warning.startswith("the robot's poses lag the tracked poses by about 1.")
    with pytest.raises(ValueError, match="lag the tracked poses by about 5"):
        start_from_poses(later)


def test_a_calibration_is_saved_with_its_camera_only(tmp_path, fit):
    with pytest.raises(ValueError, match=r"give fit_poses\(camera=\.\.\.\)"):
        dataclasses.replace(fit, has_camera=False).save(tmp_path / "calibration.yaml")
    assert not list(tmp_path.iterdir())
    fit.save(tmp_path / "calibration.yaml")
    again = sv.Calibration.load(tmp_path / "calibration.yaml")
    np.testing.assert_allclose(
        host_matrices(again.camera_from_tool), host_matrices(fit.calibration.camera_from_tool)
    )


def test_a_start_is_checked_and_taken(fit):
    rough = MOUNT @ turned(np.full((1, 3), 0.02))[0]
    again = sv.fit_poses(data_of(0), start={"camera_from_tool": rough}, field=None)
    np.testing.assert_allclose(mount_error(again), mount_error(fit), atol=1e-7)
    with pytest.raises(ValueError, match="expected camera_from_tool or base_from_world"):
        sv.fit_poses(data_of(0), start={"tool_from_camera": rough})
    with pytest.raises(ValueError, match="tracked poses have no camera that is fitted"):
        sv.fit_poses(data_of(0), priors={"camera.pixel_aspect": sv.Prior(mean=1.0, std=1e-3)})
    with pytest.raises(ValueError, match=r"ratio_median: expected a positive number, found 0"):
        TrackerPrior(ratio_median=0.0)


def test_wrong_arguments_are_named(fit):
    robot, measured = tracked(0, views=4)
    bent = measured.copy()
    bent[2, 0, 0] *= 1.1
    with pytest.raises(ValueError, match=r"view b: tracker: .*rotation"):
        PoseDataset.from_poses(robot, bent, view_ids=["x", "a", "b", "c"])
    with pytest.raises(ValueError, match=r"base_from_tool: expected shape \(4, 4, 4\)"):
        PoseDataset.from_poses(robot[:3], measured)
    with pytest.raises(ValueError, match=r"camera_from_world: expected shape \(4, 4, 4\)"):
        PoseDataset.from_poses(robot, measured[:, :3, :3])
    with pytest.raises(ValueError, match="at least 3 pairs of poses, found 2"):
        sv.fit_poses(PoseDataset.from_poses(robot[:2], measured[:2]))
    data = data_of(0)
    with pytest.raises(
        ValueError, match=r"do not move alike as given .* but do if every pose is inverted"
    ):
        sv.fit_poses(dataclasses.replace(data, camera_from_world=data.camera_from_world.inverse()))
    for refuse in (lambda: sv.calibrate(data), lambda: sv.fit_joint(data, fit.calibration)):
        with pytest.raises(TypeError, match="fit_poses"):
            refuse()


def test_most_pairs_may_be_wrong_but_of_few_none_is_left_out():
    """Whatever the unit of the tracker; the median is the majority's."""
    robot, measured = tracked(0, views=4)
    few = np.ones(4, dtype=bool)
    assert robust_hand_eye(np.linalg.inv(robot), measured, few, False)[1].all()
    for scale in (1.0, 3.0):
        robot, measured = tracked(7, views=25, scale=scale)
        rng = np.random.default_rng(1)
        measured[:16] = measured[:16] @ host_exponentials(rng.normal(size=(16, 6)))
        factor, agree = robust_hand_eye(
            np.linalg.inv(robot), measured, np.ones(25, dtype=bool), scale != 1.0
        )
        assert factor == pytest.approx(scale, rel=0.02)
        assert not agree[:16].any()
        assert agree[16:].all()


@pytest.mark.parametrize("unit", [1.0, 2.5])
def test_a_wrong_pair_of_few_is_left_out_with_a_warning(unit):
    """Its tracked pose is another pair's, in metres or in a unit of the tracker's own."""
    robot, measured = tracked(0, views=5, scale=unit)
    pairs = PoseDataset.from_poses(robot, measured[[0, 1, 1, 3, 4]])
    priors = RobotPrior(), TrackerPrior()
    begin = start_of_poses(pairs, blank_calibration(pairs), None, unit != 1.0, *priors)
    assert begin.consistent.tolist() == [True, True, False, True, True]
    assert begin.ambiguities[0].startswith(
        "view 2 contradicts the other 4 pairs and is left out: were robot and tracker read"
    )


def test_a_data_set_of_poses_keeps_its_poses():
    data = data_of(0)
    part = data.select([3, 1]).mask_views([0])
    np.testing.assert_array_equal(
        host_matrices(part.camera_from_world), host_matrices(data.camera_from_world)[[3, 1]]
    )
    assert list(part.usable_views()) == [1]
    assert part.observations.padded().visible.shape == (8, 3)
    assert dataclasses.replace(part, notes=("x",)).covariance.shape == (2, 6, 6)
    assert WORLD.shape == (4, 4)


def test_a_robot_that_never_turns_is_named_with_the_option_that_ends_it():
    data = data_of(0, views=6, turns=np.zeros((6, 3)))
    with pytest.raises(ValueError, match=r"never rotates: .* start=\{'camera_from_tool': POSE\}"):
        sv.fit_poses(data)


FLAT = RobotPrior(target_bow_median=0.0, target_print_median=0.0)


@pytest.mark.parametrize(("views", "seed"), [(3, 0), (4, 2)])
def test_few_pairs_do_not_make_a_tracker_perfect(views, seed):
    """And three pairs fit a camera next to the arm as well as one on the hand.

    Without a prior on the tracker, a perfect one with a weak robot has endless evidence.
    """
    fit = sv.fit_poses(data_of(seed, views=views), field=None)
    translation, rotation = fit.tracker_noise
    assert translation == pytest.approx(TRACKER[0], rel=0.5)
    assert rotation == pytest.approx(TRACKER[1], rel=0.5)
    assert any("as well with every pose inverted" in text for text in fit.warnings) == (views == 3)
    # The covariance is of all sizes of the noise, of which so few pairs tell little.
    chain = TrackedChain(data_of(seed, views=views), fit.calibration, False, FLAT, TrackerPrior())
    of_mount = np.diagonal(likeliest_noise(chain).chain_covariance())[:6]
    assert (np.diagonal(mount_covariance(fit)) > 0.9 * of_mount).all()


def test_a_turn_of_one_joint_tells_no_size():
    """The error of the reported poses would shrink if the robot's motion did."""
    turns = np.zeros((VIEWS, 3))
    turns[:, 2] = np.linspace(-1.2, 1.2, VIEWS)
    robot = np.linalg.inv(turned(turns) @ host_exponentials(np.array([0.05, 0, 0.1, 0, 0, 0])))
    rng = np.random.default_rng(0)
    seen = MOUNT @ robot @ host_exponentials(rng.normal(size=(VIEWS, 6)) * 1e-3) @ WORLD
    data = PoseDataset.from_poses(np.linalg.inv(robot), seen)
    fit = sv.fit_poses(data, field=None)
    assert fit.noise_estimate.target_scale is None
    # What the motion does not tell is where the camera comes nearest to the hand.
    axis = MOUNT[:3, :3] @ robot[0, :3, 2]
    assert abs(axis @ np.asarray(fit.calibration.camera_from_mount.translation())) < 0.01
    with pytest.raises(ValueError, match="turns about one point: these poses tell nothing"):
        sv.fit_poses(data, scale=True)


def test_a_free_size_may_become_improbable_at_the_better_parameters():
    """The first comparison frees the target's size, the second one finds it as stated."""
    views, rng = 16, np.random.default_rng(1)
    scene = random_scene(1, views=views)
    robot = host_matrices(scene.base_from_tool)
    seen = host_matrices(scene.calibration.camera_from_world(scene.base_from_tool))
    seen[:, :3, :3] = turned(5e-4 * rng.normal(size=(views, 6))[:, 3:])[:, :3, :3] @ seen[:, :3, :3]
    seen[:, :3, 3] += rng.normal(0.0, 1e-3, (views, 3))
    errors = host_exponentials(rng.normal(size=(views, 6)) * np.repeat([2e-5, 5e-5], 3))
    fit = sv.fit_poses(PoseDataset.from_poses(robot @ errors, seen), field=None)
    assert fit.result.converged
    assert float(fit.calibration.target_scale) == 1.0


@pytest.mark.parametrize(("views", "seed", "left_over"), [(6, 28, "23."), (VIEWS, 1, "")])
def test_pairs_in_no_order_are_refused(views, seed, left_over):
    """Three of them agree with a solution from themselves.

    Of the six a fourth does by chance; those four have 10 degrees left over, all have 23.
    """
    data = data_of(1, views=views)
    order = np.random.default_rng(seed).permutation(views)
    mixed = PoseDataset.from_poses(data.base_from_tool, data.tracked_matrices[order])
    with pytest.raises(ValueError, match=f"do not move alike as given .{left_over}"):
        start_from_poses(mixed)


def test_inaccurate_pairs_are_taken_with_a_warning():
    """Ten degrees and 50 mm, as from a small marker far away."""
    turns, rng = np.random.default_rng(0).uniform(-1.5, 1.5, (VIEWS, 3)), np.random.default_rng(1)
    robot, measured = tracked(0, turns=turns)
    noise = rng.normal(size=(VIEWS, 6)) * np.repeat([0.05, np.deg2rad(10.0)], 3)
    measured = host_exponentials(noise) @ measured
    (text,) = start_from_poses(PoseDataset.from_poses(robot, measured)).ambiguities
    assert text.startswith("robot and camera agree only to")
    with pytest.raises(ValueError, match="do not move alike as given"):
        start_from_poses(PoseDataset.from_poses(np.linalg.inv(robot), measured))


def test_a_target_that_was_moved_between_two_pairs_is_named():
    """By 20 mm, from the ninth pair on; there is no such change where every other pair is wrong."""
    robot, later = tracked(3)
    later[8:, :3, 3] += later[8:, :3, :3] @ [0.02, 0.0, 0.0]
    (text,) = start_from_poses(PoseDataset.from_poses(robot, later)).ambiguities
    assert text.startswith("from view 8 on, the views contradict the earlier ones, as if the targ")
    robot, turned_over = tracked(4)
    turned_over[1::2, :3, :2] *= -1.0
    (text,) = start_from_poses(PoseDataset.from_poses(robot, turned_over)).ambiguities
    assert text.startswith("views ")
    assert text.endswith("Where so many are wrong, the others may be wrong instead")


def test_a_moved_target_is_named_where_no_mistake_explains_the_pairs():
    """By 20 mm and 6 degrees: a solution between both halves leaves large errors in all pairs."""
    robot, measured = tracked(3)
    measured[8:] = measured[8:] @ host_exponentials(np.array([0.02, 0.0, 0.0, 0.0, 0.1, 0.0]))
    with pytest.raises(ValueError, match=r"^from view 8 on, .* as if the target had been moved"):
        start_from_poses(PoseDataset.from_poses(robot, measured))


def test_copied_pairs_count_once(fit):
    robot, measured = tracked(0)
    copied = [*range(VIEWS), 3, 3, 7]
    again = sv.fit_poses(PoseDataset.from_poses(robot[copied], measured[copied]), field=None)
    assert [rejection.view for rejection in again.rejected] == ["16", "17", "18"]
    assert any("repeat both poses of an earlier view" in text for text in again.warnings)
    np.testing.assert_allclose(mount_covariance(again), mount_covariance(fit), rtol=1e-3)


def test_poses_that_are_both_inverted_are_doubted(fit):
    """They fit as well; camera and target have exchanged their places, unless a prior says so."""
    assert not any("both the robot's and the tracked poses" in text for text in fit.warnings)
    robot, measured = map(np.linalg.inv, tracked(0))
    inverted = PoseDataset.from_poses(robot, measured)
    known = {"camera_from_tool": Prior(std=10.0)}
    for priors, doubted in ((None, True), (known, False)):
        again = sv.fit_poses(inverted, field=None, priors=priors)
        doubts = [text for text in again.warnings if "both the robot's and the tracked" in text]
        assert len(doubts) == doubted
