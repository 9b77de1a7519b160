"""Check the views and the pixels of a call, and pad them so that few programs are compiled."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..cameras import (
    AnyCamera,
    Camera,
    camera_axes,
    cameras_for,
    cameras_of_views,
    in_picture,
)
from ..geometry import check_rigid, host_matrices, host_transforms
from ..robots import MAX_TOOL_COORDINATE, Command, CommandLike
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled
from ..runtime.padding import in_batches, repeat_last
from .rig_views import AnyCalibration, CameraChain, RigViews

PADDED_VIEWS = 8
"""Views are padded to a multiple of this number, so that one more view needs no compilation."""

PADDED_FEATURES = 64, 1024, 4096
"""Features are padded to the first of these numbers that is no smaller, so that few programs serve.

To compile one takes seconds; to compute with 1024 features in eight views takes 10 ms. More than
the last are not padded: computing on padding would cost more than compiling."""

POINTS_PER_BATCH = 4096
"""Number of points that are projected at once."""


def as_checked_command(poses: CommandLike, names: Sequence[str] | None = None) -> Command:
    """Return the reported poses of views as a command of host arrays.

    Args:
        poses: with one batch axis.
        names: names of the views, as many as poses; by default view 0, view 1, ...

    Raises:
        ValueError: as `as_rigid_command`, or a pose farther than an arm reaches, with the view.
    """
    command = as_rigid_command(poses, names)
    positions = np.asarray(command.base_from_tool.wxyz_xyz)[:, 4:]
    farthest = np.abs(positions).max(axis=1, initial=0.0)
    for view in np.flatnonzero(farthest > MAX_TOOL_COORDINATE).tolist():
        raise ValueError(
            f"poses: view {view if names is None else names[view]}: the tool is "
            f"{farthest[view]:.4g} m from the base: no arm is that long; millimetres given as "
            "metres?"
        )
    return command


def as_rigid_command(poses: CommandLike, names: Sequence[str] | None = None) -> Command:
    """Return poses of views, out of reach or not, as a command of host arrays."""
    reported, joints = poses, None
    if isinstance(poses, Command):
        reported, joints = poses.base_from_tool, poses.joints
    matrices = (
        host_matrices(reported) if isinstance(reported, SE3) else np.asarray(reported, dtype=float)
    )
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise ValueError(f"poses: expected (views, 4, 4) or that many SE3; found {matrices.shape}")
    views = len(matrices)
    if names is not None and len(names) != views:
        raise ValueError(f"poses: expected one for each of {len(names)} views, found {views}")
    known_as = tuple(f"view {k if names is None else names[k]}" for k in range(views))
    if problems := check_rigid(matrices, known_as):
        problem_texts = "; ".join(f"{view}: {text}" for view, text in problems.items())
        raise ValueError(f"poses: {problem_texts}")
    if joints is None:
        return Command(host_transforms(matrices))
    readings = np.asarray(joints, dtype=float)
    if readings.ndim != 2 or len(readings) != views:
        raise ValueError(f"joints: expected {views} rows of readings, found {readings.shape}")
    return Command(host_transforms(matrices), to_device(readings))


def command_at(command: Command, views: int | Sequence[int] | np.ndarray) -> Command:
    """Return the reported pose of one view, without a batch axis, or of several views."""
    # On the host, since indexing a device array compiles a program.
    return jax.tree.map(lambda array: to_device(np.asarray(array)[views]), command)


def chain_command(chain: CameraChain, command: Command) -> Command:
    """Return the reported poses of a camera's views, padded; the identity if they do not matter."""
    if chain.is_fixed:
        return padded_views(Command(host_transforms(np.tile(np.eye(4), (len(chain.views), 1, 1)))))
    return padded_views(command_at(command, chain.views))


def single_pose(pose: CommandLike) -> CommandLike:
    """Return one pose, or one command, as a batch of one."""
    if isinstance(pose, Command):
        return jax.tree.map(lambda array: to_device(np.asarray(array)[None]), pose)
    if isinstance(pose, SE3):
        return SE3(pose.wxyz_xyz.reshape(1, 7))
    return np.asarray(pose, dtype=float).reshape(1, 4, 4)


def padded_views(command: Command) -> Command:
    """Return the command with its last view repeated, up to a multiple of `PADDED_VIEWS`."""
    views = len(command.base_from_tool.wxyz_xyz)
    # -n mod k views are missing to the next multiple of k.
    return jax.tree.map(to_device, repeat_last(command, views + -views % PADDED_VIEWS))


def padded_count(count: int) -> int:
    """Return the number of features that a program is compiled for."""
    return next((size for size in PADDED_FEATURES if size >= count), count)


def padded_to(array: np.ndarray, shape: tuple[int, ...], value: float | bool = 0) -> np.ndarray:
    """Return an array with its first axes extended to a shape by a value."""
    widths = [(0, n - k) for n, k in zip(shape, array.shape, strict=False)]
    widths += [(0, 0)] * (array.ndim - len(shape))
    return np.pad(array, widths, constant_values=value)


