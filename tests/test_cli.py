import dataclasses
import html
import inspect
import re
import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from board_scene import LENS, board_folder
from detected_sample import copied_views, detected_sample
from main_job import main_job
from typer.testing import CliRunner

from smartview_jax import Calibration, report
from smartview_jax.cli import app
from smartview_jax.evaluation import ErrorBudget, error_budget, reprojection_errors
from smartview_jax.evaluation.diagnosis.causes import ErrorCause
from smartview_jax.files import read_yaml
from smartview_jax.simulation import paper_calibration, paper_points, random_scene

RUNNER = CliRunner()

LOAD = "smartview_jax.cli.calibrate_folder.load_named"
"""The function by which a subcommand reads its data set."""


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The main job on the sample, once for all tests."""
    return main_job(tmp_path_factory)


def test_the_main_job_prints_the_table(result):
    assert result.exit_code == 0, result.stderr
    text = result.stdout + result.stderr
    for words in ("staged", "joint", "correction", "held-out", "rejected", "errors of the robot"):
        assert words in text
    held_out = re.search(r"held-out error,[^│]*│\s*([\d.]+) px\s*│\s*([\d.]+) px", result.stdout)
    assert held_out is not None
    staged, joint = map(float, held_out.groups())
    assert joint == pytest.approx(0.80, abs=0.05)
    assert joint < 0.5 * staged


def test_progress_is_reported_step_by_step(result):
    lines = result.stderr.splitlines()
    for words in ("view 0 (1 of 15)", "Step 1", "Step 2", "Step 3", "joint fit", "fold 1 of 5"):
        assert len([line for line in lines if words in line]) == 1
    # Where no terminal shows it, a stage has one line: not one for each view, pass and fold.
    assert len(lines) <= 12


def test_the_calibration_file_is_the_result(result):
    calibration = Calibration.load(result.out / "calibration.yaml")
    assert float(calibration.camera.alpha_u) == pytest.approx(533.1, abs=1.0)
    assert np.isfinite(np.asarray(calibration.camera_from_tool.wxyz_xyz)).all()


def test_programs_that_cannot_correct_the_robot_have_a_file_of_their_own(result, tmp_path):
    """By the pixels it was fitted to it is the better one without the correction."""
    out, data = result.out, detected_sample()
    assert "calibration_uncorrected.yaml" in result.stdout
    bare = Calibration.load(out / "calibration_uncorrected.yaml")
    assert bare.robot_error is None
    best = reprojection_errors(bare, data).rms
    assert best == pytest.approx(0.77, abs=0.05)
    assert (
        best
        < 0.7
        * reprojection_errors(Calibration.load(out / "calibration.yaml").uncorrected, data).rms
    )
    told = RUNNER.invoke(app, ["export", str(out / "calibration.yaml"), "--to", "ros"])
    assert "export calibration_uncorrected.yaml" in told.stderr
    # Of a camera of a rig there is none.
    alone = tmp_path / "left.yaml"
    alone.write_text((out / "calibration.yaml").read_text())
    told = RUNNER.invoke(app, ["export", str(alone), "--to", "ros"])
    assert "predict worse without the correction" in " ".join(told.stderr.split())


def test_what_speaks_against_the_answer_is_said_everywhere(result):
    """The board of the sample is 2 % smaller than it is said to be: terminal, file and report."""
    out = result.out
    said = " ".join(result.stdout.split())
    # What a person can measure comes before what follows from it.
    warned = [line for line in result.stdout.splitlines() if line.startswith("warning: ")]
    assert warned[0].startswith("warning: the target is 0.97")
    assert len(warned) == 4
    assert re.search(r"warning: the target is 0\.97\d\d \+- 0\.0\d+ of its stated size", said)
    kept = yaml.safe_load((out / "calibration.yaml").read_text())["warnings"]
    assert any("measure it" in words for words in kept)
    page = (out / "report.html").read_text()
    assert all(words in html.unescape(page) for words in kept)


def test_a_camera_that_stands_is_published_in_the_base(tmp_path):
    camera = paper_calibration()
    for mount, frame in (("eye_in_hand", "tool0"), ("eye_to_hand", "base_link")):
        dataclasses.replace(camera, mount=mount).save(tmp_path / "calibration.yaml")
        told = RUNNER.invoke(app, ["export", str(tmp_path / "calibration.yaml"), "--to", "ros"])
        assert f"--frame-id {frame} " in told.stdout


def test_what_an_earlier_run_wrote_does_not_stay(tmp_path, monkeypatch):
    """Three views are too few to be held out, and these do not ask for a field."""
    asked = inspect.signature(error_budget)

    def budget(*given, **options):
        """Computing it takes longer than all fits, and has tests of its own."""
        assert asked.bind(*given, **options).arguments["held_out_by_region"]
        causes = (ErrorCause("too few views", 0.731, "take more"), ErrorCause("pixels", 0.15, ""))
        return ErrorBudget(0.75, causes, (), "too few views", "Take twelve more views.")

    monkeypatch.setattr("smartview_jax.error_budget", budget)
    monkeypatch.setattr(LOAD, lambda *_, **__: (three_views(), "three views"))
    (tmp_path / "calibration_uncorrected.yaml").write_text("from an earlier run")
    run = RUNNER.invoke(app, ["calibrate", "--diagnose", "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    assert not (tmp_path / "calibration_uncorrected.yaml").exists()
    page = (tmp_path / "report.html").read_text()
    for words in (
        "held-out error needs at least 4 usable views",
        "no split-half comparison",
        "0.731",
        "Take twelve more views.",
        "the pattern looks the same in 2 orders",
    ):
        assert words in run.stdout
        assert words in page
    assert "With 3 views no figure here is reliable" in page


def three_views():
    data = random_scene(2, 3, paper_points((0.0, 0.02))[::2]).data
    return dataclasses.replace(data, notes=("the pattern looks the same in 2 orders",))


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("ros", "static_transform_publisher"),
        ("camera_info", "distortion_model: plumb_bob"),
        ("urdf", "<origin xyz="),
        ("opencv", "!!opencv-matrix"),
    ],
)
def test_the_calibration_is_exported(result, to, words):
    run = RUNNER.invoke(app, ["export", str(result.out / "calibration.yaml"), "--to", to])
    assert run.exit_code == 0, run.output
    assert words in run.stdout


def test_the_report_is_one_page_that_fetches_nothing(result):
    out = result.out
    page = (out / "report.html").read_text()
    # The programs in it draw the scene of the cameras and copy numbers, and are in the page itself.
    drawn_by, written = re.subn(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert written == 3
    assert drawn_by.count("data:image/png;base64,") == 6
    assert not re.findall(r'(?:src|href)="(?!data:)', drawn_by)
    for words in ("Rejected points and views", "What the data cannot tell", "camera.lens.k1"):
        # Names may break after a full stop.
        assert words in page.replace("<wbr>", "")
    assert sorted(p.name for p in out.iterdir()) == [
        "calibration.yaml",
        "calibration_staged.yaml",
        "calibration_uncorrected.yaml",
        "report.html",
    ]


def test_all_files_of_a_run_carry_its_name(result):
    out = result.out
    names = {read_yaml(path)["run"] for path in out.glob("*.yaml")}
    (name,) = names
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:]{8}Z-[0-9a-f]{6}", name)
    assert name in (out / "report.html").read_text()


def test_where_results_go_is_looked_at_before_the_work(tmp_path, monkeypatch):
    def never(*_):
        raise AssertionError("it began to work")

    monkeypatch.setattr(LOAD, never)
    (tmp_path / "file").write_text("a file")
    cases = {
        tmp_path / "file": f"--out: {tmp_path / 'file'} is a file; expected a folder",
        tmp_path / "file/below": f"--out: {tmp_path / 'file'} is a file; expected a folder",
        Path("/proc/results"): "--out: /proc cannot be written to",
    }
    for out, words in cases.items():
        run = RUNNER.invoke(app, ["calibrate", "--out", str(out)])
        assert run.exit_code == 2, run.output
        assert words in run.stderr.replace("\n", " ")


def test_a_report_that_fails_leaves_the_last_runs_files(tmp_path, monkeypatch):
    """Not a new calibration next to an old report."""
    monkeypatch.setattr(LOAD, lambda *_, **__: (three_views(), "three views"))

    def broken(*_):
        raise ValueError("no report")

    monkeypatch.setattr(report, "write_page", broken)
    for name in ("calibration.yaml", "report.html"):
        (tmp_path / name).write_text("from an earlier run")
    run = RUNNER.invoke(app, ["calibrate", "--no-held-out", "--out", str(tmp_path)])
    assert run.exit_code == 2
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.yaml", "report.html"}
    for path in tmp_path.iterdir():
        assert path.read_text() == "from an earlier run"


def test_names_from_the_data_are_escaped(monkeypatch):
    from smartview_jax.report import page

    rows = page.tables.rejections
    monkeypatch.setattr(page.tables, "rejections", lambda *_: [("<script>", "&")])
    assert rows is not page.tables.rejections
    text = page.get_template("page.html").render(rejections=[("<script>", "&")], title="<b>")
    assert "<script>" not in text
    assert "&lt;script&gt;" in text


def test_errors_are_one_line_and_exit_code_two(tmp_path):
    run = RUNNER.invoke(app, ["calibrate", str(tmp_path / "nowhere")])
    assert run.exit_code == 2
    assert "no such folder" in run.stderr
    assert "Traceback" not in run.output


def test_an_interrupted_run_writes_nothing(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(LOAD, lambda *_, **__: (three_views(), "three views"))
    monkeypatch.setattr("smartview_jax.calibration_pipeline.fit_staged", interrupted)
    run = RUNNER.invoke(app, ["calibrate", "--out", str(tmp_path / "out")])
    assert run.exit_code == 130
    assert "interrupted; no file is left half-written" in run.stderr
    assert not (tmp_path / "out").exists()


def test_poses_the_wrong_way_round_are_named(tmp_path_factory, tmp_path):
    folder = shutil.copytree(board_folder(tmp_path_factory), tmp_path / "data")
    text = (folder / "dataset.yaml").read_text()
    (folder / "dataset.yaml").write_text(text.replace("base_from_tool", "tool_from_base"))
    run = RUNNER.invoke(app, ["calibrate", str(folder), *LENS, "--out", str(tmp_path / "out")])
    assert run.exit_code == 2
    assert "every pose is inverted" in run.stderr
    assert not (tmp_path / "out").exists()


def test_a_bad_view_is_an_error_or_masked_as_the_user_says(tmp_path, monkeypatch):
    folder = copied_views(tmp_path / "data")
    (folder / "images/3.png").write_bytes(b"no picture")
    run = RUNNER.invoke(app, ["compare", str(folder)])
    assert run.exit_code == 2
    assert "3.png: not a picture that can be read" in run.stderr
    seen = []
    monkeypatch.setattr("smartview_jax.compare", lambda data, *_, **__: seen.append(data) or [])
    run = RUNNER.invoke(app, ["compare", str(folder), "--bad-views", "mask"])
    assert run.exit_code == 0, run.output
    assert [view for view, _ in seen[0].masked_views] == ["3"]


def test_the_version_is_printed():
    assert "smartview_jax" in RUNNER.invoke(app, ["--version"]).output


def test_a_viewpoint_is_printed_and_written(tmp_path):
    from smartview_jax.geometry import five_viewpoints, look_at
    from smartview_jax.io import read_viewpoints
    from smartview_jax.simulation import paper_calibration

    paper_calibration().save(tmp_path / "calibration.yaml")
    given = ["viewpoint", str(tmp_path / "calibration.yaml"), "--at", "0.018,0.015,0.01"]
    unsaid = RUNNER.invoke(app, given)
    assert unsaid.exit_code == 2
    assert "does not state from which side the target was seen: give --above" in unsaid.stderr
    out = tmp_path / "v.json"
    run = RUNNER.invoke(app, [*given, "--above", "--roll", "30", "--out", str(out)])
    assert run.exit_code == 0, run.output
    point = np.array([0.018, 0.015, 0.01])
    wanted = look_at(point, np.array([[0.0, 0.0, -1.0]]), 0.2, np.deg2rad(30.0))
    expected = paper_calibration().command_for(wanted)
    found = read_viewpoints(out).base_from_tool
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-9)
    assert f"{1e3 * float(expected.translation()[0, 2]):.3f}" in run.stdout

    run = RUNNER.invoke(app, [*given, "--five", "--below", "--out", str(tmp_path / "v.csv")])
    assert run.exit_code == 0, run.output
    expected = paper_calibration().command_for(five_viewpoints(point, 0.2, above=False))
    found = read_viewpoints(tmp_path / "v.csv").base_from_tool
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-9)
    run = RUNNER.invoke(app, [*given, "--above", "--distance", "-1"])
    assert run.exit_code == 2
    assert "--distance" in run.stderr


def test_a_viewpoint_of_the_sample_is_on_the_side_that_was_seen(result, tmp_path):
    """Its frame has z into the board, which lies on a table: the tool stays over it."""
    from smartview_jax.io import read_viewpoints

    folder = result.out
    for name in ("calibration", "calibration_staged", "calibration_uncorrected"):
        out = tmp_path / f"{name}.json"
        told = ["viewpoint", str(folder / f"{name}.yaml"), "--five", "--out", str(out)]
        run = RUNNER.invoke(app, told)
        assert run.exit_code == 0, run.output
        assert (np.asarray(read_viewpoints(out).base_from_tool.translation())[:, 2] > 0.5).all()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--above"], r"the camera is 0\.\d+ m behind the target's plane"),
        (["--distance", "400"], r"the tool is 400\.\d m from the base: no arm is that long"),
        (["--at", "3,0,0"], r"the camera is 2\.\d times as far from the middle"),
    ],
)
def test_a_viewpoint_that_could_break_something_is_refused(result, tmp_path, options, reason):
    folder = result.out
    out = tmp_path / "v.val"
    given = ["viewpoint", str(folder / "calibration.yaml"), "--out", str(out), *options]
    run = RUNNER.invoke(app, given)
    assert run.exit_code == 2
    assert re.search(f"refused, nothing is written: v1: .*{reason}", run.stderr)
    assert not out.exists()
    words = re.findall("--allow [a-z-]+", run.stderr)
    assert words
    forced = RUNNER.invoke(app, [*given, *" ".join(words).split()])
    assert re.search(reason, forced.stdout)
    # What no robot can do is not written all the same.
    unreachable = "400" in options
    assert (forced.exit_code, out.exists()) == ((2, False) if unreachable else (0, True))


def test_a_viewpoint_out_of_an_arms_reach_is_refused(tmp_path):
    paper_calibration().save(tmp_path / "calibration.yaml")
    out = tmp_path / "v.val"
    given = ["viewpoint", str(tmp_path / "calibration.yaml"), "--above", "--distance", "3"]
    arm = ["--arm", "puma_560", "--near=0,90,-90,0,60,0"]
    run = RUNNER.invoke(app, [*given, *arm, "--out", str(out)])
    assert run.exit_code == 2
    assert "refused, nothing is written: v1: out of reach" in run.stderr
    assert not out.exists()


def test_a_viewpoint_in_another_makers_words(tmp_path):
    """KUKA's angles by scipy."""
    from scipy.spatial.transform import Rotation

    from smartview_jax.geometry import look_at

    paper_calibration().save(tmp_path / "calibration.yaml")
    out = tmp_path / "v.csv"
    given = ["viewpoint", str(tmp_path / "calibration.yaml"), "--above", "--out", str(out)]
    run = RUNNER.invoke(app, [*given, "--format", "kuka_abc"])
    assert run.exit_code == 0, run.output
    header, row = out.read_text().splitlines()
    assert header == "view,format,x_mm,y_mm,z_mm,a_deg,b_deg,c_deg"
    wanted = look_at(np.zeros(3), np.array([0.0, 0.0, -1.0]), 0.2)
    pose = np.asarray(paper_calibration().command_for(wanted).as_matrix())
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX", degrees=True)
    expected = [*(1e3 * pose[:3, 3]), *angles]
    np.testing.assert_allclose(np.array(row.split(",")[2:], dtype=float), expected, atol=1e-6)
    assert f"{angles[0]:.3f}" in run.stdout
    run = RUNNER.invoke(app, [*given, "--format", "kuka"])
    assert run.exit_code == 2
    assert "pose format is one of" in run.stderr


