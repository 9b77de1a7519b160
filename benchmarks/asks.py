"""What users of hand-eye calibration ask most: each question with the command or call that answers.

The questions are those that come back in the issues of OpenCV, easy_handeye, MoveIt, Kalibr,
robot_cal_tools and others. Every answer is run, and its output printed; an answer that is not given
is a failure.
"""

import dataclasses
import inspect
import itertools
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from typer.testing import CliRunner

import smartview_jax as sv
from smartview_jax import evaluation, simulation, staged
from smartview_jax.cli import app
from smartview_jax.dataset import Dataset
from smartview_jax.geometry import POSE_CODECS

from . import asks_of_cells

POINTS = simulation.paper_points((0.0, 0.02))[::4]
"""Target points of the simulated scenes: few, because every ask is about one thing."""


class Material:
    """Data and fits that several answers share, each made when it is first asked for."""

    def __init__(self, folder: Path):
        self.folder = folder

    @cached_property
    def sample(self) -> Dataset:
        """The real sample that ships in the package."""
        return sv.load_dataset(sv.io.sample_folder())

    @cached_property
    def fit(self):
        """The default calibration of the sample."""
        return sv.calibrate(self.sample)

    @cached_property
    def saved(self) -> Path:
        """A file with the calibration of the sample."""
        path = self.folder / "calibration.yaml"
        self.fit.save(path)
        return path

    @cached_property
    def scene(self) -> simulation.Scene:
        """Ten simulated views by a robot that errs at random."""
        return simulation.random_scene(
            1, 10, POINTS, translation_noise=1e-4, rotation_noise=np.deg2rad(0.01)
        )

    def command(self, *words: object) -> str:
        """Return what a command prints, on both streams, in one line."""
        run = CliRunner().invoke(app, [str(word) for word in words])
        return " ".join((run.output or "").split())


Answer = Callable[[Material], str]


class Ask(NamedTuple):
    """A question with its answer.

    Attributes:
        question: as users put it.
        call: the command or call that answers.
        answer: function that runs it and returns the output; raises an AssertionError if the
            output does not answer.
    """

    question: str
    call: str
    answer: Answer


def run(smoke: bool = False) -> bool:
    """Print every question with the answer that was run; True where all are answered."""
    unanswered = []
    with tempfile.TemporaryDirectory() as folder:
        material = Material(Path(folder))
        asked = SMOKE if smoke else range(1, len(ASKS) + 1)
        for number in asked:
            ask = ASKS[number - 1]
            try:
                text = ask.answer(material)
            # Any failure is an unanswered question; the others are still asked.
            except Exception as error:
                text = f"NOT ANSWERED: {type(error).__name__}: {error}"
                unanswered.append(number)
            print(f"{number:2} {ask.question}\n   {ask.call}\n   -> {text[:300]}")
    print(f"{len(asked) - len(unanswered)} of {len(asked)} answered")
    return not unanswered


def _expect(text: str, *patterns: str) -> str:
    """Return the part of a text from the first pattern on, after all were found in it."""
    found = [re.search(pattern, text) for pattern in patterns]
    missing = [pattern for pattern, match in zip(patterns, found, strict=True) if match is None]
    assert not missing, f"{missing} not in {text[:300]!r}"
    starts = [match.start() for match in found if match is not None]
    return text[min(starts) :]


def _one_axis(material: Material) -> Dataset:
    """Return views that are turned about one axis alone, as a SCARA robot turns them."""
    scene = material.scene
    turns = np.zeros((6, 6))
    turns[:, 5] = np.linspace(-0.6, 0.6, 6)
    turns[:, :2] = 0.01 * np.random.default_rng(0).normal(size=(6, 2))
    start = SE3(scene.base_from_tool.wxyz_xyz[0][None])
    commands = start @ SE3.exp(jnp.asarray(turns))
    return simulation.simulate(scene.calibration, commands, POINTS, pixel_noise=0.15).data


def _absurd_results(material: Material) -> str:
    scene = material.scene
    fit = sv.fit_joint(_one_axis(material), scene.calibration, fixed=("camera",), noise="trusted")
    assert np.isfinite(np.asarray(fit.calibration.camera_from_tool.as_matrix())).all()
    return _expect(str(fit), "do not determine: camera offset along the tool's z axis")