class SeenViews(NamedTuple):
    """The cameras and their poses in all views, on the host and padded for the device.

    Attributes:
        camera: intrinsics and lens, of all views or of each.
        camera_from_world: extrinsics without padding, on the host.
        padded: extrinsics with the last view repeated, for programs.
        command: the reported poses, padded in the same way.
    """

    camera: AnyCamera
    camera_from_world: Float[np.ndarray, "views 4 4"]
    padded: Float[np.ndarray, "padded_views 4 4"]
    command: Command

    @classmethod
    def of(cls, calibration: AnyCalibration, poses: CommandLike | None) -> "SeenViews":
        """Return the views of calibrated cameras at reported poses.

        Args:
            calibration: of all views, or the cameras of the views.
            poses: one for each view; None where the robot does not matter, for cameras next to the
                arm in the base frame.

        Raises:
            ValueError: a pose that is not rigid, with the view; missing poses, or not one for each
                of the cameras.
        """
        if isinstance(calibration, RigViews):
            return cls._of_rig(calibration, poses)
        calibration.require_one_arm("objects in pictures")
        if poses is None:
            raise ValueError("poses: expected the reported pose of each view, found None")
        checked = as_checked_command(poses)
        # The last view is repeated, because every program can compute with it.
        command = padded_views(checked)
        padded = np.asarray(calibration.camera_from_world_matrices(command))
        views = len(checked.base_from_tool.wxyz_xyz)
        return cls(calibration.camera, padded[:views], padded, command)

    @classmethod
    def _of_rig(cls, rig_views: RigViews, poses: CommandLike | None) -> "SeenViews":
        """Return the views of several cameras."""
        if poses is None:
            if rig_views.needs_poses:
                raise ValueError(
                    "poses: expected the reported pose of each view, found None; only cameras "
                    'next to the arm, with frame="base", do without'
                )
            poses = np.tile(np.eye(4), (len(rig_views), 1, 1))
        checked = as_checked_command(poses)
        count = len(checked.base_from_tool.wxyz_xyz)
        if count != len(rig_views):
            raise ValueError(
                f"poses: expected one for each of {len(rig_views)} views, found {count}"
            )
        command = padded_views(checked)
        camera_from_world = np.zeros((count, 4, 4))
        for chain in rig_views.chains():
            matrices = chain.calibration.camera_from_world_matrices(chain_command(chain, command))
            camera_from_world[chain.views] = np.asarray(matrices)[: len(chain.views)]
        padded = repeat_last(camera_from_world, len(command.base_from_tool.wxyz_xyz))
        return cls(rig_views.camera, camera_from_world, padded, command)

    def camera_for(self, count: int) -> AnyCamera:
        """Return the cameras for a program of `count` views, which repeats the last one."""
        return cameras_for(self.camera, count)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera of each view."""
        return cameras_of_views(self.camera, len(self.camera_from_world))

    @property
    def largest_picture(self) -> tuple[int, int]:
        """The largest width and the largest height of all views' pictures, px."""
        width, height = self.image_sizes.max(axis=0).tolist()
        return width, height

    @property
    def image_sizes(self) -> Int[np.ndarray, "views 2"]:
        """The width and height of each view's picture, px."""
        return np.array([camera.image_size for camera in self.cameras]).reshape(-1, 2)

    def poses_for(self, count: int) -> Float[np.ndarray, "_ 4 4"]:
        """Return the extrinsics for a program of `count` features, padded unless these are many."""
        return self.padded if count <= PADDED_FEATURES[-1] else self.camera_from_world

    @property
    def centres(self) -> Float[np.ndarray, "views 3"]:
        """The camera's centres in the world, m."""
        # c = -R^T t
        rotations, translations = (
            self.camera_from_world[:, :3, :3],
            self.camera_from_world[:, :3, 3],
        )
        return -np.einsum("vji,vj->vi", rotations, translations)

    def checked_points(
        self, pixels: np.ndarray | Array, visible: np.ndarray | Array | None
    ) -> tuple[Float[np.ndarray, "views points 2"], Bool[np.ndarray, "views points"]]:
        """Return pixels of points and where they are visible, checked against the pictures."""
        measured = np.asarray(pixels, dtype=float)
        if measured.ndim != 3 or measured.shape[2] != 2:
            raise ValueError(f"pixels: expected shape (views, points, 2), found {measured.shape}")
        return measured, self._checked_visibility(measured, visible)

    def checked_segments(
        self, segments: np.ndarray | Array, visible: np.ndarray | Array | None
    ) -> tuple[Float[np.ndarray, "views lines 2 2"], Bool[np.ndarray, "views lines"]]:
        """Return the ends of segments and where they are visible, checked in the same way."""
        measured = np.asarray(segments, dtype=float)
        if measured.ndim != 4 or measured.shape[2:] != (2, 2):
            raise ValueError(
                f"segments: expected shape (views, lines, 2, 2), found {measured.shape}"
            )
        return measured, self._checked_visibility(measured, visible)

    def _checked_visibility(
        self, pixels: Float[np.ndarray, "views *features 2"], visible: np.ndarray | Array | None
    ) -> Bool[np.ndarray, "views features"]:
        """Return where features are visible, after checking that these are within the picture.

        Args:
            pixels: `(views, points, 2)`, or `(views, segments, 2, 2)` for the ends of segments.
            visible: where they are visible; by default wherever the pixels are finite.
        """
        image_sizes = self.image_sizes
        if len(pixels) != len(image_sizes):
            raise ValueError(
                f"pixels: expected {len(image_sizes)} views as there are poses, found {len(pixels)}"
            )
        last = tuple(range(2, pixels.ndim))
        # Shapes first, so that a wrong shape is not reported as a pixel outside the picture.
        finite = np.isfinite(pixels).all(axis=last)
        is_visible = finite if visible is None else np.asarray(visible, dtype=bool)
        if is_visible.shape != pixels.shape[:2]:
            raise ValueError(
                f"visible: expected shape {pixels.shape[:2]}, found {is_visible.shape}"
            )
        # NaN and infinity count as outside, too; the message shows which.
        sizes = image_sizes.reshape(len(pixels), *(1 for _ in last), 2)
        inside = in_picture(pixels, sizes).all(axis=last[:-1])
        wrong = np.argwhere(is_visible & ~inside)
        if len(wrong):
            view, feature = wrong[0]
            width, height = image_sizes[view]
            raise ValueError(
                f"pixels: view {view}, feature {feature}: {pixels[view, feature].tolist()} px is "
                f"not in the picture of {width} x {height} px ({len(wrong)} such)"
            )
        # A copy, so that the caller's mask never changes.
        return np.array(is_visible)


