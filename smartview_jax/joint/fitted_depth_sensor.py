"""Describe the depth sensor of a camera by a joint fit: its bias, with uncertainty, and noise."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Dataset, DepthSensor
from ..engine import DEPTH_BIAS_NAMES


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
    own = [f"{camera}{name}" for name in DEPTH_BIAS_NAMES]
    # A held parameter has no uncertainty.
    rows = [names.index(name) if name in names else -1 for name in own]
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
