import itertools
import re

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import opencv_poses
from jaxlie import SE3, SO3
from robot_motions import CAMERA_FROM_MOUNT, HOLDER_FROM_WORLD, mirrored, transform
from scipy.spatial.transform import Rotation
from shared_data import shared_pairs
from tracked_scene import data_of

from smartview_jax.data_checks import check_conventions, mistaken_unit, target_turns
from smartview_jax.data_checks.given_poses import GivenPoses
from smartview_jax.data_checks.misread_angles import angle_format_mistakes
from smartview_jax.geometry import (
    EULER_CODECS,
    EULER_CONVENTIONS,
    as_se3,
    host_exponentials,
    host_transforms,
    pose_codec,
)
from smartview_jax.simulation import random_scene
from smartview_jax.targets import Chessboard

VIEWS = 12


@pytest.fixture(scope="module")
def poses():
    scene = random_scene(4, views=VIEWS, translation_noise=2e-4, rotation_noise=2e-4)
    seen = scene.calibration.camera_from_world(scene.base_from_tool)
    return scene.data.base_from_tool, seen


def matrices(base_from_tool):
    return np.array(base_from_tool.as_matrix())


def with_rotations(base_from_tool, rotations):
    changed = matrices(base_from_tool)
    changed[:, :3, :3] = rotations.as_matrix()
    return host_transforms(changed)


def misread(base_from_tool, true, read):
    """Rows that one pose format wrote and another read."""
    return pose_codec(read).decode(pose_codec(true).encode(base_from_tool))


def scaled(pose, factor):
    return SE3(pose.wxyz_xyz.at[:, 4:].multiply(factor))


def test_good_data_raise_no_suspicion(poses):
    report = check_conventions(*poses, "eye_in_hand")
    assert report.problems == ()
    assert report.suspicious_views == ()
    assert report.angle_mismatch < 1e-3
    assert report.length_ratio == pytest.approx(1.0, abs=0.05)


def test_inverted_poses_are_named(poses):
    robot, seen = poses
    (problem,) = check_conventions(robot.inverse(), seen, "eye_in_hand").problems
    assert "given as tool_from_base where base_from_tool is expected" in problem


def test_a_bad_view_of_motion_about_one_axis_is_no_second_axis(poses):
    """Its error is about another axis, by which the hand-eye rotation seems to be determined."""
    robot, _ = poses
    turns, noise = np.zeros((VIEWS, 6)), np.zeros((VIEWS, 6))
    turns[:, 5] = np.linspace(-0.7, 0.7, VIEWS)
    hand_eye = np.eye(4)
    hand_eye[:3, :3] = Rotation.from_euler("xyz", [0.3, -2.0, 0.5]).as_matrix()
    hand_eye[:3, 3] = [0.02, 0.09, -0.1]
    turned = host_exponentials(turns) @ matrices(robot)[0]
    noise[:, 3:] = np.random.default_rng(0).normal(0.0, 0.008, (VIEWS, 3))
    noise[3, 3:] = [0.3, 0.3, 0.3]
    noisy = host_transforms(host_exponentials(noise) @ hand_eye @ np.linalg.inv(turned))
    base_from_tool = host_transforms(turned)
    assert check_conventions(base_from_tool, noisy, "eye_in_hand").problems == ()


@pytest.mark.parametrize(
    ("name", "prefix"),
    [("koide_charuco", "20230920_"), ("tampere_synthetic", "cs1_"), ("tampere_synthetic", "cs2_")],
)
def test_inverted_poses_of_nearly_one_axis_are_named(name, prefix):
    """There the rotations alone fit either way."""
    data, reference = shared_pairs(name, prefix)
    fx, fy, cx, cy, *distortion = reference["K"]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    seen = opencv_poses(data, K, np.array(distortion))
    robot = data.base_from_tool
    assert check_conventions(robot, seen, "eye_in_hand").problems == ()
    (problem,) = check_conventions(robot.inverse(), seen, "eye_in_hand").problems
    assert "given as tool_from_base where base_from_tool is expected" in problem


