"""A camera or a target that creeps from view to view is named with its size; good sets never are.

The poses are made by SciPy's rotations and plain products of matrices.
"""

import dataclasses

import numpy as np
import pytest
from fit_scenes import MANY_VIEWS, scene_of
from robot_motions import CAMERA_FROM_MOUNT, HOLDER_FROM_WORLD, VIEWS, moving_alike, transform
from scipy.spatial.transform import Rotation

from smartview_jax.data_checks import find_drift
from smartview_jax.geometry import as_se3, host_matrices
from smartview_jax.staged import fit_staged

IDS = [f"v{view}" for view in range(VIEWS)]
EVERY_VIEW = np.ones(VIEWS, dtype=bool)
STEADY = np.tile(np.eye(4), (VIEWS, 1, 1))


def creeping(turn, shift):
    """A motion that grows evenly from the first view to the last, to these degrees and metres."""
    parts = np.linspace(0.0, 1.0, VIEWS)
    return np.array([transform(s * np.array(turn), s * np.array(shift)) for s in parts])


def found(camera=STEADY, target=STEADY, used=EVERY_VIEW, seed=0, **options):
    motions = moving_alike(seed, camera, target, **options)
    return find_drift(*map(as_se3, motions), used)


@pytest.mark.parametrize("kind", ["camera", "target"])
@pytest.mark.parametrize("seed", range(4))
def test_what_creeps_is_named_with_its_size(kind, seed):
    drift = found(**{kind: creeping([0.0, 0.3, 0.0], [0.002, 0.0, -0.002])}, seed=seed)
    assert drift.kind == kind
    assert 1e3 * drift.translation == pytest.approx(np.hypot(2.0, 2.0), abs=0.7)
    assert np.rad2deg(drift.rotation) == pytest.approx(0.3, abs=0.06)
    assert drift.score < 0.6 * drift.given_score
    words = drift.sentence("eye_in_hand", IDS)
    place = "on the tool" if kind == "camera" else "on the table"
    assert f"as if the {kind} crept {place} by" in words
    assert "from view v0 to view v13" in words


def test_the_drift_is_over_the_time_of_all_views_also_of_those_left_out():
    used = EVERY_VIEW.copy()
    used[[3, 4, 5]] = False
    whole = found(creeping([0.0, 0.0, 0.0], [0.003, 0.0, 0.0]))
    part = found(creeping([0.0, 0.0, 0.0], [0.003, 0.0, 0.0]), used=used)
    assert part.translation == pytest.approx(whole.translation, rel=0.1)


def test_the_views_between_which_it_crept_are_named():
    used = EVERY_VIEW.copy()
    used[[0, VIEWS - 1]] = False
    drift = found(creeping([0.0, 0.0, 0.0], [0.003, 0.0, 0.0]), used=used)
    assert drift.views == (1, VIEWS - 2)
    assert "from view v1 to view v12" in drift.sentence("eye_in_hand", IDS)
    assert drift.translation == pytest.approx(0.003 * (VIEWS - 3) / (VIEWS - 1), rel=0.2)


@pytest.mark.parametrize("noise", [(1e-5, 1e-3), (2e-4, 0.02), (2e-3, 0.2)])
def test_white_errors_are_no_drift(noise):
    for seed in range(10):
        assert found(seed=seed, noise=noise) is None


def test_the_robots_errors_along_a_path_are_no_drift():
    """Its errors are alike in poses near each other, and the views follow a path.

    Taken for white noise they look like a drift in 13 of the 20 draws.
    """
    named = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        time = np.linspace(0.0, 1.0, VIEWS)[:, None]
        path = 0.15 * np.hstack([np.sin(3.0 * time), np.cos(3.0 * time), time])
        path += rng.normal(0.0, 0.01, path.shape)
        turns = np.hstack([20.0 * np.sin(4.0 * time), 15.0 * np.cos(5.0 * time), 40.0 * time])
        turns += rng.normal(0.0, 2.0, turns.shape)
        robot = np.array(list(map(transform, turns, path)))
        waves, phases = rng.normal(size=(6, 3)), rng.uniform(0.0, 2.0 * np.pi, 6)
        sizes = 5e-4 * np.array([1.0, 1.0, 1.0, 0.2, 0.2, 0.2])
        errors = np.sin(8.0 * path @ waves.T + phases) * sizes
        errors += rng.normal(0.0, 0.1, errors.shape) * sizes
        erring = np.array([transform(np.rad2deg(e[3:]), e[:3]) for e in errors])
        seen = CAMERA_FROM_MOUNT @ erring @ robot @ HOLDER_FROM_WORLD
        drift = find_drift(as_se3(robot), as_se3(seen), EVERY_VIEW)
        named += drift is not None
    assert named <= 5


def test_few_views_tell_no_drift():
    used = EVERY_VIEW.copy()
    used[9:] = False
    assert found(creeping([0.0, 0.0, 0.0], [0.003, 0.0, 0.0]), used=used) is None


def test_no_drift_is_named_at_a_missing_pose():
    motions = list(moving_alike(0))
    motions[1][2] = np.nan
    assert find_drift(*map(as_se3, motions), EVERY_VIEW) is None


def test_the_size_is_that_of_the_motion_in_the_pictures():
    """Against plain arithmetic: the last camera pose, taken back to the first mount."""
    camera = creeping([0.0, 0.0, 1.0], [0.0, 0.004, 0.0])
    drift = found(camera, noise=(1e-6, 1e-4))
    last = camera[-1]
    assert drift.rotation == pytest.approx(Rotation.from_matrix(last[:3, :3]).magnitude(), rel=0.02)
    assert drift.translation == pytest.approx(np.linalg.norm(last[:3, 3]), rel=0.05)


@pytest.mark.parametrize("size", [0.003, 0.03])
def test_the_staged_fit_names_a_base_frame_that_creeps(size):
    """In words where the calibration is little wrong, as an error where it is useless."""
    data = scene_of(0, MANY_VIEWS, translation_noise=1e-4, rotation_noise=1e-4).data
    parts = np.linspace(0.0, 1.0, MANY_VIEWS)
    steps = np.array([transform([0.0, 0.0, 0.0], [size * part, 0.0, 0.0]) for part in parts])
    poses = as_se3(steps @ host_matrices(data.base_from_tool))
    crept = dataclasses.replace(data, base_from_tool=poses)
    words = "as if the target crept on the table by"
    if size < 0.01:
        assert [text for text in fit_staged(crept).warnings if words in text]
    else:
        with pytest.raises(ValueError, match=words):
            fit_staged(crept)
