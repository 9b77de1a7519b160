"""Provide priors on the standard deviations of robot errors, known before any picture is taken.

A flexible error field can absorb almost any fault of a calibration: a board of another size,
mirrored pictures, plain noise in few views. But the errors of real arms are limited, and their
limits are known. They enter the likelihood as log-normal priors on the standard deviations of the
errors: the median is typical of a good industrial arm, and a factor of `geometric_std` is one
standard deviation of the logarithm.

Sources: ISO 9283 repeatability in makers' data sheets of arms up to 20 kg payload is 0.01 to 0.1
mm. Absolute accuracy before kinematic calibration is 0.3 to several mm. Its largest part are joint
zeros wrong by 0.01 to 1 degree; link lengths and twists contribute some tenths of a mm and of a
milliradian (Mooring, Roth and Driels, Fundamentals of Manipulator Calibration, 1991; Nubiola and
Bonev, Absolute calibration of an ABB IRB 1600 robot using a laser tracker, 2013).

Some robots are far less accurate: light arms, arms that still move when the picture is taken, poses
that were logged at another time. They are a separate hypothesis with its own medians, not the tail
of the prior of good arms: in that tail, every halving of the noise would seem many times as likely.

Repeatability differs by direction, because noise of the joints reaches the tool through the arm's
Jacobian. For five arms with six joints, whose joints differ in repeatability by a factor of e, the
mean covariance over 20 views has axes that deviate from their mean by a factor of 1.4 (in axes of
the base) or 1.3 (of the tool). Robots with fewer or other joints (SCARA arms, gantries) deviate by
more, as does an arm with one worn joint. A third of all robots are taken to differ by direction, by
a factor of 1.6.

Targets are a part of the robot's world. Printed sheets on boards bow by 0.1 to 0.3 mm over 0.2 to
0.4 m, glass and milled plates by a hundredth of it; printers stretch one axis by some 0.1 % more
than the other (Strobl and Hirzinger, More accurate pinhole camera calibration with imperfect planar
target, 2011; Kogan, mrcal: deformation of the board, 2021).
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from .arm_errors import AbstractArmErrors
from .common_errors import COMMON_ERROR, CommonErrors
from .field import AbstractField

_GROUP_MEDIANS: Mapping[str, float] = MappingProxyType(
    {
        # Per metre of displacement: a zero that is wrong by a milliradian moves the tool by 1 mm
        # per metre.
        "translation_by_position": 1e-3,
        "rotation_by_position": 2e-3,
        # Per square metre: the load on a joint, and with it an error of a milliradian, changes
        # within a metre.
        "translation_by_square": 1e-3,
        "rotation_by_square": 1e-3,
        # Per radian of rotation: a wrong wrist axis moves a tool of 0.3 m by 0.3 mm.
        "translation_by_orientation": 3e-4,
        "rotation_by_orientation": 1e-3,
        # Errors of the arm itself: rad, no unit, m, rad, and rad under the arm's own weight.
        "joint_offset": 1e-3,
        "joint_ratio": 1e-3,
        "link_length": 3e-4,
        "link_twist": 5e-4,
        "joint_compliance": 5e-4,
        # Relative errors of the scale, which in an arm is correct within half a percent.
        "translation_by_stretch": 5e-3,
        "translation_by_scale": 5e-3,
    }
)

_PER_METRE_GROUPS = frozenset(
    {
        "translation_by_position",
        "rotation_by_position",
        "translation_by_stretch",
        "translation_by_scale",
    }
)
"""Groups whose medians are per metre; a field's coefficients are per reference length."""

_PER_SQUARE_METRE_GROUPS = frozenset({"translation_by_square", "rotation_by_square"})
"""Groups whose medians are per square metre."""


KNOWN_GEOMETRIC_STD = 1.01
"""Exp of the standard deviation of the logarithm of a standard deviation that is known."""


