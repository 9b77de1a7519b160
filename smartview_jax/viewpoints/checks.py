"""Check viewpoints for problems before the robot moves, with masks and reasons in words."""

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
"""Message of each failed check; the number in it is the measured value.

For a known arm, its own message about reach and singularity is used instead.
"""

DANGERS = ("reach", "absurd", "side", "tool_side", "viewed_region", "known_region")
"""Names of the checks that a robot must pass before it moves, unless a person overrides them."""


def _number(value: object) -> Float[Array, "..."]:
    """Return a value as an array of floats."""
    return jnp.asarray(value, dtype=float)


class Table(eqx.Module):
    """A plane in the base frame from which camera and tool must keep a distance.

    The camera is modelled as a sphere of radius `camera` about its centre, the tool as a sphere of
    radius `tool` about its origin. Nothing else is checked: not cables, links or other obstacles.

    Attributes:
        point: a point on the plane, m.
        normal: normal of the plane, on the side where the robot works; of any length.
        camera, tool: smallest allowed heights above the plane, m.
    """

    point: Float[Array, "3"] = eqx.field(converter=_number, default=(0.0, 0.0, 0.0))
    normal: Float[Array, "3"] = eqx.field(converter=_number, default=(0.0, 0.0, 1.0))
    camera: Float[Array, ""] = eqx.field(converter=_number, default=0.05)
    tool: Float[Array, ""] = eqx.field(converter=_number, default=0.05)

    def height(self, place: Float[Array, "*views 3"]) -> Float[Array, "*views"]:
        """Return the height above the plane of positions in the base frame, m."""
        offset = place - jnp.broadcast_to(self.point, place.shape)
        return offset @ (self.normal / jnp.linalg.norm(self.normal))


class Limits(eqx.Module):
    """The limits that a viewpoint has to keep.

    Attributes:
        margin: smallest distance from the picture's border to a target point that counts as
            visible, px.
        share: smallest fraction of the target's points that have to be visible.
        focus: smallest and largest depth of target points at which the lens is sharp, m.
        table: plane that camera and tool keep clear of; None for no plane.
        extent: largest extent of poses at which the robot error is corrected; 1 is about the edge
            of the poses that it was estimated from.
        viewed: largest distance of cameras from the middle of the views that the calibration was
            fitted to, in multiples of the farthest of these.
    """

    margin: Float[Array, ""] = eqx.field(converter=_number, default=0.0)
    share: Float[Array, ""] = eqx.field(converter=_number, default=1.0)
    focus: Float[Array, "2"] = eqx.field(converter=_number, default=(0.0, np.inf))
    table: Table | None = None
    extent: Float[Array, ""] = eqx.field(converter=_number, default=1.5)
    viewed: Float[Array, ""] = eqx.field(converter=_number, default=2.0)


