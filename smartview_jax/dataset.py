"""Hold the observations of a target from several robot poses, validated when they are read."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from .array_namespace import AnyArray, to_device
from .calibration import Calibration, mount_frames
from .cameras import Camera
from .compilation import compiled, refuse_traced
from .deprecation import DeprecatedAttribute
from .geometry import PoseLike, as_se3, check_rigid, host_matrices
from .robots import Command, SerialArm

MINIMUM_RELIABLE_VIEWS = 8
"""Smallest number of views with which a result is reliable and a single wrong view is recognised.

Of six good views of a real data set one had fourteen times the misfit of the others, to which the
transforms had been fitted; without it the error on a held-out view was six times as large.
"""

FORWARD_KINEMATICS_TOLERANCE = (1e-3, np.deg2rad(0.1))
"""Largest difference (m, rad) of reported poses from the arm's forward kinematics."""


class Observations(eqx.Module):
    """The arrays of a data set or of one view, without names, for compiled functions.

    Attributes:
        points: target points in the target frame, m.
        pixels: measured positions, px; NaN where not visible.
        visible: mask of the points that were seen.
        base_from_tool: reported by the robot, one transform per view.
        joints: readings of the robot's joints, rad or m; None where not known.
    """

    points: Float[Array, "*views points 3"]
    pixels: Float[Array, "*views points 2"]
    visible: Bool[Array, "*views points"]
    base_from_tool: SE3
    joints: Float[Array, "*views joints"] | None = None

    @property
    def command(self) -> Command:
        """The commands reported by the robot, with joint readings if they are known."""
        return Command(self.base_from_tool, self.joints)

    def residuals(
        self, predicted: Float[Array, "*views points 2"], valid: Bool[Array, "*views points"]
    ) -> Float[Array, "*views points 2"]:
        """Return measured minus predicted pixels, zero where a point has no pixel or prediction."""
        # Both terms are masked before subtracting; masking the difference would leave NaN in the
        # gradient.
        used = (self.visible & valid)[..., None]
        return jnp.where(used, self.pixels, 0.0) - jnp.where(used, predicted, 0.0)


def chain_residuals(
    calibration: Calibration, observations: Observations
) -> Float[Array, "views points 2"]:
    """Return measured minus predicted pixels through the chain (Eq. 10) at the reported poses.

    They are zero where a point was not seen, and infinite where a point was seen but cannot be
    predicted.
    """
    poses = calibration.camera_from_world_matrices(observations.command)
    return view_residuals(calibration.camera, calibration.target_scale, poses, observations)


@compiled
def view_residuals(
    camera: Camera,
    target_scale: Float[Array, ""],
    camera_from_world: Float[AnyArray, "views 4 4"],
    observations: Observations,
) -> Float[Array, "views points 2"]:
    """Return measured minus predicted pixels for given camera poses.

    They are zero where a point was not seen, and infinite where a point was seen but cannot be
    predicted. One program serves every fit, whatever it knows about the robot.
    """

    def one_view(pose_and_view: tuple[Array, Observations]) -> Float[Array, "points 2"]:
        """Return the residuals of one view."""
        pose, view = pose_and_view
        in_camera = (target_scale * view.points) @ pose[:3, :3].T + pose[:3, 3][None]
        predicted, valid = camera.project(in_camera)
        # Infinite, not zero: a calibration that cannot predict a seen point must not look good.
        unpredicted = (view.visible & ~valid)[..., None]
        return jnp.where(unpredicted, jnp.inf, view.residuals(predicted, valid))

    # View by view: projecting all views at once takes several times the memory of the data.
    return jax.lax.map(one_view, (camera_from_world, observations))


