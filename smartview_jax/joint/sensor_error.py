"""Add the uncertainty of a depth sensor's bias to the covariance of a fit to its poses."""

import dataclasses
from typing import Any

import numpy as np

from ..dataset import PoseDataset
from ..engine import solve
from ..geometry import host_exponentials, host_transforms
from .joint_fit import JointFit


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
