"""`smartview calibrate` and `check` of several cameras that watched one robot."""

import dataclasses
import json
import sys
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from arms_scene import FOUR_CAMERAS, arms_fit, arms_scene
from calibrated_rig import calibrated_rig, rig_scene
from jaxlie import SE3
from scipy.stats import norm
from two_hands_scene import KNOWN, hands_fit, hands_rig
from typer.testing import CliRunner

from smartview_jax import (
    Prior,
    Rig,
    compare,
    load_dataset,
    load_estimate,
    load_rig_estimate,
    save_dataset,
    save_rig,
)
from smartview_jax.cli import app
from smartview_jax.cli.calibrate_folder import CalibrateSettings
from smartview_jax.cli.calibrate_rig import RigResult, fitted_rig, loaded_rig
from smartview_jax.cli.check import _lonely_cameras
from smartview_jax.cli.fit_options import FitKnowledge
from smartview_jax.evaluation import RigMethod, error_budget
from smartview_jax.evaluation.diagnosis import rig_budget
from smartview_jax.joint import RIG_FILE, RigEstimate
from smartview_jax.plots import camera_mounts
from smartview_jax.report import base_rows, relative_pose_rows, rig_summary
from smartview_jax.targets import Chessboard


@pytest.fixture(scope="module")
def scene():
    return rig_scene()


SETTINGS = CalibrateSettings()

TARGET = Chessboard(rows=9, columns=12, square=0.03)


@pytest.fixture(scope="module")
def rig(scene):
    """The cameras with their target."""
    cameras = scene.rig.cameras
    return Rig({name: dataclasses.replace(data, target=TARGET) for name, data in cameras.items()})


@pytest.fixture(scope="module")
def folders(rig, tmp_path_factory):
    place = tmp_path_factory.mktemp("rig")
    for name, data in rig.cameras.items():
        save_dataset(data, place / name)
    return [str(place / name) for name in rig.cameras]


@pytest.fixture(scope="module")
def folder(rig, tmp_path_factory):
    """All cameras in one folder."""
    place = tmp_path_factory.mktemp("one") / "cell"
    save_rig(rig, place)
    return str(place)


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    return calibrated_rig(tmp_path_factory)


@pytest.fixture
def judged_by_its_own_chain(monkeypatch):
    """The error budget fits no linear chain, which `test_rig_budget` looks at."""
    monkeypatch.setattr(rig_budget, "has_generic_arm", lambda field: False)


@pytest.mark.usefixtures("judged_by_its_own_chain")
def test_a_calibration_for_each_camera_and_one_report(
    scene, rig, fit, folder, tmp_path, monkeypatch
):
    out, fitted = tmp_path / "out", []

    def known_fit(part, lens, camera, start, priors, progress=None):
        """The fit of these data; fits of the folds take as long, and are not tested here."""
        fitted.append(part)
        assert not priors
        assert lens == "opencv4"
        assert camera is None
        assert start is None
        return fit

    monkeypatch.setattr("smartview_jax.calibrate", known_fit)
    told = CliRunner().invoke(app, ["calibrate", folder, "--diagnose", "--json", "--out", str(out)])
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["converged"]
    assert document["states"] == 16
    for name, truth in scene.calibrations.items():
        estimate = load_estimate(out / f"{name}.yaml")
        found = np.asarray(estimate.calibration.camera_from_tool.translation())
        entry = document["cameras"][name]
        assert entry["camera_from_tool"]["translation"] == pytest.approx(found)
        true = np.asarray(truth.camera_from_tool.translation())
        assert np.linalg.norm(found - true) < 3e-4
        assert 0.05 < entry["rms_px"] < 0.5
        assert entry["held_out_rms_px"] == pytest.approx(entry["rms_px"], rel=0.5)
    assert len(fitted) == 6
    budget = document["budget"]
    assert set(budget["cameras"]) == set(rig.cameras)
    assert budget["cameras"]["camera1"]["causes"][0]["advice"]
    for pose in budget["poses"].values():
        variance = sum(cause["translation"] ** 2 for cause in pose["causes"])
        assert variance == pytest.approx(pose["std"]["translation"] ** 2, rel=1e-6)
    for name, data in rig.cameras.items():
        np.testing.assert_allclose(fitted[0].cameras[name].pixels, data.pixels, atol=1e-9)
    assert load_rig_estimate(out).parameter_names == fit.parameter_names
    assert str(out / RIG_FILE) in document["files"]
    told = CliRunner().invoke(app, ["evaluate", str(out), folder, "--json"])
    assert told.exit_code == 0, told.output
    for entry, (name, data) in zip(
        json.loads(told.stdout)["cameras"], rig.cameras.items(), strict=True
    ):
        assert entry["name"] == name
        assert entry["rms_px"] == pytest.approx(document["cameras"][name]["rms_px"], rel=0.5)
        # They are the pictures of the fit.
        assert entry["fitted_views"] == list(data.view_ids)
    page = (out / "report.html").read_text(encoding="utf-8")
    for text in (
        "camera2 in camera1",
        "What limits each pose.",
        "Where the error comes from",
        "Camera camera1",
        "camera2: camera_from_tool",
        "Left out",
    ):
        assert (text in page) == (text != "Left out" or bool(document["left_out"]))
    assert document["files"][-1] == str(out / "report.html")


