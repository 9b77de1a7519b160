"""Views are taken when all stands still, stored at once, and survive what happens."""

import dataclasses
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_scene import PATIENCE, everywhere, new_folder, quick_fit, wait_until
from fit_scenes import scene_of

from smartview_jax.capture import (
    CaptureOptions,
    Estimate,
    MoveRefusedError,
    NotTakenError,
    Proposal,
    SourceLostError,
    capture_unattended,
)
from smartview_jax.capture.estimation import estimate
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_dataset


def test_views_are_stored_as_they_are_taken_and_fitted(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder) as session:
        for rig.at in range(4):
            assert session.take() == f"v{1 + rig.at}"
            # At every moment the folder is a data set.
            assert load_dataset(folder).view_count == 1 + rig.at
        assert session.wait_for_fit(PATIENCE)
        assert session.last_estimate.views == 4
        assert not session.is_reached
        covered = session.coverage()
        assert 0.2 < covered.cells.mean() <= 1.0
        assert (covered.rotations > 0.0).all()
    data = load_dataset(folder)
    np.testing.assert_allclose(host_matrices(data.base_from_tool), rig.poses[:4], atol=1e-9)
    assert not list(folder.glob("*.lock"))


def test_a_view_that_does_not_stand_still_is_not_taken(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder) as session:
        rig.sways = True
        with pytest.raises(NotTakenError, match=r"the target moves in the picture: 1\.00 px"):
            session.take()
        rig.sways = False
        session.take()
        with pytest.raises(NotTakenError, match="still shows the picture of the last view"):
            session.take()
    assert load_dataset(folder).view_count == 1


def test_lost_sources_come_back(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder) as session:
        session.take()
        rig.at, rig.camera_error = 1, "unplugged"
        with pytest.raises(SourceLostError, match="unplugged"):
            session.look()
        with pytest.raises(SourceLostError, match="unplugged"):
            session.take()
        assert session.troubles == ("camera: unplugged",)
        rig.camera_error, rig.robot_error = None, "no network"
        wait_until(lambda: looks(session))
        # The picture is shown while the robot is away.
        assert session.last_look.pose is None
        with pytest.raises(SourceLostError, match="no network"):
            session.take()
        rig.robot_error = None
        wait_until(lambda: takes(session))
        assert session.troubles == ()
    assert rig.opened == {"camera": 2, "robot": 2}
    assert load_dataset(folder).view_count == 2


def looks(session):
    try:
        session.look()
    except SourceLostError:
        return False
    return True


def takes(session):
    try:
        session.take()
    except SourceLostError:
        return False
    return True


def test_another_process_goes_on_in_the_same_folder(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder) as session:
        for rig.at in range(3):
            session.take()
        with pytest.raises(BlockingIOError, match="is open in another capture"):
            rig.session(folder)
    with rig.session(folder) as session:
        assert session.view_count == 3
        rig.at = 2
        assert not session.is_new_place()
        rig.at = 3
        assert session.is_new_place()
        assert session.take() == "v4"


