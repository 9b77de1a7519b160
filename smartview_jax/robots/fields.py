"""Error fields: the part of a robot's error that is a smooth function of its pose.

A robot whose joints, links and gears are not quite what its controller believes reports poses that
are wrong by much the same amount wherever it comes back to. A field writes that error as a twist at
the tool, linear in coefficients:

    tool_from_base = exp(basis(base_from_tool) @ coefficients) @ reported
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxlie import SE3
from jaxtyping import Array, Float

SPREAD = 1.7
"""Standard deviations of the positions that count as one unit: the half width of a uniform box."""


class AbstractField(eqx.Module):
    """A basis for the twist by which the robot errs, and which coefficients share a size.

    A field of your own subclasses this; everything that takes a field takes it.
    """

    @property
    @abc.abstractmethod
    def groups(self) -> tuple[tuple[str, int], ...]:
        """Name and number of coefficients of each group, in order; a group has one variance."""

    @abc.abstractmethod
    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 coefficients"]:
        """Twists at the tool, translation (m) first, per unit of each coefficient."""

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return sum(count for _, count in self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """One name a coefficient: its group, and its number there."""
        return tuple(f"{group}.{k}" for group, count in self.groups for k in range(count))


class LinearInPosition(AbstractField):
    """Translation and rotation linear in the tool's position: 18 coefficients.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from there that counts as one unit, m.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def over(cls, base_from_tool: SE3) -> "LinearInPosition":
        """Centred on the poses `(views)` and scaled by their spread."""
        positions = base_from_tool.translation()
        return cls(jnp.mean(positions, axis=0), _reach(positions))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (("translation_by_position", 9), ("rotation_by_position", 9))

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 18"]:
        offset = _beyond(self.centre, base_from_tool.translation()) / self.reach
        return _both_parts(base_from_tool, offset)


class LinearInPose(AbstractField):
    """Translation and rotation linear in the tool's position and orientation: 54 coefficients.

    Attributes:
        centre: position of the tool where the field is zero, m.
        reach: distance from there that counts as one unit, m.
        axes: first and third column of the tool's rotation where the field is zero.
    """

    centre: Float[Array, "3"]
    reach: Float[Array, ""]
    axes: Float[Array, "6"]

    @classmethod
    def over(cls, base_from_tool: SE3) -> "LinearInPose":
        """Centred on the poses `(views)` and scaled by their spread."""
        positions = base_from_tool.translation()
        mean = jnp.mean(_axes(base_from_tool), axis=0)
        return cls(jnp.mean(positions, axis=0), _reach(positions), mean)

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (
            ("translation_by_position", 9),
            ("rotation_by_position", 9),
            ("translation_by_orientation", 18),
            ("rotation_by_orientation", 18),
        )

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 54"]:
        offset = _beyond(self.centre, base_from_tool.translation()) / self.reach
        turned = _beyond(self.axes, _axes(base_from_tool))
        parts = [_both_parts(base_from_tool, offset), _both_parts(base_from_tool, turned)]
        return jnp.concatenate(parts, axis=-1)


def _reach(positions: Float[Array, "views 3"]) -> Float[Array, ""]:
    variance = jnp.sum(jnp.var(positions, axis=0)) / 3.0
    # A robot that only turned has no spread to scale by; a field in position is then zero anyway.
    return SPREAD * jnp.sqrt(jnp.where(variance > 0.0, variance, 1.0))


def _beyond(
    mean: Float[Array, "functions"], values: Float[Array, "*views functions"]
) -> Float[Array, "*views functions"]:
    return values - jnp.broadcast_to(mean, values.shape)


def _axes(base_from_tool: SE3) -> Float[Array, "*views 6"]:
    rotation = base_from_tool.rotation().as_matrix()
    return jnp.concatenate([rotation[..., 0], rotation[..., 2]], axis=-1)


def _both_parts(
    base_from_tool: SE3, functions: Float[Array, "*views functions"]
) -> Float[Array, "*views 6 coefficients"]:
    """A translation, then a rotation, in the base's axes for each function of the pose."""
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


FIELDS: dict[str, type[LinearInPosition] | type[LinearInPose]] = {
    "position": LinearInPosition,
    "pose": LinearInPose,
}
"""Fields by the name that files and options use."""


def field_by_name(name: str) -> type[LinearInPosition] | type[LinearInPose]:
    """The class of a field.

    Raises:
        ValueError: no field is called so.
    """
    if name not in FIELDS:
        raise ValueError(f"field is one of {', '.join(FIELDS)}; found {name!r}")
    return FIELDS[name]


def field_name(field: AbstractField) -> str:
    """What `field_by_name` knows a field by; the class's own name for others."""
    return next(
        (name for name, kind in FIELDS.items() if type(field) is kind), type(field).__name__
    )
