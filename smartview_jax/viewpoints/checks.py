"""What may be wrong with a viewpoint before the robot moves: masks, and reasons in words."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float

from ..calibration import Calibration
from ..geometry import transform_points
from ..robots import FARTHEST, Command, JointSolution
from .reach import singular, words

REASONS = {
    "reach": "the arm does not get there",
    "absurd": "the tool is {:.4g} m from the base: no arm is that long; millimetres as metres?",
    "side": "the camera is {:.3f} m behind the target's plane: on the side that was not seen",
    "tool_side": "the tool is {:.3f} m behind the target's plane: through what the target lies on",
    "viewed_region": "the camera is {:.1f} times as far from the middle of the calibrated views as "
    "the farthest of them",
    "singular": "the arm is singular there",
    "in_picture": "only {:.0%} of the target is well inside the picture",
    "near_focus": "the target is as near as {:.3f} m: too near to be sharp",
    "far_focus": "the target is as far as {:.3f} m: too far to be sharp",
    "camera_clearance": "the camera is {:.3f} m above the table: too low",
    "tool_clearance": "the tool is {:.3f} m above the table: too low",
    "known_region": "{:.1f} times as far out as the poses that the robot's error is known from",
}
"""What it means that a check failed; the number is what was measured.

Of an arm that is known its own words are said instead.
"""

DANGERS = ("reach", "absurd", "side", "tool_side", "viewed_region", "known_region")
"""Checks without which no robot should be sent anywhere, unless a person says so."""


def _number(value: object) -> Float[Array, "..."]:
    return jnp.asarray(value, dtype=float)


class Table(eqx.Module):
    """A plane that nothing may come near to, in the base's frame.

    Camera and tool are spheres, of radius `camera` about the camera's centre and `tool` about the
    tool's origin. That is all that is looked at: cables, links and whatever else stands about are
    not.

    Attributes:
        point: on the plane, m.
        normal: away from it, to the side where the robot works; of any length.
        camera, tool: least heights above the plane, m.
    """

    point: Float[Array, "3"] = eqx.field(converter=_number, default=(0.0, 0.0, 0.0))
    normal: Float[Array, "3"] = eqx.field(converter=_number, default=(0.0, 0.0, 1.0))
    camera: Float[Array, ""] = eqx.field(converter=_number, default=0.05)
    tool: Float[Array, ""] = eqx.field(converter=_number, default=0.05)

    def height(self, place: Float[Array, "*views 3"]) -> Float[Array, "*views"]:
        """Of places in the base's frame above the plane, m."""
        offset = place - jnp.broadcast_to(self.point, place.shape)
        return offset @ (self.normal / jnp.linalg.norm(self.normal))


class Limits(eqx.Module):
    """What a viewpoint has to keep.

    Attributes:
        margin: between the picture's border and a target point that counts as seen, px.
        share: of the target's points that have to be seen.
        focus: least and greatest depth of target points, m: where the lens is sharp.
        table: what camera and tool stay clear of; None is nothing.
        extent: how far out poses may be where the robot's error is corrected; 1 is about the edge
            of the poses that it was found from.
        viewed: how far out cameras may stand, in multiples of the farthest of the views that the
            calibration was fitted to, from their middle.
    """

    margin: Float[Array, ""] = eqx.field(converter=_number, default=0.0)
    share: Float[Array, ""] = eqx.field(converter=_number, default=1.0)
    focus: Float[Array, "2"] = eqx.field(converter=_number, default=(0.0, np.inf))
    table: Table | None = None
    extent: Float[Array, ""] = eqx.field(converter=_number, default=1.5)
    viewed: Float[Array, ""] = eqx.field(converter=_number, default=2.0)


class Checks(eqx.Module):
    """What was checked of every viewpoint; keys are those of `REASONS`.

    Attributes:
        passed: by check; checks that could not be made are not in it.
        measured: the number that decided.
        arm: how the arm gets there; None where no arm is known.
    """

    passed: dict[str, Bool[Array, "*views"]]
    measured: dict[str, Float[Array, "*views"]]
    arm: JointSolution | None = None

    @property
    def ok(self) -> Bool[Array, "*views"]:
        """Where nothing is wrong."""
        return jnp.all(jnp.stack(list(self.passed.values())), axis=0)

    @property
    def safe(self) -> Bool[Array, "*views"]:
        """Where none of the `DANGERS` is, as far as they could be checked."""
        masks = [mask for name, mask in self.passed.items() if name in DANGERS]
        return jnp.all(jnp.stack(masks), axis=0)

    def dangers(self) -> tuple[str, ...]:
        """Say which of the `DANGERS` each viewpoint has, in their flat order."""
        return self.reasons(DANGERS)

    def reasons(self, among: tuple[str, ...] = tuple(REASONS)) -> tuple[str, ...]:
        """Say what is wrong with each viewpoint, in their flat order; empty where nothing is.

        Args:
            among: the checks to speak of.
        """
        failed = {name: ~np.ravel(mask) for name, mask in self.passed.items()}
        measured = {name: np.ravel(values) for name, values in self.measured.items()}
        checks = [name for name in REASONS if name in failed and name in among]
        return tuple(
            # Where the arm does not get, the other numbers mean nothing.
            self._words("reach", 0.0, k)
            if failed["reach"][k]
            else "; ".join(self._words(n, measured[n][k], k) for n in checks if failed[n][k])
            for k in range(np.size(self.ok))
        )

    def _words(self, check: str, measured: float, view: int) -> str:
        if self.arm is not None and check in ("reach", "singular"):
            return words(self.arm, view)
        return REASONS[check].format(measured)


