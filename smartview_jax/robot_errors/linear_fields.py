"""Define robot error fields for any robot: twists linear in the tool's position and orientation."""

import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from .field import AbstractField, AbstractLinearField

SPREAD = 1.7
"""Number of standard deviations of the positions in one unit of reach (no unit).

The half width of a uniform distribution is sqrt(3) = 1.7 standard deviations.
"""

STANDING = 1e-4
"""Standard deviation of the positions, m, below which a robot counts as not having translated."""


class LinearInPosition(AbstractLinearField):
    """A robot error field that is linear in the tool's position, with 18 coefficients.

    Both the translation and the rotation of the error are linear.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from the centre that counts as one unit, m.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def over(cls, base_from_tool: SE3) -> "LinearInPosition":
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
        positions = base_from_tool.translation()
        return cls(jnp.mean(positions, axis=0), reach_of(positions))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("translation_by_position", 9), ("rotation_by_position", 9))

    @property
    def unit_length(self) -> float:
        return float(self.reach)

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return share_of_reach(self.centre, self.reach, reported)

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 18"]:
        offset = _beyond(self.centre, base_from_tool.translation()) / self.reach
        return _both_parts(base_from_tool, offset)


class LinearInPose(AbstractLinearField):
    """A robot error field that is linear in the tool's position and orientation.

    Both the translation and the rotation of the error are linear; there are 54 coefficients.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from the centre that counts as one unit, m.
        axes: mean first and third column of the tool's rotation, at which the field is zero.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]
    axes: Float[Array, "6"]

    @classmethod
    def over(cls, base_from_tool: SE3) -> "LinearInPose":
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
        positions = base_from_tool.translation()
        mean = jnp.mean(_axes(base_from_tool), axis=0)
        return cls(jnp.mean(positions, axis=0), reach_of(positions), mean)

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (
            ("translation_by_position", 9),
            ("rotation_by_position", 9),
            ("translation_by_orientation", 18),
            ("rotation_by_orientation", 18),
        )

    @property
    def unit_length(self) -> float:
        return float(self.reach)

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return share_of_reach(self.centre, self.reach, reported)

    @property
    def nested(self) -> tuple[AbstractField, ...]:
        return (LinearInPosition(self.centre, self.reach), self)

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 54"]:
        offset = _beyond(self.centre, base_from_tool.translation()) / self.reach
        turned = _beyond(self.axes, _axes(base_from_tool))
        parts = [_both_parts(base_from_tool, offset), _both_parts(base_from_tool, turned)]
        return jnp.concatenate(parts, axis=-1)


def reach_of(positions: Float[Array, "views 3"]) -> Float[Array, ""]:
    """Return the distance from the mean position that counts as one unit, m."""
    variance = jnp.sum(jnp.var(positions, axis=0)) / 3.0
    # A robot that only rotated has no standard deviation to scale by. With a unit of 1 m its field
    # is then almost zero in position.
    return SPREAD * jnp.sqrt(jnp.where(variance > STANDING**2, variance, 1.0))


def share_of_reach(
    centre: Float[Array, "3"], reach: Float[Array, ""], reported: Command
) -> Float[Array, "*views"]:
    """Return the largest coordinate of the poses from the centre, in units of the reach.

    For uniformly distributed positions the largest value is about 1 (1.7 standard deviations).
    """
    offset = _beyond(centre, reported.base_from_tool.translation())
    return jnp.max(jnp.abs(offset), axis=-1) / reach


def _beyond(
    mean: Float[Array, "functions"], values: Float[Array, "*views functions"]
) -> Float[Array, "*views functions"]:
    """Return the difference of values from their mean."""
    return values - jnp.broadcast_to(mean, values.shape)


def _axes(base_from_tool: SE3) -> Float[Array, "*views 6"]:
    """Return the first and third column of the tool's rotation, which determine the orientation."""
    rotation = base_from_tool.rotation().as_matrix()
    return jnp.concatenate([rotation[..., 0], rotation[..., 2]], axis=-1)


def _both_parts(
    base_from_tool: SE3, functions: Float[Array, "*views functions"]
) -> Float[Array, "*views 6 coefficients"]:
    """Return a basis of translations and rotations, in base axes, for each function of a pose."""
    # For functions f of the pose, with R = base_from_tool rotation and coefficient matrices A and
    # C,
    #     twist = (R^T A f, R^T C f),
    # so a coefficient of A or C multiplies a column of R^T times one function.
    tool_from_base = jnp.swapaxes(base_from_tool.rotation().as_matrix(), -1, -2)
    part = tool_from_base[..., None, :] * functions[..., None, :, None]
    part = part.reshape(*part.shape[:-2], -1)
    nothing = jnp.zeros_like(part)
    return jnp.concatenate(
        [
            jnp.concatenate([part, nothing], axis=-1),
            jnp.concatenate([nothing, part], axis=-1),
        ],
        axis=-2,
    )