def test_folders_of_the_cameras_are_one_rig(rig, folders):
    loaded, name = loaded_rig(list(map(Path, folders)), SETTINGS, lambda _: None)
    assert name == "camera1, camera2"
    assert loaded.view_ids == rig.view_ids


def test_cameras_and_starts_may_be_known(rig, fit, tmp_path, monkeypatch):
    """The fit and the fits of the folds hold the cameras, and have the starts."""
    fit.calibrations["camera2"].save(tmp_path / "camera2.yaml")
    held, starts, told = [], [], []

    def known_fit(part, lens, camera, start, priors, progress=None):
        held.append(camera)
        starts.append(start)
        told.append(priors)
        return fit

    monkeypatch.setattr("smartview_jax.calibrate", known_fit)
    given = ["camera1.camera_from_tool=0,0,0.1,0,0,0"]
    square = ["camera.pixel_aspect=1+-0.001"]
    settings = CalibrateSettings(known=FitKnowledge(camera=tmp_path, start=given, prior=square))
    result = fitted_rig(rig, "cell", settings, lambda _: None)
    assert len(held) == 6
    assert all(set(start) == {"camera1"} for start in starts)
    assert "start given for camera1" in result.notes
    assert told == [{"camera1.camera.pixel_aspect": Prior(mean=1.0, std=1e-3)}] * 6
    assert "given: --prior camera.pixel_aspect=1+-0.001" in result.notes
    (name,) = held[0]
    assert name == "camera2"
    assert all(eqx.tree_equal(known, held[0]) for known in held)
    expected = float(fit.calibrations[name].camera.alpha_u)
    assert float(held[0][name].alpha_u) == pytest.approx(expected, rel=1e-9)
    assert f"known cameras, held: camera2, from {tmp_path}" in result.notes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--together"], "expected folders of different names"),
        (["{0}", "{0}", "--together"], "expected folders of different names"),
        (["{0}", "{2}", "--together"], "cell has several cameras"),
        (["{0}", "{1}", "--together", "--free", "target_scale"], "--free: not for several cameras"),
        (["{0}", "{1}", "--together", "--noise", "trusted"], "--noise: not for several cameras"),
        (["{0}", "{1}", "--together", "--time-offset"], "--time-offset: not for several cameras"),
        (
            ["{0}", "{1}", "--together", "--base-from-world", "0,0,0,0,0,0"],
            "--base-from-world: not",
        ),
    ],
)
def test_what_a_rig_cannot_have_is_refused(folders, folder, tmp_path, arguments, message):
    texts = [text.format(*folders, folder) for text in arguments]
    out = tmp_path / "out"
    told = CliRunner().invoke(app, ["calibrate", *texts, "--out", str(out)])
    assert told.exit_code == 2
    assert message in " ".join(told.stderr.split())
    assert not out.exists()


