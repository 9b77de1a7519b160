"""Define robot error fields for any robot: twists that are smooth functions of the tool's pose."""

from typing import Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..geometry import host_matrices
from ..robots import Command
from ..runtime.array_namespace import AnyArray, array_namespace
from ..runtime.compilation import one_program
from .field import AbstractField, AbstractLinearField

UNIFORM_HALF_WIDTH = 1.7
"""Number of standard deviations of the positions in the reach of a field (no unit).

The half width of a uniform distribution is sqrt(3) = 1.7 standard deviations.
"""

MIN_POSITION_STD = 1e-4
"""Standard deviation of the positions, m, below which a robot counts as not having translated."""


_SQUARE_GROUPS = (("translation_by_square", 18), ("rotation_by_square", 18))
"""Groups of the coefficients of the squares and products of the coordinates of the position."""


class _InPosition(AbstractLinearField):
    """A field of functions of the tool's position.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from the centre that counts as one unit, m.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def from_poses(cls, base_from_tool: SE3) -> Self:
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
        return cls(*centre_and_reach(base_from_tool))

    @property
    def reference_length(self) -> float:
        return float(self.reach)

    def normalised_distance(self, reported: Command) -> Float[Array, "*views"]:
        return max_normalised_offset(self.centre, self.reach, reported)


class _InPose(_InPosition):
    """A field of functions of the tool's position and orientation.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from the centre that counts as one unit, m.
        axes: mean first and third column of the tool's rotation, at which the field is zero.
    """

    axes: Float[Array, "6"]

    @classmethod
    def from_poses(cls, base_from_tool: SE3) -> Self:
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
        mean = np.mean(host_matrices(base_from_tool)[:, :3, [0, 2]], axis=0)
        return cls(*centre_and_reach(base_from_tool), jax.device_put(mean.T.ravel()))


class LinearInPosition(_InPosition):
    """A robot error field that is linear in the tool's position, with 18 coefficients.

    Both the translation and the rotation of the error are linear.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("translation_by_position", 9), ("rotation_by_position", 9))

    @one_program
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 18"]:
        offset = _deviation_from_mean(self.centre, base_from_tool.translation()) / self.reach
        return _twist_basis(base_from_tool, offset)


class LinearInPose(_InPose):
    """A robot error field that is linear in the tool's position and orientation.

    Both the translation and the rotation of the error are linear; there are 54 coefficients.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (
            ("translation_by_position", 9),
            ("rotation_by_position", 9),
            ("translation_by_orientation", 18),
            ("rotation_by_orientation", 18),
        )

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        return (LinearInPosition(self.centre, self.reach), self)

    @one_program
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 54"]:
        position_offset = _deviation_from_mean(self.centre, base_from_tool.translation())
        # Two columns of the rotation instead of angles: they are smooth everywhere.
        orientation_offset = _deviation_from_mean(self.axes, _tool_x_and_z(base_from_tool))
        column_blocks = [
            _twist_basis(base_from_tool, position_offset / self.reach),
            _twist_basis(base_from_tool, orientation_offset),
        ]
        return jnp.concatenate(column_blocks, axis=-1)


class QuadraticInPosition(_InPosition):
    """A robot error field that is quadratic in the tool's position, with 54 coefficients.

    Arms whose joints or links bend under gravity have such errors: the load on a joint depends on
    how far the arm reaches. Both the translation and the rotation of the error are quadratic.
    """

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*LinearInPosition(self.centre, self.reach).groups, *_SQUARE_GROUPS)

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        return (LinearInPosition(self.centre, self.reach), self)

    @one_program
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 54"]:
        offset = _deviation_from_mean(self.centre, base_from_tool.translation()) / self.reach
        functions = (offset, squares_and_products(offset))
        column_blocks = [_twist_basis(base_from_tool, f) for f in functions]
        return jnp.concatenate(column_blocks, axis=-1)


class SmoothInPose(_InPose):
    """A robot error field that is quadratic in the tool's position and linear in its orientation.

    Both the translation and the rotation of the error are; there are 90 coefficients. It contains
    `LinearInPosition`, `LinearInPose` and `QuadraticInPosition`.
    """

    @property
    def _linear(self) -> LinearInPose:
        """The field without the quadratic part."""
        return LinearInPose(self.centre, self.reach, self.axes)

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self._linear.groups, *_SQUARE_GROUPS)

    @property
    def nested_fields(self) -> tuple[AbstractField, ...]:
        quadratic = QuadraticInPosition(self.centre, self.reach)
        return (*self._linear.nested_fields, quadratic, self)

    @one_program
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 90"]:
        offset = _deviation_from_mean(self.centre, base_from_tool.translation()) / self.reach
        squares = _twist_basis(base_from_tool, squares_and_products(offset))
        return jnp.concatenate([self._linear.basis(base_from_tool), squares], axis=-1)


def centre_and_reach(base_from_tool: SE3) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return the mean position of the tool, and the distance from it that counts as one unit, m."""
    # Made once on the host, where NumPy needs no compilation.
    positions = np.asarray(base_from_tool.wxyz_xyz)[:, 4:]
    variance = np.sum(np.var(positions, axis=0)) / 3.0
    # A robot that only rotated has no standard deviation to scale by. Its reach corresponds to a
    # standard deviation of 1 m, with which the field hardly depends on the position.
    std = np.sqrt(np.where(variance > MIN_POSITION_STD**2, variance, 1.0))
    return jax.device_put((np.mean(positions, axis=0), UNIFORM_HALF_WIDTH * std))


