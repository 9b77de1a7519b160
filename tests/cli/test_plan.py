"""The planned views are new, safe and worth their time, and bring what was promised."""

import json
import re

import numpy as np
import pytest
from board_scene import BOARD, calibrated_board, run
from text_files import unwrapped

from smartview_jax import Calibration, Dataset, fit_joint, load_dataset
from smartview_jax.geometry import host_matrices
from smartview_jax.io import read_viewpoints
from smartview_jax.joint import load_estimate
from smartview_jax.simulation import simulate

ROUGH = ("--start", "camera_from_tool=0,0.05,0.06,0,0,0", "--start")
TABLE = "base_from_world=0.5,0.1,0.02,30,0,180"


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """Eight views, calibrated, which leave much to gain."""
    return calibrated_board(tmp_path_factory)


@pytest.fixture(scope="module")
def planned(board, tmp_path_factory):
    """The document of a plan, and the file of its commands."""
    file = tmp_path_factory.mktemp("plan") / "next.csv"
    ended = run("plan", board.calibration, board.data, "--gain", "8", "--out", file, "--json")
    assert ended.exit_code == 0, ended.output
    return json.loads(ended.stdout), file


def hand_eye_error(estimate, distance):
    """The root mean square displacement of a point at a distance, from the covariance alone."""
    names, covariance = list(estimate.parameter_names), np.asarray(estimate.covariance)
    translation, rotation = (
        sum(covariance[k, k] for k in map(names.index, paths))
        for paths in (
            [f"camera_from_tool.{part}.{axis}" for axis in "xyz"]
            for part in ("translation", "rotation")
        )
    )
    return np.sqrt(translation + 2.0 / 3.0 * distance**2 * rotation)


def test_the_views_bring_what_was_promised(board, planned):
    document, file = planned
    distance = 1e-3 * document["point_distance_mm"]
    before = load_estimate(board.calibration)
    stated = 1e3 * hand_eye_error(before, distance)
    assert document["std_before_mm"] == pytest.approx(stated, rel=1e-4)
    truth, data = Calibration.load(board.data / "truth.yaml"), load_dataset(board.data)
    noise = {"translation_noise": 1e-4, "rotation_noise": np.deg2rad(0.01)}
    commanded = read_viewpoints(file).base_from_tool
    more = simulate(truth, commanded, BOARD.points, seed=7, **noise).data
    together = Dataset.from_arrays(
        data.points[0],
        np.concatenate([data.pixels, more.pixels]),
        np.concatenate([host_matrices(one.base_from_tool) for one in (data, more)]),
        data.image_size,
    )
    again = fit_joint(together, before.calibration, noise=before.noise, field=None)
    promised = document["std_after_mm"]
    assert promised < 0.8 * document["std_before_mm"]
    assert 1e3 * hand_eye_error(again, distance) == pytest.approx(promised, rel=0.2)


def test_the_stop_is_where_one_more_view_gains_too_little(planned):
    document, file = planned
    count, each = document["views"], [document["std_before_mm"], *document["std_after_each_mm"]]
    gains = 1.0 - np.divide(each[1:], each[:-1])
    assert (gains[:count] >= 0.08).all()
    assert gains[count] < 0.08
    assert document["std_after_mm"] == each[count]
    assert 0 < count == len(document["commands"]) == len(read_viewpoints(file).names)


def test_the_commands_are_of_new_safe_views_of_the_whole_target(board, planned):
    document, file = planned
    calibration, data = Calibration.load(board.calibration), load_dataset(board.data)
    found = read_viewpoints(file)
    assert found.names[0] == "v9"
    assert not set(found.names) & set(data.view_ids)
    assert not any(one["refused"] for one in document["commands"])
    pixels, valid = calibration.project(found.base_from_tool, data.points[0])
    assert np.asarray(valid).all()
    assert (np.asarray(pixels) >= 0.0).all()
    assert (np.asarray(pixels) <= np.array(data.image_size) - 1.0).all()