def test_several_cameras_are_evaluated_by_the_folder_of_their_calibrations(folder, tmp_path):
    told = CliRunner().invoke(app, ["evaluate", str(tmp_path / "camera1.yaml"), folder])
    assert told.exit_code == 2
    assert "expected the folder with a calibration of each camera" in " ".join(told.stderr.split())


def test_check_looks_at_every_camera(rig, tmp_path):
    second = rig.cameras["camera2"]
    # Each view has the pose of the one before it.
    poses = SE3(np.roll(np.asarray(second.base_from_tool.wxyz_xyz), 1, axis=0))
    wrong = Rig({**rig.cameras, "camera2": dataclasses.replace(second, base_from_tool=poses)})
    save_rig(wrong, tmp_path / "cell")
    told = CliRunner().invoke(app, ["check", str(tmp_path / "cell"), "--json"])
    assert told.exit_code == 1, told.output
    document = json.loads(told.stdout)
    assert not document["can_be_calibrated"]
    assert document["states"] == 16
    assert document["cameras"]["camera1"]["can_be_calibrated"]
    assert document["cameras"]["camera2"]["problems"]


def test_the_next_states_of_the_robot_are_planned(rig, fit, folder, tmp_path):
    fit.save(tmp_path)
    words = ["plan", str(tmp_path), folder, "--views", "2", "--gain", "1"]
    told = CliRunner().invoke(app, [*words, "--json"])
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert [entry["name"] for entry in document["commands"]] == ["v17", "v18"]
    assert document["std_after_mm"] < document["std_before_mm"]
    assert set(document["seen"]) == set(rig.cameras)
    assert "two more views bring the error of a point" in document["words"][0]
    assert "in front of each camera" in document["words"][0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{out}/camera1.yaml", "{folder}"], "expected the folder RESULTS that smartview cal"),
        (["{folder}"], "writes, with rig.joint.yaml, and this folder"),
        (["{folder}", "--start", "camera_from_tool=0,0,0,0,0,0"], "plan the first views of one"),
        (["{out}", "{folder}", "--camera", "{out}"], "--camera: only with --start"),
    ],
)
def test_what_a_plan_of_several_cameras_lacks_is_said(folder, tmp_path, words, message):
    given = [word.format(out=tmp_path, folder=folder) for word in words]
    (tmp_path / RIG_FILE).touch()
    told = CliRunner().invoke(app, ["plan", *given])
    assert told.exit_code == 2
    assert message in " ".join(told.stderr.split())


def test_other_verbs_say_what_takes_several_cameras(folder):
    with pytest.raises(ValueError, match="only smartview check, calibrate, compare, evaluate and "):
        load_dataset(folder)


def test_a_camera_that_shares_nothing_is_named(rig):
    lonely = Rig(rig.cameras, {"camera1": "table", "camera2": "wall"})
    assert [text.split(" and ")[0] for text in _lonely_cameras(lonely)] == [
        f"camera {name} shares no state of the robot" for name in rig.cameras
    ]
    assert _lonely_cameras(rig) == []


def test_several_arms_are_named(tmp_path_factory):
    fit = arms_fit(tmp_path_factory)
    assert [row[0] for row in base_rows(fit)] == ["right in left"]
    # A robot moves cameras of different arms against each other.
    assert [row[0] for row in relative_pose_rows(fit)] == [
        "left_wall in left_table",
        "right_wall in right_table",
    ]
    assert rig_summary(fit).startswith(
        "4 cameras and 2 arms were calibrated together. The arms' reported poses have noise of "
        "0.1 mm and 0.011 degrees (left), 0.1 mm and 0.011 degrees (right) per axis."
    )


