"""Model the errors of an arm with unknown joints, which are inferred from the reported poses.

Errors of joint zeros, link lengths and link twists move the tool in a correlated manner: a wrong
elbow angle translates and rotates it at once, and more so the farther the arm reaches. A field that
is linear in the pose has to estimate this correlation from every data set. But upright six-axis
arms of all makes reach a pose in nearly the same configuration: upper arm and forearm in a plane
through the first axis, carrying the wrist. So an arm of usual proportions, with joints from
closed-form inverse kinematics, models the errors of a real arm better than no arm at all, although
none of its lengths is correct.
"""

import jax
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..argument_checks import require_one_of
from ..geometry import host_exponentials, host_transforms
from ..robots import Command, SerialArm, branch_joints
from .arm_errors import DHErrors
from .field import AbstractPreparedField
from .linear_fields import centre_and_reach, max_normalised_offset

MAX_POSE_REACH_FRACTION = 0.7
"""Distance of the farthest reported pose as a fraction of the reach of the default arm."""

_APPROACH_ROTATIONS = {
    "z": (0.0, 0.0),
    "-z": (np.pi, 0.0),
    "x": (0.0, -0.5 * np.pi),
    "-x": (0.0, 0.5 * np.pi),
    "y": (0.5 * np.pi, 0.0),
    "-y": (-0.5 * np.pi, 0.0),
}
"""Rotations about the flange's x and y axes, rad, to a tool whose named axis is the flange's z."""


class GenericSixAxisArm(AbstractPreparedField):
    """A robot error field of an arm whose joints are inferred from poses.

    The coefficients are errors of joint zeros (rad), link lengths (m) and link twists (rad).

    actual_pose = reported @ arm(joints)^-1 @ actual_arm(joints)

    Attributes:
        arm: a Puma-like arm, as `puma_joints` solves it, in the base frame of the poses.
        branch: signs of shoulder, elbow and wrist, as in `robots.puma_inverse_kinematics.BRANCHES`.
        centre: mean position of the tool over the views that the field was made for, m.
        reach: distance from the centre that counts as one unit, m.
    """

    arm: SerialArm
    branch: Float[Array, "3"]
    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def from_poses(
        cls,
        base_from_tool: SE3,
        approach: str = "z",
        arm: SerialArm | None = None,
        branch: tuple[int, int, int] = (1, 1, 1),
    ) -> "GenericSixAxisArm":
        """Return the field for reported poses `(views)` in the base of an upright arm.

        Args:
            base_from_tool: reported poses.
            approach: axis of the tool that points along the last joint's axis, away from the arm: z
                by ISO 9787. For an `arm` of your own, its `flange_from_tool` decides instead.
            arm: by default an arm of usual proportions that reaches all poses easily.
            branch: see the class; by default the elbow is up.

        Raises:
            ValueError: no axis has the name `approach`.
        """
        require_one_of("approach", approach, _APPROACH_ROTATIONS)
        if arm is None:
            positions = np.asarray(base_from_tool.wxyz_xyz)[:, 4:]
            farthest = np.max(np.linalg.norm(positions, axis=1))
            # The rotation about y is about the axis that the first has turned.
            about_x, about_y = _APPROACH_ROTATIONS[approach]
            turns = host_exponentials(
                np.array([[0, 0, 0, about_x, 0, 0], [0, 0, 0, 0, about_y, 0]])
            )
            flange_from_tool = host_transforms(turns[0] @ turns[1])
            arm = _generic_arm(float(farthest) / MAX_POSE_REACH_FRACTION, flange_from_tool)
        signs = jax.device_put(np.array(branch, dtype=float))
        return cls(arm, signs, *centre_and_reach(base_from_tool))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return self._dh_errors.groups

    @property
    def names(self) -> tuple[str, ...]:
        return self._dh_errors.names

    @property
    def _dh_errors(self) -> DHErrors:
        """The field of arm errors that the inferred joints are passed to."""
        return DHErrors(self.arm)

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        return max_normalised_offset(self.centre, self.reach, reported)

    def prepare(self, reported: Command) -> tuple[SE3, Command]:
        """Return reported poses times the inferred arm's inverse poses, and the inferred joints.

        The inferred arm's pose is the reported pose if the arm reaches it; otherwise the joints
        bring the arm as close to it as possible.
        """
        pose = reported.base_from_tool
        inferred = self.arm.command(branch_joints(self.arm, pose, self.branch))
        return pose @ inferred.base_from_tool.inverse(), inferred

    def prepared_pose(
        self, prepared: tuple[SE3, Command], coefficients: Float[Array, "coefficients"]
    ) -> SE3:
        # actual_pose = reported arm(joints)^-1 actual_arm(joints)
        # The arm's change of pose is applied relative to the reported pose, which is therefore
        # exact for zero coefficients even where the inferred arm does not reach it.
        reported_from_arm, inferred = prepared
        return reported_from_arm @ self._dh_errors.actual_pose(inferred, coefficients)

    def prepared_error(
        self,
        prepared: tuple[SE3, Command],
        coefficients: Float[Array, "coefficients"],
        tool_from_base: SE3,
    ) -> Float[Array, "views 4 4"]:
        # reported^-1 reported arm(joints)^-1 actual_arm(joints)
        _, inferred = prepared
        return self._dh_errors.prepared_error(
            inferred, coefficients, inferred.base_from_tool.inverse()
        )

    def prepared_jacobian(
        self, prepared: tuple[SE3, Command], coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        # The factor reported arm(joints)^-1 stands on the left and does not depend on the
        # coefficients: it does not change a twist at the tool.
        return self._dh_errors.jacobian(prepared[1], coefficients)


def _generic_arm(reach: float, flange_from_tool: SE3) -> SerialArm:
    """Return an upright arm of given reach, with an upper arm as long as the forearm."""
    right_angle = 0.5 * np.pi
    # Lengths as fractions of the reach: upper arm and forearm 0.45 each, base, shoulder offset,
    # elbow offset and wrist 0.35, 0.1, 0.05 and 0.1.
    return SerialArm(
        theta=np.array([0.0, -right_angle, 0.0, 0.0, 0.0, 0.0]),
        d=reach * np.array([0.35, 0.0, 0.0, 0.45, 0.0, 0.1]),
        a=reach * np.array([0.1, 0.45, 0.05, 0.0, 0.0, 0.0]),
        alpha=np.array([-right_angle, 0.0, -right_angle, right_angle, -right_angle, 0.0]),
        flange_from_tool=SE3(jax.device_put(np.asarray(flange_from_tool.wxyz_xyz))),
    )