class Dataset(eqx.Module):
    """A data set: points, pixels and robot poses of all views, with names and masks.

    An instance is immutable.

    Attributes:
        points, pixels, visible, base_from_tool: as in `Observations`, padded to one shape.
        view_ids: one name per view.
        image_size: width and height, px.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        masked_views: view id and reason of every view that is kept but not used.
        pictures: one file per view, if known.
        target: the description of the target, if known (a class of `targets`).
        joints: as in `Observations`.
        arm: the arm whose joints these are, if known.
        notes: sentences on assumptions made when the data were read.
    """

    points: Float[Array, "views points 3"]
    pixels: Float[Array, "views points 2"]
    visible: Bool[Array, "views points"]
    base_from_tool: SE3
    view_ids: tuple[str, ...] = eqx.field(static=True)
    image_size: tuple[int, int] = eqx.field(static=True)
    mount: str = eqx.field(static=True, default="eye_in_hand")
    masked_views: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    pictures: tuple[Path, ...] | None = eqx.field(static=True, default=None)
    target: Any = eqx.field(static=True, default=None)
    joints: Float[Array, "views joints"] | None = None
    arm: SerialArm | None = None
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    without = DeprecatedAttribute("without", "mask_views")

    @classmethod
    def from_arrays(
        cls,
        points: np.ndarray | Array,
        pixels: np.ndarray | Array,
        base_from_tool: PoseLike | None,
        image_size: tuple[int, int],
        visible: np.ndarray | Array | None = None,
        view_ids: Sequence[str | int] | None = None,
        mount: str = "eye_in_hand",
        bad_views: str = "raise",
        masked_views: Sequence[tuple[str, str]] = (),
        pictures: Sequence[Path] | None = None,
        target: Any = None,
        joints: np.ndarray | Array | None = None,
        arm: SerialArm | None = None,
        notes: Sequence[str] = (),
    ) -> "Dataset":
        """Build a data set from arrays.

        Args:
            points: `(N, 3)` or `(M, N, 3)` target points in the target (= world) frame, m.
            pixels: `(M, N, 2)` px; NaN where not seen.
            base_from_tool: `(M,)` robot poses: an `SE3` or `(M, 4, 4)`, m; None if joints and an
                arm are given instead.
            image_size: width and height, px.
            visible: `(M, N)`; by default wherever `pixels` is finite.
            view_ids: one name per view; by default 0, 1, ...
            mount: `"eye_in_hand"` (camera on the tool) or `"eye_to_hand"` (beside the arm).
            bad_views: for a view with wrong values (a pose that is not rigid, a pixel far outside
                the picture), `"raise"` an error or `"mask"` the view and keep the reason.
            masked_views: views already known to be unusable, with the reason.
            pictures: one picture file per view.
            target: the description of the target.
            joints: `(M, joints)` readings, rad, or m for a prismatic joint.
            arm: the arm whose joints these are, with its controller's nominal parameters. Poses
                that are given as well must agree with it.
            notes: sentences on assumptions made when the data were read.

        Raises:
            ValueError: a wrong shape, a duplicate id, or, unless masked, a wrong value; the
                message names the view.
        """
        refuse_traced("Dataset.from_arrays", points, pixels, base_from_tool, joints)
        mount_frames(mount)
        if bad_views not in ("raise", "mask"):
            raise ValueError(f"bad_views is 'raise' or 'mask'; found {bad_views!r}")
        # A copy, because masked pixels are overwritten below.
        pixels = np.array(pixels, dtype=float)
        if pixels.ndim != 3 or pixels.shape[-1] != 2:
            raise ValueError(f"pixels: expected shape (views, points, 2), found {pixels.shape}")
        view_count, point_count = pixels.shape[:2]
        # Each helper checks the shape of one argument and brings it to its common form.
        points = _points_per_view(np.asarray(points, dtype=float), view_count, point_count)
        ids = _view_ids(view_ids, view_count)
        if base_from_tool is None:
            base_from_tool = _forward_kinematics(joints, arm, ids)
        matrices = _pose_matrices(base_from_tool, view_count)
        seen = _visibility_mask(visible, pixels, ids)

        # A reason given by the caller takes precedence over one found here.
        problems = dict(masked_views)
        unknown = set(problems) - set(ids)
        if unknown:
            raise ValueError(f"masked_views: no view is called {sorted(unknown)}")
        # Wrong values are collected over all views, so that one error names all of them.
        wrong = check_rigid(matrices, ids)
        for view, problem in _pixel_problems(pixels, seen, image_size, ids).items():
            wrong.setdefault(view, problem)
        wrong = {view: problem for view, problem in wrong.items() if view not in problems}
        if wrong and bad_views == "raise":
            raise ValueError("; ".join(f"view {view}: {text}" for view, text in wrong.items()))
        problems = {**wrong, **problems}

        # Masked views stay in the arrays, with finite poses: one NaN would spread through sums.
        usable = np.array([view not in problems for view in ids], dtype=bool)
        matrices = np.where(usable[:, None, None] | _finite_views(matrices), matrices, np.eye(4))
        seen = seen & usable[:, None]
        points_finite = np.broadcast_to(np.isfinite(points).all(axis=-1), seen.shape)
        if not points_finite[seen].all():
            raise ValueError("points: a target point that was seen has NaN coordinates")
        # NaN makes any code fail visibly that reads a pixel without looking at the mask.
        pixels[~seen] = np.nan
        # All arrays are copies of the caller's, because `device_put` may share their memory; unlike
        # `jnp.asarray` it compiles no program.
        data = cls(
            points=jax.device_put(np.broadcast_to(np.nan_to_num(points), (*seen.shape, 3))),
            pixels=jax.device_put(pixels),
            visible=jax.device_put(seen),
            base_from_tool=as_se3(matrices),
            view_ids=ids,
            image_size=(int(image_size[0]), int(image_size[1])),
            mount=mount,
            masked_views=tuple((view, problems[view]) for view in ids if view in problems),
            pictures=None if pictures is None else tuple(Path(p) for p in pictures),
            target=target,
            notes=tuple(notes),
        )
        return data if joints is None and arm is None else data.with_joints(joints, arm)

    def with_joints(self, joints: np.ndarray | Array | None, arm: SerialArm | None) -> "Dataset":
        """Return the data set with joint readings, and poses by the arm's forward kinematics.

        Args:
            joints: `(views, joints)` readings, rad, or m for a prismatic joint.
            arm: the arm whose joints these are, with its controller's nominal parameters.

        Raises:
            ValueError: a wrong shape, or a view whose reported pose differs from the forward
                kinematics; the message names it.
        """
        computed = _forward_kinematics(joints, arm, self.view_ids)
        masked = {view for view, _ in self.masked_views}
        used = np.array([view not in masked for view in self.view_ids], dtype=bool)
        # Masked views are not compared: a wrong pose may be the reason why they are masked.
        _check_forward_kinematics(computed, self.base_from_tool, used, self.view_ids)
        poses = np.where(used[:, None], computed.wxyz_xyz, self.base_from_tool.wxyz_xyz)
        # Joint readings of masked views may be NaN, which would spread through sums over views.
        readings = np.nan_to_num(np.asarray(joints, dtype=float))
        return dataclasses.replace(
            self,
            base_from_tool=SE3(jax.device_put(poses)),
            joints=jax.device_put(readings),
            arm=arm,
        )

    @property
    def observations(self) -> Observations:
        """The arrays of the data set, without names."""
        return Observations(
            self.points, self.pixels, self.visible, self.base_from_tool, self.joints
        )

    @property
    def command(self) -> Command:
        """The commands reported by the robot, with joint readings if they are known."""
        return self.observations.command

    @property
    def view_count(self) -> int:
        """The number of views, masked ones included."""
        return len(self.view_ids)

    @property
    def observation_count(self) -> int:
        """The number of visible points over all views."""
        return int(np.count_nonzero(np.asarray(self.visible)))

    def usable_views(self, minimum_points: int = 4) -> np.ndarray:
        """Return the indices of the views with no fewer than `minimum_points` visible points."""
        return np.flatnonzero(np.asarray(self.visible).sum(axis=1) >= minimum_points)

    def with_visible(self, visible: Bool[np.ndarray, "views points"]) -> "Dataset":
        """Return the data set with these observations only, of those that are visible."""
        return dataclasses.replace(
            self, visible=to_device(np.asarray(self.visible) & np.asarray(visible))
        )

    def mask_views(self, views: Sequence[int] | np.ndarray) -> "Dataset":
        """Return the data set with some views masked; shapes stay, so nothing is compiled again."""
        unmasked = np.ones(self.view_count, dtype=bool)
        unmasked[list(views)] = False
        visible = np.asarray(self.visible) & unmasked[:, None]
        pixels = np.where(visible[..., None], self.pixels, np.nan)
        visible, pixels = jax.device_put((visible, pixels))
        return dataclasses.replace(self, visible=visible, pixels=pixels)

    def select(self, views: Sequence[int] | np.ndarray) -> "Dataset":
        """Return a data set of the given views only, in the given order.

        Args:
            views: indices, each once; or a mask over all views.

        Raises:
            ValueError: an index occurs twice.
        """
        # NumPy indexing accepts both indices and masks; an empty list would become an array of
        # floats, which is no index.
        index = np.arange(self.view_count)[np.asarray(views)] if len(views) else np.zeros(0, int)
        if len(np.unique(index)) < len(index):
            raise ValueError(f"views: expected each index once, found {list(views)}")
        ids = tuple(self.view_ids[i] for i in index)

        def taken(values: Array) -> Array:
            """Return the given views' entries; NumPy needs no program for each number of views."""
            return jax.device_put(np.asarray(values)[index])

        return Dataset(
            points=taken(self.points),
            pixels=taken(self.pixels),
            visible=taken(self.visible),
            base_from_tool=SE3(taken(self.base_from_tool.wxyz_xyz)),
            view_ids=ids,
            image_size=self.image_size,
            mount=self.mount,
            masked_views=tuple(entry for entry in self.masked_views if entry[0] in ids),
            pictures=None if self.pictures is None else tuple(self.pictures[i] for i in index),
            target=self.target,
            joints=None if self.joints is None else taken(self.joints),
            arm=self.arm,
            notes=self.notes,
        )