def _how_accurate(material: Material) -> str:
    text = " ".join(str(material.fit).split())
    held_out = sv.held_out(material.sample, sv.fit_staged).errors
    error = f"staged: held out {held_out.rms:.2f} px, {held_out.rms_mm:.2f} mm at the target"
    mount = _expect(text, r"camera_from_tool .* x +\S+ \+- \S+ mm")
    return f"{mount[:90]} ...; {error}"


def _inverted_poses(material: Material) -> str:
    data = material.sample
    inverted = dataclasses.replace(data, base_from_tool=data.base_from_tool.inverse())
    try:
        sv.calibrate(inverted)
    except ValueError as error:
        return _expect(str(error), "invert|tool_from_base")
    raise AssertionError("inverted poses were taken")


def _eye_to_hand(material: Material) -> str:
    truth = material.scene.calibration
    # The same pictures, told from the other side: the camera stands, the target is carried.
    data = dataclasses.replace(
        material.scene.data,
        mount="eye_to_hand",
        base_from_tool=material.scene.data.base_from_tool.inverse(),
    )
    fit = sv.calibrate(data)
    found = fit.calibration.camera_from_base.translation()
    error = 1e3 * float(np.linalg.norm(found - truth.camera_from_tool.translation()))
    assert error < 3.0
    return f"camera_from_base {error:.2f} mm off the truth; mount={fit.calibration.mount}"


def _refusal(data: sv.Dataset, poses: SE3) -> str:
    """Return the message with which the staged fit refuses wrong poses."""
    try:
        sv.fit_staged(dataclasses.replace(data, base_from_tool=poses))
    except ValueError as error:
        return str(error)
    raise AssertionError("wrong poses were taken")


def _angle_conventions(material: Material) -> str:
    data = material.sample
    angles = np.asarray(data.base_from_tool.rotation().as_rpy_radians()).T
    wrong = SO3.from_rpy_radians(*jnp.asarray(angles[:, ::-1]).T)
    mixed = SE3.from_rotation_and_translation(wrong, data.base_from_tool.translation())
    return f"formats: {', '.join(POSE_CODECS)}; a wrong one: {_refusal(data, mixed)[:160]}"


def _units(material: Material) -> str:
    data = material.sample
    poses = data.base_from_tool
    in_mm = SE3.from_rotation_and_translation(poses.rotation(), 1e3 * poses.translation())
    return _expect(_refusal(data, in_mm), "1000|unit|mm")


def _which_views(material: Material) -> str:
    text = material.command("plan", material.saved, sv.io.sample_folder(), "--views", 3)
    return _expect(text, r"more views? brings? .* from \S+ to \S+ mm")


def _same_answer(material: Material) -> str:
    data = material.scene.data
    order = np.random.default_rng(0).permutation(data.view_count)
    fits = [sv.calibrate(views).calibration for views in (data, data.select(order))]
    shifts = [np.asarray(fit.camera_from_tool.translation()) for fit in fits]
    difference = 1e3 * float(np.linalg.norm(shifts[0] - shifts[1]))
    assert difference < 1e-3
    return f"views in another order: {difference:.1e} mm; halves: evaluation.split_half_difference"


def _which_method(material: Material) -> str:
    rows = evaluation.compare(material.scene.data, evaluation.standard_methods())
    texts = [
        f"{row.name} {row.held_out.errors.rms:.2f} px" for row in rows if row.held_out is not None
    ]
    assert len(texts) >= 2
    return ", ".join(texts)


def _ignored_options(_: Material) -> str:
    parameters = inspect.signature(sv.fit_joint).parameters.values()
    options = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    assert len(options) > 8
    return f"by keyword only: {', '.join(options)}"


