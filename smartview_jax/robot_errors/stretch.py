"""The simplest smooth errors: the robot goes too far, or the target is not of its size.

A robot whose ways are all too long by one share errs in proportion to where its *tool* is. A target
that is smaller than it is said to be looks the same, but for where the *camera* is. The two differ
by how the offset between tool and camera turns, which is next to nothing; only a ruler tells them
apart.
"""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..robots import Command
from .field import AbstractField, AbstractLinearField
from .linear_fields import LinearInPose, reach_of

STRETCH = "translation_by_stretch"
"""The group of the one coefficient by which all ways are longer than they should be."""


class Stretched(AbstractField):
    """Another field's error, and besides all ways that the robot reports too long by one share.

    A coefficient `c` of the stretch is a share `c / reach`. Linear fields can stretch too, but only
    as they can shear: they take a robot that goes 10 % too far for one that may also go 10 % askew.

    Attributes:
        field: the error besides, on which the ways are too long.
        centre: position of the tool that does not move, m.
        reach: distance from there that counts as one unit, m.
    """

    field: AbstractField
    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def over(cls, field: AbstractField, base_from_tool: SE3) -> "Stretched":
        """Centred on the poses `(views)` and scaled by their spread."""
        positions = base_from_tool.translation()
        return cls(field, jnp.mean(positions, axis=0), reach_of(positions))

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.field.groups, (STRETCH, 1))

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.field.names, f"{STRETCH}.0")

    @property
    def unit_length(self) -> float:
        return float(self.reach)

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return self.field.extent(reported)

    def true_pose(self, reported: Command, coefficients: Float[Array, "coefficients"]) -> SE3:
        true = self.field.true_pose(reported, coefficients[:-1])
        return true @ SE3.exp(-coefficients[-1] * self._along(reported))

    def by_coefficients(
        self, reported: Command, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "views 6 coefficients"]:
        besides = self.field.by_coefficients(reported, coefficients[:-1])
        along = self._along(reported)
        after = SE3.exp(coefficients[-1] * along).adjoint()
        return jnp.concatenate([after @ besides, -along[..., None]], axis=-1)

    def _along(self, reported: Command) -> Float[Array, "*views 6"]:
        """The way from the centre, in units of the reach, as a twist at the tool."""
        return _shift(_way(reported.base_from_tool, self.centre) / self.reach)


class PoseOrStretch(AbstractLinearField):
    """`LinearInPose`, a stretch of the tool's ways, and one of the camera's: 56 coefficients.

    A coefficient `c` of either stretch is a share `c / reach` by which the ways that the robot
    reports are longer than those it goes. Which groups count is data: another choice is not another
    program.

    Attributes:
        pose: the field besides; its centre and reach are the stretches' too.
        seen_from: the tool's frame: what a wrong scale of the target keeps in proportion, m: the
            centre of a camera on the tool; of a target on the tool, its origin.
        counts: one for each group that counts, zero for the others, in the order of `groups`.
    """

    STRETCH: ClassVar[str] = STRETCH
    SCALE: ClassVar[str] = "translation_by_scale"

    pose: LinearInPose
    seen_from: Float[Array, "3"]
    counts: Float[Array, "groups"]

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.pose.groups, (self.STRETCH, 1), (self.SCALE, 1))

    @property
    def unit_length(self) -> float:
        return self.pose.unit_length

    def extent(self, reported: Command) -> Float[Array, "*views"]:
        return self.pose.extent(reported)

    def basis(self, base_from_tool: SE3) -> Float[Array, "*views 6 56"]:
        tool = _way(base_from_tool, self.pose.centre) / self.pose.reach
        camera = tool + _like(self.seen_from, tool) / self.pose.reach
        stretches = jnp.stack([_shift(tool), _shift(camera)], axis=-1)
        sizes = np.array([size for _, size in self.groups])
        counts = jnp.repeat(self.counts, sizes, total_repeat_length=self.size)
        basis = jnp.concatenate([self.pose.basis(base_from_tool), stretches], axis=-1)
        return basis * _like(counts, basis)


def _way(base_from_tool: SE3, centre: Float[Array, "3"]) -> Float[Array, "*views 3"]:
    """From the centre to the tool, in the tool's frame, m."""
    position = base_from_tool.translation()
    return base_from_tool.rotation().inverse() @ (position - _like(centre, position))


def _shift(way: Float[Array, "*views 3"]) -> Float[Array, "*views 6"]:
    """A twist that turns nothing."""
    return jnp.concatenate([way, jnp.zeros_like(way)], axis=-1)


def _like(vector: Float[Array, "n"], many: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    return jnp.broadcast_to(vector, many.shape)