def test_motions_are_off_bounded_and_stopped(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    view = Proposal(rig.poses[1], False)
    with rig.session(folder) as session, pytest.raises(MoveRefusedError, match="start with --move"):
        session.move_to(view)
    x = rig.poses[0, 0, 3]
    narrow = everywhere()._replace(lowest=(x - 0.01, -3.0, -3.0), highest=(x + 0.01, 3.0, 3.0))
    with rig.session(folder, motion=narrow) as session:
        with pytest.raises(MoveRefusedError, match=r"at x = .* outside the box"):
            session.move_to(view)
        # A robot that stands outside is not led in along an unknown path.
        rig.at = 1
        with pytest.raises(MoveRefusedError, match="outside the box"):
            session.move_to(Proposal(rig.poses[0], False))
    rig.at = 0
    with rig.session(folder, motion=everywhere()) as session:
        rig.finish.clear()
        failed = []
        mover = threading.Thread(target=lambda: failed.append(refusal(session, view)))
        mover.start()
        assert rig.on_the_way.wait(PATIENCE)
        assert session.is_moving
        session.stop()
        mover.join(PATIENCE)
        assert failed == ["stopped"]
        rig.finish.set()
        # A stop holds until a person allows motions again.
        assert refusal(session, view) == "stopped"
        assert rig.moved_to == []
        session.allow_motion()
        session.move_to(view)
        assert rig.moved_to == [1]


def refusal(session, view):
    try:
        session.move_to(view)
    except MoveRefusedError as error:
        return str(error)
    return None


def test_an_unattended_run_ends_when_the_goal_is_reached(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder, goal=1e-3, motion=everywhere()) as session:
        for rig.at in range(4):
            session.take()
        rig.camera_error = "asleep"
        threading.Timer(0.3, lambda: setattr(rig, "camera_error", None)).start()
        outcome = capture_unattended(session, patience=PATIENCE)
    assert outcome.is_reached
    assert outcome.reason == "stop: 1 mm reached"
    assert outcome.error <= 1e-3
    assert 9 <= outcome.views == load_dataset(folder).view_count <= 11


def test_the_outcome_is_of_all_views(tmp_path, rig, monkeypatch):
    """A view may have been taken while the fit was running that reaches the goal."""
    fit = quick_fit(rig)

    def fit_with_slow_last(data, *arguments):
        time.sleep(0.3 * (data.view_count == 10))
        return fit(data, *arguments)

    monkeypatch.setattr("smartview_jax.capture.session.estimate", fit_with_slow_last)
    with rig.session(new_folder(tmp_path / "data"), goal=1e-3, motion=everywhere()) as session:
        for rig.at in range(9):
            session.take()
        assert session.wait_for_fit(PATIENCE)
        assert session.is_reached
        rig.at = 9
        session.take()
        outcome = capture_unattended(session)
    assert (outcome.views, outcome.error) == (10, pytest.approx(0.9e-3))


def test_an_unattended_run_says_why_it_ends_without_the_goal(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder, motion=everywhere()) as session:
        assert "no more views can be proposed" in capture_unattended(session).reason
        for rig.at in range(4):
            session.take()
        assert capture_unattended(session, 6).reason == (
            "6 views were taken: 1.5 mm reached instead of 0.4 mm; that needs about 34 more views"
        )
        rig.robot_error = "no network"
        lost = capture_unattended(session, patience=0.5)
        assert lost.reason == "nothing for 0.5 s: no network"
        assert not lost.is_reached
        session.stop()
        assert capture_unattended(session).reason == "stopped"


def test_views_that_are_not_enough_for_a_fit_or_an_error_say_so(tmp_path, rig, monkeypatch):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder, first_fit=8) as session:
        for rig.at in range(4):
            session.take()
        reason = capture_unattended(session, 4).reason
    assert reason == "4 views were taken, but none is fitted yet: a fit needs 8"
    unknown = Estimate(4, float("inf"), 0.5, None, ("not determined yet: the camera's z",), ())
    monkeypatch.setattr("smartview_jax.capture.session.estimate", lambda *_: unknown)
    with rig.session(folder) as session:
        reason = capture_unattended(session, 4).reason
    assert reason == (
        "4 views were taken, but the error is not known yet; not determined yet: the camera's z"
    )
    small = unknown._replace(error=3e-4, warnings=())
    monkeypatch.setattr("smartview_jax.capture.session.estimate", lambda *_: small)
    with rig.session(folder) as session:
        reason = capture_unattended(session, 4).reason
    assert reason == (
        "4 views were taken: 0.3 mm reached, but an error is believed only with 4 more views"
    )


def test_the_missing_views_are_counted_by_their_information():
    # Equal views: the error falls with the root of their number, from 1 mm at 10 views.
    errors = [1e-3 * np.sqrt(10.0 / count) for count in (10, 11, 12)]
    found = Estimate(10, errors[0], 0.5, None, (), (), tuple(errors[1:]))
    assert found.missing_views(0.501e-3) == 30
    assert found.missing_views(0.9e-3) == 3
    # Reached, but too few views to be believed, whatever is planned.
    assert found._replace(views=5).missing_views(2e-3) == 3
    assert found._replace(views=5, next_errors=()).missing_views(2e-3) == 3
    # Views that bring nothing; nothing planned.
    assert found._replace(next_errors=(1e-3,)).missing_views(5e-4) is None
    assert found._replace(next_errors=()).missing_views(5e-4) is None


def test_places_that_the_robot_does_not_reach_are_planned_around(tmp_path, rig):
    """All proposals of a plan may be refused: the next plan knows where."""
    folder = new_folder(tmp_path / "data")
    rig.unreachable = {4, 5, 6, 9}
    with rig.session(folder, goal=1e-3, motion=everywhere()) as session:
        for rig.at in range(4):
            session.take()
        assert capture_unattended(session, patience=PATIENCE).reason == "stop: 1 mm reached"
    assert not rig.unreachable & {*rig.moved_to}
    rig.unreachable = set(range(15))
    rig.at = 0
    with rig.session(folder, motion=everywhere()) as session:
        reason = capture_unattended(session, patience=PATIENCE).reason
    assert reason == "no more views can be proposed; out of reach"


