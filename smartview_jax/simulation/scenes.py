"""Simulate calibration data with known truth: viewpoints, pixel noise, robot noise, outliers."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool

from ..calibration import Calibration
from ..cameras import Camera, Radial
from ..dataset import Dataset
from ..geometry import PoseLike, as_se3, host_exponentials, host_matrices, viewing_direction
from ..geometry import look_at as look_along
from ..runtime.array_namespace import to_device
from ..targets import AbstractTarget


class Scene(eqx.Module):
    """A simulated data set, together with its true values.

    Attributes:
        data: the data set of the experiment: noisy pixels and reported poses.
        calibration: the true calibration.
        base_from_tool: the true robot poses.
        outliers: whether each observation was replaced by a gross error.
    """

    data: Dataset
    calibration: Calibration
    base_from_tool: SE3
    outliers: Bool[Array, "views points"]


def simulate(
    calibration: Calibration,
    base_from_tool: PoseLike,
    points: np.ndarray,
    seed: int = 0,
    pixel_noise: float = 0.15,
    translation_noise: float = 0.0,
    rotation_noise: float = 0.0,
    outlier_fraction: float = 0.0,
) -> Scene:
    """Simulate observations of `points` from true robot poses, with errors of known size.

    Args:
        calibration: the true calibration.
        base_from_tool: `(views)` true robot poses.
        points: `(N, 3)` or `(views, N, 3)` target points, m.
        seed: seed of numpy's generator; the same seed gives the same scene.
        pixel_noise: standard deviation of `u` and of `v`, px.
        translation_noise, rotation_noise: standard deviations, per axis at the tool, of the
            correction in `tool_from_base = exp(correction) @ reported`; m and rad.
        outlier_fraction: fraction of observations shifted by 5 to 50 px.

    Returns:
        A scene in which points behind the camera or outside the picture are not visible.
    """
    rng = np.random.default_rng(seed)
    actual_poses = as_se3(base_from_tool)
    predicted, valid = calibration.project(actual_poses, points)
    # pixel = projection + N(0, pixel_noise^2), independently in u and v.
    pixels = np.array(predicted) + pixel_noise * rng.standard_normal(predicted.shape)
    # Random numbers are drawn for every observation, visible or not, so that a seed gives the same
    # noise whichever points are visible.
    outliers = rng.random(valid.shape) < outlier_fraction
    # An outlier is shifted by a random distance in a random direction.
    angle = rng.uniform(0.0, 2.0 * np.pi, valid.shape)
    outlier_distance = rng.uniform(5.0, 50.0, valid.shape)
    shift = outlier_distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels = pixels + outliers[..., None] * shift

    size = np.array(calibration.camera.image_size)
    # Points that cannot be projected are NaN; comparisons with NaN are false.
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0.0) & (pixels <= size - 1.0)).all(axis=-1)
    visible = np.asarray(valid) & inside
    data = Dataset.from_arrays(
        points,
        np.where(visible[..., None], pixels, np.nan),
        reported_poses(actual_poses, rng, translation_noise, rotation_noise),
        image_size=calibration.camera.image_size,
        mount=calibration.mount,
    )
    return Scene(data, calibration, actual_poses, to_device(outliers & visible))


def reported_poses(
    base_from_tool: SE3, rng: np.random.Generator, translation_noise: float, rotation_noise: float
) -> SE3:
    """Return a robot's reports of true poses `(views)`, with the noise described in `simulate`."""
    # In terms of tool_from_base, true = exp(correction) reported; inverted, base_from_tool has
    # reported = true exp(correction).
    sigmas = np.repeat([translation_noise, rotation_noise], 3)
    twists = sigmas * rng.standard_normal((len(base_from_tool.wxyz_xyz), 6))
    return as_se3(host_matrices(base_from_tool) @ host_exponentials(twists))


def look_at_from_above(
    point: np.ndarray,
    distance: float | np.ndarray,
    tilt: float | np.ndarray,
    azimuth: float | np.ndarray,
    roll: float | np.ndarray = 0.0,
) -> SE3:
    """Return `camera_from_world` of cameras that look at a world point from above (world +z).

    Args:
        point: `(3,)` point on the optical axis, m.
        distance: distance from the camera to that point, m.
        tilt: angle between the viewing direction and the world's z axis, rad.
        azimuth: direction of the tilt about the world's z axis, from x, rad.
        roll: rotation about the optical axis, rad; zero as in `geometry.look_at`.

    Returns:
        Transforms with the broadcast shape of the four numbers.
    """
    return look_along(np.asarray(point), viewing_direction(tilt, azimuth), distance, roll)


