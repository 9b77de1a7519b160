"""What is wrong with an arm itself: zeros and gears of its joints, its Denavit-Hartenberg numbers.

Unlike the linear fields these are exact: the tool is where forward kinematics with the corrected
numbers puts it. An error at either end of the chain that is the same in all views is also a
displacement of the base or of the tool: the zero of the last joint cannot be told from the
hand-eye transform, nor that of the first from where the target stands. Their prior keeps them at
nothing.
"""

import abc
import dataclasses

import jax
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command, JointsLike, SerialArm, by_numbers, joints_near
from .field import AbstractField


class AbstractArmErrors(AbstractField):
    """Errors of the numbers that forward kinematics goes by.

    Attributes:
        arm: as its controller believes it to be.
    """

    arm: SerialArm

    @abc.abstractmethod
    def corrected(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        """The arm as it is."""

    def ratios(self, coefficients: Float[Array, "coefficients"]) -> Float[Array, "joints"]:
        """How far each joint of the corrected arm goes per unit of its reading."""
        del coefficients
        return jnp.ones(self.arm.size)

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        """`base_from_tool` as it is.

        Raises:
            ValueError: a pose without the joints' readings.
        """
        return self.corrected(coefficients).base_from_tool(self._gone(reported, coefficients))

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        """As of any field, through the arm's numbers, whose twists are known."""
        at = jax.lax.stop_gradient(coefficients)
        twists = by_numbers(self.corrected(at), self._gone(reported, at))

        def numbers(
            moved: Float[Array, "coefficients"], one: Command
        ) -> Float[Array, "rows joints"]:
            # How far a joint went moves the tool as its zero does.
            arm = _with_offsets(self.corrected(moved), self._gone(one, moved))
            return jnp.stack([arm.theta, arm.d, arm.a, arm.alpha])

        rows = jax.vmap(jax.jacfwd(numbers), in_axes=(None, 0))(coefficients, reported)
        return jnp.einsum("vkrj,vrjc->vkc", twists, rows)

    def _gone(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views joints"]:
        """How far every joint went for its reading."""
        if reported.joints is None:
            raise ValueError(
                "the errors of an arm are corrected by its joints: give arm.command(joints) "
                "instead of a pose, or corrected=False for the bare chain"
            )
        joints = jnp.asarray(reported.joints, dtype=float)
        return joints * jnp.broadcast_to(self.ratios(coefficients), joints.shape)

    def command(
        self,
        true: SE3,
        coefficients: Float[Array, "coefficients"],
        near: JointsLike | None = None,
    ) -> Command:
        """What to tell the robot; see `AbstractField`. NaN where the arm does not reach.

        Raises:
            ValueError: without `near`: an arm reaches a pose in several ways.
        """
        if near is None:
            raise ValueError(
                "an arm reaches a pose in several ways: give near=joints, angles in whose "
                "neighbourhood to look"
            )
        ratios = self.ratios(coefficients)
        arm = self.corrected(coefficients)
        # The limits are of the readings.
        arm = dataclasses.replace(arm, limits=arm.limits * ratios[:, None])
        near = jnp.asarray(near, dtype=float)
        gone, reached = joints_near(arm, true, near * jnp.broadcast_to(ratios, near.shape))
        joints = gone / jnp.broadcast_to(ratios, gone.shape)
        return self.arm.command(jnp.where(reached[..., None], joints, jnp.nan))


def arm_of(field: AbstractField | None) -> SerialArm | None:
    """The arm whose own errors a field is about; None for other fields, and for none."""
    return field.arm if isinstance(field, AbstractArmErrors) else None


class JointOffsets(AbstractArmErrors):
    """The zero of every joint: added to its reading, rad (m where it slides)."""

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("joint_offset", self.arm.size),)

    @property
    def names(self) -> tuple[str, ...]:
        return _by_joint(("joint_offset",), self.arm)

    def corrected(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return _with_offsets(self.arm, coefficients)


class JointRatios(AbstractArmErrors):
    """The zero of every joint, and how much further it goes than it reads, a share of the reading.

    A joint goes `(1 + joint_ratio) * reading + joint_offset`: a gear of other teeth, an encoder of
    other counts. The arm's own zero is where no joint's share counts.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("joint_offset", self.arm.size), ("joint_ratio", self.arm.size))

    @property
    def names(self) -> tuple[str, ...]:
        return _by_joint(("joint_offset", "joint_ratio"), self.arm)

    @property
    def nested(self) -> tuple[AbstractField, ...]:
        return (JointOffsets(self.arm), self)

    def corrected(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return _with_offsets(self.arm, coefficients[: self.arm.size])

    def ratios(self, coefficients: Float[Array, "coefficients"]) -> Float[Array, "joints"]:
        return 1.0 + coefficients[self.arm.size :]


class DHErrors(AbstractArmErrors):
    """The zero of every joint, the lengths `d` and `a` (m) and the twist `alpha` (rad) of links."""

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        n = self.arm.size
        return (("joint_offset", n), ("link_length", 2 * n), ("link_twist", n))

    @property
    def names(self) -> tuple[str, ...]:
        parts = ("joint_offset", "link_length.d", "link_length.a", "link_twist")
        return _by_joint(parts, self.arm)

    @property
    def nested(self) -> tuple[AbstractField, ...]:
        return (JointOffsets(self.arm), self)

    def corrected(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        offset, d, a, alpha = jnp.split(coefficients, 4)
        arm = _with_offsets(self.arm, offset)
        return dataclasses.replace(arm, d=arm.d + d, a=arm.a + a, alpha=arm.alpha + alpha)


def _with_offsets(arm: SerialArm, offset: Float[Array, "joints"]) -> SerialArm:
    slides = jnp.array(arm.prismatic)
    nothing = jnp.zeros_like(offset)
    return dataclasses.replace(
        arm,
        theta=arm.theta + jnp.where(slides, nothing, offset),
        d=arm.d + jnp.where(slides, offset, nothing),
    )


def _by_joint(parts: tuple[str, ...], arm: SerialArm) -> tuple[str, ...]:
    """Joints count from one, as they do on robots."""
    return tuple(f"{part}.{1 + k}" for part in parts for k in range(arm.size))
