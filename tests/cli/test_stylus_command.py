"""The commands put the tip on the point, and misses are judged by the calibration's own error."""

import json

import numpy as np
import pytest
from board_scene import calibrated_board, run

import smartview_jax as sv
from smartview_jax.files import read_yaml
from smartview_jax.geometry import host_matrices
from smartview_jax.io import read_viewpoints
from smartview_jax.simulation import paper_calibration

TIP = np.array([0.01, -0.02, 0.15])
WORDS = ("--tip", ",".join(map(str, TIP)), "--five", "--tilt", "10")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    return calibrated_board(tmp_path_factory).calibration


def touched(path, *words):
    return run("stylus", path, *words)


def test_the_tip_is_on_the_point(tmp_path):
    path, out = tmp_path / "calibration.yaml", tmp_path / "touch.json"
    truth = paper_calibration()
    truth.save(path)
    point = np.array([0.02, 0.01, 0.004])
    words = (*WORDS, "--above", "--at", ",".join(map(str, point)), "--out", str(out))
    ended = touched(path, *words)
    assert ended.exit_code == 0, ended.output
    assert "has no covariance" in ended.stdout
    world_from_base = np.linalg.inv(host_matrices(truth.base_from_world))
    tools = world_from_base @ host_matrices(read_viewpoints(out).base_from_tool)
    assert len(tools) == 5
    np.testing.assert_allclose(
        (tools @ np.append(TIP, 1.0))[:, :3], np.tile(point, (5, 1)), atol=1e-9
    )
    # The first is upright: from the tool straight down to the tip.
    np.testing.assert_allclose(
        tools[0, :3, :3] @ TIP / np.linalg.norm(TIP), [0.0, 0.0, -1.0], atol=1e-9
    )
    assert touched(path, *words, "--gap", "5").exit_code == 0
    stopped = world_from_base @ host_matrices(read_viewpoints(out).base_from_tool)
    before = (stopped @ np.append(TIP, 1.0))[:, :3] - point
    np.testing.assert_allclose(np.linalg.norm(before, axis=1), 5e-3, atol=1e-9)
    # Above the point, not in it.
    np.testing.assert_allclose(before[0], [0.0, 0.0, 5e-3], atol=1e-9)


def test_what_to_expect_is_printed_before_anything_is_touched(fitted):
    ended = touched(fitted, *WORDS)
    assert ended.exit_code == 0, ended.output
    assert "its 95 % ellipse mm" in ended.stdout
    assert "miss" not in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 80


def test_misses_of_the_expected_size_are_as_expected(fitted, tmp_path):
    document = json.loads(touched(fitted, *WORDS, "--json").stdout)
    std = np.array([one["expected"]["std_m"] for one in document["touches"]])
    # A displacement of the target, of one standard deviation, is common to all touches.
    lines = [f"{one['name']},{1e3 * std[0, 0]},0.0,0.0" for one in document["touches"]]
    misses = tmp_path / "misses.csv"
    misses.write_text("\n".join(["view,x_mm,y_mm,z_mm", *lines]))
    ended = touched(fitted, *WORDS, "--misses", str(misses))
    assert ended.exit_code == 0, ended.output
    assert f"5 touches miss by {1e3 * std[0, 0]:.2f} mm RMS" in ended.stdout
    assert "5 of 5 are inside" in ended.stdout
    assert "): as the calibration predicts" in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 80
    misses.write_text("\n".join(["view;x_mm;y_mm", *(f"v{k};9,0;-7,0" for k in range(1, 6))]))
    worse = touched(fitted, *WORDS, "--misses", str(misses))
    seen = "misses.csv was read separated by semicolons; with a decimal comma"
    assert f"note: {seen}" in worse.stdout
    assert "0 of 5 are inside" in worse.stdout
    assert "): more than the calibration predicts" in " ".join(worse.stdout.split())
    words = " ".join(worse.stdout.split())
    assert "likely causes: all touches miss alike, by about (9.00, -7.00) mm" in words
    found = json.loads(touched(fitted, *WORDS, "--misses", str(misses), "--json").stdout)
    assert found["notes"] == [seen]
    assert found["rms_m"] == pytest.approx(np.hypot(9e-3, 7e-3))
    assert found["comparison"]["p_value"] < 0.01
    assert found["likely_causes"].startswith("all touches miss alike")
    assert found["touches"][0]["distance_m"] == found["rms_m"]


def test_misses_correct_the_calibration(fitted, tmp_path):
    words = ("--tip", "0,0,0.15", "--at", "0,0,0", "--at", "0.1,0,0", "--at", "0,0.05,0")
    touches = json.loads(touched(fitted, *words, "--json").stdout)["touches"]
    assert [one["name"] for one in touches] == ["v1", "v2", "v3"]
    shift = 1e3 * touches[0]["expected"]["std_m"][0]
    misses, corrected = tmp_path / "misses.csv", tmp_path / "corrected.yaml"
    rows = [f"{one['name']},{shift},0,0" for one in touches]
    misses.write_text("\n".join(["view,x_mm,y_mm,z_mm", *rows]))
    words = (*words, "--misses", str(misses))
    ended = touched(fitted, *words, "--corrected", str(corrected), "--measurement-std", "0.01")
    assert ended.exit_code == 0, ended.output
    assert max(map(len, ended.stdout.replace(str(corrected), "corrected.yaml").splitlines())) <= 80
    assert "corrected; it predicts" in ended.stdout
    before, after = (sv.load_estimate(path) for path in (fitted, corrected))
    assert after.calibration.region is not None
    kept = [read_yaml(path)["pictures"] for path in (fitted, corrected)]
    assert kept[0] == kept[1]
    assert (np.diag(after.covariance) <= np.diag(before.covariance) * (1 + 1e-9)).all()
    # The tip went too far along the world's x: so far is the world from where it was taken to be.
    moved = np.linalg.inv(host_matrices(before.calibration.base_from_world)) @ host_matrices(
        after.calibration.base_from_world
    )
    assert -shift < 1e3 * moved[0, 3] < -0.3 * shift
    document = json.loads(touched(fitted, *words, "--corrected", str(corrected), "--json").stdout)
    assert document["corrected"] == str(corrected)
    assert document["corrected_expected_rms_m"] < document["comparison"]["expected_rms_m"]
    corrected.unlink()
    misses.write_text("\n".join(["view,x_mm,y_mm", *(f"v{k},9,-7" for k in range(1, 4))]))
    refused = touched(fitted, *words, "--corrected", str(corrected))
    assert refused.exit_code == 2
    assert "larger than the calibration predicts" in refused.stderr
    assert "all touches miss alike" in " ".join(refused.stderr.split())
    assert not corrected.exists()


def test_what_is_wrong_is_said(fitted, tmp_path):
    (tmp_path / "m.csv").write_text("view,x_mm,y_mm\nv1,1,2\n")
    for words, message in (
        ((*WORDS, "--misses", str(tmp_path / "m.csv")), "expected the touches v1, v2"),
        ((*WORDS, "--at", "9,0,0", "--arm", "puma_560", "--near=0,90,-90,0,60,0"), "refused"),
        ((*WORDS, "--corrected", "c.yaml"), "--corrected needs the measured misses"),
        ((), "--tip"),
    ):
        ended = touched(fitted, *words)
        assert ended.exit_code == 2
        assert message in ended.stderr