def random_viewpoints(
    rng: np.random.Generator,
    count: int,
    point: np.ndarray,
    distance: tuple[float, float],
    tilt: float,
    roll: float = np.pi,
) -> SE3:
    """Return random `camera_from_world`, `(count)`, that look at a point.

    Tilt is uniform between 0 and `tilt`, azimuth uniform over the circle, roll uniform within
    `+-roll`, all in rad; distance is uniform within its limits, m.
    """
    return look_at_from_above(
        point,
        rng.uniform(*distance, count),
        rng.uniform(0.0, tilt, count),
        rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(-roll, roll, count),
    )


def paper_calibration() -> Calibration:
    """Return a true calibration like the paper's: 1/3 inch CCD, 16 mm lens, radial distortion."""
    camera = Camera(2133.0, 2133.0, 322.0, 238.0, Radial(0.3), image_size=(640, 480))
    return calibration_of(camera, 0.45)


def calibration_of(camera: Camera, reach: float) -> Calibration:
    """Return a calibration of a camera on a hand whose target is `reach` (m) before the robot."""
    camera_from_tool = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.03, -0.05, 0.1), jnp.array([-0.02, 0.06, -0.09])
    )
    base_from_world = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.01, -0.02, 0.15), jnp.array([reach, -0.12, 0.05])
    )
    return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)


def paper_points(heights: tuple[float, ...] = (0.0, 0.005, 0.01, 0.015, 0.02)) -> np.ndarray:
    """Return the circle centres, `(7 * 6 * heights, 3)`, of a board at several heights z, m.

    The circles are 6 mm apart.
    """
    x, y, z = np.meshgrid(0.006 * np.arange(7), 0.006 * np.arange(6), heights, indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def random_scene(
    seed: int = 0,
    views: int = 15,
    points: np.ndarray | None = None,
    calibration: Calibration | None = None,
    tilt: float = np.deg2rad(35.0),
    distance: tuple[float, float] = (0.17, 0.25),
    **noise: float,
) -> Scene:
    """Return random views of a target, by default the paper's at two heights.

    The camera is by default the paper's, too.

    Args:
        seed: the same seed gives the same scene.
        points: target points, m.
        tilt: largest tilt of the camera, rad.
        distance: smallest and largest distance from the middle of the target, m.
        noise: as for `simulate`.
    """
    truth = paper_calibration() if calibration is None else calibration
    target_points = paper_points((0.0, 0.02)) if points is None else points
    # A separate generator, so that viewpoints do not depend on the random numbers of the noise.
    rng = np.random.default_rng((seed, 1))
    camera_from_world = random_viewpoints(rng, views, target_points.mean(axis=0), distance, tilt)
    return simulate(truth, truth.command_for(camera_from_world), target_points, seed=seed, **noise)


def random_target_scene(
    seed: int,
    views: int,
    target: AbstractTarget,
    calibration: Calibration | None = None,
    tilt: float = np.deg2rad(35.0),
    distance: tuple[float, float] = (0.17, 0.25),
    **noise: float,
) -> Scene:
    """Return random views of the printed side of a target.

    Args:
        seed: the same seed gives the same scene.
        views: number of views.
        target: the visible target; it is stored in the data set.
        calibration: the true one; by default the paper's.
        tilt: largest tilt of the camera, rad.
        distance: smallest and largest distance from the middle of the target, m.
        noise: as for `simulate`.
    """
    truth = paper_calibration() if calibration is None else calibration
    centre = target.points.mean(axis=0)
    rng = np.random.default_rng((seed, 1))
    camera_from_world = random_viewpoints(rng, views, centre, distance, tilt)
    if not target.y_up:
        # z points into the board, so that its printed side is seen from below: the viewpoints are
        # rotated by half a turn about the target's own x axis.
        turn = np.diag([1.0, -1.0, -1.0, 1.0])
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        camera_from_world = as_se3(host_matrices(camera_from_world) @ turn)
    commands = truth.command_for(camera_from_world)
    scene = simulate(truth, commands, target.points, seed=seed, **noise)
    return dataclasses.replace(scene, data=dataclasses.replace(scene.data, target=target))
