"""Render pictures as a calibrated camera takes them, by ray tracing from pixels to the board.

The only approximation is the sampling of the pixel area. Rays follow the calibrated lens model, so
that a detector's result can be compared with `Calibration.project`.
"""

from pathlib import Path
from typing import Any, TypedDict, Unpack

import cv2
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float, UInt8

from ..calibration import Calibration
from ..cameras import Camera
from ..files import write_atomically
from ..geometry import PoseLike, as_se3, host_matrices
from ..io import write_dataset_folder
from ..runtime.compilation import compiled_optimised
from ..targets import AbstractTarget, StackedTarget
from .patterns import printed_pattern

DARK_LEVEL, LIGHT_LEVEL, BACKGROUND_LEVEL = 40.0, 215.0, 120.0
"""Grey levels of the print, of the paper, and of everything other than the board's front."""

ROWS_PER_BATCH = 64
"""Number of picture rows sampled at once, to limit memory."""


class SensorOptions(TypedDict, total=False):
    """The keyword arguments of `sensor_picture`."""

    blur: float
    noise: float
    exposure: float
    seed: int


def render(
    calibration: Calibration,
    base_from_tool: PoseLike,
    target: AbstractTarget,
    *,
    height_index: int = 0,
    samples: int = 4,
    **sensor: Unpack[SensorOptions],
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the picture of a target from one robot pose.

    Args:
        calibration: camera, mount and pose of the target.
        base_from_tool: the true robot pose, a single one.
        target: target to draw; only its front is visible.
        height_index: index of the height of a `StackedTarget` at which the board is placed.
        samples: number of rays per pixel in each direction.
        sensor: `blur`, `noise`, `exposure` and `seed`, as for `sensor_picture`.
    """
    board, z = target, 0.0
    if isinstance(target, StackedTarget):
        board, z = target.board, target.heights[height_index] * float(calibration.target_scale)
    camera_from_world = calibration.camera_from_world(base_from_tool)
    plane_points, in_front = _sample_plane(
        calibration.camera, camera_from_world, z, target.y_up, samples
    )
    plane_points = plane_points / float(calibration.target_scale)
    # The y axis of a stack points up, but down on most boards.
    y_sign = 1.0 if board.y_up == target.y_up else -1.0
    dark = printed_pattern(board)(
        plane_points[..., 0].ravel(), y_sign * plane_points[..., 1].ravel()
    )
    grey_level = np.where(dark.reshape(in_front.shape), DARK_LEVEL, LIGHT_LEVEL)
    picture = np.where(in_front, grey_level, BACKGROUND_LEVEL)
    width, rows = calibration.camera.image_size
    # The mean over the samples of each pixel is the light that the pixel collects.
    brightness = picture.reshape(rows, samples, width, samples).mean(axis=(1, 3))
    return sensor_picture(brightness, **sensor)


def _sample_plane(
    camera: Camera, camera_from_world: SE3, z: float, front_is_up: bool, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return where every sample's ray intersects the plane at height z, and whether in front.

    The points are x and y in the world frame, m.
    """
    width, rows = camera.image_size
    # Samples are spread evenly over a pixel, which extends 0.5 px around its centre.
    u = (np.arange(width * samples) + 0.5) / samples - 0.5
    v = (np.arange(rows * samples) + 0.5) / samples - 0.5
    plane = jnp.asarray(z)
    parts = [
        _ray_plane_intersection(
            camera, camera_from_world, jnp.asarray(u), jnp.asarray(batch), plane
        )
        for batch in np.split(v, range(ROWS_PER_BATCH * samples, len(v), ROWS_PER_BATCH * samples))
    ]
    plane_points = np.concatenate([np.asarray(part[0]) for part in parts])
    in_front = np.concatenate([np.asarray(part[1]) for part in parts])
    # The board shows its front only to a camera on the front's side of the plane.
    camera_height = float(np.linalg.inv(host_matrices(camera_from_world))[2, 3])
    return plane_points, in_front & ((camera_height > z) == front_is_up)


@compiled_optimised
def _ray_plane_intersection(
    camera: Camera,
    camera_from_world: SE3,
    u: Float[Array, "columns"],
    v: Float[Array, "rows"],
    z: Float[Array, ""],
) -> tuple[Float[Array, "rows columns 2"], Array]:
    """Return where pixel rays intersect a horizontal plane, and whether that is in front."""
    pixels = jnp.stack(jnp.meshgrid(u, v), axis=-1)
    rays, valid = camera.unproject(pixels)
    world_from_camera = camera_from_world.inverse()
    # Row vectors: d_world = R d_camera is written d_camera R^T.
    direction = rays @ world_from_camera.rotation().as_matrix().T
    centre = world_from_camera.translation()
    # The point is c + t d with t = (z - c_z) / d_z, for the camera centre c and the ray d, both in
    # the world frame. A ray parallel to the plane gets t = 0, which is not in front.
    ray_parameter = (z - centre[2]) / jnp.where(
        direction[..., 2] == 0.0, jnp.inf, direction[..., 2]
    )
    plane_points = centre[:2][None, None] + ray_parameter[..., None] * direction[..., :2]
    in_front = valid & (ray_parameter > 0.0)
    return jnp.where(in_front[..., None], plane_points, 0.0), in_front


def write_pictures(
    folder: str | Path,
    calibration: Calibration,
    base_from_tool: PoseLike,
    target: AbstractTarget,
    reported_poses: PoseLike | None = None,
    suffix: str = ".png",
    pose_format: str = "matrix",
    **options: Any,
) -> Path:
    """Write a data-set folder with a rendered picture for every robot pose and every height.

    Args:
        folder: folder to create; `load_dataset` reads it.
        base_from_tool: `(views)` true robot poses.
        reported_poses: `(views)` poses that the robot reports; the true ones by default.
        suffix: kind of the picture files; `".jpg"` is small, `".png"` exact.
        pose_format: format of the poses in `poses.csv`: one of `POSE_CODECS`.
        options: passed on to `render`, other than its height and seed.
    """
    folder, poses = Path(folder), as_se3(base_from_tool)
    height_count = target.height_count
    views = [str(k) for k in range(len(poses.wxyz_xyz))]
    pattern = ("images/{view}_{height}" if height_count > 1 else "images/{view}") + suffix
    for k, view in enumerate(views):
        pose = SE3(poses.wxyz_xyz[k])
        for height_index in range(height_count):
            picture = render(
                calibration,
                pose,
                target,
                height_index=height_index,
                seed=k * height_count + height_index,
                **options,
            )
            path = folder / pattern.format(view=view, height=height_index)
            write_atomically(path, cv2.imencode(suffix, picture)[1].tobytes())
    write_dataset_folder(
        folder,
        views,
        poses if reported_poses is None else as_se3(reported_poses),
        calibration.camera.image_size,
        target,
        calibration.mount,
        {"pictures": {"pattern": pattern}},
        pose_format,
    )
    return folder


def sensor_picture(
    brightness: Float[np.ndarray, "rows columns"],
    *,
    blur: float = 0.7,
    noise: float = 1.0,
    exposure: float = 1.0,
    seed: int = 0,
) -> UInt8[np.ndarray, "rows columns"]:
    """Return the picture that a sensor takes of the brightness averaged over each pixel.

    Args:
        brightness: grey levels at an exposure of one; values above 255 saturate.
        blur: standard deviation of the lens's blur, px.
        noise: standard deviation of the sensor's noise, grey levels.
        exposure: factor by which the brightness is multiplied.
        seed: seed of the noise.
    """
    picture = np.asarray(brightness, dtype=float)
    if blur > 0.0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur)
    picture = exposure * picture
    picture = picture + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    # Saturation and rounding come last, as in a converter.
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)