@dataclasses.dataclass(frozen=True)
class RobotPrior:
    """The log-normal priors on the standard deviations of a robot's errors.

    Attributes:
        translation_median: median repeatability of a reported position, per axis, m.
        rotation_median: median repeatability of a reported orientation, per axis, rad.
        group_medians: median standard deviation of each named group of an error field: m, rad or
            no unit, and per metre of displacement for groups that grow with the position.
        other_group_median: median for groups of a field that `group_medians` does not name.
        geometric_std: exp of the standard deviation of the logarithm, for repeatability.
        group_geometric_std: the same for groups of a field.
        other_group_geometric_std: the same for groups that `group_medians` does not name.
        weak_robot_probability: probability of a robot whose reported poses scatter by millimetres.
        weak_translation_median: median repeatability of such a robot's position, per axis, m.
        weak_rotation_median: median repeatability of its orientation, per axis, rad.
        wrong_target_probability: probability that the target is not of its stated size.
        wrong_target_scale_std: standard deviation of the logarithm of the ratio of true to stated
            size of such a target.
        target_bow_median: median displacement of a flat target's edge out of its plane, in parts
            of half its longer side; zero, as for the next, for a target that is exactly flat.
        target_print_median: median displacement of its edge within its plane, by a different
            stretch of both axes and by shear, in the same unit.
        target_geometric_std: exp of the standard deviation of the logarithms of both.
        wrong_lens_probability: probability that the lens deviates from its model; zero skips this
            hypothesis. The covariance of the transforms includes the effect of such a lens.
        directional_probability: probability that poses without a smooth error err more in some
            directions than in others, as with a SCARA arm, a lift, or an arm with a worn joint;
            zero, or a fit without smooth errors (`field=None`), skips this hypothesis.
        directional_geometric_std: exp of the standard deviation of the logarithm of the error along
            an axis of such a robot, about the mean over its axes.
        model_odds: prior odds of the models of the robot error by name (`"white"` for noise of the
            poses alone, or a field's name), as known of a type of robot; by default, and for models
            that it does not name, the odds for any robot.
        geometric_std_by_name: exp of the standard deviation of the logarithm, of `"translation"`,
            `"rotation"` and groups by name, where it differs from the values above.
        common_errors: errors that all robots of the type have in common; the standard deviations
            above are then about these. None for a robot of any type, whose errors have mean zero.
    """

    translation_median: float = 5e-5
    rotation_median: float = 1e-4
    group_medians: Mapping[str, float] = dataclasses.field(default_factory=lambda: _GROUP_MEDIANS)
    other_group_median: float = 1e-3
    geometric_std: float = float(np.e)
    group_geometric_std: float = float(np.exp(0.9))
    other_group_geometric_std: float = float(np.exp(3.0))
    weak_robot_probability: float = 0.01
    weak_translation_median: float = 5e-3
    weak_rotation_median: float = 1.7e-2
    wrong_target_probability: float = 0.01
    wrong_target_scale_std: float = 0.5
    target_bow_median: float = 5e-4
    target_print_median: float = 2e-4
    target_geometric_std: float = float(np.exp(1.2))
    wrong_lens_probability: float = 0.5
    directional_probability: float = 1.0 / 3.0
    directional_geometric_std: float = float(np.exp(0.5))
    model_odds: Mapping[str, float] = dataclasses.field(default_factory=dict)
    geometric_std_by_name: Mapping[str, float] = dataclasses.field(default_factory=dict)
    common_errors: CommonErrors | None = None

    def __post_init__(self) -> None:
        positive = (
            "translation_median",
            "rotation_median",
            "other_group_median",
            "weak_translation_median",
            "weak_rotation_median",
            "wrong_target_scale_std",
        )
        named = {name: getattr(self, name) for name in positive}
        for mapping in ("group_medians", "model_odds"):
            values = getattr(self, mapping).items()
            named |= {f"{mapping}[{name!r}]": value for name, value in values}
        for name, value in named.items():
            if not 0.0 < value < np.inf:
                raise ValueError(f"RobotPrior.{name}: expected a positive number, found {value}")
        factors = (
            "geometric_std",
            "group_geometric_std",
            "other_group_geometric_std",
            "target_geometric_std",
            "directional_geometric_std",
        )
        named = {name: getattr(self, name) for name in factors}
        by_name = self.geometric_std_by_name.items()
        named |= {f"geometric_std_by_name[{name!r}]": value for name, value in by_name}
        for name, value in named.items():
            if not 1.0 < value < np.inf:
                raise ValueError(f"RobotPrior.{name}: expected a factor above 1, found {value}")
        for name in (
            "weak_robot_probability",
            "wrong_target_probability",
            "wrong_lens_probability",
            "directional_probability",
        ):
            value = getattr(self, name)
            if not 0.0 <= value < 1.0:
                raise ValueError(
                    f"RobotPrior.{name}: expected a probability below 1, found {value}"
                )

        shape = self.target_bow_median, self.target_print_median
        if not (min(shape) > 0.0 or shape == (0.0, 0.0)) or not np.isfinite(shape).all():
            raise ValueError(
                f"RobotPrior.target_bow_median, target_print_median: expected two positive "
                f"numbers, or zero twice, found {shape[0]} and {shape[1]}"
            )

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle: Python cannot pickle a read-only view of a dictionary."""
        return vars(self) | {"group_medians": dict(self.group_medians)}

    def about_type(self, field: AbstractField | None) -> AbstractField | None:
        """Return a field about the errors of the type; other fields than an arm's stay as they are.

        Raises:
            ValueError: the field is of another nominal arm than the common errors.
        """
        if self.common_errors is None or not isinstance(field, AbstractArmErrors):
            return field
        return field if field.is_about_type else self.common_errors.about(field)

    @property
    def target_is_flat(self) -> bool:
        """Whether flat targets are exactly flat, and printed without any distortion."""
        return self.target_bow_median == 0.0

    def medians(self, field: AbstractField | None) -> Float[np.ndarray, "kinds"]:
        """Return the median standard deviations of translation, rotation and each field group."""
        reference_length = 1.0 if field is None else field.reference_length
        names = () if field is None else field.group_names
        # A coefficient of a position-dependent group is the error at the field's reference length,
        # hence median per metre times reference length.
        group_medians = [
            1.0
            if name == COMMON_ERROR
            else self.group_medians.get(name, self.other_group_median)
            * reference_length ** _length_power(name)
            for name in names
        ]
        return np.array([self.translation_median, self.rotation_median, *group_medians])

    def log_stds(self, field: AbstractField | None) -> Float[np.ndarray, "kinds"]:
        """Return the standard deviations of the logarithms, in the order of `medians`."""
        names = ("translation", "rotation", *(() if field is None else dict(field.groups)))
        # x is log-normal with geometric standard deviation g: log x has the std log g.
        return np.log([self.geometric_std_of(name) for name in names])

    def geometric_std_of(self, name: str) -> float:
        """Return exp of the standard deviation of the logarithm of one standard deviation.

        Args:
            name: `"translation"`, `"rotation"` or the name of a group.
        """
        if name == COMMON_ERROR:
            return KNOWN_GEOMETRIC_STD
        if name in self.geometric_std_by_name:
            return self.geometric_std_by_name[name]
        if name in ("translation", "rotation"):
            return self.geometric_std
        known = name in self.group_medians
        return self.group_geometric_std if known else self.other_group_geometric_std


def _length_power(group: str) -> int:
    """Return the power of a length by which the errors of a group grow with the displacement."""
    return (group in _PER_METRE_GROUPS) + 2 * (group in _PER_SQUARE_METRE_GROUPS)
