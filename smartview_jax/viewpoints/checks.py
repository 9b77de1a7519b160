"""Check viewpoints for problems before the robot moves, with masks and reasons in words."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..geometry import transform_points
from ..robots import MAX_TOOL_COORDINATE, Command, JointSolution
from ..runtime.array_namespace import as_float_array, to_device
from ..runtime.compilation import is_traced, one_program

CHECK_MESSAGES = {
    "reach": "the arm does not get there",
    "tool_distance": "the tool is {:.4g} m from the base: no arm is that long; "
    "millimetres as metres?",
    "side": "the camera is {:.3f} m behind the target's plane",
    "tool_side": "the tool is {:.3f} m behind the target's plane, where its support is",
    "viewed_region": "the camera is {:.1f} times as far from the middle of the calibrated views as "
    "these were from the target",
    "singular": "the arm is singular there",
    "in_picture": "only {:.0%} of the target is well inside the picture",
    "near_focus": "the nearest target point is at {:.3f} m: too near to be sharp",
    "far_focus": "the farthest target point is at {:.3f} m: too far to be sharp",
    "camera_clearance": "the camera is {:.3f} m above the table: too low",
    "tool_clearance": "the tool is {:.3f} m above the table: too low",
    "known_region": "{:.1f} times as far out as the poses from which the robot's error was "
    "estimated: the correction fades there, and the stated error grows",
}
"""Message of each failed check; the number in it is the measured value.

For a known arm, its own message about reach and singularity is used instead.
"""

SAFETY_CHECKS = ("reach", "tool_distance", "side", "tool_side", "viewed_region")
"""The names of the checks that a robot must pass to move, unless a person overrides them."""

ALLOWING_WORDS = {
    "unreachable": ("reach", "tool_distance"),
    "behind-target": ("side", "tool_side"),
    "outside-region": ("viewed_region",),
}
"""The checks that a person overrides by each word."""


class ClearancePlane(eqx.Module):
    """A plane in the base frame from which camera and tool must keep a distance.

    The camera is modelled as a sphere of radius `camera_clearance` about its centre, the tool as a
    sphere of radius `tool_clearance` about its origin. Nothing else is checked: not cables, links
    or other obstacles.

    Attributes:
        point: a point on the plane, m.
        normal: normal of the plane, on the side where the robot works; of any length.
        camera_clearance, tool_clearance: smallest allowed heights above the plane, m.
    """

    point: Float[Array, "3"] = eqx.field(converter=as_float_array, default=(0.0, 0.0, 0.0))
    normal: Float[Array, "3"] = eqx.field(converter=as_float_array, default=(0.0, 0.0, 1.0))
    camera_clearance: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.05)
    tool_clearance: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.05)

    def height(self, position: Float[Array, "*views 3"]) -> Float[Array, "*views"]:
        """Return the height above the plane of positions in the base frame, m."""
        offset = position - jnp.broadcast_to(self.point, position.shape)
        return offset @ (self.normal / jnp.linalg.norm(self.normal))


class Limits(eqx.Module):
    """The limits that a viewpoint has to keep.

    Attributes:
        border_margin: smallest distance from the picture's border to a target point that counts as
            visible, px.
        min_visible_fraction: smallest fraction of the target's points that have to be visible.
        focus_range: smallest and largest depth of target points at which the lens is sharp, m.
        clearance_plane: plane that camera and tool keep clear of; None for no plane.
        max_error_field_extent: largest normalised distance of poses at which the robot error is
            corrected; 1 is about the edge of the poses from which it was estimated.
        max_viewed_region_extent: largest normalised distance of cameras from the centroid of the
            views that the calibration was fitted to; 1 is the farthest distance of such a view from
            the target (see `ViewedRegion.normalised_distance`).
    """

    border_margin: Float[Array, ""] = eqx.field(converter=as_float_array, default=0.0)
    min_visible_fraction: Float[Array, ""] = eqx.field(converter=as_float_array, default=1.0)
    focus_range: Float[Array, "2"] = eqx.field(converter=as_float_array, default=(0.0, np.inf))
    clearance_plane: ClearancePlane | None = None
    max_error_field_extent: Float[Array, ""] = eqx.field(converter=as_float_array, default=1.5)
    max_viewed_region_extent: Float[Array, ""] = eqx.field(converter=as_float_array, default=2.0)


class Checks(eqx.Module):
    """The results of the checks of every viewpoint, by the names in `CHECK_MESSAGES`.

    Attributes:
        passed: whether each check passed, by name; checks that could not be made are missing.
        measured: measured value of each check, by name.
        joint_solution: inverse-kinematics solution; None where no arm is known.
    """

    passed: dict[str, Bool[Array, "*views"]]
    measured: dict[str, Float[Array, "*views"]]
    joint_solution: JointSolution | None = None

    @property
    def ok(self) -> Bool[Array, "*views"]:
        """Whether a viewpoint passes all checks."""
        return _all_of(list(self.passed.values()))

    @property
    def safe(self) -> Bool[Array, "*views"]:
        """Whether a viewpoint passes all `SAFETY_CHECKS` that could be made."""
        masks = [mask for name, mask in self.passed.items() if name in SAFETY_CHECKS]
        return _all_of(masks)

    def failed(self, check_names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the given checks that at least one viewpoint fails."""
        masks = {name: ~np.ravel(self.passed[name]) for name in check_names if name in self.passed}
        # As in `reasons`: for a pose out of reach the other checks do not count.
        reached = ~masks["reach"] if "reach" in masks else True
        return tuple(
            name for name, mask in masks.items() if (mask & (reached | (name == "reach"))).any()
        )

    def reasons(self, check_names: tuple[str, ...] = tuple(CHECK_MESSAGES)) -> tuple[str, ...]:
        """Return the reasons of the named checks that failed, by viewpoint; empty if none did."""
        failed = {name: ~np.ravel(mask) for name, mask in self.passed.items()}
        measured = {name: np.ravel(values) for name, values in self.measured.items()}
        checks = [name for name in CHECK_MESSAGES if name in failed and name in check_names]
        return tuple(
            # For a pose out of reach the values of the other checks have no meaning.
            self._message("reach", 0.0, k)
            if failed["reach"][k] and "reach" in check_names
            else "; ".join(self._message(n, measured[n][k], k) for n in checks if failed[n][k])
            for k in range(next(iter(failed.values())).size)
        )

    def _message(self, check: str, measured: float, view: int) -> str:
        """Return the reason of one check for one view."""
        if self.joint_solution is not None and check in ("reach", "singular"):
            place = np.unravel_index(view, self.joint_solution.status.shape)
            return self.joint_solution.status_text(tuple(map(int, place)))
        return CHECK_MESSAGES[check].format(measured)