def _no_opencv(_: Material) -> str:
    code = (
        "import sys; sys.modules['cv2'] = None\n"
        "import smartview_jax as sv\n"
        "from smartview_jax.engine import build_problem\n"
        "print('fit_joint, fit_staged, Dataset' if sv.fit_joint and sv.fit_staged else '')"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return _expect(told.stdout.strip(), "fit_joint") + " are there without OpenCV"


def _few_axes(material: Material) -> str:
    prior = {"camera_from_tool.translation.z": sv.Prior(std=1e-3)}
    fit = sv.fit_joint(
        _one_axis(material),
        material.scene.calibration,
        fixed=("camera",),
        noise="trusted",
        priors=prior,
    )
    assert not fit.observability.null_directions
    return f"z by its prior: +- {1e3 * fit.std['camera_from_tool.translation.z']:.2f} mm, rest free"


def _good_or_bad(material: Material) -> str:
    fit = material.fit
    errors = evaluation.reprojection_errors(fit.calibration, material.sample)
    floor = float(fit.staged.step2.rms)
    return (
        f"{errors.rms:.2f} px, {errors.rms_mm:.2f} mm at the target; the camera alone reaches "
        f"{floor:.2f} px; {len(fit.warnings)} warnings, the first: {fit.warnings[0]}"
    )


def _together(material: Material) -> str:
    data, truth = material.scene.data, material.scene.calibration
    shifts = {}
    for name, fitter in (("staged", sv.fit_staged), ("joint", sv.calibrate)):
        found = fitter(data).calibration.camera_from_tool.translation()
        shifts[name] = 1e3 * np.linalg.norm(found - truth.camera_from_tool.translation())
    return ", ".join(f"{name} {mm:.2f} mm off" for name, mm in shifts.items())


def _robot_inaccurate(material: Material) -> str:
    text = " ".join(str(material.fit).split())
    return _expect(text, "model of the robot's error: [a-z_]+")


def _only_view_left_out(material: Material, view: int, pose: jnp.ndarray) -> str:
    """Return why a view is left out, and no other, after the robot reported a wrong pose there."""
    data = material.scene.data
    poses = SE3(data.base_from_tool.wxyz_xyz.at[view].set(pose))
    fit = sv.calibrate(dataclasses.replace(data, base_from_tool=poses))
    whole = [rejection for rejection in fit.rejected if rejection.point is None]
    assert [rejection.view for rejection in whole] == [str(view)]
    return f"view {whole[0].view}: {whole[0].reason}"


def _bad_samples(material: Material) -> str:
    pose = material.scene.data.base_from_tool.wxyz_xyz[4]
    return _only_view_left_out(material, 4, pose.at[4].add(0.02))


def _shifted_pairs(material: Material) -> str:
    data = material.sample
    shifted = SE3(jnp.roll(data.base_from_tool.wxyz_xyz, 1, axis=0))
    return _expect(_refusal(data, shifted), "pair|order|shift")


def _save_and_repeat(material: Material) -> str:
    estimate = sv.load_estimate(material.saved)
    folder = material.folder / "data"
    sv.save_dataset(material.sample, folder)
    again = sv.load_dataset(folder)
    assert again.observation_count == material.sample.observation_count
    return f"{len(estimate.parameter_names)} parameters with covariance, {again.view_count} views"


def _still_moving(material: Material) -> str:
    turn = SE3.exp(jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.05]))
    pose = SE3(material.scene.data.base_from_tool.wxyz_xyz[6]) @ turn
    return _only_view_left_out(material, 6, pose.wxyz_xyz)


def _detections(material: Material) -> str:
    data = material.scene.data
    corners, poses = material.folder / "corners.csv", material.folder / "matrices.csv"
    matrices = np.asarray(data.base_from_tool.as_matrix()).reshape(-1, 16)
    header = ",".join(f"m{i}{j}" for i, j in itertools.product(range(4), repeat=2))
    rows = [f"{k},{','.join(map(repr, row.tolist()))}" for k, row in enumerate(matrices)]
    poses.write_text("\n".join([f"view,{header}", *rows]))
    lines = ["view,X,Y,Z,u,v"]
    # Every second point: what another detector saw of a board that is partly hidden.
    for view, point in np.argwhere(np.asarray(data.visible))[::2]:
        values = [*data.points[view, point].tolist(), *data.pixels[view, point].tolist()]
        lines.append(f"{view},{','.join(map(repr, values))}")
    corners.write_text("\n".join(lines))
    found = sv.io.import_correspondences(poses, corners, data.image_size)
    fit = sv.calibrate(found)
    assert fit.result.converged
    return f"{found.observation_count} corners of another detector; converged"


def _pose_flips(material: Material) -> str:
    views = sum(1 for rejection in material.fit.rejected if rejection.point is None)
    assert views == 0
    return f"{material.sample.view_count} views of one flat board, none flipped, none rejected"


def _publish(material: Material) -> str:
    tf = material.command("export", material.saved, "--to", "ros")
    urdf = material.command("export", material.saved, "--to", "urdf")
    _expect(urdf, "<origin xyz=")
    return _expect(tf, "static_transform_publisher")


def _initial_guess(material: Material) -> str:
    shown = staged.fit_staged(material.scene.data)
    assert shown.result.converged
    return f"none is asked for; {shown.result.message}"


