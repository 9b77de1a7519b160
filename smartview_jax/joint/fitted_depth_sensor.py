"""Weigh the depths of a camera for a joint fit, and describe its depth sensor by the result."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Dataset, DepthSensor
from ..engine import DEPTH_BIAS_NAMES, Noise, ParameterChoice
from ..robot_errors import FieldChoice
from ..variance import with_weighed_depths


def fitted_depth_sensor(
    data: Dataset,
    calibration: Calibration,
    names: Sequence[str],
    covariance: Float[np.ndarray, "free free"],
    camera: str = "",
) -> DepthSensor | None:
    """Return bias and noise of the depths at the points; None without a depth sensor.

    Args:
        data: the camera's data set.
        calibration: its calibration by the fit.
        names: names of the free parameters.
        covariance: their covariance.
        camera: start of the names of this camera's parameters, such as "left." in a rig.
    """
    bias, noise = calibration.depth_bias, data.depth_noise
    if bias is None or noise is None:
        return None
    bias_names = [f"{camera}{name}" for name in DEPTH_BIAS_NAMES]
    # A held parameter has no uncertainty.
    rows = [names.index(name) if name in names else -1 for name in bias_names]
    padded = np.pad(covariance, (0, 1))
    scale_std, offset_std = map(float, np.sqrt(np.diagonal(padded)[rows]))
    product = scale_std * offset_std
    correlation = float(padded[rows[0], rows[1]]) / product if product else 0.0
    return DepthSensor(
        float(bias.scale),
        float(bias.offset),
        scale_std,
        offset_std,
        correlation,
        None,
        noise.constant,
        noise.quadratic,
        noise.common or 0.0,
    )


def weighed_depths(
    data: Dataset,
    start: Calibration,
    choice: ParameterChoice,
    noise: str | Noise,
    field: FieldChoice,
) -> Dataset:
    """Return the data with depths that count relative to the pixels' noise, stated or not."""
    if not isinstance(noise, Noise):
        return with_weighed_depths(data, start, choice, field)
    own_field = start.field if field == "auto" else field
    return with_weighed_depths(data, start, choice, own_field, noise.within_view_pixel)
