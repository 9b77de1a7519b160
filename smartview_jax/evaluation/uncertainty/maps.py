"""Map the uncertainty of a calibration's predictions over the picture and the workspace.

Like mrcal's projection uncertainty, but for the whole chain: camera, hand-eye transform, target and
the robot's error, with their correlations.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ...calibration import Calibration
from ...dataset import Dataset, Observations, chain_residuals, require_same_set_up
from ...engine import host_retract
from ...geometry import look_at
from ...robots import Command, as_command
from ...runtime.array_namespace import to_device
from .propagation import CalibrationEstimate, covariance_root

MARGIN = 0.02
"""Margin of a map around the picture, relative to the picture's width."""


class PictureUncertainty(NamedTuple):
    """The standard deviation of predicted pixels, at many positions in a picture.

    Attributes:
        view_id: name of the view.
        pixels: predicted pixels of the points, px.
        std: standard deviation of `pixels`, u and v together, px.
        depth: distance of the points from the camera along its axis, m.
        image_size: width and height of the picture, px.
    """

    view_id: str
    pixels: Float[np.ndarray, "points 2"]
    std: Float[np.ndarray, "points"]
    depth: float
    image_size: tuple[int, int]


def picture_uncertainty(
    estimate: CalibrationEstimate, data: Dataset, view: int | None = None
) -> PictureUncertainty:
    """Return the uncertainty of predicted pixels, for points that fill the picture of a view.

    The points are in a plane parallel to the picture, at the median depth of the target's points;
    the noise of the robot's pose is not included.

    Args:
        estimate: the result of `fit_joint` or `cramer_rao`, or a saved one.
        data: the data set of the view, which gives the robot's pose and the depth.
        view: index of the view; by default the one that shows the most points.

    Raises:
        ValueError: a parameter is undetermined, the view shows no point, or the estimate is of
            another mount or of pictures of another size.
    """
    calibration = estimate.calibration
    require_same_set_up("the calibration", calibration, data)
    visible = np.asarray(data.visible)
    view = int(np.argmax(visible.sum(axis=1))) if view is None else view
    if not visible[view].any():
        raise ValueError(f"view {data.view_ids[view]}: no point of the target is visible")
    # Arrays of the data's shape, all with the same pose, so that the compiled programs of the
    # data's residuals are used again.
    command = jax.tree.map(
        lambda leaf: to_device(np.broadcast_to(np.asarray(leaf)[view], np.shape(leaf)).copy()),
        data.command,
    )
    camera_from_world = np.asarray(calibration.camera_from_world_matrices(command))[0]
    in_camera = np.asarray(data.points)[view][visible[view]] @ camera_from_world[2, :3]
    depth = float(np.median(in_camera + camera_from_world[2, 3]))
    rays = _rays_over_picture(calibration, visible.size)
    world = (depth * rays - camera_from_world[:3, 3]) @ camera_from_world[:3, :3]
    points = world.reshape(*visible.shape, 3) / float(calibration.target_scale)
    pixels, std = _pixels_with_std(estimate, command, points)
    used = np.isfinite(std).ravel()
    return PictureUncertainty(
        data.view_ids[view],
        pixels.reshape(-1, 2)[used],
        std.ravel()[used],
        depth,
        calibration.camera.image_size,
    )


def _pixels_with_std(
    estimate: CalibrationEstimate, command: Command, points: Float[np.ndarray, "views points 3"]
) -> tuple[Float[np.ndarray, "views points 2"], Float[np.ndarray, "views points"]]:
    """Return the pixels of points and their standard deviation, u and v together.

    NaN for a point without a pixel. Derivatives are central differences with the compiled programs
    of the fits, so that nothing is compiled.
    """
    calibration = estimate.calibration
    everywhere = np.ones(points.shape[:2], dtype=bool)
    observations = Observations(
        to_device(points),
        to_device(np.zeros((*points.shape[:2], 2))),
        to_device(everywhere),
        command.base_from_tool,
        command.joints,
    )

    def pixels_of(changed: Calibration) -> Float[np.ndarray, "views points 2"]:
        """Return the pixels for a calibration: minus the residuals of pixels at zero."""
        residuals = np.asarray(chain_residuals(changed, observations))
        return np.where(np.isfinite(residuals), -residuals, np.nan)

    # With P = sum_k d_k d_k^T: J P J^T = sum_k (J d_k)^2, where J d_k follows from steps of +- d_k,
    # one standard deviation, over which pixels are nearly linear functions.
    variance = np.zeros((*points.shape[:2], 2))
    for step in np.asarray(covariance_root(estimate)):
        if step.any():
            difference = pixels_of(host_retract(calibration, step))
            difference -= pixels_of(host_retract(calibration, -step))
            variance += (0.5 * difference) ** 2
    return pixels_of(calibration), np.sqrt(variance.sum(axis=-1))


