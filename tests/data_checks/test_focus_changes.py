"""A focal length that changes from view to view is told from a robot that errs.

Depths are scaled by hand; the noise of a distance is compared with OpenCV's poses.
"""

import cv2
import numpy as np
import pytest
from robot_motions import VIEWS, moving_alike, transform
from scipy.optimize import minimize

from smartview_jax.data_checks import SeenDistances
from smartview_jax.data_checks.focus_changes import _Positions, find_focus_change
from smartview_jax.geometry import as_se3

MIDDLE = np.array([0.1, 0.07, 0.0])


def found(robot, camera, noise=1e-4, mount="eye_in_hand"):
    seen, used = SeenDistances(MIDDLE, np.full(len(robot), noise)), np.ones(len(robot), dtype=bool)
    return find_focus_change(as_se3(robot), as_se3(camera), used, seen, mount)


def with_focal_lengths(camera, relative):
    """Poses that a camera with one focal length finds where it had others."""
    moved = camera.copy()
    moved[:, 2, 3] -= (relative - 1.0) * depths(camera)
    return moved


def depths(camera):
    return camera[:, 2, :3] @ MIDDLE + camera[:, 2, 3]


@pytest.mark.parametrize("seed", range(3))
def test_changes_of_the_focal_length_are_named_with_their_size(seed):
    robot, camera = moving_alike(seed)
    assert (depths(camera) > 0.0).all()
    changes = np.random.default_rng(seed).normal(0.0, 0.006, VIEWS)
    change = found(robot, with_focal_lengths(camera, 1.0 + changes))
    assert change.relative_std == pytest.approx(0.006, rel=0.5)
    assert change.across < 1e-3
    assert "focal length seems to change" in change.sentence([])


def test_a_focal_length_that_follows_the_distance_is_named():
    robot, camera = moving_alike(1)
    distance = depths(camera)
    change = found(robot, with_focal_lengths(camera, 1.0 + 0.1 * (distance - distance.mean())))
    # The size and the common focal length explain a part.
    assert 0.1 < change.relative_std / (0.1 * distance.std()) < 1.0


@pytest.mark.parametrize("ratios", [{4: 1.25}, {0: 0.97}, {3: 1.1, 9: 0.9}])
def test_single_pictures_with_another_focal_length_are_named(ratios):
    robot, camera = moving_alike(3)
    zoomed = camera.copy()
    for view, ratio in ratios.items():
        zoomed[view, 2, 3] += (1.0 / ratio - 1.0) * depths(camera)[view]
    change = found(robot, zoomed)
    assert change.views == tuple(ratios)
    np.testing.assert_allclose(change.ratios, list(ratios.values()), atol=0.005)
    assert change.across < 1e-3
    (first, *_), named = ratios, change.sentence([f"n{k}" for k in range(VIEWS)])
    assert f"n{first} ({100.0 * (change.ratios[0] - 1.0):+.2g} %)" in named
    assert "Switch autofocus off" not in named


def test_single_pictures_near_the_end_are_no_change_of_all_later_ones():
    """A change before them explains most of the errors, too, but the last view contradicts it."""
    robot, camera = moving_alike(3, noise=(2e-3, 0.2), views=24)
    zoomed, single = camera.copy(), [20, 21, 22]
    zoomed[single, 2, 3] += (1.0 / 1.1 - 1.0) * depths(camera)[single]
    assert found(robot, zoomed).views == (20, 21, 22)


@pytest.mark.parametrize(("first", "ratio"), [(4, 1.05), (7, 0.97), (VIEWS - 4, 1.02)])
def test_a_focal_length_that_changed_once_is_told_from_which_view_on(first, ratio):
    robot, camera = moving_alike(2)
    zoomed = camera.copy()
    zoomed[first:, 2, 3] += (1.0 / ratio - 1.0) * depths(camera)[first:]
    change = found(robot, zoomed)
    assert change.is_once
    assert change.views == (first,)
    assert change.ratios[0] == pytest.approx(ratio, abs=0.005)
    named = change.sentence([f"n{k}" for k in range(VIEWS)])
    assert named.startswith(f"from view n{first} on, the focal length")
    assert f"({100.0 * (change.ratios[0] - 1.0):+.2g} %)" in named


@pytest.mark.parametrize("noise", [(2e-4, 0.02), (2e-3, 0.2)])
def test_a_robot_that_errs_alike_in_all_directions_is_left_in_peace(noise):
    assert all(found(*moving_alike(seed, noise=noise)) is None for seed in range(4))


