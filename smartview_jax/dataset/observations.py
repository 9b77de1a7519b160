"""Hold the measurements of a data set as arrays, and compute their residuals by view."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration, TargetShape
from ..cameras import Camera
from ..geometry import as_se3, transformed_coordinates
from ..robots import Command, HandPoses
from ..runtime.array_namespace import AnyArray, to_device
from ..runtime.compilation import compiled, is_traced
from ..runtime.modules import HostModule, with_fields
from ..runtime.padding import host_without_padding, padded_counts, repeat_last
from .depth_readings import DepthReadings
from .pose_observations import PoseObservations


class Observations(HostModule):
    """The arrays of a data set or of one view, without names, for compiled functions.

    Attributes:
        points: target points in the target frame, m.
        pixels: measured positions, px; NaN where not visible.
        visible: mask of the visible points.
        base_from_tool: poses reported by the robot, one transform per view.
        joints: readings of the robot's joints, rad or m; None if unknown.
        depths: depths measured at the points; None without a depth sensor.
        hands: poses of two hands, one with the camera and one with the target; None for one arm.
    """

    points: Float[Array, "*views points 3"]
    pixels: Float[Array, "*views points 2"]
    visible: Bool[Array, "*views points"]
    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None
    depths: DepthReadings | None = None
    hands: HandPoses | None = None

    @property
    def command(self) -> Command:
        """The commands reported by the robot, with joint readings if they are known."""
        return Command(self.base_from_tool, self.joints, self.hands)

    def of_shape(self, shape: TargetShape | None) -> "Observations":
        """Return the observations of a target whose points are displaced by its shape, if any."""
        if shape is None:
            return self
        return with_fields(self, points=shape.displaced(self.points))

    def padded(self) -> "Observations":
        """Return the observations of a small data set with invisible views and points added.

        Data sets of similar size then share compiled programs (`padding`). Large data sets are
        returned unchanged.
        """
        return self.padded_to(*padded_counts(*self.visible.shape))

    def padded_to(self, views: int, points: int) -> "Observations":
        """Return the observations with invisible views and points added, up to these numbers."""
        if self.visible.shape == (views, points):
            return self
        is_visible = np.zeros((views, points), dtype=bool)
        is_visible[: self.visible.shape[0], : self.visible.shape[1]] = np.asarray(self.visible)
        host = jax.tree.map(
            np.asarray, (self.points, self.pixels, self.base_from_tool, self.joints)
        )
        in_columns = (*repeat_last(host[:2], points, axis=1), *host[2:])
        depths = None if self.depths is None else self.depths.padded_points(points)
        hands = jax.tree.map(np.asarray, self.hands)
        target_points, pixels, base_from_tool, joints, depths, hands = repeat_last(
            (*in_columns, depths, hands), views
        )
        return with_fields(
            self,
            points=target_points,
            pixels=pixels,
            visible=is_visible,
            base_from_tool=base_from_tool,
            joints=joints,
            depths=depths,
            hands=hands,
        )

    def residuals(
        self, predicted: Float[Array, "*views points 2"], valid: Bool[Array, "*views points"]
    ) -> Float[Array, "*views points 2"]:
        """Return measured minus predicted pixels, zero where a point has no pixel or prediction."""
        # The two terms are masked, not their difference, which would leave NaN in the gradient.
        used = (self.visible & valid)[..., None]
        return jnp.where(used, self.pixels, 0.0) - jnp.where(used, predicted, 0.0)


AnyObservations = Observations | PoseObservations
"""What a problem can be fitted to: points in pictures, or tracked poses."""


def evenly_spaced(count: int, largest: int) -> Int[np.ndarray, "chosen"]:
    """Return `largest` of the indices of `count` views at equal distances; all if there are fewer.

    Some questions are answered as well by some of many views, in less time.
    """
    return np.unique(np.linspace(0, count - 1, largest).round().astype(int))


def medians_by_view(
    values: Float[np.ndarray, "views points"], counted: Bool[np.ndarray, "views points"]
) -> Float[np.ndarray, "views"]:
    """Return the median of the counted values of each view; NaN for a view without any.

    A loop over the views would take as long as a fit if there are many views.
    """
    # Sorting puts a view's counted values first; a NaN among them is handled separately below.
    count = counted.sum(axis=1)
    in_order = np.sort(np.where(counted, values, np.inf), axis=1)
    middle = np.maximum(np.stack([count - 1, count]) // 2, 0)
    lower, upper = np.take_along_axis(in_order, middle.T, axis=1).T
    unknown = (count == 0) | (counted & np.isnan(values)).any(axis=1)
    with np.errstate(invalid="ignore"):
        return np.where(unknown, np.nan, 0.5 * (lower + upper))


def chain_residuals(
    calibration: Calibration, observations: AnyObservations
) -> Float[AnyArray, "views points 2"]:
    """Return measured minus predicted pixels through the chain (Eq. 10) at the reported poses.

    They are zero where a point is not visible, and infinite where a visible point cannot be
    predicted. Outside of `jit` and the like they are a NumPy array.
    """
    poses = calibration.camera_from_world_matrices(observations.command)
    return view_residuals(
        calibration.camera,
        calibration.target_scale,
        poses,
        observations.of_shape(calibration.target_shape),
    )


def view_residuals(
    camera: Camera,
    target_scale: Float[Array, ""],
    camera_from_world: Float[AnyArray, "views 4 4"],
    observations: AnyObservations,
) -> Float[AnyArray, "views points 2"]:
    """Return measured minus predicted pixels for given camera poses.

    They are zero where a point is not visible, and infinite where a visible point cannot be
    predicted. Outside of `jit` and the like they are a NumPy array. All fits share this program,
    whatever they assume about the robot.
    """
    if is_traced(camera, target_scale, camera_from_world, observations):
        return _view_residuals(camera, target_scale, camera_from_world, observations)
    padded = observations.padded()
    poses = repeat_last(camera_from_world, len(padded.visible))
    residuals = _view_residuals(camera, target_scale, poses, padded)
    return host_without_padding(residuals, *observations.visible.shape)


def camera_residuals(
    camera: Camera,
    camera_from_world: Float[np.ndarray, "views 4 4"],
    observations: AnyObservations,
) -> Float[np.ndarray, "views points 2"]:
    """Return `view_residuals` of a target of its stated size, px, on the host."""
    scale = to_device(np.ones(()))
    return np.asarray(view_residuals(camera, scale, camera_from_world, observations))


@compiled
def _view_residuals(
    camera: Camera,
    target_scale: Float[Array, ""],
    camera_from_world: Float[AnyArray, "views 4 4"],
    observations: AnyObservations,
) -> Float[Array, "views points 2"]:
    """Return the residuals of `view_residuals`, compiled for the given shapes."""
    if isinstance(observations, PoseObservations):
        return observations.residuals(as_se3(camera_from_world), target_scale)

    def one_view(pose_and_view: tuple[Array, Observations]) -> Float[Array, "points 2"]:
        """Return the residuals of one view."""
        pose, view = pose_and_view
        in_camera = transformed_coordinates(target_scale * pose[:3, :3], pose[:3, 3], view.points)
        predicted, valid = camera.project(jnp.stack(in_camera, axis=-1))
        # Infinite, not zero: a calibration that cannot predict a visible point must not look good.
        unpredicted = (view.visible & ~valid)[..., None]
        return jnp.where(unpredicted, jnp.inf, view.residuals(predicted, valid))

    # Projecting all views at once would take several times the memory of the data.
    return jax.lax.map(one_view, (camera_from_world, observations))
