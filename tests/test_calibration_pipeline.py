"""Staged, then joint: what either left out, and what is said before anything is compiled."""

import dataclasses
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from jaxlie import SE3
from scipy.spatial.transform import Rotation
from standard_scene import POINTS, VIEWS

from smartview_jax import calibrate, fit_joint, fit_staged
from smartview_jax.calibration_pipeline import refit_uncorrected
from smartview_jax.engine import Prior, padded
from smartview_jax.joint import needs_precompiling, precompile
from smartview_jax.runtime.modules import with_fields
from smartview_jax.runtime.padding import padded_counts
from smartview_jax.simulation import simulate
from smartview_jax.staged import with_start_doubts


@pytest.fixture(scope="module")
def scene():
    return scene_of(6, outlier_fraction=0.05)


@pytest.fixture(scope="module")
def messages():
    return []


@pytest.fixture(scope="module")
def fit(scene, messages):
    return calibrate(scene.data, progress=messages.append)


def test_calibrate_goes_all_the_way(scene, fit, messages):
    assert fit.result.converged
    assert fit.staged.result.converged
    assert any(text.startswith("joint fit") for text in messages)
    assert not np.asarray(fit.inliers & scene.outliers).any()
    error = (fit.calibration.camera_from_tool.inverse() @ scene.calibration.camera_from_tool).log()
    assert float(jnp.linalg.norm(error[:3])) < 2e-3


def test_a_calibration_writes_its_page(fit, tmp_path):
    doubtful = dataclasses.replace(
        fit, warnings=("the target bends",), data=with_fields(fit.data, notes=("no unit given",))
    )
    doubtful.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    x, *_ = 1e3 * fit.calibration.camera_from_tool.translation()
    assert f"{float(x):.1f}" in page
    assert "<strong>First of all:</strong> the target bends." in page
    assert "no unit given" in page


def test_what_either_fit_left_out_is_listed_once():
    """A point that Step 2 sets aside, and a view that was moved, by too little for Step 2."""
    scene = scene_of(3, MANY_VIEWS, outlier_fraction=0.02, translation_noise=2e-4)
    poses = scene.data.base_from_tool.wxyz_xyz
    moved = SE3(poses[6]) @ SE3.exp(jnp.array([6e-3, 0.0, 0.0, 0.0, 0.0, 0.01]))
    data = eqx.tree_at(
        lambda d: d.base_from_tool.wxyz_xyz, scene.data, poses.at[6].set(moved.wxyz_xyz)
    )
    fit = calibrate(data, "radial", field=None)
    assert fit.staged.rejected
    names = [entry[:2] for entry in fit.rejected]
    assert len(set(names)) == len(names)
    assert {entry[:2] for entry in fit.staged.rejected} < set(names)
    assert ("6", None) in names
    # The chain that corrects nothing is not fitted to that view either.
    seen = data.visible & fit.staged.inliers & fit.joint.problem.observations.visible
    used = eqx.tree_at(lambda d: d.visible, data.mask_views([6]), seen)
    shape = fit.joint.calibration.target_shape
    start = dataclasses.replace(fit.staged.calibration, target_shape=shape)
    without = fit_joint(used, start, noise="trusted").calibration
    bare = refit_uncorrected(data, fit)
    gap = bare.camera_from_tool.inverse() @ without.camera_from_tool
    assert float(jnp.linalg.norm(gap.log())) < 1e-5


def test_views_on_a_sphere_about_the_target_do_not_shrink_it():
    """Such views fit any size of the target, as in programs that place them on a sphere."""
    scene = scene_of(0)
    first = np.asarray(scene.calibration.camera_from_world(scene.base_from_tool).as_matrix())[0]
    about = np.eye(4)
    about[:3, 3] = first[:3, :3] @ POINTS.mean(axis=0) + first[:3, 3]
    tilts = np.zeros((VIEWS, 4, 4))
    rotation_vectors = np.random.default_rng(0).uniform(-0.4, 0.4, (VIEWS, 3)) * [1.0, 1.0, 0.0]
    tilts[:, :3, :3] = Rotation.from_rotvec(rotation_vectors).as_matrix()
    tilts[:, 3, 3] = 1.0
    seen = about @ tilts @ np.linalg.inv(about) @ first
    camera_from_tool, base_from_world = (
        np.asarray(pose.as_matrix())
        for pose in (scene.calibration.camera_from_tool, scene.calibration.base_from_world)
    )
    poses = base_from_world @ np.linalg.inv(seen) @ camera_from_tool
    data = simulate(scene.calibration, poses, POINTS, 0, 0.15, 3e-4, 3e-4).data
    fit = calibrate(data, "radial", field=None)
    assert fit.noise_estimate is not None
    assert fit.noise_estimate.target_scale is None
    assert float(fit.calibration.target_scale) == 1.0
    error = fit.calibration.camera_from_tool.translation() - camera_from_tool[:3, 3]
    assert float(jnp.linalg.norm(error)) < 2e-3
    assert any("do not tell the target's size" in text for text in fit.warnings)