def _all_of(masks: list[Bool[Array, "*views"]]) -> Bool[Array, "*views"]:
    if is_traced(masks):
        return jnp.all(jnp.stack(masks), axis=0)
    return to_device(np.all([np.asarray(mask) for mask in masks], axis=0))


@one_program
def check_views(
    calibration: Calibration,
    command: Command,
    camera_from_world: SE3,
    points: Float[Array, "points 3"] | None,
    joint_solution: JointSolution | None,
    limits: Limits,
) -> Checks:
    """Return the results of all checks that the given information allows.

    Without points (m) visibility and focus are not checked; the solution is None without an arm.
    """
    views = camera_from_world.get_batch_axes()
    finite = jnp.all(jnp.isfinite(camera_from_world.wxyz_xyz), axis=-1)
    passed, measured = {"reach": finite}, {"reach": jnp.zeros(views)}
    if joint_solution is not None:
        passed = {"reach": joint_solution.is_solved, "singular": ~joint_solution.is_singular}
        measured["singular"] = jnp.zeros(views)

    # The value of each check is kept with its mask, for the message.
    def record(name: str, value: Array, ok: Array) -> None:
        passed[name], measured[name] = ok, value

    if points is not None:
        in_camera = transform_points(camera_from_world, calibration.target_scale * points)
        inside = border_distance(calibration, in_camera) >= limits.border_margin
        visible_fraction = jnp.mean(inside.astype(float), axis=-1)
        # The tolerance of 1e-9 absorbs the rounding of a mean of zeros and ones.
        record(
            "in_picture", visible_fraction, visible_fraction >= limits.min_visible_fraction - 1e-9
        )
        # The lens is sharp in a range of depths z, not of distances from the camera's centre.
        nearest, farthest = (f(in_camera[..., 2], axis=-1) for f in (jnp.min, jnp.max))
        record("near_focus", nearest, nearest >= limits.focus_range[0])
        record("far_focus", farthest, farthest <= limits.focus_range[1])
    error = calibration.robot_error
    max_coordinate = jnp.max(jnp.abs(command.base_from_tool.translation()), axis=-1)
    record("tool_distance", max_coordinate, max_coordinate <= MAX_TOOL_COORDINATE)
    if calibration.region is not None:
        _check_viewed_region(calibration, command, camera_from_world, limits, record)
    else:
        _check_side_of_camera(calibration, command, camera_from_world, record)
    if limits.clearance_plane is not None:
        # Clearance depends on the robot's actual pose, so the robot error is applied.
        actual_pose = command.base_from_tool if error is None else error.actual_pose(command)
        camera = _camera_in_base(calibration, actual_pose)
        for name, position, min_height in (
            ("camera_clearance", camera, limits.clearance_plane.camera_clearance),
            ("tool_clearance", actual_pose.translation(), limits.clearance_plane.tool_clearance),
        ):
            height = limits.clearance_plane.height(position)
            record(name, height, height >= min_height)
    if error is not None:
        extent = error.field.normalised_distance(command)
        record("known_region", extent, extent <= limits.max_error_field_extent)
    return Checks(passed, measured, joint_solution)