def test_the_wrong_mount_is_named(poses):
    (problem,) = check_conventions(*poses, "eye_to_hand").problems
    assert "on the hand (eye_in_hand)" in problem


@pytest.mark.parametrize(
    ("robot_factor", "target_factor", "text"),
    [
        (1e3, 1.0, "the robot's positions look like millimetres"),
        (1e2, 1.0, "the robot's positions look like centimetres"),
        (1.0, 1e3, "the target's points look like millimetres"),
        (1.0, 1.0 / 0.0254, "the target's points look like inches where metres are expected"),
        (1.0 / 25.4, 1.0, "the robot's positions look like inches where millimetres are stated"),
        (1.0, 10.0, "or the target's points like millimetres where centimetres are"),
    ],
)
def test_wrong_units_of_length_are_named(poses, robot_factor, target_factor, text):
    robot, seen = poses
    turns = target_turns(np.array([[[0.0, 0.0, 0.0], [0.2, 0.1, 0.0]]]), np.ones((1, 2), bool))
    (problem,) = check_conventions(
        scaled(robot, robot_factor), scaled(seen, target_factor), "eye_in_hand", turns=turns
    ).problems
    assert text in problem
    # Not with a second mistake, such as a missing pose at the end, that explains nothing more.
    assert "explain it about as well" not in problem


def transposed(seen):
    seen[:, :3, :3] = seen[:, :3, :3].swapaxes(1, 2)


def quaternion_read_as_xyzw(seen):
    quaternions = Rotation.from_matrix(seen[:, :3, :3]).as_quat()
    seen[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix()


def y_backwards(seen):
    seen[:, 1, 3] *= -1.0


def in_millimetres(seen):
    seen[:, :3, 3] *= 1e3


def in_a_unit_of_its_own(seen):
    seen[:, :3, 3] *= 0.15


def in_a_unit_near_a_factor_of_ten(seen):
    seen[:, :3, 3] *= 0.102


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (transposed, "in the tracked poses the rotations are transposed, the positions are not"),
        (quaternion_read_as_xyzw, "in the tracked poses quaternions in the order wxyz were read"),
        (y_backwards, "in the tracked poses the positions are in a left-handed frame, or y has"),
        (in_millimetres, "the tracked positions look like millimetres where metres are expected"),
        (in_a_unit_of_its_own, "the tracker moved 0.15 times as far as the robot: its unit of len"),
        (
            in_a_unit_near_a_factor_of_ten,
            "If the robot's positions are right, the tracker's unit",
        ),
    ],
)
def test_mistakes_of_a_tracker_are_not_put_on_the_robot(poses, wrong, text):
    robot, seen = poses
    tracked = np.array(seen.as_matrix())
    wrong(tracked)
    report = check_conventions(robot, host_transforms(tracked), "eye_in_hand", tracked=True)
    assert text in report.problems[0].split("next best")[0]


def test_a_robot_far_away_is_not_taken_for_a_tracker_with_a_unit_of_its_own():
    """Its poses are in millimetres, not in metres."""
    pairs = data_of(0)
    robot = scaled(pairs.base_from_tool, 1e3)
    (problem,) = check_conventions(
        robot, pairs.camera_from_world, "eye_in_hand", tracked=True
    ).problems
    assert problem.startswith("the robot's positions look like millimetres where metres are")
    assert "its own" not in problem


def test_a_unit_of_the_trackers_own_comes_before_mistakes_that_leave_more_over():
    """On two straight ways a wrong sign of x removes most of the misfit by chance."""
    rng = np.random.default_rng(13)
    low, high = [-34.0, -34.0, -34.0, -0.1, -0.1, 0.4], [34.0, 34.0, 34.0, 0.1, 0.1, 0.7]
    turns, shifts = np.split(rng.uniform(low, high, (3, 6)), 2, axis=1)
    places = np.linspace(0.0, 2.0, 16)

    def along(ends):
        return np.array([np.interp(places, range(3), numbers) for numbers in ends.T]).T

    seen = np.array(list(map(transform, along(turns), along(shifts))))
    noise = map(transform, rng.normal(0.0, 0.1, (16, 3)), rng.normal(0.0, 5e-4, (16, 3)))
    tracked = seen @ np.array(list(noise))
    tracked[:, :3, 3] *= 6.3
    robot = HOLDER_FROM_WORLD @ np.linalg.inv(seen) @ CAMERA_FROM_MOUNT
    poses = as_se3(robot), as_se3(tracked)
    (problem,) = check_conventions(*poses, "eye_in_hand", tracked=True).problems
    assert problem.startswith("the tracker moved 6.3")