@pytest.mark.parametrize("field", [None, "auto"])
def test_what_is_rehearsed_is_the_fit_that_is_made(field, monkeypatch):
    """Whatever its numbers: a program is compiled for the structure and the shapes."""
    rehearsed, scene = [], scene_of(0)
    monkeypatch.setattr(sys.modules[precompile.__module__], "solve", rehearsed.append)
    precompile(scene.data, "opencv4", field=field)
    fit = fit_joint(scene.data, scene.calibration, lens="opencv4", noise="estimated", field=field)
    kinds = [
        (jax.tree.structure(p), jax.tree.map(np.shape, (p.observations, p.prepared_poses)))
        # The solver pads the free parameters, and gives errors alike in all directions axes too.
        for p in map(padded, (*rehearsed, fit.problem))
    ]
    assert kinds[0] == kinds[1]


def test_a_second_set_of_the_same_kind_is_not_rehearsed(monkeypatch):
    """Its programs exist: only sets of other sizes, mounts, arms or options need others.

    Sixteen views are padded to as many as eight, but a robot of unknown build is tried too.
    """
    monkeypatch.setattr(sys.modules[needs_precompiling.__module__], "_precompiled", set())
    few, other, many = scene_of(0).data, scene_of(1).data, scene_of(0, MANY_VIEWS).data
    options = ("opencv4", None, "estimated", "auto")
    assert needs_precompiling(few, *options)
    assert not needs_precompiling(other, *options)
    assert padded_counts(*many.visible.shape) == padded_counts(*few.visible.shape)
    assert needs_precompiling(many, *options)
    assert needs_precompiling(few, "radial", *options[1:])
    assert needs_precompiling(few, *options[:-1], None)
    fixed_camera = dataclasses.replace(few, mount="eye_to_hand")
    assert needs_precompiling(fixed_camera, *options)


def test_what_is_wrong_with_the_data_is_said_at_once(monkeypatch):
    """Not after the rehearsal has compiled everything."""
    monkeypatch.setattr(
        "smartview_jax.calibration_pipeline.precompile", lambda *_: pytest.fail("rehearsed")
    )
    scene = scene_of(0, 2)
    with pytest.raises(ValueError, match="a calibration needs at least 3 views"):
        calibrate(scene.data)


def test_rows_that_were_exchanged_are_named_where_no_fit_is_left():
    """Two of eight: the others are too few for the staged fit to tell which views are wrong."""
    scene = scene_of(5, 8)
    poses = np.array(scene.data.base_from_tool.wxyz_xyz)
    poses[[2, 5]] = poses[[5, 2]]
    data = dataclasses.replace(scene.data, base_from_tool=SE3(jnp.asarray(poses)))
    try:
        said = " ".join(calibrate(data, "radial").warnings)
    except ValueError as error:
        said = str(error)
    assert "view 2: its rotation differs" in said or "do not belong together" in said


def test_a_start_the_other_way_round_is_named_first_and_not_used():
    scene = scene_of(6)
    start = {"camera_from_tool": scene.calibration.camera_from_tool.inverse()}
    fit, without = (calibrate(scene.data, start=given) for given in (start, None))
    said = fit.warnings[0]
    assert said.startswith("the start's camera_from_tool does not belong to these data: ")
    assert "px if camera_from_tool and tool_from_camera were exchanged" in said
    assert said.endswith("; the fit does without it")
    np.testing.assert_allclose(
        fit.calibration.camera_from_tool.wxyz_xyz,
        without.calibration.camera_from_tool.wxyz_xyz,
        atol=1e-9,
    )


@pytest.mark.parametrize("used_paths", [("camera_from_tool",), ("camera_from_tool.rotation.x",)])
def test_a_start_that_is_held_or_in_a_prior_is_kept_though_it_is_doubted(used_paths):
    scene = scene_of(6)
    start = {"camera_from_tool": scene.calibration.camera_from_tool.inverse()}
    staged, kept = with_start_doubts(fit_staged(scene.data), start, scene.data, used_paths)
    assert kept == start
    assert staged.warnings[-1].startswith("the start's camera_from_tool does not belong to these")
    assert "does without it" not in staged.warnings[-1]


def test_a_place_that_a_prior_states_is_no_start_to_doubt():
    """The staged fit sets out from there unturned, which is not what the user said."""
    scene = scene_of(6)
    place = np.asarray(scene.calibration.camera_from_tool.translation())
    priors = {
        f"camera_from_tool.translation.{axis}": Prior(std=0.01, mean=float(x))
        for axis, x in zip("xyz", place, strict=True)
    }
    fit = calibrate(scene.data, priors=priors)
    assert not [text for text in fit.warnings if "start" in text]


def test_a_stretched_target_answers_that_no_single_camera_fits():
    """The staged fit cannot know it; the joint fit finds the stretch, and leaves the noise."""
    data = scene_of(1, MANY_VIEWS, translation_noise=1e-4, rotation_noise=1e-4).data
    stated = np.array(data.points)
    stated[..., 0] /= 1.06
    fit = calibrate(dataclasses.replace(data, points=jnp.asarray(stated)))
    doubt = fit.staged.camera_doubt
    assert doubt.text.startswith("no single camera fits these pictures")
    assert doubt.text in fit.staged.warnings
    assert doubt.text not in fit.warnings
    # (1 + a) / (1 - a) = 1.06, for 2 a.
    stretch, std = fit.noise_estimate.target_shape.stretch
    assert stretch == pytest.approx(2.0 * 0.06 / 2.06, abs=5.0 * std)
    # A fit that leaves far more than a camera in each view would does not answer it.
    assert not doubt.misfit.is_answered_by(3.0 * doubt.misfit.single)