def _points_per_view(points: np.ndarray, view_count: int, point_count: int) -> np.ndarray:
    """Return points as `(views, points, 3)`, or as `(1, points, 3)` if common to all views.

    Raises:
        ValueError: the shape does not match the pixels.
    """
    if points.shape == (point_count, 3):
        return points[None]
    if points.shape != (view_count, point_count, 3):
        raise ValueError(
            f"points: expected shape ({point_count}, 3) or ({view_count}, {point_count}, 3) to "
            f"match pixels, found {points.shape}"
        )
    return points


def _forward_kinematics(
    joints: np.ndarray | Array | None, arm: SerialArm | None, ids: tuple[str, ...]
) -> SE3:
    """Compute `base_from_tool` of every view by the arm's forward kinematics.

    Raises:
        ValueError: joints or arm are missing, or the shape is wrong.
    """
    if joints is None or arm is None:
        raise ValueError(
            "expected poses, or joints and the arm they are of; found "
            f"{'neither' if joints is arm else 'joints alone' if arm is None else 'an arm alone'}"
        )
    readings = np.asarray(joints, dtype=float)
    if readings.shape != (len(ids), arm.joint_count):
        raise ValueError(
            f"joints: expected shape ({len(ids)}, {arm.joint_count}), one reading a joint in every "
            f"view, found {readings.shape}"
        )
    return arm.base_from_tool(readings)