@pytest.mark.parametrize("wrong", [transposed, quaternion_read_as_xyzw])
def test_a_mistake_of_one_reader_in_both_files_is_named(poses, wrong):
    both = [np.array(transforms.as_matrix()) for transforms in poses]
    for matrices in both:
        wrong(matrices)
    report = check_conventions(*map(host_transforms, both), "eye_in_hand", tracked=True)
    assert report.explained
    assert report.hypotheses[0].name.startswith("both_")


def test_a_ratio_of_lengths_is_named_for_units_only_where_it_is_theirs():
    assert "feet where metres are expected" in mistaken_unit(0.31)
    assert "inches where centimetres are stated" in mistaken_unit(2.55)
    # A file in metres that is read as millimetres is as likely as a target in millimetres.
    assert "metres where millimetres are stated" in mistaken_unit(1000.0)
    assert mistaken_unit(0.5) == mistaken_unit(-1.0) == ""


def test_degrees_taken_for_radians_are_named(poses):
    robot, seen = poses
    vectors = jnp.rad2deg(robot.rotation().log())
    wrong = SE3.from_rotation_and_translation(SO3.exp(vectors), robot.translation())
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "(degrees?)" in problem


@pytest.mark.parametrize(
    ("true", "read", "text"),
    [
        (
            "kuka_abc",
            "fanuc_wpr",
            "the angles are kuka_abc (yaw_pitch_roll) and were read as fanuc",
        ),
        ("fanuc_wpr", "kuka_abc", "or the reverse (first and third angle swapped)"),
        ("quaternion_xyzw", "quaternion_wxyz", "in the order xyzw were read as wxyz"),
        ("abb", "quaternion_xyzw", "in the order wxyz were read as xyzw"),
        ("ur", "yaw_pitch_roll", "are ur (rotation_vector) and were read as kuka_abc"),
        ("kuka_abc", "rotation_vector", "are kuka_abc (yaw_pitch_roll) and were read as ur"),
        ("val_oat", "kawasaki_oat", "the angles are val_oat and were read as kawasaki_oat"),
        ("kawasaki_oat", "val_oat", "the angles are kawasaki_oat and were read as val_oat"),
        ("staubli_val3", "kawasaki_oat", "are staubli_val3 and were read as kawasaki_oat"),
        ("fanuc_wpr", "kawasaki_oat", "the angles are fanuc_wpr and were read as kawasaki_oat"),
        ("ur", "staubli_val3", "are ur (rotation_vector) and were read as staubli_val3"),
    ],
)
def test_poses_read_in_another_format_are_named_for_it(poses, true, read, text):
    robot, seen = poses
    (problem,) = check_conventions(misread(robot, true, read), seen, "eye_in_hand").problems
    assert text in problem.split("next best")[0]
    assert "mm left over between two views, in the median)" in problem
    assert "tool_from_base" not in problem.split("next best")[0]


def test_transposed_rotations_are_told_from_inverted_poses(poses):
    """By rotation alone they are the same; positions tell."""
    robot, seen = poses
    rotations = Rotation.from_matrix(matrices(robot)[:, :3, :3])
    report = check_conventions(with_rotations(robot, rotations.inv()), seen, "eye_in_hand")
    (problem,) = report.problems
    assert "but do if the rotations are transposed, the positions are not" in problem
    scores = {one.name: one.closure_error for one in report.hypotheses[::-1]}
    assert scores["inverted"].rotation == pytest.approx(scores["transposed"].rotation, rel=1e-6)
    assert scores["inverted"].translation > 20.0 * scores["transposed"].translation


_BEFORE_A_NAME = ("the angles are ", "(or ", "(the same are ", ", ")