def looking_down(seed, lift=0.0, along=0.0, noise=2e-4):
    """Poses of a camera that looks down on the target, m and rad.

    Args:
        seed: of NumPy's generator.
        lift: error of the robot along the base's z axis.
        along: error of the camera's pose along its own axis.
        noise: error of the robot in any direction.
    """
    rng = np.random.default_rng(seed)
    poses = np.empty((2, VIEWS, 4, 4))
    for view in range(VIEWS):
        true = transform(rng.normal(0.0, 12.0, 3), rng.normal(0.0, 0.1, 3))
        error = transform(np.zeros(3), rng.normal(0.0, [noise, noise, np.hypot(noise, lift)]))
        camera = transform([0, 0, 95], [0.02, 0.05, -0.1]) @ true
        camera = camera @ transform([180, 0, 30], [0.4, 0.1, 0.6])
        camera[2, 3] += rng.normal(0.0, along)
        poses[:, view] = true @ error, camera
    return poses


def test_a_robot_that_errs_along_an_axis_of_its_base_is_left_in_peace():
    for seed in range(4):
        assert found(*looking_down(seed, lift=5e-3)) is None
        assert found(*looking_down(seed, along=5e-3)) is not None


def test_a_lift_below_a_camera_that_hangs_over_the_arm_is_left_in_peace():
    """The base does not turn before the camera; the axes of the hand do."""
    down = transform([180.0, 0.0, 0.0], [0.0, 0.0, 0.8])
    for seed in range(4):
        rng = np.random.default_rng(seed)
        robot, camera = np.empty((2, VIEWS, 4, 4))
        for view in range(VIEWS):
            robot[view] = transform(rng.normal(0.0, 12.0, 3), rng.normal(0.0, 0.1, 3))
            true = transform([0, 0, 0], rng.normal(0.0, [2e-4, 2e-4, 5e-3])) @ robot[view]
            camera[view] = down @ true @ transform([180, 0, 30], [0.02, 0.05, 0.1])
        assert found(robot, camera, mount="eye_to_hand") is None


def test_the_likeliest_errors_are_those_that_scipy_finds():
    rng = np.random.default_rng(0)
    columns, vectors = rng.normal(size=(VIEWS, 3, 4)), rng.normal(size=(VIEWS, 3))
    noise = 0.3 * rng.normal(size=(VIEWS, 3))
    positions = columns @ rng.normal(size=4) + noise * rng.normal(size=(VIEWS, 1))
    positions += 0.8 * vectors * rng.normal(size=(VIEWS, 1)) + 0.2 * rng.normal(size=(VIEWS, 3))

    def deviance(unknowns):
        """By the density of the normal distribution."""
        alike, along = np.exp(2.0 * unknowns[:2])
        covariance = alike * np.eye(3) + along * vectors[:, :, None] * vectors[:, None]
        covariance = covariance + noise[:, :, None] * noise[:, None]
        errors = positions - columns @ unknowns[2:]
        scaled = np.linalg.solve(covariance, errors[..., None])[..., 0]
        return np.sum(errors * scaled) + np.linalg.slogdet(covariance)[1].sum()

    expected = minimize(deviance, np.array([-1.0, -1.0, 0.0, 0.0, 0.0, 0.0]))
    products = noise[:, :, None] * noise[:, None]
    found = _Positions.of(columns, positions, products).likelihood(vectors)
    np.testing.assert_allclose([found.sigma, found.size], np.exp(expected.x[:2]), rtol=1e-3)
    assert found.deviance == pytest.approx(expected.fun, abs=1e-4)


@pytest.mark.parametrize("groups", [np.eye(VIEWS, dtype=bool), np.tri(VIEWS, dtype=bool)[:-1]])
def test_the_group_that_explains_most_is_found_as_by_trying_all(groups):
    rng = np.random.default_rng(0)
    columns, vectors = rng.normal(size=(VIEWS, 3, 4)), rng.normal(size=(VIEWS, 3))
    errors = _Positions.of(columns, rng.normal(size=(VIEWS, 3)), np.zeros((VIEWS, 3, 3)))
    chosen = list[int]()
    for _ in range(3):
        given = errors.with_free_groups(vectors, groups[chosen])
        tried = [groups[[*chosen, k]] for k in range(len(groups))]
        sigmas = [errors.with_free_groups(vectors, groups).sigma for groups in tried]
        best, left_over = given.most_explaining(vectors, groups)
        assert best == np.argmin(sigmas)
        assert left_over == pytest.approx((sigmas[best] / given.sigma) ** 2)
        chosen.append(best)


def test_many_pictures_that_all_have_another_focal_length_are_not_tried_one_by_one(monkeypatch):
    tried = []
    of_views = _Positions.with_free_groups
    monkeypatch.setattr(
        _Positions, "with_free_groups", lambda *given: tried.append(given) or of_views(*given)
    )
    robot, camera = moving_alike(0, views=80)
    changes = np.random.default_rng(0).normal(0.0, 0.006, len(robot))
    assert found(robot, with_focal_lengths(camera, 1.0 + changes)).views == ()
    assert len(tried) < 8


