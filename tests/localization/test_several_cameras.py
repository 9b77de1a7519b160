"""Objects in pictures of several cameras: a stereo pair on the hand, and one next to the arm."""

import numpy as np
import pytest
from drawn_edges import drawn, evidence
from placed_box import MIDDLE, MODEL, POSE, error_of
from rig_pair import (
    BASE_FROM_WORLD,
    drawn_errors,
    estimate,
    noise_twist,
    seen_by,
    stereo_pair,
    true_camera,
    true_pose,
)
from seen_scene import SAMPLES

from smartview_jax.cameras import ViewCameras
from smartview_jax.engine import Observability
from smartview_jax.evaluation import mean_nees, nees
from smartview_jax.features import UNSEEN
from smartview_jax.geometry import (
    host_adjoints,
    host_exponentials,
    host_logarithms,
    host_matrices,
    host_transforms,
    look_at,
)
from smartview_jax.grasping import GraspScene, PlacedObject
from smartview_jax.grasping.localized import checked_object
from smartview_jax.grasping.uncertainty import error_covariance, gripper_errors
from smartview_jax.joint import SavedEstimate
from smartview_jax.localization import (
    Hypothesis,
    Localizations,
    Reachable,
    Wireframe,
    localize,
    next_view,
)
from smartview_jax.localization.earlier_views import together_with
from smartview_jax.localization.edges.edge_lookup import DEPTH_CELL_PX, DepthBuffers, EdgeLookup
from smartview_jax.localization.refining.refinement import refine_pose
from smartview_jax.localization.search.scoring import stacked_maps
from smartview_jax.modeling import (
    CalibrationUncertainty,
    RigViews,
    SeenViews,
    as_checked_command,
    pixel_jacobians,
)
from smartview_jax.robots import Command, Gripper

PAIR, TARGET = ["left", "right"], "base_from_world"
GRIPPER = Gripper()
RUNS = 15


def hand_poses(directions):
    """Reported poses of the hand that look along directions at the box."""
    looking = host_matrices(look_at(MIDDLE, np.array(directions), 0.4))
    return BASE_FROM_WORLD @ np.linalg.inv(looking)


POSES = hand_poses([[0.5, 0.6, -0.8]])[[0, 0]]


@pytest.fixture(scope="module")
def rig():
    return estimate(stereo_pair(), 1.0, 0.3)


@pytest.fixture(scope="module")
def wireframe():
    return Wireframe.of(MODEL, SAMPLES)


def true_views(rig, cameras, poses, errors, twist):
    """The views that cameras with these errors take, in one state of the robot."""
    matrices = [
        true_pose(rig, name, errors, pose, twist) for name, pose in zip(cameras, poses, strict=True)
    ]
    seen = SeenViews.of(RigViews(rig, cameras), poses)
    names = list(dict.fromkeys(cameras))
    index = np.array([names.index(name) for name in cameras])
    true = ViewCameras.of([true_camera(rig, name, errors) for name in names], index)
    return seen._replace(camera=true, camera_from_world=np.stack(matrices))


def target_hardly_known(rig):
    """The same rig, but the target's pose in the base is known to 1.2 mm and 3 mrad only."""
    loose = np.array([20.0 if "_from_world" in name else 1.0 for name in rig.parameter_names])
    return rig._replace(covariance=loose[:, None] * rig.covariance * loose)


def grasped(rig, found, names, errors, rng):
    """Error of a grasp on the found box, and its covariance, also for an object measured alone."""
    down = host_exponentials(np.array([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]))
    world_from_gripper = found.world_from_object @ down
    base_from_tool = BASE_FROM_WORLD @ world_from_gripper @ np.linalg.inv(GRIPPER.tool_from_gripper)
    scene = GraspScene(rig.calibrations["right"], estimate=rig)
    (known,) = gripper_errors(scene, GRIPPER, Command(host_transforms(base_from_tool[None])))
    turn = [0.0] * 3 + [errors[f"{TARGET}.rotation.{k}"] for k in "xyz"]
    true = host_exponentials(np.array(turn)) @ BASE_FROM_WORLD
    true[:3, 3] = BASE_FROM_WORLD[:3, 3] + [errors[f"{TARGET}.translation.{k}"] for k in "xyz"]
    reached = base_from_tool @ np.linalg.inv(host_exponentials(noise_twist(rng)))
    actual = np.linalg.inv(true) @ reached @ GRIPPER.tool_from_gripper
    tau = host_logarithms(np.linalg.inv(actual) @ world_from_gripper)
    back = np.linalg.inv(down)
    eta = tau - host_adjoints(back) @ error_of(found.world_from_object)
    jacobian = found.calibration_jacobian[:, : len(names)]
    together = PlacedObject(MODEL, found.world_from_object, found.covariance, jacobian, names)
    alone = together._replace(calibration_jacobian=None)
    return eta, *(error_covariance(placed, back, known)[:6, :6] for placed in (together, alone))