def _rays_over_picture(calibration: Calibration, count: int) -> Float[np.ndarray, "count 3"]:
    """Return `count` directions that fill the picture and a margin, the last one repeated."""
    camera = calibration.camera
    width, height = camera.image_size
    # A grid of square cells, with at most `count` points.
    columns = int(np.sqrt(count * width / height))
    rows = count // columns
    margin = MARGIN * width
    # Distortion is ignored here: it moves the points by some pixels, but they are reported at
    # their true pixels.
    u, v = np.meshgrid(
        np.linspace(-margin, width + margin, columns), np.linspace(-margin, height + margin, rows)
    )
    x = (u - float(camera.u0)) / float(camera.alpha_u)
    y = (v - float(camera.v0)) / float(camera.alpha_v)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return rays[np.minimum(np.arange(count), len(rays) - 1)]


class WorkspaceUncertainty(NamedTuple):
    """The aiming error of a camera that is sent to look at points.

    Attributes:
        points: the points, in the target's frame, m.
        std: standard deviation of the distance between each point and the point aimed at, m.
        distance: distance of the camera from the points, m.
    """

    points: Float[np.ndarray, "rows columns 3"]
    std: Float[np.ndarray, "rows columns"]
    distance: float


def workspace_uncertainty(
    estimate: CalibrationEstimate, data: Dataset, extent: float = 2.0, count: int = 15
) -> WorkspaceUncertainty:
    """Return the aiming error of a camera over points of the target's plane and around it.

    For every point of a grid the robot is commanded, by Eq. 19, so that the camera looks at the
    point perpendicularly from the median distance of the views. The standard deviation of the
    point's pixel, times distance over focal length, is the aiming error.

    Args:
        estimate: the result of `fit_joint` or `cramer_rao`, or a saved one.
        data: the views, for their distance and for the target's extent.
        extent: size of the region relative to the target.
        count: number of points along each side.

    Raises:
        ValueError: a parameter is undetermined, the estimate is of another mount or of pictures of
            another size, or the calibration corrects errors of joints, for which poses alone do
            not suffice.
    """
    calibration = estimate.calibration
    require_same_set_up("the calibration", calibration, data)
    if calibration.robot_error is not None and data.command.joints is not None:
        raise ValueError("data: a map needs a calibration without errors of joints")
    target = np.asarray(data.points)[np.asarray(data.visible)]
    centres = np.linalg.inv(calibration.camera_from_world_matrices(data.command))[:, :3, 3]
    # About the middle of the target, also in height.
    middle = 0.5 * (target.min(axis=0) + target.max(axis=0))
    distance = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    half = 0.5 * extent * np.maximum(np.ptp(target, axis=0)[:2].max(), 1e-3)
    x, y = np.meshgrid(*[middle[k] + np.linspace(-half, half, count) for k in (0, 1)])
    points = np.stack([x, y, np.full_like(x, middle[2])], axis=-1)
    # From the side of the target on which the views were taken.
    downwards = np.array([0.0, 0.0, -1.0 if centres[:, 2].mean() > middle[2] else 1.0])
    camera_from_world = look_at(points.reshape(-1, 3), downwards, distance)
    # The correction of the robot's error is negligible here.
    command = as_command(calibration.command_for(camera_from_world, corrected=False))
    at_points = points.reshape(-1, 1, 3) / float(calibration.target_scale)
    _, std = _pixels_with_std(estimate, command, at_points)
    focal = float(np.sqrt(float(calibration.camera.alpha_u) * float(calibration.camera.alpha_v)))
    metres = std.reshape(x.shape) * distance / focal
    return WorkspaceUncertainty(points, metres, distance)
