"""Several cameras on one arm: fitted together they are better known, and say how well."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from calibrated_rig import calibrated_rig, rig_scene
from fit_scenes import scene_of
from jaxlie import SE3
from starts import nudged

from smartview_jax import (
    Calibration,
    Camera,
    Noise,
    Prior,
    Rig,
    calibrate,
    fit_joint,
    fit_rig,
    fit_staged,
    load_estimate,
    load_rig_estimate,
    look_at,
)
from smartview_jax.cameras import Radial
from smartview_jax.dataset import picture_digests
from smartview_jax.evaluation.diagnosis.rig_budget import covariance_by_cause
from smartview_jax.files import read_yaml
from smartview_jax.joint import RIG_FILE, RigEstimate, is_rig
from smartview_jax.joint.rig_fitting import rig_warnings
from smartview_jax.robot_errors import RobotPrior
from smartview_jax.simulation import paper_calibration, simulate
from smartview_jax.variance import TargetScaleEvidence

NOISE = Noise(0.15, 1e-4, 2e-4)
"""Noise of the scenes below, as stated."""


@pytest.fixture(scope="module")
def scene():
    return rig_scene()


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    return calibrated_rig(tmp_path_factory)


def test_the_fit_writes_its_page(fit, tmp_path):
    dataclasses.replace(fit, warnings=("left: moved",)).report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "warning: left: moved" in page
    assert all(f"{name}: " in page for name in fit.calibrations)


def test_one_camera_is_fitted_as_alone():
    data, start = scene_of(0, translation_noise=1e-4).data, nudged(paper_calibration())
    alone = fit_joint(data, start, noise=NOISE)
    rig = fit_rig(Rig({"only": data}), {"only": start}, noise=NOISE)
    assert rig.solution.costs[-1] == pytest.approx(alone.solution.costs[-1], rel=1e-12)
    np.testing.assert_allclose(rig.pose_corrections, alone.pose_corrections, atol=1e-12)
    std = np.sqrt(np.diag(alone.covariance))
    difference = (rig.covariance - alone.covariance) / np.outer(std, std)
    assert np.abs(difference).max() < 1e-6
    np.testing.assert_allclose(
        rig.calibrations["only"].camera_from_tool.wxyz_xyz,
        alone.calibration.camera_from_tool.wxyz_xyz,
        atol=1e-11,
    )
    assert rig.parameter_names[0] == "only.camera.alpha_u"
    assert rig.parameter_names[-1] == "base_from_world.rotation.z"


def test_a_known_camera_that_the_pictures_contradict_is_named():
    """With the estimate that the fit of one camera names."""
    data, start = scene_of(0, translation_noise=1e-4).data, paper_calibration()
    camera = dataclasses.replace(start.camera, alpha_u=1.01 * start.camera.alpha_u)
    start = dataclasses.replace(start, camera=camera)
    alone = fit_joint(data, start, noise=NOISE, fixed=("camera",))
    rig = fit_rig(Rig({"only": data}), {"only": start}, noise=NOISE, fixed=("only.camera",))
    expected = next(text for text in alone.warnings if "contradict held parameters" in text)
    (text,) = rig.warnings
    assert "estimated only.camera.alpha_u" in text
    assert text.split(": correct")[0].replace("only.", "") == expected.split("; freed")[0]
    # The intervals of the rest hold what the wrong camera changes.
    for name in alone.parameter_names:
        in_rig = name.replace("camera_from", "only.camera_from")
        assert rig.std[in_rig] == pytest.approx(alone.std[name], rel=1e-3)
    parts = covariance_by_cause(rig)
    np.testing.assert_allclose(np.sum(list(parts.values()), axis=0), rig.covariance, rtol=1e-6)
    found = rig.calibrations["only"].camera_from_tool.translation()
    error = found - paper_calibration().camera_from_tool.translation()
    for axis, offset in zip("xyz", error, strict=True):
        assert abs(float(offset)) < 2.5 * rig.std[f"only.camera_from_tool.translation.{axis}"]
    true = fit_rig(
        Rig({"only": data}), {"only": paper_calibration()}, noise=NOISE, fixed=("only.camera",)
    )
    assert true.warnings == ()
    assert true.contradicted_covariance is None


def test_square_pixels_are_known_as_in_the_fit_of_one_camera():
    data, start = scene_of(0, translation_noise=1e-4).data, nudged(paper_calibration())
    told = Prior(mean=1.0, std=1e-4)
    alone = fit_joint(data, start, noise=NOISE, priors={"camera.pixel_aspect": told})
    rig = fit_rig(
        Rig({"only": data}),
        {"only": start},
        noise=NOISE,
        priors={"only.camera.pixel_aspect": told},
    )
    std = np.sqrt(np.diag(alone.covariance))
    difference = (rig.covariance - alone.covariance) / np.outer(std, std)
    assert np.abs(difference).max() < 1e-6
    assert rig.std["only.camera.pixel_aspect"] == pytest.approx(
        alone.std["camera.pixel_aspect"], rel=1e-6
    )
    camera, other = rig.calibrations["only"].camera, alone.calibration.camera
    assert float(camera.alpha_v) == pytest.approx(float(other.alpha_v), abs=1e-6)
    parts = sum(covariance_by_cause(rig).values(), np.zeros_like(rig.covariance))
    assert np.abs((parts - rig.covariance) / np.outer(std, std)).max() < 1e-6
    assert rig.warnings == ()
    wrong = fit_rig(
        Rig({"only": data}),
        {"only": start},
        noise=NOISE,
        priors={"only.camera.pixel_aspect": Prior(mean=1.02, std=1e-4)},
    )
    told = {"camera.pixel_aspect": Prior(mean=1.02, std=1e-4)}
    alone = fit_joint(data, start, noise=NOISE, priors=told)
    expected = next(text for text in alone.warnings if "contradict the prior" in text)
    text = next(text for text in wrong.warnings if "contradict the prior" in text)
    assert text.replace("only.", "") == expected
    for name in (*alone.parameter_names[:5], "camera.pixel_aspect"):
        assert wrong.std[f"only.{name}"] == pytest.approx(alone.std[name], rel=1e-3)


def test_cameras_of_one_arm_know_it_better_together(scene, fit):
    """Each camera alone has eight views; the errors of the arm show in all sixteen."""
    for name, truth in scene.calibrations.items():
        alone = calibrate(scene.rig.cameras[name])
        together = fit.calibrations[name]
        place = truth.camera_from_tool.translation()
        errors = [
            np.linalg.norm(found.camera_from_tool.translation() - place)
            for found in (together, alone.calibration)
        ]
        assert errors[0] < 0.5 * errors[1]
        for axis in "xyz":
            path = f"{name}.camera_from_tool.translation.{axis}"
            index = "xyz".index(axis)
            error = together.camera_from_tool.translation() - place
            assert abs(float(error[index])) < fit.confidence_half_width(path, 0.999)


def test_the_relative_pose_has_the_covariance_of_both(scene, fit):
    """By simulation of the covariance; the pose itself against the truth."""
    relative = fit.relative("camera1", "camera2")
    truth = (
        scene.calibrations["camera1"].camera_from_tool
        @ scene.calibrations["camera2"].camera_from_tool.inverse()
    )
    error = np.asarray((relative.transform @ truth.inverse()).log())
    assert error @ np.linalg.solve(relative.covariance, error) < 22.5  # chi-square, 0.999
    names = [
        f"{camera}.camera_from_tool.{part}.{axis}"
        for camera in ("camera1", "camera2")
        for part in ("translation", "rotation")
        for axis in "xyz"
    ]
    index = [fit.parameter_names.index(name) for name in names]
    covariance = np.asarray(fit.covariance)[np.ix_(index, index)]
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(12), covariance, 20_000)
    first, second = (
        _moved(fit.calibrations[camera].camera_from_tool, jnp.asarray(step))
        for camera, step in (("camera1", steps[:, :6]), ("camera2", steps[:, 6:]))
    )
    sampled = first @ second.inverse()
    turned = sampled.rotation() @ relative.transform.rotation().inverse()
    drawn = np.hstack(
        [sampled.translation() - relative.transform.translation()[None], turned.log()]
    )
    np.testing.assert_allclose(np.cov(drawn.T), relative.covariance, rtol=0.1, atol=2e-10)


def _moved(transform, steps):
    """The transform after translation and rotation steps, one for each row."""
    turns = SE3.exp(steps.at[:, :3].set(0.0)).rotation()
    rotations = turns @ SE3(transform.wxyz_xyz[None]).rotation()
    translations = transform.translation()[None] + steps[:, :3]
    return SE3.from_rotation_and_translation(rotations, translations)


def test_each_camera_is_saved_with_its_covariance(fit, tmp_path):
    fit.save(tmp_path / "rig")
    for name, calibration in fit.calibrations.items():
        read = load_estimate(tmp_path / "rig" / f"{name}.yaml")
        kept = fit.estimate(name)
        assert read.parameter_names == kept.parameter_names
        np.testing.assert_allclose(read.covariance, kept.covariance, rtol=1e-12)
        # The noise is of this camera, not of the rig's average one.
        assert read.noise.pixel == read.pixel_sigma == fit.pixel_sigmas[name]
        ratio = fit.noise.white_pixel / fit.noise.pixel
        assert read.noise.white_pixel == pytest.approx(ratio * read.pixel_sigma, rel=1e-12)
        assert isinstance(read.calibration, Calibration)
        np.testing.assert_allclose(
            read.calibration.camera_from_tool.wxyz_xyz, calibration.camera_from_tool.wxyz_xyz
        )


def test_the_pictures_of_each_camera_are_recognised_by_its_file(fit, scene, tmp_path):
    fit.save(tmp_path)
    for name, data in scene.rig.cameras.items():
        digests = read_yaml(tmp_path / f"{name}.yaml")["pictures"]
        assert digests == [digest for digest in picture_digests(data) if digest]


def test_the_joint_covariance_is_saved_next_to_the_cameras(fit, tmp_path):
    fit.save(tmp_path)
    read, kept = load_rig_estimate(tmp_path), RigEstimate.of(fit)
    assert read.parameter_names == kept.parameter_names
    assert read.camera_names == kept.camera_names
    assert read.noise == kept.noise
    np.testing.assert_allclose(read.covariance, kept.covariance, rtol=1e-12)
    assert is_rig(tmp_path)
    assert is_rig(tmp_path / RIG_FILE)
    assert not is_rig(tmp_path / "camera1.yaml")
    content = yaml.safe_load((tmp_path / RIG_FILE).read_text())
    last = content["parameters_of"]["camera1"].pop()
    (tmp_path / RIG_FILE).write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=r"parameters_of.camera1: expected names of the \d+ param"):
        load_rig_estimate(tmp_path)
    content["uncertainty"] = None
    content["parameters_of"]["camera1"].append(last)
    (tmp_path / RIG_FILE).write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match="uncertainty: missing, since the data did not determine"):
        load_rig_estimate(tmp_path)


def test_the_text_names_cameras_and_robot(fit):
    text = str(fit)
    assert "camera1.camera_from_tool: " in text
    assert "px RMS" in text
    assert text.splitlines()[0].startswith("converged in ")


def test_a_camera_on_the_hand_and_one_next_to_the_arm_share_the_robots_states():
    """Each has a target of its own; the robot moves the cameras against each other."""
    wrist = scene_of(0, translation_noise=1e-4)
    poses = wrist.base_from_tool
    middle = np.mean(np.asarray(poses.translation()), axis=0)
    camera_from_base = look_at(middle, (-1.0, -0.2, -0.1), 0.9)
    fixed_camera = Calibration.eye_to_hand(
        Camera(1500.0, 1510.0, 640.0, 360.0, Radial(0.1), (1280, 720)), camera_from_base, np.eye(4)
    )
    points = np.asarray(wrist.data.points)[0] * 4.0
    seen = simulate(fixed_camera, poses, points, 1, 0.1).data
    table = dataclasses.replace(seen, base_from_tool=wrist.data.base_from_tool)
    rig = Rig({"wrist": wrist.data, "table": table})
    fit = fit_rig(rig, {"wrist": nudged(paper_calibration()), "table": fixed_camera}, noise=NOISE)
    assert fit.result.converged
    assert "target_eye_to_hand.tool_from_world.rotation.z" in fit.parameter_names
    assert fit.pose_corrections.shape == (len(rig.view_ids), 6)
    for name, truth in (("wrist", wrist.calibration), ("table", fixed_camera)):
        found, mount = fit.calibrations[name].camera_from_mount, truth.camera_from_mount
        turn = (found.rotation() @ mount.rotation().inverse()).log()
        error = np.concatenate([found.translation() - mount.translation(), turn])
        path = f"{name}.{truth.transform_names[0]}"
        std = [fit.std[f"{path}.{part}.{k}"] for part in ("translation", "rotation") for k in "xyz"]
        assert (np.abs(error) < 4.0 * np.array(std)).all()
        assert np.linalg.norm(std[:3]) < 2e-2
    with pytest.raises(ValueError, match="their relative pose changes with the robot's"):
        fit.relative("wrist", "table")


def test_reasons_to_doubt_are_said(fit):
    """A good fit has none; each of these changes gives one."""
    prior = RobotPrior()
    assert rig_warnings(fit, prior) == ()
    undetermined = dataclasses.replace(fit, std={**fit.std, "camera1.camera.u0": np.inf})
    (text,) = rig_warnings(undetermined, prior)
    assert text.startswith("the data do not determine camera1.camera.u0: turn the robot")
    (direction,) = undetermined.estimate("camera1").observability.null_directions
    assert direction.components == (("camera.u0", 1.0),)
    whole = undetermined.estimate("camera2").observability
    assert whole.rank == whole.parameter_count
    weak = fit.noise_estimate._replace(noise=dataclasses.replace(fit.noise, translation=0.05))
    (text,) = rig_warnings(dataclasses.replace(fit, noise_estimates={"arm": weak}), prior)
    assert "the robot's poses err by 50 mm" in text
    calibration = fit.calibrations["camera2"]
    width, height = calibration.camera.image_size
    of_half = dataclasses.replace(calibration.camera, image_size=(2 * width, 2 * height))
    halved = fit.calibrations | {"camera2": dataclasses.replace(calibration, camera=of_half)}
    (text,) = rig_warnings(dataclasses.replace(fit, calibrations=halved), prior)
    assert text.startswith("camera2: the principal point (")
    size = TargetScaleEvidence(0.9, 0.98, 0.001)
    sizes = {"target_scale": size, "wall.target_scale": size}
    larger = fit.noise_estimate._replace(target_scales=sizes, converged=False)
    texts = rig_warnings(dataclasses.replace(fit, noise_estimates={"arm": larger}), prior)
    assert texts[0] == (
        "the target may be 0.9800 +- 0.0010 of its stated size (probability 0.90): measure it"
    )
    assert texts[1].startswith("the target wall may be 0.9800 +- 0.0010 of its stated size")
    assert texts[2].startswith("the estimate of the errors' sizes did not converge")


def test_a_wrong_size_of_one_of_two_targets_is_found(scene):
    """The wall's target is stated 3 % too large; the table's as it is."""
    truth, data = scene.calibrations, dict(scene.rig.cameras)
    data["camera2"] = dataclasses.replace(data["camera2"], points=1.03 * data["camera2"].points)
    rig = Rig(data, {"camera1": "table", "camera2": "wall"})
    fit = fit_rig(rig, {name: nudged(start) for name, start in truth.items()})
    size = fit.noise_estimate.target_scales["wall.target_scale"]
    assert size.probability > 0.99
    assert abs(size.scale - 1.0 / 1.03) < 4.0 * size.std < 0.01
    (warning,) = fit.warnings
    assert warning.startswith("the target wall may be 0.97")
    assert "table.target_scale" not in fit.parameter_names
    for name, calibration in fit.calibrations.items():
        error = (
            calibration.camera_from_tool.translation() - truth[name].camera_from_tool.translation()
        )
        for axis, offset in zip("xyz", error, strict=True):
            path = f"{name}.camera_from_tool.translation.{axis}"
            assert abs(float(offset)) < fit.confidence_half_width(path, 0.999)


def test_few_states_are_said():
    data, start = scene_of(0, translation_noise=1e-4).data, nudged(paper_calibration())
    few = data.mask_views([0, 1, 2])
    fit = fit_rig(Rig({"only": few}), {"only": start}, noise=NOISE)
    assert fit.warnings == (
        "5 states of the robot are few: no figure is reliable with fewer than 8",
    )


def test_wrong_arguments_are_named(scene, fit):
    with pytest.raises(ValueError, match="expected a camera of camera1, camera2, found 'left'"):
        fit.relative("left", "camera1")
    starts = dict(fit.calibrations)
    with pytest.raises(ValueError, match="starts: expected the cameras camera1, camera2, found"):
        fit_rig(scene.rig, {"camera1": starts["camera1"]})
    with pytest.raises(ValueError, match="start: expected cameras of camera1, camera2, found"):
        calibrate(scene.rig, start={"camera_from_tool": np.eye(4)})
    with pytest.raises(ValueError, match="a rig takes noise, field"):
        calibrate(scene.rig, loss="huber")


def test_a_camera_that_saw_one_orientation_starts_from_where_others_see_the_target():
    left = scene_of(0, translation_noise=1e-5, rotation_noise=1e-5)
    shifts = np.array([[0, 0, 0], [3e-3, 0, 0], [0, 3e-3, 0], [-2e-3, 1e-3, 4e-3]])
    pose = np.asarray(left.data.base_from_tool.wxyz_xyz)[0]
    poses = SE3(jnp.array([np.append(pose[:4], pose[4:] + shift) for shift in shifts]))
    points = np.asarray(left.data.points[0])
    right = simulate(left.calibration, poses, points, 5, 0.1).data
    right = dataclasses.replace(right, view_ids=tuple("abcd"))
    with pytest.raises(ValueError, match="the robot never rotates"):
        fit_staged(right, camera=left.calibration.camera)
    messages = []
    rig = calibrate(
        Rig({"left": left.data, "right": right}),
        "radial",
        camera={"right": left.calibration.camera},
        noise=NOISE,
        progress=messages.append,
    )
    assert "right: again, from the place of its target that left tells" in messages
    found, true = rig.calibrations["right"].camera_from_tool, left.calibration.camera_from_tool
    error = np.asarray(found.translation() - true.translation())
    std = [rig.std[f"right.camera_from_tool.translation.{axis}"] for axis in "xyz"]
    assert (np.abs(error) < 3.0 * np.array(std)).all()
    assert max(std) < 2e-3
    alone = Rig({"left": left.data, "right": right}, {"left": "table", "right": "wall"})
    with pytest.raises(ValueError, match="camera 'right': the robot never rotates"):
        calibrate(alone, "radial", camera={"right": left.calibration.camera}, noise=NOISE)
