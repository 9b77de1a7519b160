"""What `smartview grasp` prints and writes is Eq. 20, and it refuses what no arm can do."""

import dataclasses
import json

import numpy as np
import pytest
from board_scene import board_folder, calibrated_board, run
from solids import box

from smartview_jax.geometry import host_matrices, pose_codec
from smartview_jax.io import read_viewpoints, save_object_model
from smartview_jax.joint import load_estimate
from smartview_jax.modeling import grasp_on_face
from smartview_jax.simulation import paper_calibration

POSE = "0.02,-0.01,0.05,20,0,0"
DOWN = "0,0,0.01,0,180,0"


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("grasp") / "calibration.yaml"
    paper_calibration().save(path)
    return path


def grasped(path, *words):
    return run("grasp", path, *words)


def transform(text):
    numbers = np.array([[float(word) for word in text.split(",")]])
    poses = pose_codec("yaw_pitch_roll").decode(numbers, "m", "deg")
    return host_matrices(poses)[0]


def test_the_command_is_eq_20(calibration, tmp_path):
    out = tmp_path / "grasp.csv"
    words = ("--object-pose", POSE, "--grasp-pose", DOWN, "--gripper", "0,0,0.11,0,0,0")
    ended = grasped(calibration, *words, "--approach", "60", "--out", str(out))
    assert ended.exit_code == 0, ended.output
    found = read_viewpoints(out)
    assert found.names == ("approach", "grasp")
    world_from_gripper = transform(POSE) @ transform(DOWN)
    expected = (
        host_matrices(paper_calibration().base_from_world)
        @ world_from_gripper
        @ np.linalg.inv(transform("0,0,0.11,0,0,0"))
    )
    commanded = host_matrices(found.base_from_tool)
    np.testing.assert_allclose(commanded[1], expected, atol=1e-9)
    # The way in begins 60 mm back along the gripper's z, which points to the object.
    back = commanded[1][:3, 3] - commanded[0][:3, 3]
    np.testing.assert_allclose(back, 0.06 * commanded[1][:3, 2], atol=1e-9)
    assert f"{1e3 * expected[0, 3]:.3f}" in ended.stdout
    assert "has no covariance" in " ".join(ended.stdout.split())


def test_a_models_grasp_is_chosen_by_its_name(calibration, tmp_path):
    solid = box(0.06, 0.04, 0.03, name="box")
    grasps = [
        dataclasses.replace(
            grasp_on_face(solid, 1, opening_direction=np.array([0.0, 1.0, 0.0]), depth=0.02),
            name=name,
            depth=0.02,
        )
        for name in ("top", "other")
    ]
    path = save_object_model(dataclasses.replace(solid, grasps=tuple(grasps)), tmp_path / "o.json")
    ended = grasped(calibration, "--object-pose", POSE, "--model", str(path), "--name", "other")
    assert ended.exit_code == 0, ended.output
    wrong = grasped(calibration, "--model", str(path), "--name", "bottom")
    assert wrong.exit_code == 2
    assert "has the grasps 'top', 'other'; found 'bottom'" in wrong.stderr
    bare = save_object_model(solid, tmp_path / "bare.json")
    none = grasped(calibration, "--model", str(bare))
    assert none.exit_code == 2
    assert "no grasps in it" in none.stderr


def test_one_document_for_programs(calibration):
    words = ("--object-pose", POSE, "--grasp-pose", DOWN, "--format", "kuka_abc", "--json")
    ended = grasped(calibration, *words)
    assert ended.exit_code == 0, ended.output
    document = json.loads(ended.stdout)
    assert document["smartview"] == "grasp"
    assert [one["name"] for one in document["commands"]] == ["approach", "grasp"]
    assert list(document["commands"][0]["pose"]) == [
        "x_mm", "y_mm", "z_mm", "a_deg", "b_deg", "c_deg",
    ]  # fmt: skip
    assert document["error"] is None


def test_the_error_is_that_of_the_calibration(tmp_path_factory):
    path = calibrated_board(tmp_path_factory).calibration
    fit = load_estimate(path)
    words = ("--grasp-pose", DOWN, "--allow", "behind-target")
    document = json.loads(grasped(path, *words, "--json").stdout)
    sigmas = document["error"]["std_m"]
    # At the world's origin the tool is as well known as the origin and the robot are.
    places = [fit.parameter_names.index(f"base_from_world.translation.{axis}") for axis in "xyz"]
    variance = np.diagonal(fit.covariance)[places].sum()
    expected = np.sqrt(variance + 3 * fit.noise.translation**2)
    assert np.sqrt(np.sum(np.square(sigmas))) == pytest.approx(expected, rel=0.1)
    ended = grasped(path, *words)
    assert f"within +- ({1.96e3 * sigmas[0]:.2f}, " in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 80


def test_what_the_arm_cannot_reach_is_refused_and_not_written(calibration, tmp_path):
    out = tmp_path / "grasp.val"
    far = ("--object-pose", "3,0,0,0,0,0", "--grasp-pose", DOWN, "--out", str(out))
    arm = ("--arm", "puma_560", "--near=0,90,-90,0,60,0")
    ended = grasped(calibration, *far, *arm)
    assert ended.exit_code == 2
    assert "refused, nothing is written: approach: out of reach" in ended.stderr
    assert not out.exists()
    # Without an arm nothing is known of its reach.
    assert grasped(calibration, *far).exit_code == 0
    assert "MOVE grasp" in out.read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give either --grasp-pose or --model"),
        (("--grasp-pose", "0,0,1"), "--grasp-pose: expected six numbers"),
        (("--grasp-pose", DOWN, "--name", "top"), "selects a grasp of a model"),
        (("--grasp-pose", DOWN, "--format", "oat"), "pose format is one of"),
    ],
)
def test_what_is_missing_is_said(calibration, words, message):
    ended = grasped(calibration, *words)
    assert ended.exit_code == 2
    assert message in ended.stderr


@pytest.mark.parametrize("tilt", ["0,180,0", "30,150,0"])
def test_a_grasp_behind_the_target_is_refused_without_a_region(tilt, tmp_path_factory, tmp_path):
    """The truth of a simulation says nothing of the views, but its camera looks down."""
    truth = board_folder(tmp_path_factory) / "truth.yaml"
    out = tmp_path / "grasp.csv"
    words = (truth, "--grasp-pose", f"0,0,-0.15,{tilt}", "--out", out)
    ended = grasped(*words)
    assert ended.exit_code == 2
    assert "grasp: the tool is 0.150 m behind the target's plane" in ended.stderr
    assert "--allow behind-target" in ended.stderr
    assert "not checked: the calibration has no region" in ended.stdout
    assert not out.exists()
    # The word of another check allows nothing.
    other = grasped(*words, "--allow", "unreachable", "--allow", "outside-region")
    assert (other.exit_code, out.exists()) == (2, False)
    assert grasped(*words, "--allow", "behind-target").exit_code == 0
    assert out.exists()


def test_a_word_allows_its_own_check_only(calibration, tmp_path):
    out = tmp_path / "grasp.val"
    words = ("--object-pose", "3,0,-0.3,0,0,0", "--grasp-pose", DOWN, "--out", out)
    words = (*words, "--arm", "puma_560", "--near=0,90,-90,0,60,0")
    assert "--allow unreachable" in grasped(calibration, *words).stderr
    ended = grasped(calibration, *words, "--allow", "unreachable")
    assert ended.exit_code == 2
    assert "m behind the target's plane" in ended.stderr
    assert "--allow behind-target" in ended.stderr
    assert "--allow unreachable" not in ended.stderr
    assert not out.exists()
