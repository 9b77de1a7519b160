"""The errors of an arm whose joints nobody told: those that the reported poses imply.

Zeros of joints, lengths and twists of links move the tool in ways that belong together: an elbow
that is bent too far shifts and turns it at once, and more so the farther it reaches. A field that
is linear in the pose has to learn that anew in every set. But the way an upright six-axis arm
reaches for a pose is much the same in any make: upper arm and forearm in a plane through the first
axis, the wrist held up by them. So an arm of usual proportions, its joints found in closed form, is
nearer to a real one's errors than no arm at all, though none of its lengths is true.
"""

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..robots import Command, SerialArm, branch_joints
from .arm_errors import DHErrors
from .field import AbstractField
from .linear_fields import reach_of, share_of_reach

STRETCHED = 0.7
"""Share of its reach at which the arm is at the farthest pose."""

_TURNS = {
    "z": (0.0, 0.0),
    "-z": (np.pi, 0.0),
    "x": (0.0, -0.5 * np.pi),
    "-x": (0.0, 0.5 * np.pi),
    "y": (0.5 * np.pi, 0.0),
    "-y": (-0.5 * np.pi, 0.0),
}
"""About the flange's x and y axes, to the tool whose axis of that name is the flange's own z."""


class ImpliedArm(AbstractField):
    """Joint zeros, link lengths (m) and twists of a Puma-like arm, by what poses it reports.

    tool_from_base = arm(corrected, joints)^-1 @ arm(joints) @ reported

    Attributes:
        arm: of the shape that `puma_joints` solves, reaching from the base that poses are in.
        branch: signs of shoulder, elbow and wrist, as in `robots.puma_inverse.BRANCHES`.
        centre: position of the tool in the middle of the views it was made for, m.
        reach: distance from there that counts as one unit, m.
    """

    arm: SerialArm
    branch: Float[Array, "3"]
    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def over(
        cls,
        base_from_tool: SE3,
        approach: str = "z",
        arm: SerialArm | None = None,
        branch: tuple[int, int, int] = (1, 1, 1),
    ) -> "ImpliedArm":
        """For reported poses `(views)` in a base that the arm stands upright on.

        Args:
            base_from_tool: reported.
            approach: the tool's axis that points away from the arm along the last joint's, z by
                ISO 9787; an arm of your own says so by its `flange_from_tool`.
            arm: by default one of usual proportions, for which the poses are well within reach.
            branch: see above; by default the elbow is up.

        Raises:
            ValueError: no axis is called so.
        """
        if approach not in _TURNS:
            raise ValueError(f"approach is one of {', '.join(_TURNS)}; found {approach!r}")
        positions = base_from_tool.translation()
        if arm is None:
            about_x, about_y = _TURNS[approach]
            flange_from_tool = SO3.from_x_radians(about_x) @ SO3.from_y_radians(about_y)
            farthest = jnp.max(jnp.linalg.norm(positions, axis=1))
            arm = _usual(farthest / STRETCHED, flange_from_tool)
        signs = jnp.asarray(branch, dtype=float)
        return cls(arm, signs, jnp.mean(positions, axis=0), reach_of(positions))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return self._errors.groups

    @property
    def names(self) -> tuple[str, ...]:
        return self._errors.names

    @property
    def _errors(self) -> DHErrors:
        return DHErrors(self.arm)

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return share_of_reach(self.centre, self.reach, reported)

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """`base_from_tool` as it is; beyond the arm's reach by the joints that come nearest."""
        pose, implied = reported.base_from_tool, self._implied(reported)
        corrected = self._errors.true_pose(implied, coefficients)
        return pose @ implied.base_from_tool.inverse() @ corrected

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        return self._errors.by_coefficients(self._implied(reported), coefficients)

    def _implied(self, reported: Command) -> Command:
        """What the arm would report; its pose is the reported one where it reaches."""
        return self.arm.command(branch_joints(self.arm, reported.base_from_tool, self.branch))


def _usual(reach: Float[Array, ""], flange_from_tool: SO3) -> SerialArm:
    """An upright arm of upper and lower parts of the same length, as makers build them."""
    right = 0.5 * jnp.pi
    return SerialArm(
        theta=jnp.array([0.0, -right, 0.0, 0.0, 0.0, 0.0]),
        d=reach * jnp.array([0.35, 0.0, 0.0, 0.45, 0.0, 0.1]),
        a=reach * jnp.array([0.1, 0.45, 0.05, 0.0, 0.0, 0.0]),
        alpha=jnp.array([-right, 0.0, -right, right, -right, 0.0]),
        flange_from_tool=SE3.from_rotation(flange_from_tool),
    )