def test_poses_without_noise_are_judged_as_well():
    assert found(*looking_down(0, lift=5e-3, noise=0.0), noise=1e-12) is None


@pytest.mark.parametrize("seed", range(3))
def test_two_exchanged_pictures_are_no_change_of_the_focus_and_hide_none(seed):
    robot, camera = moving_alike(seed)
    exchanged = np.arange(VIEWS)
    exchanged[[2, 5]] = 5, 2
    assert found(robot, camera[exchanged]) is None
    changes = np.random.default_rng(seed).normal(0.0, 0.006, VIEWS)
    changed = with_focal_lengths(camera, 1.0 + changes)[exchanged]
    assert found(robot, changed).relative_std == pytest.approx(0.006, rel=0.5)


def test_a_small_target_tells_its_distance_badly():
    robot, camera = moving_alike(2, noise=(5e-5, 0.005))
    noisy = with_focal_lengths(camera, 1.0 + np.random.default_rng(0).normal(0.0, 0.004, VIEWS))
    assert found(robot, noisy, noise=1e-4) is not None
    assert found(robot, noisy, noise=4e-3) is None


def test_the_noise_of_a_distance_is_the_scatter_of_opencvs_poses():
    rng, sigma = np.random.default_rng(3), 0.2
    points = np.array([[x, y, 0.0] for y in np.arange(5) * 0.03 for x in np.arange(7) * 0.03])
    matrix = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])
    pixels = cv2.projectPoints(points, np.zeros(3), np.array([-0.1, -0.06, 0.5]), matrix, None)[0]
    pixels = pixels.reshape(1, -1, 2)
    visible = np.ones((1, len(points)), dtype=bool)
    seen = SeenDistances.of_points(points[None], pixels, visible, sigma)
    distances = []
    for _ in range(300):
        noisy = pixels[0] + rng.normal(0.0, sigma, pixels[0].shape)
        _, turn, place = cv2.solvePnP(points, noisy, matrix, None)
        distances.append((cv2.Rodrigues(turn)[0] @ points.mean(axis=0) + place.ravel())[2])
    # 300 draws tell a standard deviation to 4 %; the tilt costs some accuracy.
    assert np.std(distances) / 0.5 == pytest.approx(float(seen.noise[0]), rel=0.3)


def test_few_views_tell_nothing():
    robot, camera = moving_alike(0)
    changed = with_focal_lengths(camera, 1.0 + np.random.default_rng(0).normal(0.0, 0.01, VIEWS))
    assert found(robot[:7], changed[:7]) is None


def test_views_that_are_hardly_turned_tell_no_change_of_focus():
    """Their tilts are seen wrongly, about the middle of the target."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        robot, camera = np.empty((2, VIEWS, 4, 4))
        for view in range(VIEWS):
            robot[view] = transform(rng.normal(0.0, 2.0, 3), rng.normal(0.0, 0.1, 3))
            camera[view] = transform([0, 0, 95], [0.02, 0.05, -0.1]) @ robot[view]
            camera[view] = camera[view] @ transform([180, 0, 30], [0.4, 0.1, 0.6])
            middle = camera[view, :3, :3] @ MIDDLE + camera[view, :3, 3]
            tilt = transform([*rng.normal(0.0, 0.5, 2), 0], [0, 0, 0])[:3, :3]
            camera[view, :3, :3] = tilt @ camera[view, :3, :3]
            camera[view, :3, 3] = middle - camera[view, :3, :3] @ MIDDLE
        assert found(robot, camera) is None


def test_a_focal_length_that_is_wrong_in_all_views_alike_is_no_change():
    for seed in range(4):
        robot, camera = looking_down(seed)
        assert found(robot, with_focal_lengths(camera, np.full(VIEWS, 0.8))) is None


def test_the_bound_that_ends_the_search_early_changes_no_answer(monkeypatch):
    sizes, seeds = (0.0, 1e-3, 1.5e-3, 2e-3, 4e-3), range(4)
    scenes = []
    for seed in seeds:
        robot, camera = moving_alike(seed)
        changes = np.random.default_rng(seed).normal(size=VIEWS)
        scenes += [(robot, with_focal_lengths(camera, 1.0 + size * changes)) for size in sizes]
    answers = [found(*scene) for scene in scenes]
    assert None in answers
    assert any(answers)
    bound = "smartview_jax.data_checks.focus_changes._Positions.least_deviance"
    monkeypatch.setattr(bound, lambda *_: -np.inf)
    assert answers == [found(*scene) for scene in scenes]