def test_the_words_say_from_what_to_what_and_why_to_stop(board):
    given = (board.calibration, board.data, "--views", "2")
    ended = run("plan", *given, "--gain", "1")
    assert ended.exit_code == 0, ended.output
    said = re.search(
        r"two more views bring the error of a point 0\.\d+ m in front of the camera \(in the tool "
        r"frame\) from ([\d.]+) to ([\d.]+) mm \(standard deviation\); more views would still help",
        unwrapped(ended.stdout),
    )
    assert said is not None
    assert float(said[2]) < float(said[1])
    # It takes minutes where programs are compiled: each stage is said when it begins.
    stages = ("reading the calibration", "views so far tell", "checking 1000", "choosing 2 of")
    assert all(stage in ended.stderr for stage in (*stages, "exchanging", "best first"))
    enough = run("plan", *given, "--goal", "50", "--json")
    assert enough.exit_code == 0
    document = json.loads(enough.stdout)
    assert (document["views"], document["commands"], document["file"]) == (0, [], None)
    assert "no more views are needed" in document["words"][0]
    assert "the goal of 50 mm is reached" in document["words"][0]
    missed = run("plan", *given, "--goal", "0.001")
    assert "the goal of 0.001 mm is not reached" in unwrapped(missed.stdout)
    assert len(missed.stdout.splitlines()[-1]) <= 80


def test_first_views_come_from_rough_transforms_alone(tmp_path):
    """A folder without a picture; all points are in the picture of a pinhole by hand."""
    assert run("new", tmp_path / "mine", "--target", "chessboard").exit_code == 0
    out = tmp_path / "first.csv"
    given = (tmp_path / "mine", *ROUGH, TABLE, "--views", "6", "--below")
    ended = run("plan", *given, "--out", out)
    assert ended.exit_code == 0, ended.output
    assert "a focal length of 1536 px is assumed" in unwrapped(ended.stdout)
    assert re.search(
        r"six views will determine a point 0\.\d+ m in front of the camera", unwrapped(ended.stdout)
    )
    poses = host_matrices(read_viewpoints(out).base_from_tool)
    assert len(poses) == 6
    camera_from_tool = np.eye(4)
    camera_from_tool[:3, 3] = [0.0, 0.05, 0.06]
    turn = np.deg2rad(30.0)
    # Yaw 30 degrees about z after a roll of 180 about x.
    base_from_world = np.array(
        [
            [np.cos(turn), np.sin(turn), 0.0, 0.5],
            [np.sin(turn), -np.cos(turn), 0.0, 0.1],
            [0.0, 0.0, -1.0, 0.02],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    from smartview_jax.io import read_folder_description

    points = read_folder_description(tmp_path / "mine").target.points
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    chain = camera_from_tool @ np.linalg.inv(poses) @ base_from_world
    seen = np.einsum("vij,nj->vni", chain, homogeneous)
    assert (seen[..., 2] > 0.0).all()
    pixels = 1536.0 * seen[..., :2] / seen[..., 2:3] + [639.5, 511.5]
    # A tenth of the shorter side stays free.
    assert (pixels >= 102.0).all()
    assert (pixels <= [1279.0 - 102.0, 1023.0 - 102.0]).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("{out}",), "expected calibration.yaml and its data-set folder"),
        (("truth.yaml", "."), "uncertainty: missing"),
        (("{out}", ".", "--camera", "truth.yaml"), "--camera: only with --start"),
        (("nowhere.yaml", "."), "nowhere.yaml"),
        ((".", "--start", TABLE), "--start camera_from_tool=x,y,z,yaw,pitch,roll"),
        ((".", *ROUGH, "base_from_world=0,0,0,0,90,0"), "from which side is the target seen"),
        (
            (".", *ROUGH, TABLE, "--distance", "0.01,0.02"),
            "only 0 of 1000 candidates may be taken",
        ),
    ],
)
def test_what_is_missing_is_said(board, monkeypatch, words, message):
    monkeypatch.chdir(board.data)
    ended = run("plan", *(word.format(out=board.calibration) for word in words))
    assert ended.exit_code == 2
    assert message in ended.stderr.replace("\n", " ")
