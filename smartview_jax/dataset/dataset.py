"""Hold the observations of a target from several robot poses, checked when a data set is built."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..argument_checks import require_one_of, spelling_suggestion
from ..calibration import ONE_ARM_MOUNTS, host_mount_from_holder
from ..geometry import PoseLike, as_se3, check_rigid, host_matrices
from ..robots import Command, HandPoses, SerialArm
from ..runtime.array_namespace import to_device
from ..runtime.compilation import is_traced, refuse_traced
from ..runtime.modules import HostModule, with_fields
from .dataset_text import dataset_text
from .depth_readings import DepthNoise, DepthReadings, depth_readings
from .input_checks import (
    check_forward_kinematics,
    checked_matrices,
    checked_view_ids,
    finite_views,
    forward_kinematics,
    pixel_problems,
    points_per_view,
    visibility_mask,
)
from .observations import Observations

MINIMUM_RELIABLE_VIEWS = 8
"""Smallest number of views for a reliable result in which a single wrong view is recognised.

In a fit to six good views of a real data set, one view had fourteen times the misfit of the others.
Without this view, the error on a held-out view was six times as large.
"""


class Dataset(HostModule):
    """A data set: points, pixels and robot poses of all views, with names and masks.

    An instance is immutable.

    Attributes:
        points, pixels, visible, base_from_tool: as in `Observations`, padded to one shape.
        view_ids: one name per view.
        image_size: width and height, px.
        mount: `"eye_in_hand"`, `"eye_to_hand"`, or `"hand_to_hand"`, which `between_hands` makes.
        masked_views: view id and reason of every view that is kept but not used.
        pictures: one file per view, if known.
        target: the description of the target, if known (a class of `targets`).
        joints: as in `Observations`.
        arm: the arm whose joints these are, if known.
        notes: sentences on assumptions made when the data were read.
        pose_format: format in which the robot's controller writes poses, a key of `POSE_CODECS`;
            None if it is not known.
        depths: depths that the camera measured at the points; None without a depth sensor.
        depth_noise: standard deviation of these depths.
        hands: poses of two hands, one with the camera and one with the target. `base_from_tool` is
            then the pose of the camera's hand in the other hand's frame, for assumed places of the
            bases (`with_bases`). None for one arm.

    For example:

        >>> pixels = np.array(data.pixels)  # (views, points, 2)
        >>> pixels[2] = np.nan  # the target was not found in this picture
        >>> mine = sv.Dataset.from_arrays(points, pixels, data.base_from_tool, (640, 480))
        >>> print(mine.view_count, mine.observation_count, mine.usable_views())
        8 96 [0 1 3 4 5 6 7]
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
    pose_format: str | None = eqx.field(static=True, default=None)
    depths: DepthReadings | None = None
    depth_noise: DepthNoise | None = eqx.field(static=True, default=None)
    hands: HandPoses | None = None

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
            mount: `"eye_in_hand"` (camera on the tool) or `"eye_to_hand"` (fixed camera).
            bad_views: for a view with wrong values (a pose that is not rigid, a pixel far outside
                the picture), `"raise"` an error or `"mask"` the view and keep the reason.
            masked_views: views already known to be unusable, with the reason.
            pictures: one picture file per view.
            joints: `(M, joints)` readings, rad, or m for a prismatic joint.
            arm: the arm whose joints these are, with its controller's nominal parameters. Poses
                that are given as well must agree with it.
            notes: sentences on assumptions made when the data were read.

        Raises:
            ValueError: a wrong shape, a duplicate id, or, unless masked, a wrong value; the
                message names the view.
        """
        refuse_traced("Dataset.from_arrays", points, pixels, base_from_tool, joints)
        require_one_of("mount", mount, ONE_ARM_MOUNTS)
        if bad_views not in ("raise", "mask"):
            raise ValueError(f"bad_views is 'raise' or 'mask'; found {bad_views!r}")
        # Copied, because masked pixels are overwritten below.
        pixels = np.array(pixels, dtype=float)
        if pixels.ndim != 3 or pixels.shape[-1] != 2:
            raise ValueError(f"pixels: expected shape (views, points, 2), found {pixels.shape}")
        view_count, point_count = pixels.shape[:2]
        # Each helper checks the shape of one argument and brings it to its common form.
        points = points_per_view(np.asarray(points, dtype=float), view_count, point_count)
        ids = checked_view_ids(view_ids, view_count)
        if base_from_tool is None:
            base_from_tool = forward_kinematics(joints, arm, ids)
        matrices = checked_matrices("base_from_tool", base_from_tool, view_count)
        is_visible = visibility_mask(visible, pixels, ids)

        wrong_values = check_rigid(matrices, ids)
        for view, problem in pixel_problems(pixels, is_visible, image_size, ids).items():
            wrong_values.setdefault(view, problem)
        reasons = _mask_reasons(dict(masked_views), wrong_values, ids, bad_views == "mask")

        # Masked views stay in the arrays, with finite poses: one NaN would spread through sums.
        usable = np.array([view not in reasons for view in ids], dtype=bool)
        matrices = np.where(usable[:, None, None] | finite_views(matrices), matrices, np.eye(4))
        is_visible = is_visible & usable[:, None]
        points_finite = np.broadcast_to(np.isfinite(points).all(axis=-1), is_visible.shape)
        if not points_finite[is_visible].all():
            raise ValueError("points: a target point that is visible has NaN coordinates")
        # With NaN, code that ignores the mask fails visibly.
        pixels[~is_visible] = np.nan
        # The arrays are copies, because `device_put` may share memory with the caller's arrays;
        # unlike `jnp.asarray` it compiles no program.
        data = cls(
            points=to_device(np.broadcast_to(np.nan_to_num(points), (*is_visible.shape, 3))),
            pixels=to_device(pixels),
            visible=to_device(is_visible),
            base_from_tool=as_se3(matrices),
            view_ids=ids,
            image_size=(int(image_size[0]), int(image_size[1])),
            mount=mount,
            masked_views=tuple((view, reasons[view]) for view in ids if view in reasons),
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
        if self.hands is not None:
            raise ValueError("with_joints: expected the poses of one arm, found two arms")
        computed = forward_kinematics(joints, arm, self.view_ids)
        masked = {view for view, _ in self.masked_views}
        used = np.array([view not in masked for view in self.view_ids], dtype=bool)
        # Masked views are not compared: a wrong pose may be the reason why they are masked.
        check_forward_kinematics(computed, self.base_from_tool, used, self.view_ids)
        poses = np.where(used[:, None], computed.wxyz_xyz, self.base_from_tool.wxyz_xyz)
        # Joint readings of masked views may be NaN, which would spread through sums over views.
        readings = np.nan_to_num(np.asarray(joints, dtype=float))
        return dataclasses.replace(
            self,
            base_from_tool=SE3(to_device(poses)),
            joints=to_device(readings),
            arm=arm,
        )

    def between_hands(
        self,
        other_base_from_other_tool: PoseLike,
        base_from_other_base: PoseLike | None = None,
    ) -> "Dataset":
        """Return the data set of this camera on a hand for a target that another arm carries.

        A fit then finds where both bases are to each other, too. The errors of both arms add up to
        one error in each view, of one hand's pose in the other's frame: its noise, stated or
        estimated, is about the point midway between the hands, where rotation and translation are
        independent if both arms err alike.

        Args:
            other_base_from_other_tool: `(views)` poses of the hand with the target, as the arm
                that carries it reported them, in its own base.
            base_from_other_base: approximate base of this arm in the base of the camera's arm; by
                default `calibrate` searches for it.

        Raises:
            ValueError: a wrong shape, a pose that is not rigid (the message names the view), or a
                data set whose target is not seen from a hand, or that has an arm's joints.
        """
        if self.mount != "eye_in_hand" or self.joints is not None:
            kind = self.mount if self.joints is None else "a data set with joints"
            raise ValueError(
                f"between_hands: expected an eye_in_hand data set without joints, found {kind}"
            )
        matrices = checked_matrices(
            "other_base_from_other_tool", other_base_from_other_tool, self.view_count
        )
        masked = {view for view, _ in self.masked_views}
        wrong = check_rigid(matrices, self.view_ids)
        for view, text in wrong.items():
            if view not in masked:
                raise ValueError(f"other_base_from_other_tool: view {view}: {text}")
        # Another camera may have seen its target in a state whose view is masked here.
        is_pose = np.array([view not in wrong for view in self.view_ids], dtype=bool)
        matrices = np.where(is_pose[:, None, None], matrices, np.eye(4))
        hands = HandPoses(self.base_from_tool, as_se3(matrices))
        between = dataclasses.replace(self, mount="hand_to_hand", hands=hands)
        return between.with_bases(
            as_se3(np.eye(4) if base_from_other_base is None else base_from_other_base)
        )

    @property
    def mount_from_holder(self) -> SE3:
        """The robot's part of the chain as reported, from the target's holder to the mount."""
        return host_mount_from_holder(self.mount, self.base_from_tool)

    @property
    def base_from_other_base(self) -> SE3 | None:
        """The assumed base of the other arm in the base of the camera's; None for one arm."""
        if self.hands is None:
            return None
        this_arm, other, relative = (
            host_matrices(SE3(np.asarray(poses.wxyz_xyz)[0]))  # pyright: ignore[reportArgumentType]
            for poses in (
                self.hands.base_from_tool,
                self.hands.other_base_from_other_tool,
                self.base_from_tool,
            )
        )
        return as_se3(this_arm @ np.linalg.inv(relative) @ np.linalg.inv(other))

    def with_bases(self, base_from_other_base: SE3) -> "Dataset":
        """Return the data of two arms with their bases so placed; of one arm as they are."""
        if self.hands is None:
            return self
        poses = self.hands.host_other_tool_from_tool(base_from_other_base)
        return dataclasses.replace(self, base_from_tool=SE3(to_device(poses.wxyz_xyz)))

    def with_depths(
        self, depths: np.ndarray | Array | None, noise: DepthNoise | None = None
    ) -> "Dataset":
        """Return the data set with depths that the camera measured at the points.

        A fit then uses three numbers of a point, and estimates the bias of the depths, scale and
        offset, as well.

        Args:
            depths: `(views, points)` along the camera's optical axis, m, as depth pictures have
                them (not the distance from the camera's centre); NaN where there is none. None
                drops the depths.
            noise: standard deviation of the depths, if the sensor states it; by default estimated
                from their scatter about planes.

        Raises:
            ValueError: a wrong shape, a depth that is not above 0, another unit than metres, or too
                few depths to estimate their noise; the message names the view.

        For example:

            >>> camera_from_world = truth.camera_from_world(scene.base_from_tool)
            >>> points = camera_from_world.as_matrix() @ np.insert(data.points, 3, 1, 2).mT
            >>> rng = np.random.default_rng(0)
            >>> depths = points[:, 2] + 1e-3 * rng.normal(size=data.visible.shape)
            >>> print(f"{1e3 * data.with_depths(depths).depth_noise.constant:.1f} mm")
            0.9 mm
        """
        if depths is None:
            return dataclasses.replace(self, depths=None, depth_noise=None)
        values = np.array(depths, dtype=float)
        if values.shape != self.visible.shape:
            raise ValueError(
                f"depths: expected shape {self.visible.shape} (views, points), found {values.shape}"
            )
        if len(wrong := np.argwhere(values <= 0.0)):
            view, point = wrong[0]
            raise ValueError(
                f"depths: view {self.view_ids[view]}, point {point}: expected above 0 m, found "
                f"{values[view, point]:.4g}; NaN where there is none"
            )
        readings, noise = depth_readings(
            np.asarray(self.points), values, np.asarray(self.visible), noise
        )
        known = np.isfinite(values) & np.asarray(self.visible)
        left_out = int((known & ~readings.used).sum())
        note = f"{left_out} of {known.sum()} depths are far from the plane of the view's others"
        notes = (*self.notes, f"{note}, and left out") if left_out else self.notes
        return dataclasses.replace(self, depths=readings, depth_noise=noise, notes=notes)

    def __repr__(self) -> str:
        # A traced data set, inside `jit`, has no numbers to show.
        return super().__repr__() if is_traced(self) else dataset_text(self)

    @property
    def observations(self) -> Observations:
        """The arrays of the data set, without names."""
        return Observations(
            self.points,
            self.pixels,
            self.visible,
            self.base_from_tool,
            self.joints,
            self.depths,
            self.hands,
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
        """Return the data set with only the given visible observations."""
        visible = np.asarray(self.visible) & np.asarray(visible)
        return with_fields(self, visible=to_device(visible))

    def mask_views(self, views: Sequence[int] | np.ndarray) -> "Dataset":
        """Return the data set with some views masked; shapes and so compiled programs stay."""
        unmasked = np.ones(self.view_count, dtype=bool)
        unmasked[list(views)] = False
        visible = np.asarray(self.visible) & unmasked[:, None]
        pixels = np.where(visible[..., None], self.pixels, np.nan)
        visible, pixels = jax.device_put((visible, pixels))
        return with_fields(self, visible=visible, pixels=pixels)

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
        return dataclasses.replace(
            self,
            **self._arrays_of(index),
            view_ids=ids,
            masked_views=tuple(entry for entry in self.masked_views if entry[0] in ids),
            pictures=None if self.pictures is None else tuple(self.pictures[i] for i in index),
        )

    def without(self, views: str | Sequence[str]) -> "Dataset":
        """Return the data set without some views, to fit the others.

        Args:
            views: names of the views, as in `view_ids`, such as `data.without(["3", "7"])`.

        Raises:
            ValueError: the data set has no view of such a name.
        """
        names = {views} if isinstance(views, str) else set(views)
        if unknown := sorted(names - set(self.view_ids)):
            hint = spelling_suggestion(unknown[0], self.view_ids)
            raise ValueError(f"views: no view is called {', '.join(map(repr, unknown))}{hint}")
        return self.select(np.array([view not in names for view in self.view_ids], dtype=bool))

    def _arrays_of(self, index: np.ndarray) -> dict[str, Any]:
        """Return the arrays of the given views, by name."""
        names = ("points", "pixels", "visible", "base_from_tool", "joints", "depths", "hands")
        arrays = tuple(getattr(self, name) for name in names)
        return dict(zip(names, of_views(arrays, index), strict=True))


def of_views(arrays: Any, index: np.ndarray) -> Any:
    """Return the entries of some views in all arrays; indexing by NumPy compiles nothing."""
    return jax.tree.map(lambda values: jax.device_put(np.asarray(values)[index]), arrays)


def _mask_reasons(
    given: dict[str, str], wrong_values: dict[str, str], ids: Sequence[str], mask: bool
) -> dict[str, str]:
    """Return why views are masked, by their names; the caller's reasons take precedence."""
    unknown = set(given) - set(ids)
    if unknown:
        raise ValueError(f"masked_views: no view is called {sorted(unknown)}")
    wrong_values = {view: text for view, text in wrong_values.items() if view not in given}
    if wrong_values and not mask:
        raise ValueError("; ".join(f"view {view}: {text}" for view, text in wrong_values.items()))
    return {**wrong_values, **given}