READ = "kuka_abc", "fanuc_wpr", "staubli_val3"


def named_as(true, text):
    """Whether a convention of three angles is named in a text, by any of the names it has."""
    axes, moving = EULER_CONVENTIONS[true]
    # A convention with a maker's name has this name; the angles in reverse order are the same.
    same = {"ZYX": "kuka_abc", "XYZ": "staubli_val3", "ZYZ": "kawasaki_oat"}
    name = same.get(axes, true) if moving else true if axes != "XYZ" else "fanuc_wpr"
    reverse = f"euler_{axes[::-1]}_{'fixed' if moving else 'moving'}"
    names = {name, reverse, same.get(axes[::-1], name) if not moving else name}
    return any(f"{before}{alias}" in text for alias in names for before in _BEFORE_A_NAME)


@pytest.mark.parametrize(
    ("true", "read"), list(zip(EULER_CODECS, itertools.cycle(READ), strict=False))
)
def test_every_convention_of_three_angles_is_named(poses, true, read):
    robot, seen = poses
    wrong = misread(robot, true, read)
    if np.allclose(wrong.as_matrix(), robot.as_matrix()):
        return
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert named_as(true, problem), problem
    assert "explain it about as well" not in problem


@pytest.mark.parametrize("read", READ)
def test_any_convention_read_as_another_is_undone_by_a_mistake_of_its_name(poses, read):
    robot, seen = map(matrices, poses)
    for true in EULER_CODECS:
        wrong = matrices(misread(poses[0], true, read))
        given = GivenPoses(wrong, seen)
        undone = (
            m.undo(given)[0] for m in angle_format_mistakes() if named_as(true, m.description)
        )
        assert np.allclose(wrong, robot) or any(np.allclose(poses, robot) for poses in undone), true


def test_radians_taken_for_degrees_are_named(poses):
    robot, seen = poses
    rows = pose_codec("kuka_abc").encode(robot, "m", "rad")
    wrong = pose_codec("kuka_abc").decode(rows, "m", "deg")
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "kuka_abc (yaw_pitch_roll)) are in radians and were read as degrees" in problem


def test_two_mistakes_at_once_are_both_named(poses):
    robot, seen = poses
    wrong = scaled(robot.inverse(), 1e3)
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "tool_from_base" in problem
    assert "and the robot's positions look like millimetres" in problem


@pytest.mark.parametrize("column", [True, False])
def test_mirrored_pictures_are_named(column):
    """The poses that OpenCV finds in them: the board is seen from behind."""
    scene = random_scene(3, VIEWS, Chessboard(6, 9, 0.006).points)
    camera = scene.calibration.camera
    K = np.array([[camera.alpha_u, 0.0, camera.u0], [0.0, camera.alpha_v, camera.v0], [0, 0, 1.0]])
    width, height = camera.image_size
    pixels = np.array(scene.data.pixels)
    mirrored = [width - 1.0, 0.0] if column else [0.0, height - 1.0]
    sign = [-1.0, 1.0] if column else [1.0, -1.0]
    seen = []
    for where, visible in zip(pixels, np.asarray(scene.data.visible), strict=True):
        points = np.asarray(scene.data.points)[0][visible]
        flipped = (sign * where + mirrored)[visible]
        _, r, t = cv2.solvePnP(points, flipped, K, None, flags=cv2.SOLVEPNP_IPPE)
        seen.append(np.block([[cv2.Rodrigues(r)[0], t], [np.zeros((1, 3)), np.ones((1, 1))]]))
    seen = host_transforms(np.stack(seen))
    (problem,) = check_conventions(scene.data.base_from_tool, seen, "eye_in_hand").problems
    assert "but do if the pictures are mirrored" in problem


@pytest.mark.parametrize("axis", range(3))
def test_an_axis_of_the_positions_that_counts_backwards_is_named(poses, axis):
    robot, seen = poses
    wrong = matrices(robot)
    wrong[:, axis, 3] *= -1.0
    (problem,) = check_conventions(host_transforms(wrong), seen, "eye_in_hand").problems
    assert (
        f"left-handed frame, or {'xyz'[axis]} has the wrong sign" in problem.split("next best")[0]
    )