def test_a_pose_from_a_stereo_pair_is_as_uncertain_as_it_is_said_to_be(rig, wireframe):
    """So is a grasp on it: what the cameras and the gripper share cancels."""
    rig = target_hardly_known(rig)
    views = SeenViews.of(RigViews(rig, PAIR), POSES)
    uncertainty = CalibrationUncertainty.of(views, RigViews(rig, PAIR), None)
    rng, errors, covariances, grasps = np.random.default_rng(0), [], [], []
    for numbers in drawn_errors(rig, rng, RUNS):
        true = true_views(rig, PAIR, POSES, numbers, noise_twist(rng))
        lookup = EdgeLookup.of(drawn(MODEL, true, POSE, 0.1, rng), views.largest_picture)
        refined = refine_pose(POSE, MODEL, wireframe, views, lookup, uncertainty, radius=10.0)
        errors.append(error_of(refined.world_from_object))
        covariances.append(refined.covariance)
        grasps.append(grasped(rig, refined, uncertainty.shared_names, numbers, rng))
    assert mean_nees(nees(np.array(errors), np.array(covariances)), 6).is_consistent
    misses, together, alone = map(np.array, zip(*grasps, strict=True))
    assert mean_nees(nees(misses, together), 6).is_consistent
    assert (np.trace(together[:, :3, :3].T) < 0.5 * np.trace(alone[:, :3, :3].T)).all()


@pytest.fixture(scope="module")
def pictures(rig):
    """Of different sizes, by different cameras, at one pose of the hand."""
    exact = dict.fromkeys(rig.parameter_names, 0.0)
    true = true_views(rig, PAIR, POSES, exact, np.zeros(6))
    return evidence(drawn(MODEL, true, POSE), [camera.image_size for camera in true.cameras])


def test_an_object_is_found_in_a_stereo_pair(rig, pictures, monkeypatch):
    # The start is the truth: nothing has to converge, whose program takes long to compile.
    monkeypatch.setattr(
        "smartview_jax.localization.judging.candidates.poses_on_edges",
        lambda wireframe, views, lookup, poses: (poses, np.array([[900.0, 800.0]])),
    )
    results, in_base = (
        localize(
            pictures,
            POSES,
            RigViews(rig, PAIR, frame=frame),
            MODEL,
            hypotheses=[Hypothesis(0, pose, 0.0, 0.0)],
        )
        for frame, pose in (("world", POSE), ("base", BASE_FROM_WORLD @ POSE))
    )
    (in_world,), (in_base,) = results, in_base
    assert in_world.verdict.decision == "accepted"
    assert np.linalg.norm(error_of(in_world.world_from_object)[:3]) < 1e-4
    assert results.calibration.cameras == ("left", "right")
    expected = BASE_FROM_WORLD @ in_world.world_from_object
    np.testing.assert_allclose(in_base.world_from_object, expected, atol=1e-6)
    # What is in the base frame is not taken for what is in the world frame.
    with pytest.raises(ValueError, match="found poses in the base frame"):
        next_view([in_base], rig.calibrations["left"], Reachable(distance=0.4))
    with pytest.raises(ValueError, match="found it in the base frame"):
        checked_object(in_base)


def test_earlier_pictures_are_read_with_the_cameras_that_took_them(rig):
    """First two pictures by one camera, then one by the other."""
    poses = hand_poses([[0.5, 0.6, -0.8], [-0.35, 0.75, -0.8]])
    earlier = RigViews(rig, ["left", "left"])
    previous = Localizations([], (), (), as_checked_command(poses), earlier)
    now = RigViews(rig, ["right"])
    together, command = together_with(previous, now, as_checked_command(poses[:1]))
    seen = SeenViews.of(together, command)
    alone = [SeenViews.of(earlier, poses), SeenViews.of(now, poses[:1])]
    expected = np.concatenate([views.camera_from_world for views in alone])
    np.testing.assert_allclose(seen.camera_from_world, expected, atol=1e-14)
    assert [camera.image_size for camera in seen.cameras] == [(640, 480)] * 2 + [(800, 600)]
    # The robot came back to the first pose: its error there is another one.
    uncertainty = CalibrationUncertainty.of(seen, together, None)
    assert len(uncertainty.names) - uncertainty.shared_count == 18


