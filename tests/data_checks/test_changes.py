"""A set-up that changes half-way is named by kind, place and size; a good one, weak or not, never.

The poses are made by SciPy's rotations and plain products of matrices.
"""

import dataclasses
import re

import numpy as np
import pytest
from robot_motions import CAMERA_FROM_MOUNT, UNCHANGED, VIEWS, mirrored, moving_alike, transform

from smartview_jax.data_checks import find_change
from smartview_jax.data_checks.changes import _Search
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.staged import fit_staged

FIRST_CHANGED = 8
IDS = [f"v{view}" for view in range(VIEWS)]
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
KNOCK = transform([0.0, 1.5, 0.0], [0.003, 0.0, 0.0])


def motions(seed=0, camera_knock=UNCHANGED, target_push=UNCHANGED, noise=(2e-4, 0.02)):
    """Robot poses and what a camera sees that is knocked, or a target that is pushed, half-way."""
    after = (np.arange(VIEWS) >= FIRST_CHANGED)[:, None, None]
    changes = (np.where(after, change, UNCHANGED) for change in (camera_knock, target_push))
    return tuple(map(as_se3, moving_alike(seed, *changes, noise=noise)))


@pytest.mark.parametrize("moved", ["camera", "target"])
def test_what_was_moved_is_named_with_its_size(moved):
    knocked = {"camera_knock" if moved == "camera" else "target_push": KNOCK}
    report = find_change(*motions(**knocked), EVERY_VIEW)
    change = report.changes[0]
    assert (change.kind, change.first_view) == (moved, FIRST_CHANGED)
    assert np.rad2deg(change.rotation) == pytest.approx(1.5, abs=0.05)
    if moved == "camera":
        at_camera = CAMERA_FROM_MOUNT @ KNOCK @ np.linalg.inv(CAMERA_FROM_MOUNT)
        assert change.translation == pytest.approx(np.linalg.norm(at_camera[:3, 3]), abs=4e-4)


def test_the_words_follow_the_mount():
    report = find_change(*motions(camera_knock=KNOCK), EVERY_VIEW)
    in_hand = report.sentence("eye_in_hand", IDS)
    assert in_hand.startswith(
        "from view v8 on, the views contradict the earlier ones, as if the camera"
    )
    assert "had been moved on the tool (or the controller's tool frame changed)" in in_hand
    assert "base frame" in report.sentence("eye_to_hand", IDS)
    pushed = find_change(*motions(target_push=KNOCK), EVERY_VIEW)
    assert "the target had been moved in the hand" in pushed.sentence("eye_to_hand", IDS)


@pytest.mark.parametrize("turns", [1, 2])
def test_pictures_that_are_turned_from_a_view_on_are_no_moved_camera(turns):
    """A program that reads a picture's orientation, or a viewer, turned the later half."""
    robot, camera = motions()
    seen = host_matrices(camera).copy()
    seen[FIRST_CHANGED:] = transform([0.0, 0.0, 90.0 * turns], [0.0] * 3) @ seen[FIRST_CHANGED:]
    sentence = find_change(robot, as_se3(seen), EVERY_VIEW).sentence("eye_in_hand", IDS)
    by = f"{90 * turns}|{360 - 90 * turns}"
    assert re.search(
        f"from view v8 on.* as if the pictures had been turned by ({by}) deg", sentence
    )
    assert sentence.endswith("Turn them back")


@pytest.mark.parametrize("axis", [0, 1])
def test_pictures_that_are_mirrored_from_a_view_on_are_no_moved_camera(axis):
    robot, camera = motions()
    seen = host_matrices(camera).copy()
    seen[FIRST_CHANGED:] = mirrored(seen[FIRST_CHANGED:], axis)
    report = find_change(robot, as_se3(seen), EVERY_VIEW)
    assert [(change.kind, change.first_view) for change in report.changes] == [
        ("mirror", FIRST_CHANGED)
    ]
    assert report.contradicts
    assert report.sentence("eye_in_hand", IDS).endswith("Mirror them back")


@pytest.mark.parametrize("noise", [(2e-4, 0.02), (5e-3, 0.5)])
def test_a_zoom_is_named_with_its_size(noise):
    """The depth is too small by the zoom: the pictures are larger than the focal length says."""
    robot, camera = motions(noise=noise)
    seen = host_matrices(camera).copy()
    seen[FIRST_CHANGED:, 2, 3] /= 1.05
    report = find_change(robot, as_se3(seen), EVERY_VIEW)
    zoom = next(change for change in report.changes if change.kind == "zoom")
    assert zoom.first_view == FIRST_CHANGED
    assert zoom.zoom == pytest.approx(1.05, abs=0.01)
    assert f"the lens had zoomed by +{100.0 * zoom.zoom - 100.0:.1f} %" in report.sentence(
        "eye_in_hand", IDS
    )