def test_the_document_has_the_arms(tmp_path_factory):
    fit, (rig, _) = arms_fit(tmp_path_factory), arms_scene(0, FOUR_CAMERAS, 4)
    document = RigResult(rig, "cell", fit, None, ()).document("run", [])
    assert "robot" not in document
    right = document["arms"]["right"]
    assert right["cameras"] == ["right_table", "right_wall"]
    assert right["translation"] == 1e-4
    base = right["base_left_from_base"]
    assert base["translation"] == fit.base("left", "right").transform.translation().tolist()
    assert right["std"]["translation"] == fit.base("left", "right").std[:3].tolist()
    # Cameras on one hand have a relative pose; its noise is known, so that its interval is normal.
    assert list(document["relative"]) == ["left_wall in left_table", "right_wall in right_table"]
    walls = document["relative"]["left_wall in left_table"]
    std = fit.relative("left_table", "left_wall").std
    assert walls["std"]["rotation"] == std[3:].tolist()
    np.testing.assert_allclose(walls["half_width_95"]["rotation"], norm.ppf(0.975) * std[3:])


def test_a_pair_of_arms_has_a_noise_and_bases(tmp_path_factory):
    """A camera on the left hand sees a target on the right one, and so does a fixed one."""
    rig, fit = hands_rig(0)[0], hands_fit(tmp_path_factory)
    document = RigResult(rig, "cell", fit, None, ()).document("run", [])
    assert document["arms"]["left"]["cameras"] == ["wrist"]
    assert document["arms"]["right"]["cameras"] == ["fixed", "wrist"]
    noise = KNOWN["noise"]["left+right"]
    stated = {"translation": noise.translation, "rotation": noise.rotation}
    assert document["pairs"] == {"left+right": stated}
    assert document["relative"] == {}
    assert relative_pose_rows(fit) == []
    assert [row[0] for row in base_rows(fit)] == ["left in right"]
    text = rig_summary(fit)
    assert text.startswith("2 cameras and 2 arms were calibrated together.")
    assert "0.016 degrees (left+right, of one hand in the other's frame) per axis" in text
    titles = [axes.get_title() for axes in camera_mounts(fit).axes]
    assert titles == ["in the frame of the base of right", "in the frame of the tool of left"]
    names = [pose.name for pose in rig_budget.pose_uncertainties(fit)]
    assert names == ["fixed.camera_from_base", "wrist.camera_from_tool"]
    for arm in ("right", "left+right"):
        parts = rig_budget.covariance_by_cause(fit).values()
        np.testing.assert_allclose(sum(parts), fit.covariance, atol=1e-14)
        assert RigEstimate.of(fit, arm).noise == KNOWN["noise"][arm]


@pytest.mark.usefixtures("judged_by_its_own_chain")
def test_the_causes_of_the_errors_are_printed(rig, fit, capsys):
    RigResult(rig, "cell", fit, None, (), error_budget(rig, fit)).print()
    lines = capsys.readouterr().out.splitlines()
    (header,) = [line for line in lines if "error by cause (px)" in line]
    assert header.index("camera1") < header.index("camera2")
    assert any("pixel noise" in line and "0." in line for line in lines)
    assert any(line.startswith("camera2: ") for line in lines)
    assert any("camera2 in camera1" in line and "pixel noise" in line for line in lines)


def test_methods_of_several_cameras_stand_side_by_side(rig, fit, folder, monkeypatch):
    """Fits take long and are tested in other files: these are known."""
    methods = {
        "alone": RigMethod(lambda _: fit.calibrations["camera1"], alone=True),
        "together": lambda _: fit,
    }
    monkeypatch.setattr(
        sys.modules["smartview_jax.evaluation"], "standard_rig_methods", lambda _: methods
    )
    ended = CliRunner().invoke(app, ["compare", folder])
    assert ended.exit_code == 0, ended.output
    for camera in rig.cameras:
        assert f"camera {camera}, lens opencv4" in ended.output
    ended = CliRunner().invoke(app, ["compare", folder, "--json"])
    content = json.loads(ended.stdout)
    expected = compare(rig, methods)
    for camera, rows in expected.items():
        shown = content["cameras"][camera]["methods"]
        assert [row["name"] for row in shown] == [row.name for row in rows]
        assert shown[-1]["held_out"]["rms_px"] == pytest.approx(rows[-1].held_out.errors.rms)
    ended = CliRunner().invoke(app, ["compare", folder, "--fixed", "camera"])
    assert ended.exit_code == 2
    assert "--fixed: not for several cameras" in ended.stderr