def test_earlier_pictures_of_another_rig_are_refused(rig):
    other = estimate({**stereo_pair(), "left": stereo_pair()["right"]})
    command = as_checked_command(POSES[:1])
    previous = Localizations([], (), (), command, RigViews(rig, ["left"]))
    for calibration, said in (
        (RigViews(other, ["right"]), "another calibration of 'left', of a camera of 640x480 px"),
        (RigViews({"right": other.calibrations["right"]}, ["right"]), "of camera 'left', which"),
        (RigViews(rig, ["right"], frame="base"), "its poses are in the world frame"),
        (rig.calibrations["left"], "its views are of several cameras; give RigViews"),
    ):
        with pytest.raises(ValueError, match=f"^previous: .*{said}"):
            together_with(previous, calibration, command)
    single = Localizations([], (), (), command, rig.calibrations["left"])
    with pytest.raises(ValueError, match=r"^previous: it was found with a single calibration"):
        together_with(single, RigViews(rig, ["left"]), command)


def test_pictures_of_a_wrong_camera_are_named(rig, pictures):
    swapped = RigViews(rig, PAIR[::-1])
    with pytest.raises(ValueError, match=r"^view 0: evidence of a picture of 640x480 px, expected"):
        localize(pictures, POSES, swapped, MODEL)
    picture = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    with pytest.raises(ValueError, match=r"^view 1: .*640 x 480"):
        localize([pictures[0], picture], POSES, RigViews(rig, PAIR), MODEL)
    with pytest.raises(ValueError, match=r"^calibration: 2 pictures, but RigViews name .* 1 views"):
        localize(pictures, POSES, RigViews(rig, ["left"]), MODEL)
    with pytest.raises(ValueError, match=r"^covariance: expected None, since views of a rig"):
        localize(pictures, POSES, RigViews(rig, PAIR), MODEL, covariance=single_estimate(rig))


def test_pictures_of_different_sizes_are_reduced_in_proportion(rig):
    views = SeenViews.of(RigViews(rig, PAIR), POSES)
    halves = [
        camera.resized((camera.image_size[0] // 2, camera.image_size[1] // 4))
        for camera in views.cameras
    ]
    small = views._replace(camera=ViewCameras.of(halves, np.array([0, 1])))
    uncertainty = CalibrationUncertainty.of(views, RigViews(rig, PAIR), None)
    points = MIDDLE + np.random.default_rng(0).normal(0.0, 0.02, (5, 3))
    moved, halved = (
        np.einsum("vpil,vln->vpin", pixel_jacobians(seen, points).by_view, own.view_jacobian)
        for seen, own in ((views, uncertainty), (small, uncertainty.resized(views, small)))
    )
    assert halved == pytest.approx(np.array([[0.5], [0.25]]) * moved, rel=1e-9)


def test_a_surface_hides_what_is_behind_it_in_each_cameras_picture(rig):
    views = SeenViews.of(RigViews(rig, PAIR), POSES)
    known = DepthBuffers(views)
    corners = np.array([[[-0.02, -0.02, 0.0], [0.03, -0.01, 0.0], [0.0, 0.03, 0.0]]])
    known.add_triangles(MIDDLE + corners)
    exact = dict.fromkeys(rig.parameter_names, 0.0)
    for view, (name, pose) in enumerate(zip(PAIR, POSES, strict=True)):
        (u, v), *_ = seen_by(rig, name, exact, MIDDLE[None], pose, np.zeros(6))
        cell = known.inverse_depth[
            view, int(v + 0.5) // DEPTH_CELL_PX, int(u + 0.5) // DEPTH_CELL_PX
        ]
        depth = (views.camera_from_world[view] @ [*MIDDLE, 1.0])[2]
        assert cell * depth == pytest.approx(1.0, abs=0.01)
        # Nothing else is hidden.
        assert 0.002 < (known.inverse_depth[view] > 0.0).mean() < 0.05


def test_maps_of_pictures_of_different_sizes_are_unseen_beyond_the_smaller():
    wide, high = np.zeros((2, 3, 5), np.uint8), np.ones((2, 4, 2), np.uint8)
    both = stacked_maps([wide, high], UNSEEN)
    assert both.shape == (2, 2, 4, 5)
    np.testing.assert_array_equal(both[0, :, :3], wide)
    np.testing.assert_array_equal(both[1, :, :, :2], high)
    assert (both[0, :, 3] == UNSEEN).all()
    assert (both[1, :, :, 2:] == UNSEEN).all()


def single_estimate(rig):
    """Of the left camera alone."""
    numbers = Observability(0, 0, (), (), 1.0)
    return SavedEstimate(rig.calibrations["left"], np.zeros((0, 0)), (), None, 0.1, numbers)