@compiled
def _pose_difference(first: SE3, second: SE3) -> Float[Array, "*views 6"]:
    """Return the twist from one pose to another, `log(first^-1 second)`."""
    return (first.inverse() @ second).log()


def _check_forward_kinematics(
    computed: SE3, reported: SE3, used: Bool[np.ndarray, "views"], ids: tuple[str, ...]
) -> None:
    """Raise a ValueError if a reported pose differs from the arm's forward kinematics.

    The tool frame, the pose convention or the arm is then wrong.
    """
    # The difference is the twist log(computed^-1 reported): translation (m), then rotation (rad).
    twist = np.asarray(_pose_difference(computed, reported))
    # Largest component of each of the two; NaN fails the comparison below.
    max_components = np.abs(twist).reshape(-1, 2, 3).max(axis=2)
    for view in np.flatnonzero(used):
        translation, rotation = max_components[view]
        if not (
            translation <= FORWARD_KINEMATICS_TOLERANCE[0]
            and rotation <= FORWARD_KINEMATICS_TOLERANCE[1]
        ):
            raise ValueError(
                f"view {ids[view]}: the reported pose is {1e3 * translation:.3g} mm and "
                f"{np.rad2deg(rotation):.3g} deg from where the arm's joints put the tool: another "
                "tool frame, convention or arm?"
            )


