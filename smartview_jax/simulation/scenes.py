"""Simulated calibrations with known truth: viewpoints, pixel noise, robot noise, outliers."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Bool

from ..calibration import Calibration
from ..cameras import Camera, Radial
from ..dataset import Dataset
from ..geometry import PoseLike, as_se3, direction_of
from ..geometry import look_at as look_along


class Scene(eqx.Module):
    """What was simulated, and the truth behind it.

    Attributes:
        data: what an experiment would have given: noisy pixels, reported poses.
        calibration: the true one.
        base_from_tool: the true robot poses.
        outliers: the observations that were replaced by gross errors.
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
    """Observe `points` from true robot poses, with errors of known size.

    Args:
        calibration: the truth.
        base_from_tool: `(views)` true robot poses.
        points: `(N, 3)` or `(views, N, 3)` target points, m.
        seed: of numpy's generator; the same seed gives the same scene.
        pixel_noise: standard deviation of `u` and of `v`, px.
        translation_noise, rotation_noise: standard deviations, per axis at the tool, of the
            correction in `tool_from_base = exp(correction) @ reported`; m and rad.
        outlier_fraction: share of observations moved by 5 to 50 px.

    Returns:
        A scene in which points behind the camera or outside the picture are not visible.
    """
    rng = np.random.default_rng(seed)
    true_pose = as_se3(base_from_tool)
    predicted, valid = calibration.project(true_pose, points)
    pixels = np.array(predicted) + pixel_noise * rng.standard_normal(predicted.shape)
    outliers = rng.random(valid.shape) < outlier_fraction
    angle = rng.uniform(0.0, 2.0 * np.pi, valid.shape)
    jump = rng.uniform(5.0, 50.0, valid.shape)
    shift = jump[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels = pixels + outliers[..., None] * shift

    size = np.array(calibration.camera.image_size)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0.0) & (pixels <= size - 1.0)).all(axis=-1)
    visible = np.asarray(valid) & inside
    data = Dataset.from_arrays(
        points,
        np.where(visible[..., None], pixels, np.nan),
        reported_poses(true_pose, rng, translation_noise, rotation_noise),
        image_size=calibration.camera.image_size,
        mount=calibration.mount,
    )
    return Scene(data, calibration, true_pose, jnp.asarray(outliers & visible))


def reported_poses(
    base_from_tool: SE3, rng: np.random.Generator, translation_noise: float, rotation_noise: float
) -> SE3:
    """What a robot says of true poses `(views)`; noise as in `simulate`."""
    deviations = np.repeat([translation_noise, rotation_noise], 3)
    corrections = deviations * rng.standard_normal((len(base_from_tool.wxyz_xyz), 6))
    return base_from_tool @ SE3.exp(jnp.asarray(corrections))


def look_at(
    target: np.ndarray,
    distance: float | np.ndarray,
    tilt: float | np.ndarray,
    azimuth: float | np.ndarray,
    roll: float | np.ndarray = 0.0,
) -> SE3:
    """`camera_from_world` of cameras that look at a point of the world from above (world +z).

    Args:
        target: `(3,)` the point on the optical axis, m.
        distance: from the camera to it, m.
        tilt: angle between the viewing direction and the world's z axis, rad.
        azimuth: direction of the tilt about the world's z axis, from x, rad.
        roll: rotation about the optical axis, rad; zero as in `geometry.look_at`.

    Returns:
        Transforms with the broadcast shape of the four numbers.
    """
    return look_along(np.asarray(target), direction_of(tilt, azimuth), distance, roll)


def views_around(
    rng: np.random.Generator,
    count: int,
    target: np.ndarray,
    distance: tuple[float, float],
    tilt: float,
    roll: float = np.pi,
) -> SE3:
    """Random `camera_from_world`, `(count)`, that look at a point.

    Tilt is uniform up to `tilt`, azimuth any, roll uniform within `+-roll`; rad and m.
    """
    return look_at(
        target,
        rng.uniform(*distance, count),
        rng.uniform(0.0, tilt, count),
        rng.uniform(0.0, 2.0 * np.pi, count),
        rng.uniform(-roll, roll, count),
    )


def paper_calibration() -> Calibration:
    """A true calibration like the paper's: 1/3 inch CCD, 16 mm lens, radial distortion."""
    camera = Camera(2133.0, 2133.0, 322.0, 238.0, Radial(0.3), image_size=(640, 480))
    camera_from_tool = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.03, -0.05, 0.1), jnp.array([-0.02, 0.06, -0.09])
    )
    base_from_world = SE3.from_rotation_and_translation(
        SO3.from_rpy_radians(0.01, -0.02, 0.15), jnp.array([0.45, -0.12, 0.05])
    )
    return Calibration.eye_in_hand(camera, camera_from_tool, base_from_world)


def paper_points(heights: tuple[float, ...] = (0.0, 0.005, 0.01, 0.015, 0.02)) -> np.ndarray:
    """`(7 * 6 * heights, 3)` circle centres of a board, 6 mm apart, at several heights z, m."""
    x, y, z = np.meshgrid(0.006 * np.arange(7), 0.006 * np.arange(6), heights, indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def random_scene(
    seed: int = 0,
    views: int = 15,
    points: np.ndarray | None = None,
    calibration: Calibration | None = None,
    tilt: float = np.deg2rad(35.0),
    distance: tuple[float, float] = (0.17, 0.25),
    pixel_noise: float = 0.15,
    translation_noise: float = 0.0,
    rotation_noise: float = 0.0,
    outlier_fraction: float = 0.0,
) -> Scene:
    """Random views of a target, by default the paper's camera over its board at two heights."""
    truth = paper_calibration() if calibration is None else calibration
    target = paper_points((0.0, 0.02)) if points is None else points
    rng = np.random.default_rng((seed, 1))
    camera_from_world = views_around(rng, views, target.mean(axis=0), distance, tilt)
    return simulate(
        truth,
        truth.command_for(camera_from_world),
        target,
        seed=seed,
        pixel_noise=pixel_noise,
        translation_noise=translation_noise,
        rotation_noise=rotation_noise,
        outlier_fraction=outlier_fraction,
    )