def test_depths_that_fit_nothing_are_no_zoom():
    """Half of the depths are negative: no lens does that."""
    robot, camera = motions()
    seen = host_matrices(camera).copy()
    seen[FIRST_CHANGED:, 2, 3] *= -1.0
    report = find_change(robot, as_se3(seen), EVERY_VIEW)
    assert report is None or all(change.kind != "zoom" for change in report.changes)


def test_a_camera_pushed_along_its_axis_is_no_zoom():
    push = transform([0, 0, 0], 0.02 * CAMERA_FROM_MOUNT[2, :3])
    report = find_change(*motions(camera_knock=push), EVERY_VIEW)
    assert [change.kind for change in report.changes] == ["camera"]


@pytest.mark.parametrize("noise", [(1e-5, 1e-3), (2e-4, 0.02), (5e-3, 1.0)])
def test_errors_in_single_views_are_no_change(noise):
    for seed in range(6):
        assert find_change(*motions(seed, noise=noise), EVERY_VIEW) is None


def test_where_none_is_likely_to_first_order_no_change_is_fitted(monkeypatch):
    """It would cost as much as all other checks; and where one is likely, no answer differs."""
    weak, knocked = motions(noise=(1e-3, 0.2)), motions(camera_knock=KNOCK)
    fitted, changes = [], _Search.changes
    monkeypatch.setattr(_Search, "changes", lambda *given: fitted.append(given) or changes(*given))
    assert find_change(*weak, EVERY_VIEW) is None
    assert not fitted
    named = find_change(*knocked, EVERY_VIEW)
    monkeypatch.setattr(_Search, "promising", lambda search, places, options: places)
    assert find_change(*knocked, EVERY_VIEW) == named


def test_another_size_of_the_target_hides_no_change():
    robot, camera = motions(camera_knock=KNOCK)
    larger = host_matrices(robot).copy()
    larger[:, :3, 3] /= 1.3
    with_size, with_both = (
        find_change(as_se3(larger), camera, EVERY_VIEW, length_ratio=ratio) for ratio in (1.0, 1.3)
    )
    for report in (with_size, with_both):
        assert report.changes[0].first_view == FIRST_CHANGED
    assert with_both.explains_most
    assert not with_size.explains_most


@pytest.mark.parametrize(("hand", "views"), [("mount", 40), ("holder", 24)])
def test_a_knock_below_the_noise_of_a_view_is_named_in_many_views(hand, views):
    """It moves the camera by 5 mm; the noise in a view is 1.7 mm and 0.35 degrees long.

    Next to the arm, where the hand holds the target, the camera is a metre away from the noise.
    """
    noise = (1e-3, 0.2)
    first, every_view = views // 2, np.ones(views, dtype=bool)
    knock = np.stack([transform([0, 0, 0], [5e-3 * (k >= first), 0, 0]) for k in range(views)])
    for seed in range(3):
        robot, camera = moving_alike(seed, noise=noise, views=views, errs_at=hand)
        knocked = as_se3(knock @ camera)
        assert find_change(as_se3(robot), as_se3(camera), every_view) is None
        change = find_change(as_se3(robot), knocked, every_view).changes[0]
        assert change.kind == "camera"
        assert abs(change.first_view - first) <= 1
        assert change.translation == pytest.approx(5e-3, abs=1.5e-3)


def test_few_views_and_unused_ones_say_nothing():
    robot, camera = motions(camera_knock=KNOCK)
    for used, is_seen in ((slice(4, 11), False), (slice(4, 12), True)):
        mask = np.zeros(VIEWS, dtype=bool)
        mask[used] = True
        assert (find_change(robot, camera, mask) is not None) == is_seen


def test_the_staged_fit_refuses_data_with_another_base_frame_from_a_view_on(scene):
    poses = host_matrices(scene.data.base_from_tool).copy()
    poses[4:] = transform([0.0, 0.0, 20.0], [0.1, 0.0, 0.0]) @ poses[4:]
    data = dataclasses.replace(scene.data, base_from_tool=as_se3(poses))
    with pytest.raises(
        ValueError, match=r"from view 4 on, .* as if the target had been moved \(or the c"
    ):
        fit_staged(data)


@pytest.mark.parametrize("knocked", ["camera_knock", "target_push"])
def test_the_controllers_choice_of_tool_and_base_changes_nothing(knocked):
    """A tool frame far from the camera turns small rotations into large translations."""
    robot, camera = motions(**{knocked: KNOCK}, noise=(2e-3, 0.2))
    base, tool = (
        transform([20.0, -30.0, 50.0], [0.3, -0.9, 0.4]),
        transform([5.0, 40.0, 9.0], [2.0] * 3),
    )
    renamed = as_se3(tool @ host_matrices(robot) @ base)
    expected, report = (find_change(poses, camera, EVERY_VIEW) for poses in (robot, renamed))
    assert [change.kind for change in report.changes] == [
        change.kind for change in expected.changes
    ]
    np.testing.assert_allclose(report.score, expected.score, rtol=1e-3)
    np.testing.assert_allclose(
        [report.changes[0].evidence, report.changes[0].translation],
        [expected.changes[0].evidence, expected.changes[0].translation],
        rtol=1e-2,
    )