def test_a_robot_whose_frame_is_left_handed_is_named(poses):
    """No data tell it from mirrored pictures, so that both are named."""
    robot, seen = poses
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    wrong = host_transforms(mirror @ matrices(robot) @ mirror)
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "or the robot's frame is left-handed" in problem.split("next best")[0]


def test_positions_alone_that_do_not_fit_are_named(poses):
    """Every second row lies on the other side of the base: every rotation is right."""
    robot, seen = poses
    changed = matrices(robot)
    changed[::2, :3, 3] += [0.0, 0.0, -0.8] * np.sign(changed[::2, 2:3, 3])
    (problem,) = check_conventions(host_transforms(changed), seen, "eye_in_hand").problems
    assert "they turn alike, but the positions do not fit" in problem


def test_a_target_of_half_its_stated_size_is_not_another_frame(poses):
    robot, seen = poses
    smaller = matrices(seen)
    smaller[:, :3, 3] *= 2.2
    report = check_conventions(robot, host_transforms(smaller), "eye_in_hand")
    assert report.problems == ()
    assert report.length_ratio == pytest.approx(2.2, rel=0.02)
    # A weak robot that moves its tool as far turns it as well.
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.normal(0, 0.02, (VIEWS, 3)), rng.normal(0, 0.03, (VIEWS, 3))], 1)
    weak = host_transforms(matrices(robot) @ host_exponentials(errors))
    assert check_conventions(weak, seen, "eye_in_hand").problems == ()


def test_a_mistake_that_corrects_little_is_not_suggested(poses):
    """Every third row repeats the row before; millimetres leave the rotations as wrong as given."""
    robot, seen = poses
    order = np.arange(VIEWS)
    order[1::3] -= 1
    order[2::3] -= 2
    stale = SE3(robot.wxyz_xyz[order])
    (problem,) = check_conventions(stale, seen, "eye_in_hand").problems
    assert "no mistake that is known explains it" in problem
    assert "the nearest" not in problem


@pytest.mark.parametrize(
    ("order", "text"),
    [
        (np.roll(np.arange(VIEWS), 1), "each fits the pose 1 view after its own"),
        (np.roll(np.arange(VIEWS), -2), "each fits the pose 2 views before its own"),
        (np.arange(VIEWS)[::-1], "they fit the poses in reverse order"),
        (
            np.r_[:4, 5:VIEWS, 4],
            "from the view number 5 on, each fits the pose before its own: is a pose missing?",
        ),
        (
            np.r_[:7, VIEWS - 1, 7 : VIEWS - 1],
            "from the view number 8 on, each fits the pose after its own: is a picture missing?",
        ),
        (np.array(sorted(range(VIEWS), key=str)), "one of the two is sorted as words"),
    ],
)
def test_pictures_paired_in_another_order_are_named(poses, order, text):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz[order])
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert text in problem.split("next best")[0]


@pytest.mark.parametrize("columns", [4, 3])
def test_views_numbered_from_another_corner_are_named(poses, columns):
    """A symmetric grid of 3 rows whose numbering begins at the opposite corner in some pictures,
    or, where it is square, at the next one."""
    robot, seen = poses
    x, y = np.meshgrid(np.arange(columns), np.arange(3.0))
    grid = 0.03 * np.stack([x, y, 0.0 * x], axis=-1)
    turned = grid[::-1, ::-1] if columns == 4 else np.rot90(grid)
    # The motion that takes the grid's points into their order as seen (Kabsch).
    own, other = grid.reshape(-1, 3), turned.reshape(-1, 3)
    rotation, _ = Rotation.align_vectors(other - other.mean(axis=0), own - own.mean(axis=0))
    turn = np.eye(4)
    turn[:3, :3] = rotation.as_matrix()
    turn[:3, 3] = other.mean(axis=0) - rotation.apply(own.mean(axis=0))
    camera, wrong = np.array(seen.as_matrix()), [1, 4, 5, 10]
    camera[wrong] = camera[wrong] @ turn
    points = np.tile(own, (VIEWS, 1, 1))
    turns = target_turns(points, np.ones(points.shape[:2], dtype=bool))
    ids = [f"p{k}" for k in range(VIEWS)]
    report = check_conventions(robot, host_transforms(camera), "eye_in_hand", None, turns, ids)
    text = "the target's points are numbered from another corner: views p1, p4, p5, p10"
    assert text in report.problems[0]
    no_points = np.zeros(points.shape[:2], dtype=bool)
    assert target_turns(points, no_points) is None