def check_views(
    calibration: Calibration,
    command: Command,
    camera_from_world: SE3,
    points: Float[Array, "points 3"] | None,
    arm: JointSolution | None,
    limits: Limits,
) -> Checks:
    """Every check that what is given allows.

    Args:
        calibration: of camera and robot.
        command: what the robot would be told, `(*views)`.
        camera_from_world: where the camera would then be.
        points: of the target, m; None leaves out what concerns them.
        arm: how the arm gets there; None where no arm is known.
        limits: what to keep.
    """
    views = camera_from_world.get_batch_axes()
    finite = jnp.all(jnp.isfinite(camera_from_world.wxyz_xyz), axis=-1)
    passed, measured = {"reach": finite}, {"reach": jnp.zeros(views)}
    if arm is not None:
        passed = {"reach": arm.reached, "singular": ~singular(arm)}
        measured["singular"] = jnp.zeros(views)

    def note(name: str, value: Array, fine: Array) -> None:
        passed[name], measured[name] = fine, value

    if points is not None:
        in_camera = transform_points(camera_from_world, calibration.target_scale * points)
        inside = border_distance(calibration, in_camera) >= limits.margin
        seen = jnp.mean(inside.astype(float), axis=-1)
        note("in_picture", seen, seen >= limits.share - 1e-9)
        nearest, farthest = (f(in_camera[..., 2], axis=-1) for f in (jnp.min, jnp.max))
        note("near_focus", nearest, nearest >= limits.focus[0])
        note("far_focus", farthest, farthest <= limits.focus[1])
    error = calibration.robot_error
    far = jnp.max(jnp.abs(command.base_from_tool.translation()), axis=-1)
    note("absurd", far, far <= FARTHEST)
    if calibration.region is not None:
        _note_region(calibration, command, camera_from_world, limits, note)
    if limits.table is not None:
        true = command.base_from_tool if error is None else error.true_pose(command)
        camera = _camera_in_base(calibration, true)
        for name, place, least in (
            ("camera_clearance", camera, limits.table.camera),
            ("tool_clearance", true.translation(), limits.table.tool),
        ):
            height = limits.table.height(place)
            note(name, height, height >= least)
    if error is not None:
        extent = error.field.extent(command)
        note("known_region", extent, extent <= limits.extent)
    return Checks(passed, measured, arm)


def _note_region(
    calibration: Calibration,
    command: Command,
    camera_from_world: SE3,
    limits: Limits,
    note: Callable[[str, Array, Array], None],
) -> None:
    """Checks against the views that the calibration was fitted to."""
    region = calibration.region
    assert region is not None
    cameras = camera_from_world.inverse().translation()
    height = region.height(cameras)
    note("side", -height, (height > 0.0) | (region.side == 0.0))
    if calibration.mount == "eye_in_hand":
        world_from_holder = calibration.holder_from_world.inverse()
        places = command.base_from_tool.translation()
        rotation = world_from_holder.rotation().as_matrix()
        tools = places @ rotation.T + jnp.broadcast_to(
            world_from_holder.translation(), places.shape
        )
        height = region.height(tools)
        # Beside the target the tool may have been lower than it, and may be so again.
        note("tool_side", -height, height >= jnp.minimum(region.lowest_tool, 0.0))
    extent = region.extent(cameras)
    note("viewed_region", extent, extent <= limits.viewed)


def border_distance(
    calibration: Calibration, in_camera: Float[Array, "*points 3"]
) -> Float[Array, "*points"]:
    """Of points in the camera's frame from the picture's border, px; negative outside.

    Minus infinity where a point cannot be projected at all.
    """
    pixels, valid = calibration.camera.project(in_camera)
    width, height = calibration.camera.image_size
    u, v = (jnp.where(valid, pixels[..., k], 0.0) for k in range(2))
    distance = jnp.minimum(jnp.minimum(u, width - 1.0 - u), jnp.minimum(v, height - 1.0 - v))
    return jnp.where(valid, distance, -jnp.inf)


def _camera_in_base(calibration: Calibration, base_from_tool: SE3) -> Float[Array, "*views 3"]:
    """Centre of the camera in the base's frame, m."""
    centre = calibration.camera_from_mount.inverse().translation()
    if calibration.mount == "eye_to_hand":
        return jnp.broadcast_to(centre, base_from_tool.translation().shape)
    return base_from_tool.apply(jnp.broadcast_to(centre, base_from_tool.translation().shape))