def _true_sigma(_: Material) -> str:
    inside, count = 0, 12
    for seed in range(count):
        scene = simulation.random_scene(seed, 8, POINTS)
        fit = sv.fit_joint(scene.data, scene.calibration, noise="trusted", field=None)
        for axis in "xyz":
            name = f"camera_from_tool.translation.{axis}"
            k = "xyz".index(axis)
            found = fit.calibration.camera_from_tool.translation()[k]
            error = abs(float(found - scene.calibration.camera_from_tool.translation()[k]))
            inside += error <= fit.confidence_half_width(name)
    share = inside / (3 * count)
    assert share >= 0.8
    return f"95 % intervals hold the truth in {share:.0%} of {3 * count}; `consistency` asks 1000"


def _solver(material: Material) -> str:
    fit = material.fit.joint
    assert jax.config.read("jax_enable_x64")
    costs = np.asarray(fit.solution.costs)
    assert (np.diff(costs[np.isfinite(costs)]) <= 1e-9 * costs[0]).all()
    return f"float64; cost by step {np.array2string(costs[:6], precision=2)}; {fit.result.message}"


ASKS = (
    Ask("The result is NaN or absurd", "print(sv.fit_joint(...))", _absurd_results),
    Ask("How accurate is it?", "print(fit); sv.held_out(data, fitter)", _how_accurate),
    Ask("Which matrix do I invert?", "sv.calibrate(data)", _inverted_poses),
    Ask("The camera stands next to the robot", 'mount="eye_to_hand"', _eye_to_hand),
    Ask("The Euler order of my robot", "smartview new --robot kuka", _angle_conventions),
    Ask("Millimetres or metres?", "sv.calibrate(data)", _units),
    Ask("How many poses, and which?", "smartview plan CALIBRATION DATASET", _which_views),
    Ask("A different answer each time", "sv.calibrate(data.select(order))", _same_answer),
    Ask("Tsai fails, Park does not", "smartview compare", _which_method),
    Ask("An option was ignored", "sv.fit_joint(data, start, *, ...)", _ignored_options),
    Ask("A function is missing in the wheel", "import smartview_jax", _no_opencv),
    Ask("SCARA, gantry, few axes", "priors={...: sv.Prior(std=1e-3)}", _few_axes),
    Ask("Is this reprojection error good?", "print(fit); fit.warnings", _good_or_bad),
    Ask("Intrinsics and hand-eye together", "sv.calibrate and sv.fit_staged", _together),
    Ask("The robot itself is inaccurate", "print(fit)", _robot_inaccurate),
    Ask("Remove bad samples", "fit.rejected", _bad_samples),
    Ask("Pictures and poses are shifted", "sv.calibrate(data)", _shifted_pairs),
    Ask("Save, load, repeat", "fit.save; sv.load_estimate; sv.save_dataset", _save_and_repeat),
    Ask("The robot was still moving", "fit.rejected; sv.estimate_time_offset", _still_moving),
    Ask("The board is not detected", "sv.io.import_correspondences", _detections),
    Ask("Poses of a flat board flip", "sv.calibrate(data)", _pose_flips),
    Ask("Into URDF and tf", "smartview export --to ros, urdf", _publish),
    Ask("The initial guess", "sv.fit_staged(data)", _initial_guess),
    Ask("Standard deviations are wrong", "fit.confidence_half_width(name)", _true_sigma),
    Ask("The solver does not end", "fit.solution.costs", _solver),
    Ask("Several cameras, one robot", "sv.calibrate(sv.Rig(...))", asks_of_cells.several_cameras),
    Ask("I have poses, not pixels", "sv.fit_poses(samples)", asks_of_cells.tracked_poses),
    Ask("Kalibr's AprilGrid is not found", "target: {file: ...}", asks_of_cells.april_grid),
    Ask("My board is bent", "fit.warnings", asks_of_cells.bent_board),
    Ask("A hobby arm", "robot_prior=sv.RobotPrior(...)", asks_of_cells.hobby_arm),
    Ask("The depth camera is off", "sv.depth", asks_of_cells.depth_camera),
    Ask("ROS 2: capture, bags, files", "smartview import; export", asks_of_cells.ros2),
    Ask("A calibrated URDF back", "export --to robot_urdf", asks_of_cells.calibrated_urdf),
)
"""The questions, the most frequent first."""

SMOKE = (1, 6, 10, 17, 28, 31)
"""Numbers of the questions that a smoke run asks."""
