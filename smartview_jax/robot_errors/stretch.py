"""Model the simplest smooth errors: a wrong scale of the robot's motion or of the target.

If all displacements of a robot are too long by one factor, its error is proportional to the
position of the *tool*. A target that is smaller than stated has the same effect, but in proportion
to the position of the *camera*. The two differ only by the rotation of the offset between tool and
camera, a very small effect; only a ruler separates them.
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
"""Name of the group with the single coefficient of the scale of the robot's displacements."""


class Stretched(AbstractField):
    """A robot error field combined with a wrong scale of all displacements that the robot reports.

    A coefficient `c` of the stretch is a relative error of `c / reach`. Linear fields can model a
    stretch too, but only together with shears of the same size: for them a robot whose scale is 10
    % too large may also be skewed by 10 %.

    Attributes:
        field: the other error, to which the stretch is added.
        centre: position of the tool that the stretch does not move, m.
        reach: distance from the centre that counts as one unit, m.
    """

    field: AbstractField
    centre: Float[Array, "3"]
    reach: Float[Array, ""]

    @classmethod
    def over(cls, field: AbstractField, base_from_tool: SE3) -> "Stretched":
        """Return the field centred on poses `(views)` and scaled by their standard deviation."""
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
        # With the unit twist a of the stretch and its coefficient s, true = field(c) exp(-s a), and
        #     field(c) exp(d) exp(-s a) = true exp(Ad(exp(s a)) d):
        # the other field's Jacobian is carried to the tool by the adjoint. That of the stretch is
        # -a.
        besides = self.field.by_coefficients(reported, coefficients[:-1])
        along = self._along(reported)
        after = SE3.exp(coefficients[-1] * along).adjoint()
        return jnp.concatenate([after @ besides, -along[..., None]], axis=-1)

    def _along(self, reported: Command) -> Float[Array, "*views 6"]:
        """Return the displacement from the centre as a twist at the tool, in units of the reach."""
        return _shift(_way(reported.base_from_tool, self.centre) / self.reach)


class PoseOrStretch(AbstractLinearField):
    """A robot error field: `LinearInPose` with stretches of tool and camera, 56 coefficients.

    A coefficient `c` of either stretch is a relative error `c / reach`, by which the displacements
    that the robot reports are longer than the true ones. The active groups are data: another
    selection needs no new compilation.

    Attributes:
        pose: the linear field; its centre and reach also apply to the stretches.
        seen_from: point in the tool frame whose positions a wrong scale of the target scales, m:
            the centre of a camera on the tool, or the origin of a target on the tool.
        counts: one for each active group and zero for the others, in the order of `groups`.
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
        # Both stretches are translations proportional to a position relative to the centre: that of
        # the tool, and that of the camera, which is offset from it by `seen_from`.
        tool = _way(base_from_tool, self.pose.centre) / self.pose.reach
        camera = tool + _like(self.seen_from, tool) / self.pose.reach
        stretches = jnp.stack([_shift(tool), _shift(camera)], axis=-1)
        sizes = np.array([size for _, size in self.groups])
        counts = jnp.repeat(self.counts, sizes, total_repeat_length=self.size)
        basis = jnp.concatenate([self.pose.basis(base_from_tool), stretches], axis=-1)
        # A zero column removes a group without changing the shape of the problem.
        return basis * _like(counts, basis)


def _way(base_from_tool: SE3, centre: Float[Array, "3"]) -> Float[Array, "*views 3"]:
    """Return the displacement from the centre to the tool, in the tool frame, m."""
    position = base_from_tool.translation()
    return base_from_tool.rotation().inverse() @ (position - _like(centre, position))


def _shift(way: Float[Array, "*views 3"]) -> Float[Array, "*views 6"]:
    """Return the twist of a pure translation."""
    return jnp.concatenate([way, jnp.zeros_like(way)], axis=-1)


def _like(vector: Float[Array, "n"], many: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Return a vector broadcast to the shape of a batch."""
    return jnp.broadcast_to(vector, many.shape)
