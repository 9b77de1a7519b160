"""Depth sensors in a joint fit: how their depths count, and how well their biases are known.

A camera with depths weighs them, and its fit describes the sensor. A sensor that measured whole
poses was described before the fit, whose covariance grows by the uncertainty of that description.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..dataset import Dataset, DepthSensor, PoseDataset
from ..engine import DEPTH_BIAS_NAMES, Noise, ParameterChoice, solve
from ..geometry import host_exponentials, host_transforms
from ..robot_errors import FieldChoice
from ..variance import with_weighed_depths
from .joint_fit import JointFit


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


def with_sensor_error(fit: JointFit, data: PoseDataset) -> dict[str, Any]:
    """Return covariance and standard deviations with the uncertainty of the sensor's bias.

    An error of the bias moves all tracked poses together. The fit's change is found by fitting
    poses that are moved by one standard deviation of each independent part of the bias.
    """
    assert data.sensor is not None
    assert data.camera_from_world is not None
    # Columns: changes of each pose by the independent parts of the bias.
    changes = np.asarray(data.sensor_changes) @ np.linalg.cholesky(data.sensor.covariance)
    added, measured = np.zeros_like(fit.covariance), data.tracked_matrices
    for part in np.moveaxis(changes, 2, 0):
        moved = measured.copy()
        turn = np.concatenate([np.zeros_like(part[:, 3:]), part[:, 3:]], axis=1)
        moved[:, :3, :3] = (host_exponentials(turn) @ measured)[:, :3, :3]
        moved[:, :3, 3] += part[:, :3]
        observations = dataclasses.replace(
            fit.problem.observations, camera_from_world=host_transforms(moved)
        )
        problem = dataclasses.replace(fit.problem, observations=observations)
        solution, _ = solve(problem, start=fit.solution.z)
        step = np.asarray(solution.z.shared) - np.asarray(fit.solution.z.shared)
        added += np.outer(step, step)
    std = dict(fit.std)
    for name, variance in zip(fit.parameter_names, np.diagonal(added), strict=True):
        std[name] = float(np.hypot(std[name], np.sqrt(variance)))
    return {"covariance": fit.covariance + added, "std": std}