class Checks(eqx.Module):
    """The results of the checks of every viewpoint, by the names in `REASONS`.

    Attributes:
        passed: whether each check passed, by name; checks that could not be made are missing.
        measured: measured value of each check, by name.
        arm: inverse-kinematics solution; None where no arm is known.
    """

    passed: dict[str, Bool[Array, "*views"]]
    measured: dict[str, Float[Array, "*views"]]
    arm: JointSolution | None = None

    @property
    def ok(self) -> Bool[Array, "*views"]:
        """Whether a viewpoint passes all checks."""
        return jnp.all(jnp.stack(list(self.passed.values())), axis=0)

    @property
    def safe(self) -> Bool[Array, "*views"]:
        """Whether a viewpoint passes those of the `DANGERS` that could be checked."""
        masks = [mask for name, mask in self.passed.items() if name in DANGERS]
        return jnp.all(jnp.stack(masks), axis=0)

    def dangers(self) -> tuple[str, ...]:
        """Return the reasons among the `DANGERS` for each viewpoint, in flat order."""
        return self.reasons(DANGERS)

    def reasons(self, among: tuple[str, ...] = tuple(REASONS)) -> tuple[str, ...]:
        """Return the reasons of all failed checks for each viewpoint, in flat order.

        A reason is empty where all checks pass.

        Args:
            among: names of the checks to report.
        """
        failed = {name: ~np.ravel(mask) for name, mask in self.passed.items()}
        measured = {name: np.ravel(values) for name, values in self.measured.items()}
        checks = [name for name in REASONS if name in failed and name in among]
        return tuple(
            # Without a pose that the arm reaches, the values of the other checks have no meaning.
            self._words("reach", 0.0, k)
            if failed["reach"][k]
            else "; ".join(self._words(n, measured[n][k], k) for n in checks if failed[n][k])
            for k in range(np.size(self.ok))
        )

    def _words(self, check: str, measured: float, view: int) -> str:
        """Return the reason of one check for one view."""
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
    """Return the results of all checks that the given information allows.

    Args:
        calibration: calibration of camera and robot.
        command: robot commands, `(*views)`.
        camera_from_world: camera poses that the commands result in.
        points: target points, m; None omits the checks of visibility and focus.
        arm: inverse-kinematics solution; None where no arm is known.
        limits: limits to keep.
    """
    views = camera_from_world.get_batch_axes()
    finite = jnp.all(jnp.isfinite(camera_from_world.wxyz_xyz), axis=-1)
    passed, measured = {"reach": finite}, {"reach": jnp.zeros(views)}
    if arm is not None:
        passed = {"reach": arm.reached, "singular": ~singular(arm)}
        measured["singular"] = jnp.zeros(views)

    # Every check keeps its value beside its mask, for the message.
    def note(name: str, value: Array, fine: Array) -> None:
        passed[name], measured[name] = fine, value

    if points is not None:
        in_camera = transform_points(camera_from_world, calibration.target_scale * points)
        inside = border_distance(calibration, in_camera) >= limits.margin
        seen = jnp.mean(inside.astype(float), axis=-1)
        # The tolerance of 1e-9 absorbs the rounding of a mean of zeros and ones.
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
        # Clearance is a matter of where the robot really is, so the robot error is applied.
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
    """Record the checks against the views that the calibration was fitted to."""
    region = calibration.region
    assert region is not None
    cameras = camera_from_world.inverse().translation()
    height = region.height(cameras)
    note("side", -height, (height > 0.0) | (region.side == 0.0))
    if calibration.mount == "eye_in_hand":
        # Tool positions p in the world frame: world = R p + t.
        world_from_holder = calibration.holder_from_world.inverse()
        places = command.base_from_tool.translation()
        rotation = world_from_holder.rotation().as_matrix()
        tools = places @ rotation.T + jnp.broadcast_to(
            world_from_holder.translation(), places.shape
        )
        height = region.height(tools)
        # The tool must stay above the target's plane. If it was lower beside the target in the
        # views of the fit, it may be as low again.
        note("tool_side", -height, height >= jnp.minimum(region.lowest_tool, 0.0))
    extent = region.extent(cameras)
    note("viewed_region", extent, extent <= limits.viewed)


def border_distance(
    calibration: Calibration, in_camera: Float[Array, "*points 3"]
) -> Float[Array, "*points"]:
    """Return the distance, px, from the picture's border of points in the camera frame.

    It is negative outside the picture, and minus infinity where a point cannot be projected.
    """
    pixels, valid = calibration.camera.project(in_camera)
    width, height = calibration.camera.image_size
    u, v = (jnp.where(valid, pixels[..., k], 0.0) for k in range(2))
    distance = jnp.minimum(jnp.minimum(u, width - 1.0 - u), jnp.minimum(v, height - 1.0 - v))
    return jnp.where(valid, distance, -jnp.inf)


def _camera_in_base(calibration: Calibration, base_from_tool: SE3) -> Float[Array, "*views 3"]:
    """Return the camera's centre in the base frame, m."""
    centre = calibration.camera_from_mount.inverse().translation()
    if calibration.mount == "eye_to_hand":
        return jnp.broadcast_to(centre, base_from_tool.translation().shape)
    return base_from_tool.apply(jnp.broadcast_to(centre, base_from_tool.translation().shape))
