"""Provide a fitted robot error field, which maps reported poses to actual poses and back."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command, CommandLike, JointsLike, as_command
from ..runtime.array_namespace import to_device
from ..runtime.compilation import compiled, compiled_optimised
from ..runtime.modules import HostModule
from .field import INVERSION_STEPS, AbstractField


class RobotError(HostModule):
    """A robot error field with fitted coefficients.

    Attributes:
        field: the field, which defines the coefficients.
        coefficients: values, in the order of the field's `names`.
    """

    field: AbstractField
    coefficients: Float[Array, "coefficients"]

    @classmethod
    def zero(cls, field: AbstractField) -> "RobotError":
        """Return the error with all coefficients zero: none, or the errors that a type has."""
        return cls(field, to_device(np.zeros(field.size)))

    @classmethod
    def without_errors(cls, field: AbstractField) -> "RobotError":
        """Return the error that corrects nothing, also of a robot whose type has common errors."""
        return cls(field, to_device(field.without_errors))

    @property
    def whole(self) -> "RobotError":
        """The same error with the coefficients about zero, not about the mean of a type."""
        if not self.field.is_about_type:
            return self
        coefficients = self.field.host_whole(np.asarray(self.coefficients))
        return RobotError(self.field.whole, to_device(coefficients))

    def converted_to(self, field: AbstractField) -> "RobotError":
        """Return the error with another field, which has some of the same groups of coefficients.

        Coefficients are copied by name, and coefficients that only the new field has are zero. It
        is the same error if all coefficients that only the old field has are zero.
        """
        values = dict(zip(self.field.names, np.asarray(self.coefficients), strict=True))
        return RobotError(field, to_device([float(values.get(name, 0.0)) for name in field.names]))

    def actual_pose(self, reported: CommandLike) -> SE3:
        """Return the actual `base_from_tool` for what the robot reports, `(*views)`."""
        return _actual_pose(self, as_command(reported))

    def jacobian(self, reported: CommandLike) -> Float[Array, "views 6 coefficients"]:
        """Return the twist of the actual pose at the tool per unit of each coefficient.

        The translation (m) comes first.
        """
        return _jacobian(self, as_command(reported))

    def relevance(self, reported: CommandLike) -> Float[Array, "*views"]:
        """Return how far the fitted coefficients apply to poses: 1 among the data, 0 far away.

        A field is linear only near the poses that it was fitted to. Elsewhere the robot has other
        coefficients, drawn from the same prior. Their correlation with the fitted ones decreases
        with the distance d beyond the edge of these poses as exp(-d^2 / 2). The unit of d is the
        field's extent, within which it was assumed to be linear.

        The errors of an arm's joints apply everywhere.
        """
        return _relevance(self, as_command(reported))

    def expected_pose(self, reported: CommandLike) -> SE3:
        """Return the expected actual pose: `actual_pose`, with a correction that fades far away.

        Where the coefficients apply only in part (see `relevance`), the rest of the error has the
        prior's mean of zero.
        """
        return _expected_pose(self, as_command(reported))

    def expected_command(self, actual: SE3, near: JointsLike | None = None) -> tuple[Command, SE3]:
        """Return the command whose `expected_pose` is the actual one, and this expected pose.

        The arguments are as in `command`. The pose differs from the actual one where the inversion
        does not succeed, and is NaN where the arm does not reach it.
        """
        return _expected_command(self, actual, near)

    def command(self, actual: SE3, near: JointsLike | None = None) -> Command:
        """Return the command that brings the tool to an actual pose; it inverts `actual_pose`.

        Args:
            actual: wanted poses, `(*views)`.
            near: joint readings near which to solve; used by fields of arm errors only.
        """
        return _command(self, actual, near)


# Operation by operation there would be dozens of programs for each number of views.
@compiled
def _actual_pose(error: RobotError, reported: Command) -> SE3:
    """Compute `RobotError.actual_pose` as one program."""
    return error.field.actual_pose(reported, error.coefficients)


@compiled
def _jacobian(error: RobotError, reported: Command) -> Float[Array, "views 6 coefficients"]:
    """Compute `RobotError.jacobian` as one program."""
    return error.field.jacobian(reported, error.coefficients)


@compiled_optimised
def _command(error: RobotError, actual: SE3, near: JointsLike | None) -> Command:
    """Compute `RobotError.command` as one program."""
    return error.field.command(actual, error.coefficients, near)


@compiled
def _relevance(error: RobotError, reported: Command) -> Float[Array, "*views"]:
    """Compute `RobotError.relevance` as one program."""
    beyond = jnp.maximum(error.field.normalised_distance(reported) - 1.0, 0.0)
    return jnp.exp(-0.5 * beyond**2)


@compiled
def _expected_pose(error: RobotError, reported: Command) -> SE3:
    """Compute `RobotError.expected_pose` as one program."""
    actual_pose = error.field.actual_pose(reported, error.coefficients)
    return _between(reported.base_from_tool, actual_pose, _relevance(error, reported))


@compiled_optimised
def _expected_command(
    error: RobotError, actual: SE3, near: JointsLike | None
) -> tuple[Command, SE3]:
    """Compute `RobotError.expected_command` as one program."""
    command = error.field.command(actual, error.coefficients, near)
    # The errors of an arm's joints apply everywhere, and the joint readings belong to this pose.
    if command.joints is not None:
        return command, _expected_pose(error, command)

    # The fixed point of `AbstractField.command`, for the expected pose. A further step gives the
    # expected pose of the last command, which would otherwise be half of a second program.
    def fixed_point_step(state: tuple[SE3, SE3, SE3], _: None) -> tuple[tuple[SE3, SE3, SE3], None]:
        reported = state[0]
        expected = _expected_pose(error, Command(reported))
        return (reported @ (expected.inverse() @ actual), reported, expected), None

    start = actual, actual, actual
    _, reported, expected = jax.lax.scan(fixed_point_step, start, length=INVERSION_STEPS + 1)[0]
    return Command(reported), expected


def _between(start: SE3, end: SE3, fraction: Float[Array, "*views"]) -> SE3:
    """Return poses at a fraction of the way from some poses to others."""
    return start @ SE3.exp(fraction[..., None] * (start.inverse() @ end).log())