def checked_sigma(
    pixel_sigma: float | np.ndarray, shape: tuple[int, int], covariance: tuple[int, ...]
) -> np.ndarray:
    """Return `pixel_sigma` as an array: one number, one of each observation, or its covariance.

    The shape is of views and features; given covariances have further axes.
    """
    sigma = np.asarray(pixel_sigma, dtype=float)
    if sigma.shape not in ((), shape, (*shape, *covariance)):
        raise ValueError(
            f"pixel_sigma: expected a number, {shape} or {(*shape, *covariance)}; "
            f"found {sigma.shape}"
        )
    if sigma.ndim <= 2 and not np.all(sigma > 0.0):
        raise ValueError(f"pixel_sigma: expected positive numbers, found {sigma.min():g}")
    return sigma


def whitening_of(
    pixel_sigma: float | np.ndarray, shape: tuple[int, int]
) -> Float[np.ndarray, "#views #features 2 2"]:
    """Return matrices that scale pixel errors to unit covariance, one for each observation.

    Args:
        pixel_sigma: standard deviation of u and of v, px: one, or one for each observation `(views,
            features)`; or covariances `(views, features, 2, 2)`, px^2.
        shape: numbers of views and features; the result is broadcast to it only if `pixel_sigma`
            differs between observations.
    """
    sigma = checked_sigma(pixel_sigma, shape, (2, 2))
    # Equal and independent errors of u and v are a multiple of the identity.
    if sigma.ndim < 3:
        scale = sigma if sigma.ndim else sigma[None, None]
        return np.eye(2) / scale[..., None, None]
    try:
        # C = L L^T, and the covariance of L^-1 e is the identity.
        return np.linalg.inv(np.linalg.cholesky(sigma))
    except np.linalg.LinAlgError as error:
        raise ValueError("pixel_sigma: a covariance is not positive definite") from error


def project_points(
    views: SeenViews, points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "views points 2"]:
    """Return the pixels of points (m, world) in all views; NaN outside picture or lens."""
    count, poses = len(views.camera_from_world), to_device(views.padded)
    camera = views.camera_for(len(views.padded))

    def of_batch(batch: Float[Array, "batch 3"]) -> Float[np.ndarray, "batch views 2"]:
        return np.asarray(_project(camera, poses, batch))[:count].swapaxes(0, 1)

    pixels = in_batches(of_batch, points, POINTS_PER_BATCH).swapaxes(0, 1)
    return np.where(in_picture(pixels, views.image_sizes[:, None])[..., None], pixels, np.nan)


@compiled
def _project(
    camera: AnyCamera,
    camera_from_world: Float[Array, "views 4 4"],
    points: Float[Array, "points 3"],
) -> Float[Array, "views points 2"]:
    def project_in_view(
        view_camera: AnyCamera, matrix: Float[Array, "4 4"]
    ) -> Float[Array, "points 2"]:
        return view_camera.project(points @ matrix[:3, :3].T + matrix[:3, 3][None])[0]

    return jax.vmap(project_in_view, (camera_axes(camera), 0))(camera, camera_from_world)
