"""What a person knows already enters the fit, is kept with its result, and is refused if wrong."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from board_scene import LENS, board_folder, run, single_tag_folder
from jaxlie import SE3, SO3

from smartview_jax import Calibration, Prior, load_dataset
from smartview_jax.cameras import Fisheye, OpenCV4
from smartview_jax.cli.fit_options import (
    FitKnowledge,
    parse_fit_options,
    parse_rig_aspects,
    parse_rig_start,
)
from smartview_jax.files import read_yaml
from smartview_jax.geometry import host_logarithms, host_matrices
from smartview_jax.io import read_camera, ros_camera_info
from smartview_jax.joint import load_estimate


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return board_folder(tmp_path_factory)


def calibrated(folder, out, *words):
    return run("calibrate", folder, *LENS, "--no-held-out", "--out", out, *words)


def options(**given):
    return parse_fit_options("opencv4", "eye_in_hand", FitKnowledge(**given))


def test_a_known_camera_is_held_and_said(folder, tmp_path):
    truth = Calibration.load(folder / "truth.yaml")
    ended = calibrated(folder, tmp_path, "--camera", folder / "truth.yaml", "--json")
    assert ended.exit_code == 0, ended.output
    saved = Calibration.load(tmp_path / "calibration.yaml")
    assert saved.camera.lens == truth.camera.lens
    assert float(saved.camera.alpha_u) == float(truth.camera.alpha_u)
    stated = {one["name"]: one for one in json.loads(ended.stdout)["parameters"]}
    assert stated["camera.alpha_u"]["held"]
    assert not stated["camera_from_tool.translation.x"]["held"]
    source = read_yaml(tmp_path / "calibration.yaml")["source"]
    assert source == f"board; given: --camera {folder / 'truth.yaml'}"
    assert f"--camera {folder / 'truth.yaml'}" in (tmp_path / "report.html").read_text()


def test_a_single_tag_needs_a_known_camera(tmp_path):
    """Four corners of a tag in every view are a pose, but no camera."""
    scene = single_tag_folder(tmp_path)
    alone = calibrated(tmp_path / "tag", tmp_path / "out", "--bad-views", "mask")
    assert alone.exit_code == 2
    assert "4 points seen, 6 needed" in alone.stderr
    assert "--camera FILE) 4 points suffice" in alone.stderr.replace("\n", " ")
    told = calibrated(tmp_path / "tag", tmp_path / "out", "--camera", tmp_path / "camera.yaml")
    assert told.exit_code == 0, told.output
    found = load_estimate(tmp_path / "out" / "calibration.yaml")
    # Within the stated uncertainty of the truth.
    difference = found.calibration.camera_from_tool @ scene.calibration.camera_from_tool.inverse()
    std = np.sqrt(np.diagonal(found.covariance))[:3]
    assert (np.abs(np.asarray(difference.translation())) < 5.0 * np.max(std)).all()


def test_a_prior_and_a_free_scale_enter_the_fit(folder, tmp_path):
    prior = ("--prior", "target_scale=1+-0.0005", "--prior", "camera.u0=300+-0.01px")
    ended = calibrated(folder, tmp_path, *prior)
    assert ended.exit_code == 0, ended.output
    found = load_estimate(tmp_path / "calibration.yaml")
    std = dict(zip(found.parameter_names, np.sqrt(np.diagonal(found.covariance)), strict=True))
    assert float(found.calibration.camera.u0) == pytest.approx(300.0, abs=0.1)
    assert std["camera.u0"] <= 0.0105
    assert 0.0 < std["target_scale"] <= 0.00053
    assert "given: --prior target_scale=1+-0.0005, --prior camera.u0=300" in "".join(
        (tmp_path / "calibration.yaml").read_text().split("\n")[:6]
    )


def test_a_transform_from_a_drawing_is_kept(folder, tmp_path):
    """Given from the tool to the camera, as drawings have it, and held."""
    truth = Calibration.load(folder / "truth.yaml").camera_from_tool
    inverse = truth.inverse()
    angles = np.rad2deg([float(x) for x in inverse.rotation().as_rpy_radians()])[::-1]
    pose = ",".join(f"{x:.9f}" for x in [*np.asarray(inverse.translation()), *angles])
    words = ("--start", f"tool_from_camera={pose}", "--fixed", "camera_from_tool")
    ended = calibrated(folder, tmp_path, *words)
    assert ended.exit_code == 0, ended.output
    kept = Calibration.load(tmp_path / "calibration.yaml").camera_from_tool
    np.testing.assert_allclose(host_matrices(kept), host_matrices(truth), atol=1e-8)
    names = load_estimate(tmp_path / "calibration.yaml").parameter_names
    assert not any(name.startswith("camera_from_tool") for name in names)


def test_a_start_of_one_transform_keeps_the_first_view(folder):
    from smartview_jax.staged import fit_staged, merged_start

    data = load_dataset(folder)
    found = fit_staged(data, "radial").calibration
    turn = SE3.from_rotation_and_translation(SO3.from_x_radians(0.1), np.array([0.01, 0.0, 0.0]))
    for name in ("camera_from_tool", "base_from_world"):
        start = merged_start(found, {name: turn @ getattr(found, name)}, data, None)
        moved = host_logarithms(
            host_matrices(getattr(start, name) @ getattr(found, name).inverse())
        )
        np.testing.assert_allclose(moved, np.asarray(turn.log()), atol=1e-9)
        before, after = (
            host_matrices(one.camera_from_world(data.base_from_tool)) for one in (found, start)
        )
        np.testing.assert_allclose(after[0], before[0], atol=1e-9)
        assert np.abs(after[1] - before[1]).max() > 1e-4


def test_numbers_are_in_the_units_that_stand_behind_them(tmp_path):
    (tmp_path / "known.yaml").write_text(
        "camera_from_tool.translation.z: 0.08 +- 0.001 m\ncamera_from_tool.rotation: +-2deg\n"
    )
    found = options(
        prior=["camera_from_tool.translation.x=-12.5+-2mm", str(tmp_path / "known.yaml")]
    ).priors
    assert (found["camera_from_tool.translation.x"].mean,) == pytest.approx((-0.0125,))
    assert found["camera_from_tool.translation.x"].std == pytest.approx(0.002)
    assert found["camera_from_tool.translation.z"].mean == pytest.approx(0.08)
    assert found["camera_from_tool.rotation"].std == pytest.approx(np.deg2rad(2.0))
    assert found["camera_from_tool.rotation"].mean is None


def test_square_pixels_are_a_number_without_a_unit():
    told = {"camera.pixel_aspect": Prior(mean=1.0, std=1e-3)}
    assert options(prior=["camera.pixel_aspect=1+-0.001"]).priors == told


def test_square_pixels_of_all_cameras_of_a_rig_or_of_one():
    texts = ["left.camera.pixel_aspect=+-0.0001", "camera.pixel_aspect=1+-0.001"]
    assert parse_rig_aspects(texts, ["left", "right", "top"], ["top"]) == {
        "left.camera.pixel_aspect": Prior(std=1e-4),
        "right.camera.pixel_aspect": Prior(mean=1.0, std=1e-3),
    }
    for text, words in (
        ("top.camera.pixel_aspect=1+-0.1", "did you mean"),
        ("left.camera.u0=1+-1px", "did you mean"),
        ("left.camera.alpha_v=1+-1", "only camera.pixel_aspect has a prior"),
    ):
        with pytest.raises(ValueError, match=words):
            parse_rig_aspects([text], ["left", "right", "top"], ["top"])
    with pytest.raises(ValueError, match="every camera is held by --camera"):
        parse_rig_aspects(texts[1:], ["left", "right"], ["left", "right"])


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"fixed": ["camera.u9"]}, "--fixed: no parameter is called 'camera.u9'; did you mean"),
        ({"free": ["camera"]}, "--free camera: it is free already"),
        ({"prior": ["camera.u0=640+-5"]}, "expected a unit, px, as in camera.u0=1"),
        ({"prior": ["camera.u0=640+-5mm"]}, "expected a unit, px"),
        ({"prior": ["camera.u0=640"]}, r"--prior camera.u0: expected VALUE\+-SIGMA"),
        ({"prior": ["camera.u0=640+-0px"]}, "expected a positive SIGMA, found 0"),
        ({"prior": ["camera_from_tool=1+-1mm"]}, "it has several units"),
        ({"prior": ["camera.pixel_aspect=1+-0.001px"]}, "expected a unit, none"),
        ({"fixed": ["camera.pixel_aspect"]}, "--fixed, --free: 'camera.pixel_aspect' is neither"),
        ({"prior": ["camera_from_tool.rotation.x=1+-1deg"]}, "centred on its start"),
        ({"prior": ["nowhere.yaml"]}, "expected NAME=VALUE.* or a YAML file; found 'nowhere.yaml'"),
        ({"prior": ["camera.u0=1+-1px"], "fixed": ["camera"]}, "--prior camera.u0: it is held by"),
        ({"start": ["tool_from_base=0,0,0,0,0,0"]}, "expected camera_from_tool or base_from_world"),
        ({"start": ["camera_from_tool=0,0"]}, "--start camera_from_tool: expected six numbers"),
    ],
)
def test_what_cannot_be_meant_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        options(**given)


def test_the_command_refuses_with_the_code_of_the_other_verbs(folder, tmp_path):
    for verb in ("calibrate", "compare"):
        ended = run(verb, folder, "--fixed", "camera.u9")
        assert ended.exit_code == 2
        assert ended.stderr.strip().splitlines()[-1].startswith("smartview: --fixed: no parameter")
    small = Calibration.load(folder / "truth.yaml")
    camera = dataclasses.replace(small.camera, image_size=(320, 240))
    dataclasses.replace(small, camera=camera).save(tmp_path / "other.yaml")
    for option in ("--camera", "--start"):
        ended = calibrated(folder, tmp_path / "out", option, tmp_path / "other.yaml")
        assert ended.exit_code == 2
        assert (
            "takes pictures of 320 x 240 px, but the data have pictures of 640 x 480"
            in ended.stderr
        )


@pytest.mark.parametrize(
    "lens", [OpenCV4(-0.1, 0.02, 1e-3, -2e-3), Fisheye(0.01, -0.002, 0.001, 0.0)]
)
def test_a_camera_info_of_ros_is_the_camera_again(folder, tmp_path, lens):
    truth = Calibration.load(folder / "truth.yaml")
    camera = dataclasses.replace(truth.camera, lens=lens)
    path = tmp_path / "camera_info.yaml"
    path.write_text(ros_camera_info(dataclasses.replace(truth, camera=camera)))
    read = read_camera(path)
    assert read.image_size == camera.image_size
    points = jnp.array([[0.05, -0.03, 0.3], [-0.1, 0.02, 0.25]])
    np.testing.assert_allclose(read.project(points)[0], camera.project(points)[0], atol=1e-9)


def test_the_bases_of_two_arms_may_be_known():
    given = {"start": ["base_from_other_base=0.9,0,0,180,0,0"], "fixed": ["base_from_other_base"]}
    known = parse_fit_options("opencv4", "hand_to_hand", FitKnowledge(**given))
    assert known.fixed == ("base_from_other_base",)
    pose = host_matrices(known.start["base_from_other_base"])
    np.testing.assert_allclose(pose[:3, 3], [0.9, 0.0, 0.0])
    with pytest.raises(ValueError, match="no parameter is called 'base_from_other_base'"):
        options(fixed=["base_from_other_base"])


MOUNTS = {"wrist": "eye_in_hand", "fixed": "eye_to_hand"}


def test_the_starts_of_several_cameras(folder, tmp_path):
    """A folder that `calibrate` wrote for a rig, with a transform of the options in the place."""
    truth = Calibration.load(folder / "truth.yaml")
    truth.save(tmp_path / "wrist.yaml")
    dataclasses.replace(truth, mount="eye_to_hand").save(tmp_path / "fixed.yaml")
    one = parse_rig_start(["wrist.tool_from_camera=0.1,0,0,0,0,0"], MOUNTS)
    assert set(one) == {"wrist"}
    np.testing.assert_allclose(one["wrist"]["camera_from_tool"].translation(), [-0.1, 0.0, 0.0])
    both = parse_rig_start([str(tmp_path), "fixed.tool_from_world=0,0,0.2,0,0,0"], MOUNTS)
    assert [start.mount for start in both.values()] == list(MOUNTS.values())
    np.testing.assert_allclose(
        both["wrist"].holder_from_world.wxyz_xyz, truth.holder_from_world.wxyz_xyz
    )
    np.testing.assert_allclose(both["fixed"].tool_from_world.translation(), [0.0, 0.0, 0.2])
    assert parse_rig_start([], MOUNTS) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera_from_tool=0,0,0,0,0,0", "expected CAMERA.TRANSFORM=... with a camera of wrist, f"),
        ("fixed.camera_from_tool=0,0,0,0,0,0", "expected camera_from_base or tool_from_world"),
        (".", "wrist.yaml: missing, the calibration of camera wrist"),
    ],
)
def test_wrong_starts_of_several_cameras_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        parse_rig_start([text], MOUNTS)