def test_a_place_at_which_a_person_stopped_the_robot_is_reached_later(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    with rig.session(folder, goal=1e-3, motion=everywhere()) as session:
        for rig.at in range(4):
            session.take()
        rig.finish.clear()
        reasons = []
        run = threading.Thread(target=lambda: reasons.append(capture_unattended(session).reason))
        run.start()
        assert rig.on_the_way.wait(PATIENCE)
        session.stop()
        run.join(PATIENCE)
        assert reasons == ["stopped"]
        rig.finish.set()
        session.allow_motion()
        capture_unattended(session, patience=PATIENCE)
    # The views that the first plan proposes.
    assert rig.moved_to[:2] == [4, 5]


def test_an_unattended_run_gives_up_where_nothing_is_reached(tmp_path, rig, monkeypatch):
    folder = new_folder(tmp_path / "data")
    rig.unreachable, planned = set(range(15)), quick_fit(rig)
    where = "smartview_jax.capture.session"
    monkeypatch.setattr(f"{where}.estimate", lambda data, o, _: planned(data, o, rig.poses[:2]))
    monkeypatch.setattr(f"{where}.is_near", lambda pose, _: np.zeros(1, bool))
    with rig.session(folder, motion=everywhere()) as session:
        for rig.at in range(4):
            session.take()
        reason = capture_unattended(session, patience=PATIENCE).reason
    assert reason == "20 proposed views failed, the last: out of reach"


def test_a_plan_and_a_fit_may_take_longer_than_a_lost_camera(tmp_path, rig, monkeypatch):
    """A machine that compiles for the first time is not out of order."""
    folder = new_folder(tmp_path / "data")
    fit = quick_fit(rig)

    def slow_fit(*arguments):
        time.sleep(0.6)
        return fit(*arguments)

    monkeypatch.setattr("smartview_jax.capture.session.estimate", slow_fit)
    with rig.session(folder, goal=1e-3, motion=everywhere()) as session:
        monkeypatch.setattr(session, "plan_first", lambda: time.sleep(0.6))
        for rig.at in range(4):
            session.take()
        assert capture_unattended(session, patience=0.5).reason == "stop: 1 mm reached"


def test_a_robot_that_another_program_moves_is_watched(tmp_path, rig):
    """Views are taken wherever it stands still, and not twice at one place."""
    folder = new_folder(tmp_path / "data")
    closing = threading.Event()
    with rig.session(folder) as session:
        run = threading.Thread(target=lambda: capture_unattended(session, closing=closing))
        run.start()
        for rig.at in range(3):
            wait_until(lambda: session.view_count == 1 + rig.at)
        closing.set()
        run.join(PATIENCE)
        assert session.view_count == 3


KILLED = """
import os, signal, sys
sys.path[:0] = sys.argv[2:]
from capture_scene import Rig
rig = Rig()
with rig.session(sys.argv[1]) as session:
    session.listener = lambda text: print(text, flush=True)
    for rig.at in range(15):
        session.take()
"""


def test_nothing_that_was_taken_is_lost_with_the_process(tmp_path, rig):
    folder = new_folder(tmp_path / "data")
    paths = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(folder), *paths],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ},
    )
    said = []
    with process:
        for line in process.stdout:
            said.append(line)
            if len(said) == 2:
                process.kill()
        assert process.wait(PATIENCE) == -9
    taken = sum("taken" in line for line in said)
    # The lock of the killed process is stale.
    with rig.session(folder) as session:
        assert taken >= 2
        assert taken <= session.view_count <= taken + 1
        rig.at = 14
        session.take()
    data = load_dataset(folder)
    count = data.view_count - 1
    expected = [*rig.poses[:count], rig.poses[14]]
    np.testing.assert_allclose(host_matrices(data.base_from_tool), expected, atol=1e-9)
    assert not data.masked_views


def test_an_estimate_states_the_error_and_proposes_views():
    noise = {"pixel_noise": 0.15, "translation_noise": 1e-4, "rotation_noise": 2e-4}
    data = scene_of(1, **noise).data
    options = CaptureOptions(goal=1e-6, lens="radial", motion=everywhere())
    found = estimate(data, options)
    assert found.is_reliable
    assert found.reaches(1.01 * found.error)
    assert not found.reaches(0.99 * found.error)
    assert 5e-5 < found.error < 2e-3
    assert len(found.proposals) == len(found.next_errors) == 4
    assert found.error > found.next_errors[0] > found.next_errors[3]
    assert not any(proposal.is_rough for proposal in found.proposals)
    places = np.array([proposal.base_from_tool for proposal in found.proposals])
    again = estimate(data, options, places).proposals
    for pose in [proposal.base_from_tool for proposal in again]:
        distances = np.linalg.norm(places[:, :3, 3] - pose[:3, 3], axis=1)
        turns = [np.linalg.norm(cv2.Rodrigues(p[:3, :3].T @ pose[:3, :3])[0]) for p in places]
        assert ((distances >= 0.02) | (np.rad2deg(turns) >= 5.0)).all()


def test_a_fit_that_fails_waits_for_more_views():
    data = scene_of(1).data
    unusable = dataclasses.replace(data, visible=data.visible & False)
    found = estimate(unusable, CaptureOptions())
    assert (found.fit, found.proposals, found.error) == (None, (), float("inf"))
    assert found.warnings
    assert not found.reaches(1.0)
