"""Define the types of a joint fit's options, for functions that pass them on."""

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import optimistix as optx

from ..engine import AbstractLoss, Noise, Prior
from ..robot_errors import FieldChoice, RobotPrior


class CameraOptions(TypedDict, total=False):
    """The options of `fit_joint` that also a camera alone has, as its keyword arguments."""

    loss: str | AbstractLoss | None
    fixed: Sequence[str]
    priors: Mapping[str, Prior] | None
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None


class JointOptions(CameraOptions, total=False):
    """The options of `fit_joint` that concern the fit itself, as its keyword arguments."""

    noise: str | Noise
    field: FieldChoice
    free: Sequence[str]
    devices: Sequence[Any] | None
    gross_errors: str
    robot_prior: RobotPrior | None