def test_a_viewpoint_in_an_arms_joints(tmp_path):
    """An arm by its name, and one whose zeros were fitted: its readings make up for them."""
    from smartview_jax.geometry import look_at
    from smartview_jax.io import read_viewpoints
    from smartview_jax.robot_errors import JointOffsets, RobotError
    from smartview_jax.robots import joints_for_pose, puma_560
    from smartview_jax.simulation import paper_calibration

    arm, path, out = puma_560(), tmp_path / "calibration.yaml", tmp_path / "v.json"
    wanted = look_at(np.zeros(3), np.array([[0.0, 0.0, -1.0]]), 0.2)
    bare = paper_calibration()
    near = joints_for_pose(arm, bare.command_for(wanted), np.deg2rad([[0, 90, -90, 0, 60, 0]]))
    words = ",".join(f"{reading:.0f}" for reading in np.rad2deg(near.joints[0]))
    given = ["viewpoint", str(path), "--above", f"--near={words}", "--out", str(out)]
    offsets = jnp.array([0.0, 0.01, -0.02, 0.0, 0.01, 0.0])
    fitted = dataclasses.replace(bare, robot_error=RobotError(JointOffsets(arm), offsets))
    for known, named in ((bare, ["--arm", "puma_560"]), (fitted, [])):
        known.save(path)
        run = RUNNER.invoke(app, [*given, *named])
        assert run.exit_code == 0, run.output
        joints = read_viewpoints(out).joints
        assert f"{np.rad2deg(joints[0, 1]):.3f}" in run.stdout
        there = known.camera_from_world(arm.command(joints))
        np.testing.assert_allclose((there @ wanted.inverse()).log(), 0.0, atol=1e-7)

    bare.save(path)
    for words, message in (
        (["viewpoint", str(path), "--above", "--arm", "puma_560"], "--near"),
        (given, "--arm"),
        ([*given, "--arm", "puma_560", "--near=1,2"], "expected 6 numbers"),
        ([*given, "--arm", "scara"], "puma_560"),
    ):
        run = RUNNER.invoke(app, words)
        assert run.exit_code == 2
        assert message in run.stderr


def test_the_demo_needs_enough_views_of_the_board(tmp_path):
    run = RUNNER.invoke(app, ["demo", "--views", "3", "--out", str(tmp_path)])
    assert run.exit_code == 2
    assert "--views: expected 8 or more, found 3" in run.stderr
