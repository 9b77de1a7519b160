"""Robot errors about the errors that all robots of a type have in common.

Robots whose drawings are wrong (URDF, Denavit-Hartenberg parameters) share errors: the coefficients
of their error field have a mean other than zero, known from earlier robots of the type to some
covariance S. With `S = R R^T` the coefficients of the next robot are

    c = mean + R u + e,  u ~ N(0, 1)

where e is what this robot deviates from its type. A field with the coefficients (e, u) has
independent priors about zero, as every other field.
"""

import dataclasses

import numpy as np
from jaxtyping import Array, Float

from ..robots import SerialArm
from ..runtime.array_namespace import to_device_together
from .arm_errors import AbstractArmErrors

COMMON_ERROR = "common_error"
"""Group of the coefficients u: the uncertainty of the mean, in standard deviations."""


@dataclasses.dataclass(frozen=True)
class CommonErrors:
    """The errors that all robots of a type have in common, and how well they are known.

    Attributes:
        names: names of the coefficients, as those of a field of arm errors.
        mean: mean of each coefficient over the type: m, rad or no unit.
        root: a matrix R by rows, one for each coefficient; `R R^T` is the covariance of the mean.
        arm_parameters: the function of that name, of the nominal arm that has these errors.
    """

    names: tuple[str, ...]
    mean: tuple[float, ...]
    root: tuple[tuple[float, ...], ...]
    arm_parameters: tuple[str | float, ...]

    @property
    def mean_and_std(self) -> dict[str, tuple[float, float]]:
        """The mean of each coefficient by name, and the mean's standard deviation."""
        return {
            name: (mean, float(np.linalg.norm(row)))
            for name, mean, row in zip(self.names, self.mean, self.root, strict=True)
        }

    def about(self, errors: AbstractArmErrors) -> "ErrorsOfType":
        """Return the field of an arm's deviations from its type.

        Args:
            errors: field of the errors; of coefficients that it lacks the mean is left out.

        Raises:
            ValueError: the field is of another nominal arm.
        """
        if arm_parameters(errors.arm) != self.arm_parameters:
            raise ValueError(
                "robot_prior: its common errors are of robots with other Denavit-Hartenberg "
                "parameters; take the nominal arm with which those robots were calibrated"
            )
        rows = dict(zip(self.names, zip(self.mean, self.root, strict=True), strict=True))
        nothing = 0.0, (0.0,) * len(self.root[0])
        mean, root = zip(*(rows.get(name, nothing) for name in errors.names), strict=True)
        return ErrorsOfType.of(errors, np.array(mean), np.array(root))


def arm_parameters(arm: SerialArm) -> tuple[str | float, ...]:
    """Return what tells nominal arms apart: convention, kinds of joints, theta, d, a and alpha.

    The numbers are rounded to a nanometre and a nanoradian, as files of other programs may be.
    """
    rows = (arm.prismatic, arm.theta, arm.d, arm.a, arm.alpha)
    return arm.convention, *(round(float(x), 9) for row in rows for x in np.asarray(row))


class ErrorsOfType(AbstractArmErrors):
    """A robot error field of an arm's deviations from the errors that its type has in common.

    With all coefficients zero, the arm has exactly these errors.

    Attributes:
        errors: field of the whole errors.
        mean: coefficients of the errors that the type has in common.
        root: a matrix R, whose `R R^T` is the covariance of this mean.
    """

    errors: AbstractArmErrors
    mean: Float[Array, "errors"]
    root: Float[Array, "errors uncertain"]

    def __check_init__(self) -> None:
        sizes = {"mean": len(self.mean), "root": len(self.root)}
        for name, size in sizes.items():
            if size != self.errors.size:
                raise ValueError(
                    f"{name}: expected a row for each of {self.errors.size} errors, found {size}"
                )

    @classmethod
    def of(
        cls,
        errors: AbstractArmErrors,
        mean: Float[np.ndarray, "errors"],
        root: Float[np.ndarray, "errors uncertain"],
    ) -> "ErrorsOfType":
        """Return the field about a mean, of the arm of `errors`."""
        arrays = to_device_together({"mean": mean, "root": root})
        return cls(errors.arm, errors, **arrays)

    @property
    def groups(self) -> tuple[tuple[str, int], ...]:
        return (*self.errors.groups, (COMMON_ERROR, self.root.shape[1]))

    @property
    def names(self) -> tuple[str, ...]:
        uncertain = (f"{COMMON_ERROR}.{1 + k}" for k in range(self.root.shape[1]))
        return (*self.errors.names, *uncertain)

    @property
    def nested_fields(self) -> tuple[AbstractArmErrors, ...]:
        """The fields with fewer groups, as far as the type's mean has no others."""
        mean, root = np.asarray(self.mean), np.asarray(self.root)
        has_mean = (mean != 0.0) | (root != 0.0).any(axis=1)
        last = int(np.flatnonzero(has_mean).max(initial=-1))
        return tuple(
            ErrorsOfType.of(part, mean[: part.size], root[: part.size])
            for part in self.errors.nested_fields
            if isinstance(part, AbstractArmErrors) and part.size > last
        )

    @property
    def whole(self) -> AbstractArmErrors:
        return self.errors

    @property
    def by_coefficients(self) -> Float[np.ndarray, "errors coefficients"]:
        return np.concatenate([np.eye(self.errors.size), np.asarray(self.root)], axis=1)

    @property
    def without_errors(self) -> Float[np.ndarray, "coefficients"]:
        return np.append(-np.asarray(self.mean), np.zeros(self.root.shape[1]))

    def host_whole(
        self, coefficients: Float[np.ndarray, "coefficients"]
    ) -> Float[np.ndarray, "errors"]:
        return np.asarray(self.mean) + self.by_coefficients @ coefficients

    def _whole(self, coefficients: Float[Array, "coefficients"]) -> Float[Array, "errors"]:
        """Return the coefficients of `errors`, with the type's mean."""
        own, common = coefficients[: self.errors.size], coefficients[self.errors.size :]
        return self.mean + own + self.root @ common

    def actual_arm(self, coefficients: Float[Array, "coefficients"]) -> SerialArm:
        return self.errors.actual_arm(self._whole(coefficients))

    def joint_scale_factors(
        self, coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "joints"]:
        return self.errors.joint_scale_factors(self._whole(coefficients))

    def joint_deflections(
        self, joints: Float[Array, "*views joints"], coefficients: Float[Array, "coefficients"]
    ) -> Float[Array, "*views joints"]:
        return self.errors.joint_deflections(joints, self._whole(coefficients))