@pytest.mark.parametrize(("views", "exchanged"), [(6, [1, 4]), (12, [0, 3, 6, 9])])
def test_the_views_without_which_all_agree_are_named(poses, views, exchanged):
    robot, seen = (SE3(part.wxyz_xyz[:views]) for part in poses)
    order = np.arange(views)
    order[exchanged] = np.roll(exchanged, 1)
    (problem,) = check_conventions(SE3(robot.wxyz_xyz[order]), seen, "eye_in_hand").problems
    assert f"but do without views {', '.join(map(str, exchanged))} (" in problem


@pytest.mark.parametrize("count", [1, 4])
def test_mirrored_pictures_are_left_out_where_they_are_few_and_else_named(poses, count):
    robot, seen = poses
    camera = np.array(seen.as_matrix())
    camera[:count] = mirrored(camera[:count])
    report = check_conventions(robot, as_se3(camera), "eye_in_hand")
    assert [view for view, _ in report.suspicious_views] == list(range(count))
    assert len(report.problems) == (count > 1)
    if report.problems:
        text = r"but do without views 0, 1, 2, 3 .*their pictures seem to be mirrored"
        assert re.search(text, report.problems[0])


def test_pictures_in_no_order_are_not_called_angles_in_another_unit_alone(poses):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz[np.random.default_rng(1).permutation(VIEWS)])
    (problem,) = check_conventions(wrong, seen, "eye_in_hand").problems
    assert "the pictures are paired with wrong poses in no order, or" in problem
    assert "no mistake that is known explains it" in problem


def test_where_several_mistakes_explain_the_data_all_are_named(poses):
    """A robot that does not move its tool, turning about its origin: positions tell nothing."""
    robot, _ = poses
    turning = matrices(robot)
    turning[:, :3, 3] = 0.0
    turning = host_transforms(turning)
    hand_eye = SE3.from_rotation_and_translation(SO3.identity(), jnp.array([0.0, 0.0, 0.3]))
    seen = SE3(hand_eye.wxyz_xyz[None]) @ turning.inverse()
    (problem,) = check_conventions(turning.inverse(), seen, "eye_in_hand").problems
    assert "mistakes explain it about as well" in problem
    assert "every pose is inverted" in problem
    assert "the rotations are transposed" in problem


@pytest.mark.parametrize("views", [[5], [2, 9]])
def test_single_wrong_poses_are_not_blamed_on_all(poses, views):
    robot, seen = poses
    wrong = robot.wxyz_xyz
    for k in views:
        wrong = wrong.at[k].set(SE3.exp(jnp.array([0.2, 0.1, 0.3, 1.0, -2.0, 0.5 + k])).wxyz_xyz)
    report = check_conventions(SE3(wrong), seen, "eye_in_hand")
    assert report.problems == ()
    assert [view for view, _ in report.suspicious_views] == views


def test_a_mispaired_view_is_pointed_out(poses):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz.at[5].set(robot.wxyz_xyz[6]))
    report = check_conventions(wrong, seen, "eye_in_hand")
    assert report.problems == ()
    assert [view for view, _ in report.suspicious_views] == [5]
    assert "paired with the right pose?" in report.suspicious_views[0][1]


def test_a_hidden_view_is_not_asked(poses):
    robot, seen = poses
    wrong = SE3(robot.wxyz_xyz.at[5].set(robot.wxyz_xyz[6]))
    weights = jnp.ones(VIEWS).at[5].set(0.0)
    assert check_conventions(wrong, seen, "eye_in_hand", weights).suspicious_views == ()
    assert np.isfinite(check_conventions(wrong, seen, "eye_in_hand", weights).closure_error).all()