def _check_viewed_region(
    calibration: Calibration,
    command: Command,
    camera_from_world: SE3,
    limits: Limits,
    record: Callable[[str, Array, Array], None],
) -> None:
    """Record the checks against the views that the calibration was fitted to."""
    region = calibration.region
    assert region is not None
    # Heights are positive on the side from which the target was seen. The messages state the
    # distance behind it, hence the minus signs. `side` is zero if both sides were seen.
    cameras = camera_from_world.inverse().translation()
    camera_height = region.height(cameras)
    record("side", -camera_height, (camera_height > 0.0) | (region.side == 0.0))
    if calibration.mount == "eye_in_hand":
        tool_height = region.height(_tool_in_world(calibration, command))
        # The tool must stay above the target's plane. If it was lower, next to the target, in the
        # views of the fit, it may be as low again.
        record("tool_side", -tool_height, tool_height >= jnp.minimum(region.min_tool_height, 0.0))
    extent = region.normalised_distance(cameras)
    record("viewed_region", extent, extent <= limits.max_viewed_region_extent)


def _check_side_of_camera(
    calibration: Calibration,
    command: Command,
    camera_from_world: SE3,
    record: Callable[[str, Array, Array], None],
) -> None:
    """Record the checks of the target's side where no region tells from which side it was seen.

    A camera that looks down on the target's plane, with its whole picture, belongs above the plane,
    and so does the tool that carries it. A camera that also looks along the plane tells no side.
    """
    world_from_camera = camera_from_world.inverse()
    # How steeply the optical axis, z of the camera, meets the plane z = 0 of the world.
    descent = world_from_camera.rotation().as_matrix()[..., 2, 2]
    side = -jnp.sign(descent)
    tells_side = jnp.abs(descent) > jnp.sin(_half_field_of_view(calibration))
    camera_height = side * world_from_camera.translation()[..., 2]
    record("side", -camera_height, (camera_height > 0.0) | ~tells_side)
    if calibration.mount == "eye_in_hand":
        tool_height = side * _tool_in_world(calibration, command)[..., 2]
        record("tool_side", -tool_height, (tool_height >= 0.0) | ~tells_side)


def _half_field_of_view(calibration: Calibration) -> Float[Array, ""]:
    """Return the angle from the optical axis to the picture's corners, without the lens, rad."""
    camera = calibration.camera
    width, height = camera.image_size
    return jnp.arctan(jnp.hypot(0.5 * width / camera.alpha_u, 0.5 * height / camera.alpha_v))


def _tool_in_world(calibration: Calibration, command: Command) -> Float[Array, "*views 3"]:
    """Return the tool's origin in the world, m, for a camera on the hand."""
    # Tool positions p in the world frame: world = R p + t.
    world_from_holder = calibration.holder_from_world.inverse()
    tool_positions = command.base_from_tool.translation()
    rotation = world_from_holder.rotation().as_matrix()
    return tool_positions @ rotation.T + jnp.broadcast_to(
        world_from_holder.translation(), tool_positions.shape
    )


def unchecked(calibration: Calibration, arm_is_known: bool) -> tuple[str, ...]:
    """Return in words which safety checks `check_views` cannot make, with or without an arm."""
    sentences = []
    region = calibration.region
    if region is not None and float(region.side) == 0.0:
        sentences.append("both sides of the target were seen: which side is free is unknown")
    if region is None:
        sentences.append(
            "the calibration has no region: the camera's distance from the calibrated views is not "
            "checked; the target's side is taken from the direction in which the camera looks, and "
            "not checked if the camera looks along the target"
        )
    if not arm_is_known:
        sentences.append("no arm is known (--arm): whether it reaches the pose is not checked")
    sentences.append("collisions of arm, tool and cables are not checked")
    return tuple(sentences)


@one_program
def border_distance(
    calibration: Calibration, in_camera: Float[Array, "*points 3"]
) -> Float[Array, "*points"]:
    """Return the distance, px, from the picture's border of points in the camera frame.

    It is negative outside the picture, and minus infinity where a point cannot be projected.
    """
    pixels, valid = calibration.camera.project(in_camera)
    width, height = calibration.camera.image_size
    u, v = (jnp.where(valid, pixels[..., k], 0.0) for k in range(2))
    # Pixel centres are at 0, 1, ..., width - 1.
    distance = jnp.minimum(jnp.minimum(u, width - 1.0 - u), jnp.minimum(v, height - 1.0 - v))
    return jnp.where(valid, distance, -jnp.inf)


def _camera_in_base(calibration: Calibration, base_from_tool: SE3) -> Float[Array, "*views 3"]:
    """Return the camera's centre in the base frame, m."""
    # The inverse of camera_from_mount has the camera's centre in the mount as its translation. The
    # mount is the base for eye-to-hand, and the tool, which the command displaces, otherwise.
    centre = calibration.camera_from_mount.inverse().translation()
    centres = jnp.broadcast_to(centre, base_from_tool.translation().shape)
    return centres if calibration.mount == "eye_to_hand" else base_from_tool.apply(centres)
