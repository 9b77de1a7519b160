"""Define robot error fields of the arm itself: joint zeros and ratios, links, and elastic joints.

Unlike the linear fields these are exact: the actual pose is the forward kinematics of the corrected
parameters. An error at either end of the chain that is the same in all views is equivalent to a
displacement of the base or of the tool: the zero of the last joint cannot be separated from the
hand-eye transform, nor the zero of the first joint from the target pose. Their priors keep such
coefficients at zero.
"""

import abc
import dataclasses

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import (
    Command,
    JointsLike,
    SerialArm,
    dh_jacobian,
    gravity_loads,
    solve_joints_iteratively,
)
from .field import AbstractField

DEFLECTION_STEPS = 4
"""Number of fixed-point steps from actual joint angles to readings.

Each multiplies the remaining error by the largest deflection, a few milliradians.
"""


class AbstractArmErrors(AbstractField):
    """A robot error field whose coefficients are errors of the parameters of forward kinematics.

    Attributes:
        arm: the nominal arm, as the controller assumes it.
    """

    arm: SerialArm

    @abc.abstractmethod
    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        """Return the actual arm for given coefficients."""

    def joint_scale_factors(
        self, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "joints"]:
        """Return the actual motion of each joint per unit of its reading."""
        del coefficients
        return jnp.ones(self.arm.joint_count)

    def joint_deflections(
        self, joints: Float[Array, "*views joints"], coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views joints"]:
        """Return by how much each joint bends under the load of the arm at some readings."""
        del coefficients
        return jnp.zeros_like(joints)

    def actual_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """Return the actual `base_from_tool`.

        Raises:
            ValueError: the report is a pose without joint readings.
        """
        return self.actual_arm(coefficients).base_from_tool(
            self._actual_joints(reported, coefficients)
        )

    def jacobian(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """Return the Jacobian of the actual pose, by the chain rule through the arm."""
        # Chain rule, with p the Denavit-Hartenberg parameters and c the coefficients:
        #     d pose / dc = (d pose / dp) (dp / dc)
        # The first factor is geometric (`dh_jacobian`); only the second, which is simple, is
        # differentiated automatically. The point of linearisation is held constant, since second
        # derivatives of the pose are not needed.
        linearisation_point = jax.lax.stop_gradient(coefficients)
        dh_jacobians = dh_jacobian(
            self.actual_arm(linearisation_point), self._actual_joints(reported, linearisation_point)
        )

        def dh_parameters(
            displaced: Float[Array, "coefficients"], reported_view: Command
        ) -> Float[Array, "rows joints"]:
            # Joint motion and joint zero add up in the same parameter, so that a gear ratio enters
            # as an offset of ratio times reading.
            arm = _with_joint_offsets(
                self.actual_arm(displaced), self._actual_joints(reported_view, displaced)
            )
            return jnp.stack([arm.theta, arm.d, arm.a, arm.alpha])

        parameter_jacobians = jax.vmap(jax.jacfwd(dh_parameters), in_axes=(None, 0))(
            coefficients, reported
        )
        return jnp.einsum("vkrj,vrjc->vkc", dh_jacobians, parameter_jacobians)

    def _actual_joints(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views joints"]:
        """Return the actual motion of every joint for its reading.

        Raises:
            ValueError: the report is a pose without joint readings.
        """
        if reported.joints is None:
            raise ValueError(
                "the errors of an arm are corrected by its joints: give arm.command(joints) "
                "instead of a pose, or corrected=False for the bare chain"
            )
        joints = jnp.asarray(reported.joints, dtype=float)
        turned = joints * jnp.broadcast_to(self.joint_scale_factors(coefficients), joints.shape)
        return turned + self.joint_deflections(joints, coefficients)

    def command(
        self,
        actual: SE3,
        coefficients: Float[Array, "coefficients"],
        near: JointsLike | None = None,
    ) -> Command:
        """Return the command for an actual pose, as `AbstractField` does.

        It is NaN where the arm does not reach the pose.

        Raises:
            ValueError: `near` is missing, although inverse kinematics has several solutions.
        """
        if near is None:
            raise ValueError(
                "an arm reaches a pose in several ways: give near=joints, angles in whose "
                "neighbourhood to look"
            )
        scale_factors = self.joint_scale_factors(coefficients)
        arm = self.actual_arm(coefficients)
        # The limits apply to readings, whereas this arm is solved for the actual joint motion.
        arm = dataclasses.replace(arm, limits=arm.limits * scale_factors[:, None])
        near = jnp.asarray(near, dtype=float)
        actual_joints, reached = solve_joints_iteratively(
            arm, actual, near * jnp.broadcast_to(scale_factors, near.shape)
        )
        scale_factors = jnp.broadcast_to(scale_factors, actual_joints.shape)
        joints = actual_joints / scale_factors
        # The load hardly changes within a deflection, so that few steps suffice.
        for _ in range(DEFLECTION_STEPS):
            deflections = self.joint_deflections(joints, coefficients)
            joints = (actual_joints - deflections) / scale_factors
        return self.arm.command(jnp.where(reached[..., None], joints, jnp.nan))


def nominal_arm(field: AbstractField | None) -> SerialArm | None:
    """Return the arm of a field of arm errors; None for any other field, and for None."""
    return field.arm if isinstance(field, AbstractArmErrors) else None


class JointOffsets(AbstractArmErrors):
    """A robot error field of joint zeros: offsets of the readings, rad (m if prismatic)."""

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("joint_offset", self.arm.joint_count),)

    @property
    def names(self) -> tuple[str, ...]:
        return _names_per_joint(("joint_offset",), self.arm)

    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return _with_joint_offsets(self.arm, coefficients)


class JointRatios(AbstractArmErrors):
    """A robot error field of joint zeros and gear ratios.

    The actual joint value is `(1 + joint_ratio) * reading + joint_offset`; the ratio has no unit.
    Causes are a gear with other teeth or an encoder with other counts. The ratio has no effect at a
    reading of zero.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("joint_offset", self.arm.joint_count), ("joint_ratio", self.arm.joint_count))

    @property
    def names(self) -> tuple[str, ...]:
        return _names_per_joint(("joint_offset", "joint_ratio"), self.arm)

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        return (JointOffsets(self.arm), self)

    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return _with_joint_offsets(self.arm, coefficients[: self.arm.joint_count])

    def joint_scale_factors(
        self, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "joints"]:
        return 1.0 + coefficients[self.arm.joint_count :]


class DHErrors(AbstractArmErrors):
    """A robot error field of joint zeros, link lengths `d` and `a`, and link twists `alpha`.

    Coefficients are in rad, m and rad.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        n = self.arm.joint_count
        return (("joint_offset", n), ("link_length", 2 * n), ("link_twist", n))

    @property
    def names(self) -> tuple[str, ...]:
        prefixes = ("joint_offset", "link_length.d", "link_length.a", "link_twist")
        return _names_per_joint(prefixes, self.arm)

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        return (JointOffsets(self.arm), self)

    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        offset, d, a, alpha = jnp.split(coefficients, 4)
        arm = _with_joint_offsets(self.arm, offset)
        return dataclasses.replace(arm, d=arm.d + d, a=arm.a + a, alpha=arm.alpha + alpha)


class ElasticDHErrors(AbstractArmErrors):
    """A robot error field of `DHErrors` and of joints that bend under the arm's weight.

    A coefficient of the compliance is the angle, rad, by which a joint bends under a torque of one
    (`robots.gravity_loads`): about the largest that the arm's own weight exerts at its base. It is
    positive where the joint gives way to gravity.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*DHErrors(self.arm).groups, ("joint_compliance", self.arm.joint_count))

    @property
    def names(self) -> tuple[str, ...]:
        return (*DHErrors(self.arm).names, *_names_per_joint(("joint_compliance",), self.arm))

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        return (*DHErrors(self.arm).nested_fields, self)

    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return DHErrors(self.arm).actual_arm(coefficients[: -self.arm.joint_count])

    def joint_deflections(
        self, joints: Float[Array, "*views joints"], coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views joints"]:
        compliances = coefficients[-self.arm.joint_count :]
        return gravity_loads(self.arm, joints) * jnp.broadcast_to(compliances, joints.shape)


def _with_joint_offsets(arm: SerialArm, offset: Float[Array, "joints"]) -> SerialArm:
    """Return an arm with an offset added to each joint, to `theta` or, if prismatic, to `d`."""
    prismatic = jnp.array(arm.prismatic)
    zeros = jnp.zeros_like(offset)
    return dataclasses.replace(
        arm,
        theta=arm.theta + jnp.where(prismatic, zeros, offset),
        d=arm.d + jnp.where(prismatic, offset, zeros),
    )


def _names_per_joint(prefixes: tuple[str, ...], arm: SerialArm) -> tuple[str, ...]:
    """Return names with joint numbers, which count from one as they do on robots."""
    return tuple(f"{part}.{1 + k}" for part in prefixes for k in range(arm.joint_count))