def _pose_matrices(base_from_tool: PoseLike, view_count: int) -> np.ndarray:
    """Return poses as `(views, 4, 4)` matrices, or raise a ValueError for another shape."""
    # Matrices are kept as given, not converted to SE3 first, which would normalise their rotations
    # and hide from `check_rigid` those that are not rigid.
    if not isinstance(base_from_tool, SE3):
        matrices = np.asarray(base_from_tool, dtype=float)
    else:
        matrices = host_matrices(base_from_tool)
    if matrices.shape != (view_count, 4, 4):
        raise ValueError(
            f"base_from_tool: expected shape ({view_count}, 4, 4), one pose a view, "
            f"found {matrices.shape}"
        )
    return matrices


def _view_ids(view_ids: Sequence[str | int] | None, view_count: int) -> tuple[str, ...]:
    """Return view ids as text, or raise a ValueError for a wrong number or duplicates."""
    ids = tuple(str(view) for view in (range(view_count) if view_ids is None else view_ids))
    if len(ids) != view_count:
        raise ValueError(f"view_ids: expected {view_count}, found {len(ids)}")
    # Poses and pictures are paired by id, so a duplicate would pair them wrongly.
    duplicates = sorted({view for view in ids if ids.count(view) > 1})
    if duplicates:
        raise ValueError(f"view_ids: {', '.join(duplicates)} given more than once")
    return ids


def _visibility_mask(
    visible: np.ndarray | Array | None, pixels: np.ndarray, ids: tuple[str, ...]
) -> np.ndarray:
    """Return the mask of visible points, or raise a ValueError if a visible one has no pixel."""
    has_numbers = np.asarray(np.isfinite(pixels).all(axis=-1))
    if visible is None:
        return has_numbers
    seen = np.array(visible, dtype=bool)
    if seen.shape != has_numbers.shape:
        raise ValueError(f"visible: expected shape {has_numbers.shape}, found {seen.shape}")
    # Mask and pixels contradict each other: neither is silently preferred.
    missing = seen & ~has_numbers
    if missing.any():
        view, point = np.argwhere(missing)[0]
        raise ValueError(f"view {ids[view]}: point {point} is marked visible but has no pixel")
    return seen


def _pixel_problems(
    pixels: np.ndarray, seen: np.ndarray, image_size: tuple[int, int], ids: tuple[str, ...]
) -> dict[str, str]:
    """Return the views with a pixel outside the picture, with the reason.

    Detected corners may lie up to one pixel beyond the edge.
    """
    width, height = image_size
    if width <= 0 or height <= 0:
        raise ValueError(f"image_size: expected a positive width and height, found {image_size}")
    limits = np.array([width, height], dtype=float)
    with np.errstate(invalid="ignore"):
        # Pixel centres are at integers, so the picture ends half a pixel beyond the outermost ones.
        outside = seen & ((pixels < -1.0) | (pixels > limits)).any(axis=-1)
    problems = {}
    for view in np.flatnonzero(outside.any(axis=1)):
        point = int(np.flatnonzero(outside[view])[0])
        u, v = pixels[view, point]
        problems[ids[view]] = (
            f"point {point} at ({u:.1f}, {v:.1f}) px lies outside the {width} x {height} picture"
        )
    return problems


def _finite_views(matrices: np.ndarray) -> np.ndarray:
    """Return which matrices are finite, with shape `(views, 1, 1)`."""
    return np.asarray(np.isfinite(matrices).all(axis=(1, 2), keepdims=True))