@one_program
def max_normalised_offset(
    centre: Float[Array, "3"], reach: Float[Array, ""], reported: Command
) -> Float[Array, "*views"]:
    """Return the largest coordinate of the poses from the centre, in units of the reach.

    For uniformly distributed positions the largest value is about 1 (1.7 standard deviations).
    """
    offset = _deviation_from_mean(centre, reported.base_from_tool.translation())
    return jnp.max(jnp.abs(offset), axis=-1) / reach


def _deviation_from_mean(
    mean: Float[Array, "functions"], values: Float[Array, "*views functions"]
) -> Float[Array, "*views functions"]:
    """Return the difference of values from their mean."""
    return values - jnp.broadcast_to(mean, values.shape)


def squares_and_products(offset: Float[AnyArray, "*views 3"]) -> Float[AnyArray, "*views 6"]:
    """Return the squares of the coordinates of a vector, and the products of two of them."""
    xp = array_namespace(offset)
    x, y, z = xp.moveaxis(offset, -1, 0)
    return xp.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=-1)


def _tool_x_and_z(base_from_tool: SE3) -> Float[Array, "*views 6"]:
    """Return the first and third column of the tool's rotation, which determine the orientation."""
    rotation = base_from_tool.rotation().as_matrix()
    return jnp.concatenate([rotation[..., 0], rotation[..., 2]], axis=-1)


def _twist_basis(
    base_from_tool: SE3, regressors: Float[AnyArray, "*views functions"]
) -> Float[Array, "*views 6 coefficients"]:
    """Return a basis of translations and rotations, in base axes, for each function of a pose."""
    # With the regressors f, functions of the pose, the rotation R of base_from_tool, and
    # coefficient matrices A and C,
    #     twist = (R^T A f, R^T C f),
    # so a coefficient of A or C multiplies a column of R^T times one regressor.
    tool_from_base = jnp.swapaxes(base_from_tool.rotation().as_matrix(), -1, -2)
    columns = tool_from_base[..., None, :] * regressors[..., None, :, None]
    columns = columns.reshape(*columns.shape[:-2], -1)
    zeros = jnp.zeros_like(columns)
    return jnp.concatenate(
        [
            jnp.concatenate([columns, zeros], axis=-1),
            jnp.concatenate([zeros, columns], axis=-1),
        ],
        axis=-2,
    )
